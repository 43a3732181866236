"""Through geometry and medium: results of an operator that are differentiable in its points and in its medium.

What follows from the weak pair (eigenpairs, flows, solves, products with K and M, the mass) is differentiable in both:
its gradient is that of a sum of bilinear forms (`PairPlan.bilinear`). Rows of Δ and ∇, frames and normals are evaluated
again for a gradient. All else raises an error where a derivative is asked for: no gradient is zero, or lacks a part, in
silence.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchlb.errors import DerivativeError, first_few
from torchlb.galerkin.bilinear import BilinearForm
from torchlb.galerkin.medium import Field
from torchlb.linalg.csr import side_by_side, tensors_of
from torchlb.linalg.once import once_differentiable
from torchlb.operator.batching import shapes_of
from torchlb.operator.medium import elements_of, plain
from torchlb.operator.parts import PairMatrices

Forms = Callable[..., Sequence[BilinearForm]]
"""From the gradients of results the bilinear forms whose sum has their derivative."""


class _Origin(NamedTuple):
    """What the weak pair of one shape follows from: a plan at points that require a gradient, or elements; a medium."""

    points: Tensor
    medium: dict[str, Field]
    evaluated: Any
    weak: PairMatrices

    @property
    def variables(self) -> list[Tensor]:
        """The points and fields that require a gradient."""
        every = [self.points, *(field.values for field in self.medium.values())]
        return [t for t in every if t.requires_grad]

    def gradient(self, forms: Sequence[BilinearForm]) -> list[Tensor]:
        """The derivative of a sum of forms in the variables; DerivativeError where it is not finite."""
        medium, root = plain(self.medium), _root_of_absorption(self.weak)
        forms = [part for form in forms for part in self._parts(form, root)]
        points = self.points.detach().cpu().double()
        if self.points.requires_grad:
            points.requires_grad_()
        leaves = [f.values for name, f in medium.items() if self.medium[name].values.requires_grad]
        with torch.enable_grad():
            if self.points.requires_grad:
                leaves = [points, *leaves]
                total = self.evaluated.bilinear(points, forms, medium)
            else:
                total = self.evaluated.bilinear(forms, medium)
            found = [torch.zeros_like(leaf) for leaf in leaves]
            if total.requires_grad:  # M does not depend on the conductivity, for example
                found = torch.autograd.grad(total, leaves, materialize_grads=True)
        return [_finite(g).to(v) for g, v in zip(found, self.variables, strict=True)]

    def _parts(self, form: BilinearForm, root: Tensor | None) -> list[BilinearForm]:
        """The forms that a form is the sum of; of a Robin condition `root` has √a at the vertices, (N, 1)."""
        if form.name != "energy":
            return [form]
        parts = [form._replace(name="stiffness")]
        if "potential" in self.medium:
            parts.append(form._replace(name="potential"))
        if root is not None:
            parts.append(BilinearForm("boundary", root * form.w, root * form.u, form.c))
        return parts


def _finite(gradient: Tensor) -> Tensor:
    """The gradient in points or faces; DerivativeError where it is not finite."""
    bad = (~gradient.isfinite()).nonzero()[:, 0].unique()
    if len(bad):
        raise DerivativeError(
            f"points or medium: the derivative at {len(bad)} points or faces ({first_few(bad)}) is not finite, as "
            "where all cells of a point are degenerate; remove these, or merge their corners"
        )
    return gradient


class Origins(NamedTuple):
    """The origins of a shape, or of all shapes of a batch with their numbers of points."""

    parts: list[_Origin]
    sizes: list[int]

    @property
    def variables(self) -> list[Tensor]:
        """All points and fields that require a gradient."""
        return [v for part in self.parts for v in part.variables]

    def gradient(self, forms: Sequence[BilinearForm]) -> list[Tensor]:
        """The derivative of a sum of bilinear forms in the variables."""
        rows: dict[int, tuple[Tensor, ...]] = {}
        for f in (f for form in forms for f in (form.w, form.u)):
            rows[id(f)] = f.detach().cpu().double().split(self.sizes)
        found = []
        for s, part in enumerate(self.parts):
            if part.variables:
                own = [
                    BilinearForm(f.name, rows[id(f.w)][s], rows[id(f.u)][s], f.c.cpu().double())
                    for f in forms
                ]
                found += part.gradient(own)
        return found


def origins(lb: Any) -> Origins | None:
    """What the weak pair of an operator is differentiable in; None if nothing of it requires a gradient.

    Raises DerivativeError for a batch whose shapes are no longer known.
    """
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
    parts = []
    for shape in shapes:
        moved, medium = shape.points.requires_grad, shape._medium.fields(len(shape.points))
        constant = not moved and not any(f.values.requires_grad for f in medium.values())
        evaluated = None if constant else shape.plan if moved else elements_of(shape)
        parts.append(_Origin(shape.points, medium, evaluated, shape.weak))
    return Origins(parts, [shape.num_points for shape in shapes])


def _root_of_absorption(weak: PairMatrices) -> Tensor | None:
    """√a of a Robin condition, from R_ii = a_i B_ii; None for another condition."""
    if not weak.values[3:4].any():
        return None
    values = weak.values[:, weak.row == weak.col].cpu().double()
    return torch.where(values[2] != 0, values[3] / values[2], 0.0).clamp_min(0).sqrt()[:, None]


class _Known(torch.autograd.Function):
    """Results that are known, with their derivative in the variables of an operator."""

    @staticmethod
    def forward(ctx: Any, found: Origins, forms: Forms, count: int, *given: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.save_for_backward(*given[count:])
        ctx.found, ctx.forms, ctx.count = found, forms, count
        return tuple(result.clone() for result in given[:count])

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        forms = ctx.forms(*(g.double() for g in grads))
        return None, None, None, *[None] * ctx.count, *ctx.found.gradient(forms)


class _Rows(torch.autograd.Function):
    """Rows, frames and normals that are known, evaluated again for their derivative in the points."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, plan: Any, *known: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.save_for_backward(points)
        ctx.plan = plan
        return tuple(each.clone() for each in known)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (points,) = ctx.saved_tensors
        with torch.enable_grad():
            x = points.detach().cpu().double().requires_grad_()
            found = ctx.plan.rows_at(x)
            (gradient,) = torch.autograd.grad(
                found, x, [g.to(f) for g, f in zip(grads, found, strict=True)]
            )
        return _finite(gradient).to(points), None, *[None] * len(grads)


