"""Through geometry and medium: results of an operator that are differentiable in its points and in its medium.

What follows from the weak pair (eigenpairs, flows, solves, products with K and M, the mass) is differentiable in both:
its gradient is that of a sum of bilinear forms (`PairPlan.bilinear`). Rows of Δ and ∇, frames and normals are evaluated
again for a gradient. All else raises an error where a derivative is asked for: no gradient is zero, or lacks a part, in
silence (`method.md`, section 14).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from torchlb.errors import DerivativeError, first_few, warn
from torchlb.galerkin.forms import BilinearForm
from torchlb.galerkin.matrices import PairMatrices
from torchlb.galerkin.medium import Field
from torchlb.linalg.csr import side_by_side, tensors_of
from torchlb.linalg.devices import default
from torchlb.linalg.once import once_differentiable
from torchlb.linalg.precision import LOW, ROOT_EPS, ROUNDING, TINY
from torchlb.operator.batching import shapes_of
from torchlb.operator.medium import plain
from torchlb.operator.systems import pair_system
from torchlb.spectral.eigenbasis import Eigenbasis, unstack_eigenbases

BEYOND = 10
"""Number of pairs beyond those asked for, which keep the solves for derivatives of eigenvectors well-conditioned."""
Forms = Callable[..., Sequence[BilinearForm]]
"""From the gradients of results the bilinear forms whose sum has their derivative."""


class _Origin(NamedTuple):
    """What the weak pair of one shape, of this size, follows from: points, a medium, and bilinear forms of both."""

    size: int
    points: Tensor
    medium: dict[str, Field]
    bilinear: Callable[..., Tensor] | None
    weak: PairMatrices

    @property
    def variables(self) -> list[Tensor]:
        """The points and fields that require a gradient."""
        every = [self.points, *(field.values for field in self.medium.values())]
        return [t for t in every if t.requires_grad]

    @property
    def device(self) -> torch.device:
        """Where the forms are computed: where points are that require a gradient, else on the CPU."""
        return self.points.device if self.points.requires_grad else torch.device("cpu")

    def gradient(self, forms: Sequence[BilinearForm]) -> list[Tensor]:
        """The derivative of a sum of forms in the variables; DerivativeError where it is not finite."""
        medium, root = plain(self.medium, self.device), self.weak.root_of_absorption
        energies = [form for form in forms if form.name == "energy"]
        forms = [form for form in forms if form.name != "energy"]
        forms += [form._replace(name="stiffness") for form in energies]
        if "potential" in medium:
            forms += [form._replace(name="potential") for form in energies]
        if root is not None:
            root = root.to(self.device)
            forms += [BilinearForm("boundary", root * w, root * u, c) for _, w, u, c, _ in energies]
        leaves = [f.values for name, f in medium.items() if self.medium[name].values.requires_grad]
        points = self.points.detach().double().requires_grad_()
        moved = [points] if self.points.requires_grad else []
        with torch.enable_grad(), default(self.device):
            assert self.bilinear is not None
            total = self.bilinear(*moved, forms, medium)
            found = [torch.zeros_like(leaf) for leaf in (*moved, *leaves)]
            if total.requires_grad:  # M does not depend on the conductivity, for example
                found = torch.autograd.grad(total, [*moved, *leaves], materialize_grads=True)
        return [_finite(g).to(v) for g, v in zip(found, self.variables, strict=True)]


def _finite(gradient: Tensor) -> Tensor:
    """The gradient in points or faces; DerivativeError where it is not finite."""
    if len(bad := (~gradient.isfinite()).nonzero()[:, 0].unique()):
        raise DerivativeError(
            f"points or medium: the derivative at {len(bad)} points or faces ({first_few(bad)}) is not finite, as "
            "where all cells of a point are degenerate, which can be removed or merged, or where they meet at a right "
            "angle, which leaves open what the tangent plane is: a small displacement helps"
        )
    return gradient


class Origins(list[_Origin]):
    """The origins of the shapes of a batch, or of one shape."""

    @property
    def variables(self) -> list[Tensor]:
        """All points and fields that require a gradient."""
        return [v for part in self for v in part.variables]

    def gradient(self, forms: Sequence[BilinearForm]) -> list[Tensor]:
        """The derivative of a sum of bilinear forms in the variables."""
        sizes = [part.size for part in self]
        functions = {id(f): f for form in forms for f in (form.w, form.u)}
        rows = {k: f.detach().double().split(sizes) for k, f in functions.items()}
        found = []
        for s, part in enumerate(self):
            if part.variables:
                own = {k: f[s].to(part.device) for k, f in rows.items()}
                own |= {id(f.c): f.c.to(part.device).double() for f in forms}
                parts = [f._replace(**{n: own[id(getattr(f, n))] for n in "wuc"}) for f in forms]
                found += part.gradient(parts)
        return found


def origins(lb: Any) -> Origins | None:
    """What an operator's weak pair is differentiable in, if anything; DerivativeError where a batch lost its shapes."""
    held = [lb.points, *tensors_of(lb._medium).values()]
    carries = lb._carries or any(t.requires_grad for t in held)
    if not (carries and torch.is_grad_enabled()):
        return None
    shapes = shapes_of(lb) or (lb,)
    if any(shape.sizes is not None and shape._carries for shape in shapes):
        raise DerivativeError(
            "a batch that was copied, cast or moved does not know the shapes whose points or medium require gradients; "
            "move the shapes, and batch them then"
        )
    found = Origins()
    for shape in shapes:
        medium = shape._medium.fields(len(shape.points))
        origin = _Origin(shape.num_points, shape.points, medium, None, shape.weak)
        found.append(origin._replace(bilinear=shape._bilinear()) if origin.variables else origin)
    return found


