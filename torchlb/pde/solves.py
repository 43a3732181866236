"""Implicit steps and Poisson problems on a shape, differentiable (`method.md`, section 10)."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchlb.errors import InputError
from torchlb.galerkin.forms import BilinearForm
from torchlb.linalg.checks import check_finite, takes_arrays
from torchlb.linalg.csr import shaped_like, side_by_side, tensors_of
from torchlb.linalg.once import once_differentiable
from torchlb.linalg.precision import SINGLE
from torchlb.linalg.sparse import compute_dtype, csr_product
from torchlb.operator.batching import shapes_of
from torchlb.operator.checks import check_tolerance
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.operator.pair_methods import PairMethods, check_pair
from torchlb.operator.systems import Tolerance, means, pair_system, solve_columns
from torchlb.operator.through import Origins, origins, without
from torchlb.pde.checks import as_columns, as_times, uncompiled

TOLERANCE = 1e-10
"""Default relative error of solves: below the error of any mesh, and far above rounding."""


@takes_arrays
@uncompiled
def implicit_step(
    lb: PairMethods,
    f: Shaped[Tensor, "*B N C"] | Shaped[Tensor, " N"],
    t: float | Tensor,
    *,
    boundary_values: Tensor | float | None = None,
    flux: Tensor | float | None = None,
    conductivity: Tensor | None = None,
    tolerance: float = TOLERANCE,
) -> Tensor:
    """(1 − tΔ)⁻¹f, one implicit Euler step of heat flow; differentiable in f, t and the boundary's data.

    (M + tK)u = Mf + tB·flux, by conjugate gradients with the P1 pair as preconditioner. Solved in float64; for a
    tolerance of 1e-5 or more iterations are in float32, and, where f and the operator are, right-hand sides, too. The
    result has the type of f, that of the operator where f are integers.

    Parameters
    ----------
    lb, f
        Operator of one shape, or of a batch, and (N,), (N, C) or (B, N, C).
    t
        Time ≥ 0 in ℓ², one for all channels or (C,).
    boundary_values
        u at the points of a Dirichlet condition, a number or of the shape of f, of which only those points count; 0 by
        default.
    flux
        κ∂_ν u along the rest of the boundary, κ∂_ν u + a u with `Robin`, units of f by 1/ℓ, in the same way; 0 by
        default. At Dirichlet points next to that part it counts, too, since boundary integrals reach them: continue it
        smoothly to them.
    conductivity
        κ > 0 of u − t div(κ∇u) = f, at the vertices (N,), its logarithm prolonged as the surface is, or on the faces
        (F,), if F ≠ N; by default that of the medium, or 1. Of one shape; the solution is differentiable in it, too.
    tolerance
        Relative tolerance of the solver.

    Raises InputError for wrong shapes, times that are negative or not finite, data for a boundary that is not there, a
    tolerance that is not between 0 and 1; DiffusionError where the solver does not converge.

    >>> from torchlb.surfaces import Sphere
    >>> vertices, faces = Sphere().mesh(300)
    >>> lb = LaplaceBeltrami.from_mesh(vertices, faces)
    >>> u = implicit_step(lb, vertices[:, 2], 0.5)  # z is an eigenfunction: z / (1 + 2t)
    >>> bool((u - vertices[:, 2] / 2).abs().max() < 1e-4)
    True
    """
    return _solution(lb, f, [t], boundary_values, flux, conductivity, tolerance)


@takes_arrays
@uncompiled
def poisson_solve(
    lb: PairMethods,
    f: Shaped[Tensor, "*B N C"] | Shaped[Tensor, " N"],
    *,
    boundary_values: Tensor | float | None = None,
    flux: Tensor | float | None = None,
    conductivity: Tensor | None = None,
    tolerance: float = TOLERANCE,
) -> Tensor:
    """u with −Δu = f; differentiable in f and the boundary's data. Units of f by ℓ².

    Ku = Mf + B·flux; in a medium −div(A∇u) + cu = ρf. On a component without a Dirichlet or Robin condition u has mean
    zero, and the data are made compatible: the total of f and flux is subtracted from f, evenly. Arguments and errors
    as for `implicit_step`.

    >>> from torchlb.surfaces import Sphere
    >>> vertices, faces = Sphere().mesh(300)
    >>> lb = LaplaceBeltrami.from_mesh(vertices, faces)
    >>> u = poisson_solve(lb, vertices[:, 2])
    >>> bool((u - vertices[:, 2] / 2).abs().max() < 1e-4)
    True
    """
    return _solution(lb, f, [], boundary_values, flux, conductivity, tolerance)


def _solution(
    lb: PairMethods,
    f: Tensor,
    times: list[float | Tensor],
    boundary_values: Tensor | float | None,
    flux: Tensor | float | None,
    conductivity: Tensor | None,
    tolerance: float,
) -> Tensor:
    """The implicit step, or without `times` the solution of the Poisson problem."""
    check_tolerance(tolerance)
    x = as_columns(f, lb)
    time, dtype = None, torch.float64
    if times:
        time = as_times(times[0], x, dtype).repeat(len(x) if x.ndim == 3 else 1)
        dtype = dtype if tolerance < SINGLE else compute_dtype(x, lb.mass)
    columns = side_by_side(x.to(dtype))
    lb = _with_conductivity(lb, conductivity)
    given, fluxes = (_data(lb, d, n, f) for d, n in ((boundary_values, 0), (flux, 1)))
    right, share = _product(lb, 1, columns), 1.0 if time is None else time
    if fluxes is not None:
        right = right + share * lb.product("boundary_mass", fluxes)
    if given is not None:
        right = right - share * _product(lb, 0, given)
        right = right if time is None else right - _product(lb, 1, given)
    u = solved(lb, right, time, columns, given, tolerance=tolerance)
    return shaped_like(u, f).to(x.dtype)


@uncompiled
def implicit_by_elements(
    lb: PairMethods, x: Float[Tensor, "*B N C"], time: Float[Tensor, " C"], degree: int = 4
) -> Float[Tensor, "*B N C"]:
    """(1 − tΔ)⁻¹x by P1 elements, to 1e-3 of |x|, differentiable in x and t; in the type of x.

    Σ_k c_k Zᵏx with Z = (M₁ + τK₁)⁻¹M₁, for a factor whose time τ is within a factor of two of t, if times lie within
    4⁷: z/(z + (1 − z)t/τ) interpolated at Radau's points of Chebyshev on [0, 1], where constants, z = 1, are exact.
    """
    x = without(lb, as_columns(x, lb), "implicit layers with tolerance='P1'")
    columns, time = side_by_side(x), time if x.ndim == 2 else time.repeat(len(x))
    order = time.detach().argsort()
    exponents = torch.arange(degree + 1, dtype=torch.float64, device=x.device)
    z = (1 + torch.cos(2 * torch.pi / (2 * degree + 1) * exponents)[:, None]) / 2
    powers = z**exponents
    found = []
    shapes = shapes_of(lb) or (lb,)
    parts = columns[:, order].split([shape.num_points for shape in shapes])
    for shape, v in zip(shapes, parts, strict=True):
        system, (crow, col, (_, mass)) = pair_system(shape), shape.weak.linear_pair
        levels = system.levels(time.detach()[order], v.shape[1])
        times, counts = (torch.tensor(part, device=x.device) for part in zip(*levels, strict=True))
        ratio = time[order].double() / times.repeat_interleave(counts)
        first, *coefficients = torch.linalg.solve(powers, z / (z + (1 - z) * ratio)).to(v)
        u = first * system.inside(v)
        for c in coefficients:
            v = _Near.apply(csr_product([crow, col], mass.to(v), v), system, levels)
            u = u + c * v
        found.append(u)
    return shaped_like(torch.cat(found)[:, order.argsort()], x)


class _Near(torch.autograd.Function):
    """(M₁ + τK₁)⁻¹b, symmetric, and zero at Dirichlet points."""

    @staticmethod
    def forward(ctx: Any, b: Tensor, system: Any, levels: Any) -> Tensor:  # pyright: ignore
        ctx.rest = system, levels
        return system.near(levels, b)

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> tuple[Any, ...]:  # pyright: ignore
        return _Near.apply(g, *ctx.rest), None, None


@uncompiled
def potential(
    lb: LaplaceBeltrami,
    field: Float[Tensor, "*B N d C"] | None,
    source: Float[Tensor, "*B N C"] | None = None,
    *,
    tolerance: Tolerance = "P1",
) -> Float[Tensor, "*B N C"]:
    """u with −Δu = s − ∇·v for a tangent field v, given in the frames, and a source s; differentiable.

    Ku = Σ_c G_cᵀ(π v_c) + π s, where G are the rows of the gradient and π is the mass, for s with the density of a
    medium. u has mean zero where no condition holds it. For a field alone, ∇u is closest to it; for v = ∇f, u is f less
    its mean, up to the order.

    Fields are (N, d, C) or (B, N, d, C), as `lb.local_gradient` gives them, sources (N, C) or (B, N, C), less their
    means; without a field it is None. The tolerance is that of the weak pair's solve, or "P1".
    """
    if tolerance != "P1":
        check_tolerance(tolerance)
    check_pair(lb)
    products = []
    if source is not None:
        # lb.mass has linear rows of P where it would be negative else
        mass = lb.product("mass", torch.ones_like(lb.mass))
        products.append(mass.to(source.dtype)[:, None] * source)
    if field is not None:
        weighted = lb.mass.to(field.dtype)[:, None, None] * field
        products += [
            lb.stencil.product(1 + c, weighted[..., c, :], transposed=True) for c in range(lb.dim)
        ]
    columns = side_by_side(sum(products[1:], products[0]).double())
    given = field if source is None else source
    assert given is not None, "neither field nor source"
    if tolerance == "P1":
        columns = without(lb, columns, "solutions by P1 elements")
        u = _solve(columns, None, None, None, lb, None, tolerance)
    else:
        u = solved(lb, columns, tolerance=tolerance)
    return shaped_like(u, products[0]).to(given.dtype)


def _with_conductivity(lb: PairMethods, conductivity: Tensor | None) -> PairMethods:
    """The operator with this conductivity, if any, in place of that of its medium."""
    if conductivity is None:
        return lb
    if not isinstance(lb, LaplaceBeltrami):
        raise InputError(
            "conductivity: tangent fields have that of their operator, lb.with_medium(κ).connection"
        )
    others = tensors_of(lb._known_medium) | {"conductivity": conductivity}
    return lb.with_medium(**others)


def _data(lb: PairMethods, data: Tensor | float | None, kind: int, f: Tensor) -> Tensor | None:
    """Boundary data as columns, zero where they do not count: Dirichlet values (kind 0) or fluxes (1)."""
    if data is None:
        return None
    name = ("boundary_values", "flux")[kind]
    fixed = torch.zeros_like(lb.mass, dtype=torch.bool) if lb.fixed is None else lb.fixed
    counts = _reached_by_flux(lb, ~fixed) if kind == 1 else fixed
    if not bool(counts.any()):
        missing = (
            "no Dirichlet condition; build with condition='dirichlet'",
            "a Dirichlet condition holds along the whole boundary; pass a mask as `boundary` that leaves some of it",
        )[kind]
        if not lb.weak.has_boundary:
            missing = "the shape is closed; it has no boundary for them"
        raise InputError(f"{name}: {missing}")
    values = torch.as_tensor(data, dtype=torch.float64, device=f.device)
    if values.shape not in ((), f.shape):
        raise InputError(
            f"{name}: expected the shape of f, {tuple(f.shape)}, or a number, got {tuple(values.shape)}"
        )
    columns = side_by_side(values.expand(f.shape))
    columns = torch.where(counts[:, None], columns, 0.0)
    check_finite(columns, name)
    return columns


def _reached_by_flux(lb: PairMethods, free: Tensor) -> Tensor:
    """Mask (N,) of the boundary points whose flux reaches a free point."""
    if not lb.weak.has_boundary:
        return torch.zeros_like(free)
    size = lb.weak.values[2].abs()
    return csr_product([lb.weak.crow, lb.weak.col], size, free.to(size)[:, None])[:, 0] > 0


def _product(lb: PairMethods, number: int, x: Tensor) -> Tensor:
    """K, with what is added to it, or M times x."""
    crow, col, values = lb.weak.pair
    return csr_product([crow, col], values[number].to(x), x)


def solved(
    lb: PairMethods,
    right: Float[Tensor, "N C"],
    time: Float[Tensor, " C"] | None = None,
    f: Float[Tensor, "N C"] | None = None,
    given: Float[Tensor, "N C"] | None = None,
    *,
    tolerance: float = TOLERANCE,
) -> Float[Tensor, "N C"]:
    """The solution with the boundary values u₀ that are given, differentiable in data, times, points and medium.

    Mf is the part of the right-hand side that depends on points and medium.
    """
    found = origins(lb)
    u = _solve(right, time, f, given, lb, found, tolerance, *(found.variables if found else ()))
    return u if given is None else u + given


class _Solve(torch.autograd.Function):
    """u of S(t)u = b: (M + tK)u = b, or Ku = b for a time of None; zero at Dirichlet points.

    Its derivatives are solves with the same matrix: S⁻¹g in b and −⟨S⁻¹g, K(u + u₀)⟩ in t, for the cotangent g; in what
    the matrices follow from those of ⟨w, dM(f − u − u₀)⟩ − t⟨w, dK(u + u₀)⟩, w = S⁻¹g. For a time of None f and g count
    less their means, which the solve takes off in M.
    """

    @staticmethod
    def forward(  # pyright: ignore
        ctx: Any,
        b: Tensor,
        time: Tensor | None,
        f: Tensor | None,
        given: Tensor | None,
        lb: Any,
        found: Origins | None,
        tolerance: Any,
        *variables: Tensor,
    ) -> Tensor:
        u = solve_columns(lb, b, time, tolerance).to(b.dtype)  # pyright: ignore[reportCallIssue]
        ctx.save_for_backward(time, u, b, f, given, *variables)
        ctx.rest = lb, found, tolerance
        return u

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> tuple[Any, ...]:  # pyright: ignore
        lb, found, tolerance = ctx.rest
        if found is not None:
            return _gradients_in_all(ctx, g)
        time, u, *_ = ctx.saved_tensors
        w = _solve(g, time, None, None, lb, None, tolerance)
        return w, _in_time(ctx, lb, w, u), None, None, None, None, None


def _in_time(ctx: Any, lb: PairMethods, w: Tensor, u: Tensor) -> Tensor | None:
    """The gradient in the times, where it is asked for."""
    if not ctx.needs_input_grad[1]:
        return None
    return -(w * _product(lb, 0, u)).sum(0).to(ctx.saved_tensors[0])


@once_differentiable
def _gradients_in_all(ctx: Any, g: Tensor) -> tuple[Any, ...]:
    """The gradients in data, times, points and medium, of which there are no second ones."""
    time, u, b, f, given, *_ = ctx.saved_tensors
    lb, found, tolerance = ctx.rest
    w, one = solve_columns(lb, g, time, tolerance).to(g.dtype), torch.ones_like(g[0])
    whole = u if given is None else u + given
    less = whole if time is not None else means(lb, b)
    forms = [
        BilinearForm("energy", w, whole, -one if time is None else -time),
        BilinearForm("mass", w, -less if f is None else f - less, one),
    ]
    if time is None:
        forms.append(BilinearForm("mass", means(lb, g), u, -one))
    return w, _in_time(ctx, lb, w, u), *(None,) * 5, *found.gradient(forms)


_solve: Any = _Solve.apply