class _Refused(torch.autograd.Function):
    """A value that depends on points or medium in a way that is not differentiated."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, what: str, *variables: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.what = what
        return value.clone()

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        raise DerivativeError(
            f"{ctx.what}: no derivative in the points or in the medium; eigenpairs, flows, solves, the mass, "
            "lb.product(name, f), Δf and ∇f have one. For derivatives in f, take an operator at points.detach()"
        )


def refused(value: Tensor, what: str, *variables: Tensor) -> Tensor:
    """The value, which raises DerivativeError where its derivative in the variables is asked for."""
    return _Refused.apply(value.detach(), what, *variables)  # pyright: ignore[reportReturnType]


def known(lb: Any, results: Sequence[Tensor], forms: Forms) -> Sequence[Tensor]:
    """Results with their derivatives in the operator's variables, by the forms that gradients make."""
    found = origins(lb)
    if found is None:
        return results
    given = [result.detach() for result in results]
    return _Known.apply(found, forms, len(given), *given, *found.variables)  # pyright: ignore[reportReturnType]


def without(lb: Any, x: Tensor, what: str) -> Tensor:
    """x, by which nothing is differentiable in points or medium: DerivativeError where that is asked for."""
    found = origins(lb)
    return x if found is None else x + refused(torch.zeros_like(x), what, *found.variables)


def carrying(lb: Any, points: Any) -> Any:
    """The operator; where points require a gradient, it comes by what has one, and errors by all else.

    Raises
    ------
    DerivativeError
        Where nothing of the operator has a derivative.
    """
    if not (isinstance(points, Tensor) and points.requires_grad and torch.is_grad_enabled()):
        return lb
    if not lb._has_weak_form or len(lb.plan.moved):
        raise DerivativeError(
            "points: they require gradients, which there are none of without a weak pair and of noisy curves, whose "
            "points are moved; pass points.detach() if results may be constants of them"
        )
    one = torch.ones(lb.num_points, 1, dtype=torch.float64)

    def forms(g: Tensor) -> list[BilinearForm]:
        return [BilinearForm("lumped", one, g[:, None], one[0])]

    lb.points = points.to(lb.points).view_as(lb.points)  # a buffer is no Parameter
    (lb.mass,) = known(lb, [lb.mass], forms)
    known_rows = [lb.stencil.values, lb.frames, *([lb.normals] if len(lb.normals) else [])]
    lb.stencil.values, lb.frames, *normals = _Rows.apply(lb.points, lb.plan, *known_rows)  # pyright: ignore[reportGeneralTypeIssues]
    lb.normals = normals[0] if normals else lb.normals
    if lb.weak.near.values[3:4].any():
        lb.stencil.values = refused(
            lb.stencil.values, "rows of Δ and ∇ with a Robin condition", points
        )
    return lb


def through_product(lb: Any, name: Any, f: Tensor, result: Tensor) -> Tensor:
    """The product of a matrix and f with its derivative in points and medium."""
    if name == "laplacian" or origins(lb) is None:  # the values of Δ have derivatives of their own
        return result
    kind: Any = "boundary" if name == "boundary_mass" else name
    other = side_by_side(f.detach().cpu().double())

    def forms(g: Tensor) -> list[BilinearForm]:
        return [BilinearForm(kind, side_by_side(g), other, torch.ones_like(other[0]))]

    return result + known(lb, [torch.zeros_like(result)], forms)[0]