class _Known(torch.autograd.Function):
    """Values that are known, with a function from their gradients to those of the variables that they follow from."""

    @staticmethod
    def forward(ctx: Any, gradient: Any, count: int, *given: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.save_for_backward(*given[count:])
        ctx.gradient, ctx.count = gradient, count
        return tuple(value.clone() for value in given[:count])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return None, None, *[None] * ctx.count, *ctx.gradient(*grads)


def _following(
    values: Sequence[Tensor], gradient: Callable[..., list[Tensor]], *variables: Tensor
) -> Sequence[Tensor]:
    given = [value.detach() for value in values]
    return _Known.apply(gradient, len(given), *given, *variables)  # pyright: ignore[reportReturnType]


def known(lb: Any, results: Sequence[Tensor], forms: Forms) -> Sequence[Tensor]:
    """Results with their derivatives in the operator's variables, by the forms that gradients make."""
    found = origins(lb)
    if found is None:
        return results

    def gradient(*grads: Tensor) -> list[Tensor]:
        return found.gradient(forms(*(g.double() for g in grads)))

    return _following(results, gradient, *found.variables)


def without(lb: Any, x: Tensor, what: str) -> Tensor:
    """x, by which nothing is differentiable in points or medium: DerivativeError where that is asked for."""

    def refused(g: Tensor) -> list[BilinearForm]:
        raise DerivativeError(
            f"{what}: no derivative in the points or in the medium; eigenpairs, flows, solves, the mass, "
            "lb.product(name, f), Δf and ∇f have one. For derivatives in f, take an operator at points.detach()"
        )

    return x if origins(lb) is None else x + known(lb, [torch.zeros_like(x)], refused)[0]


def carrying(lb: Any, points: Any) -> Any:
    """The operator; where points require a gradient, it comes by what has one, and errors by all else.

    Raises DerivativeError where nothing of the operator has a derivative.
    """
    if not (isinstance(points, Tensor) and points.requires_grad and torch.is_grad_enabled()):
        return lb
    if not lb._has_weak_form or len(lb.plan.moved):
        raise DerivativeError(
            "points: they require gradients, which there are none of without a weak pair and of noisy curves, whose "
            "points are moved; pass points.detach() if results may be constants of them"
        )
    plan, one = lb.plan, torch.ones_like(lb.mass.detach().double())[:, None]
    lb.points = own = points.to(lb.points).view_as(lb.points)  # a buffer is no Parameter

    def of_mass(g: Tensor) -> list[BilinearForm]:
        return [BilinearForm("lumped", one, g[:, None], one[0])]

    def of_rows(*grads: Tensor) -> list[Tensor]:
        with torch.enable_grad(), default(own.device):  # a reference to lb would keep it alive
            leaves = [v.detach().double().requires_grad_() for v in variables]
            found = plan.rows_at(leaves[0], (leaves[1:] or [mass])[0])
            scaled = [g.to(f) for g, f in zip(grads, found, strict=True)]
            gradients = torch.autograd.grad(found, leaves, scaled, materialize_grads=True)
        return [_finite(g).to(v) for g, v in zip(gradients, variables, strict=True)]

    (lb.mass,) = known(lb, [lb.mass], of_mass)
    mass = lb.mass.detach().double()
    of_robin = lb.weak.near.values[3:4].any()  # whose low-order rows have the mass in them
    variables = [own, lb.mass] if of_robin else [own]
    rows = [lb.stencil.values, lb.frames]
    rows += [lb.normals, lb._shape_operators] if len(lb.normals) else []
    lb.stencil.values, lb.frames, *rest = _following(rows, of_rows, *variables)
    if rest:
        lb.normals, lb._shape_operators = rest
    return lb


def through_product(lb: Any, name: Any, f: Tensor, result: Tensor) -> Tensor:
    """The product of a matrix and f with its derivative in points and medium."""
    if name == "laplacian" or origins(lb) is None:  # the values of Δ have derivatives of their own
        return result
    kind: Any = "boundary" if name == "boundary_mass" else name
    other = side_by_side(f.detach().double())

    def forms(g: Tensor) -> list[BilinearForm]:
        return [BilinearForm(kind, side_by_side(g), other, torch.ones_like(other[0]))]

    return result + known(lb, [torch.zeros_like(result)], forms)[0]


def through_eigenpairs(lb: Any, whole: Eigenbasis, k: int) -> Eigenbasis:
    """The first k pairs of a basis, differentiable in the variables of the operator.

    Of eigenvectors, what does not depend on the basis of an eigenspace (signatures, filters Φg(Λ)ΦᵀM, projectors) has
    exact gradients; so have symmetric functions of the eigenvalues of a cluster. Eigenvalues are spread for that.
    """
    if origins(lb) is None:
        return whole.truncate(k)
    whole = replace(whole, eigenvalues=_spread(whole.eigenvalues))
    basis = whole.truncate(k)
    shapes, wholes = shapes_of(lb) or (lb,), unstack_eigenbases(whole)
    sizes = [shape.num_points for shape in shapes]

    def forms(values: Tensor, vectors: Tensor, left: Tensor) -> list[BilinearForm]:
        grads = values.view(len(shapes), -1), vectors.split(sizes), left.split(sizes)
        parts = [_of_shape(*row) for row in zip(shapes, wholes, *grads, strict=True)]
        most = max(part[0].shape[1] for part in parts)
        w, of_mass, u = (
            torch.cat([pad(own, (0, most - own.shape[1])) for own in column])
            for column in zip(*parts, strict=True)
        )
        one = torch.ones(most, dtype=torch.float64)
        return [BilinearForm("energy", w, u, one), BilinearForm("mass", of_mass, u, one)]

    results = basis.eigenvalues, basis.eigenvectors, basis.left
    values, vectors, left = known(lb, results, forms)
    return Eigenbasis(values, vectors, lb.mass, left, basis.sizes, basis.relative_errors)


def _spread(values: Float[Tensor, "*S k"]) -> Float[Tensor, "*S k"]:
    """Eigenvalues, moved apart by some 1e-9 where they agree, so that quotients of differences are derivatives.

    >>> (_spread(torch.tensor([0.0, 2.0, 2.0], dtype=torch.float64)) / 2 - 1)[1:] > 1e-9
    tensor([False,  True])
    """
    step = LOW * ROOT_EPS * torch.arange(values.shape[-1], device=values.device).double()
    apart = ((values.double().log() - step).cummax(-1).values + step).exp()
    return torch.where(apart > (1 + ROUNDING) * values, apart, values.double()).to(values)


def _of_shape(
    lb: Any,
    whole: Eigenbasis,
    of_values: Float[Tensor, " k"],
    of_vectors: Float[Tensor, "N k"],
    of_left: Float[Tensor, "N k"],
) -> tuple[Float[Tensor, "N m"], Float[Tensor, "N m"], Float[Tensor, "N m"]]:
    """Functions w and v with the derivative Σ_i w_iᵀdK φ_i + v_iᵀdM φ_i of a result, and all known φ.

    Inside the span of the m known eigenvectors it takes quotients of differences, broadened where rounding of the type
    of the eigenvectors decides; outside, a solve for each vector (Nelson 1976).
    """
    phi, lam = whole.eigenvectors.double(), whole.eigenvalues.double()
    count = min(of_values.shape[0], len(lam))
    more, own = (0, len(lam) - count), of_values[:count] * phi[:, :count]
    w, v = pad(own, more), pad(-lam[:count] * own, more)
    if not (of_vectors.any() or of_left.any()):
        return w, v, phi
    solver = pair_system(lb)
    left = solver.inside(of_left[:, :count])  # MΦ is zero at Dirichlet points
    v += pad(left, more)
    gradient = of_vectors[:, :count] + solver.mass_product(left)
    inside = pad(phi.T @ gradient, more)  # φ_jᵀḡ_i
    gap, width = lam - lam[:, None], torch.finfo(whole.eigenvectors.dtype).eps ** 0.75 * lam
    close = ((gap.abs() < width / LOW) & (lam > 0)).triu(1)[:count].any(0)
    if close.any():
        warn(
            f"eigenbasis: {int(close.sum())} eigenvalues ({first_few(close.nonzero()[:, 0])}) agree with others to the "
            f"rounding of {whole.eigenvectors.dtype}; derivatives of what eigenvectors turn into each other there are "
            "not exact; take the operator in float64"
        )
    turning = (inside - inside.T) * gap / (gap.square() + width.square()).clamp_min(TINY) / 2
    w += phi @ turning
    v -= phi @ (turning * (lam + lam[:, None]) / 2 + (inside + inside.T) / 4)
    free = lb.num_points if lb.fixed is None else int((~lb.fixed).sum())
    if len(lam) >= free:
        return w, v, phi
    outside = solver.solve_beyond(gradient, lam[:count], phi, lam[-1])
    w -= pad(outside, more)
    v += pad(lam[:count] * outside, more)
    return w, v, phi
