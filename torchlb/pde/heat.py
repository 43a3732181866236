"""Heat flow e^{tΔ}f = e^{−tM⁻¹K}f (`method.md`, section 8).

`Method` names the ways to compute it. "rational", the default of functions, needs no basis and is exact to the
tolerance: a rational series in Z = (M + γK)⁻¹M. "spectral", the default of layers, is exact on the span of the slow
eigenvectors; everything beyond the basis is dropped, also as t → 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import partial
from numbers import Real
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Shaped
from torch import Tensor

from torchlb.errors import InputError, shown
from torchlb.galerkin.forms import BilinearForm
from torchlb.linalg.checks import check_choice, check_tensor, takes_arrays
from torchlb.linalg.conjugate_gradients import Linear
from torchlb.linalg.csr import shaped_like, side_by_side
from torchlb.linalg.exponential import chebyshev_vectors, poles, rational_coefficients
from torchlb.linalg.once import once_differentiable
from torchlb.linalg.precision import ROOT_EPS, ROUNDING
from torchlb.linalg.sparse import compute_dtype
from torchlb.operator.checks import check_tolerance
from torchlb.operator.inputs import check_mask
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.operator.pair_methods import PairMethods, check_pair
from torchlb.operator.systems import PairSystem, pair_system
from torchlb.operator.through import Origins, origins
from torchlb.pde.checks import as_columns, as_times, check_shape, uncompiled
from torchlb.pde.solves import implicit_step

Method = Literal["rational", "spectral"]


@takes_arrays
def heat_flow(
    lb: PairMethods,
    f: Shaped[Tensor, "*B N C"] | Shaped[Tensor, " N"],
    t: float | Tensor,
    *,
    method: Method = "rational",
    k: int = 128,
    tolerance: float = ROOT_EPS,
) -> Tensor:
    """e^{tΔ}f: f after diffusion over the surface for a time t; differentiable in f and t.

    Computed in the wider of the types of f and the operator, at least float32; only a half-precision f gets its own
    type back. Raises InputError for times that are negative or not finite, an unknown method, a wrong shape, a
    tolerance that is not between 0 and 1, an operator without a weak pair.

    Parameters
    ----------
    lb
        Operator of one shape, or of a batch.
    f
        (N,), (N, C) or (B, N, C). With Dirichlet's condition the flow starts from the closest function that is zero
        along the boundary.
    t
        Time ≥ 0 in ℓ², one for all channels or (C,). (In a time t a peak spreads to a width of √(2t).)
    method
        "rational", which is exact to the tolerance, or "spectral" (`docs/conventions.md`).
    k
        Number of eigenpairs, for "spectral".
    tolerance
        Bound on the error in the norm of M, relative to |f|. Where all values around are smaller, as far from a heated
        point, they are noise: their logarithms and directions (geodesics) need an implicit step.

    Examples
    --------
    >>> from torchlb import LaplaceBeltrami
    >>> theta = torch.arange(36, dtype=torch.float64) * torch.pi / 18
    >>> lb = LaplaceBeltrami.from_points(torch.stack([theta.cos(), theta.sin()], dim=1))
    >>> bool(torch.allclose(heat_flow(lb, theta.cos(), 0.5), math.exp(-0.5) * theta.cos(), atol=1e-2))
    True
    """
    x = as_columns(f, lb)
    check_choice("method", method, Method)
    dtype = compute_dtype(x, lb.mass)
    time = as_times(t, x, dtype)
    with torch.autocast(x.device.type, enabled=False):
        y = flow(lb, _vanishing(lb, x.to(dtype)), time, method, k, tolerance)
    y = y.to(x.dtype) if x.dtype.itemsize < 4 else y
    return y[:, 0] if f.ndim == 1 else y


def _vanishing(lb: PairMethods, x: Tensor) -> Tensor:
    """The functions closest to x, in the norm of M, of those that are zero at Dirichlet points."""
    if lb.fixed is None:
        return x
    known = not torch.compiler.is_compiling() and not x.requires_grad
    if known and not bool(x[..., lb.fixed, :].any()):
        return x
    return implicit_step(lb, x, 0.0, tolerance=ROUNDING)


@takes_arrays
def smooth(
    lb: LaplaceBeltrami,
    f: Shaped[Tensor, "*B N C"] | Shaped[Tensor, " N"],
    fwhm: float,
    *,
    mask: Tensor | None = None,
) -> Tensor:
    """f smoothed along the surface by a Gaussian of a given full width at half maximum; differentiable in f.

    `heat_flow` for the time t = σ²/2, where σ = fwhm/√(8 ln 2); in the plane it is the convolution with the Gaussian of
    standard deviation σ. A width of less than four edges is not resolved: the weights have both signs then, and values
    may leave the range of f, most of all within a mask of single points. Errors are those of `heat_flow`.

    Parameters
    ----------
    lb, f
        Operator of one shape, or of a batch, and (N,), (N, C) or (B, N, C).
    fwhm
        Width ≥ 0 in ℓ, the unit of the points.
    mask
        (N,), true where f counts. With it the result is e^{tΔ}(mf)/e^{tΔ}m there, a weighted mean of the values inside,
        and NaN elsewhere, where f may be NaN, too. Without it NaN are an error.
    """
    if not isinstance(fwhm, Real) or not 0 <= fwhm < math.inf:
        raise InputError(f"fwhm: expected a length of at least 0, got {shown(fwhm)}")
    time = float(fwhm) ** 2 / (16 * math.log(2))
    if mask is None:
        return heat_flow(lb, f, time)
    check_tensor(f)
    check_shape(f[:, None] if f.ndim == 1 else f, lb)
    inside = check_mask(mask, lb.num_points).to(f.device).view((-1, 1) if f.ndim > 1 else -1)
    whole = heat_flow(lb, torch.where(inside, f, 0), time)
    weight = heat_flow(lb, inside.to(whole), time)  # zero where a condition holds f at zero
    return torch.where(inside, whole / torch.where(weight == 0, 1.0, weight), torch.nan)


def flow(lb: PairMethods, x: Tensor, time: Tensor, method: str, k: int, tolerance: float) -> Tensor:
    """e^{tΔ}x, (N, C) or (B, N, C), in the type of x, which is float32 or float64; autocast has to be off."""
    check_tolerance(tolerance)
    if x.ndim == 3:
        y = flow(lb, side_by_side(x), time.repeat(len(x)), method, k, tolerance)
        return shaped_like(y, x)
    check_pair(lb)
    if method == "spectral":  # Φ e^{−λt} ΦᵀMx
        basis = lb.eigenbasis(k)
        decay = torch.exp(-basis.eigenvalues.to(x.dtype)[..., None] * time)
        return basis.from_basis(decay * basis.analyse(x))
    found = origins(lb)
    variables = found.variables if found else ()
    y, _ = _flow(x.double(), time.double(), lb, found, tolerance, 0, False, *variables)
    return y.to(x.dtype)


class _Flow(torch.autograd.Function):
    """Derivatives of Σ_k c_k(t) T_k(2Z − 1)x in t, of an order and of the next.

    The adjoint is the same series of Zᵀ = M(M + γK)⁻¹, so that their own derivatives are such flows again.
    """

    @staticmethod
    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,
        x: Tensor,
        time: Tensor,
        lb: Any,
        found: Origins | None,
        tolerance: float,
        order: int,
        transposed: bool,
        *variables: Tensor,
    ) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(x, time, *variables)
        ctx.set_materialize_grads(False)
        ctx.rest = lb, found, tolerance, order, transposed
        return _summed(lb, x, time, tolerance, order, transposed)  # pyright: ignore[reportCallIssue]

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        if all(g is None for g in grads):
            return (None,) * len(ctx.needs_input_grad)
        return _in_data(ctx, *grads) if ctx.rest[1] is None else _in_all(ctx, grads[0])


_flow: Any = uncompiled(_Flow.apply)


def _in_data(ctx: Any, *grads: Tensor | None) -> tuple[Any, ...]:
    """The gradients in x and in the times."""
    x, time, *_ = ctx.saved_tensors
    lb, _, tolerance, order, transposed = ctx.rest
    flows = [
        _flow(g, time, lb, None, tolerance, number, not transposed)
        for number, g in enumerate(grads, order)
        if g is not None
    ]
    grad_x, slope = (sum(parts[1:], parts[0]) for parts in zip(*flows, strict=True))
    return grad_x, (slope * x).sum(0), *(None,) * 5


@once_differentiable
def _in_all(ctx: Any, g: Tensor) -> tuple[Any, ...]:
    """The gradients in x, times, points and medium, of which there are no second ones."""
    x, time, *_ = ctx.saved_tensors
    lb, found, tolerance, *_ = ctx.rest
    return *_in_data(ctx, g), *found.gradient(_forms(lb, x, g, time, tolerance))


def _poles(
    solver: PairSystem, time: Tensor, tolerance: float
) -> Iterator[tuple[float, Tensor, np.ndarray, Linear]]:
    """Every pole γ with its columns, their t/γ, and the product with S = (M + γK)⁻¹."""
    times = time.detach().cpu().numpy()
    for pole, chosen in poles(times):
        at_pole = time.new_full((len(chosen),), pole)
        solve = partial(solver.solve, time=at_pole, tolerance=tolerance / 10)
        yield pole, torch.from_numpy(chosen).to(time.device), times[chosen] / pole, solve


def _doubled(solver: PairSystem, solve: Linear, transposed: bool, v: Tensor) -> Tensor:
    """(2Z − 1)v, Z = SM, or its transpose's product with v."""
    z = solver.mass_product(solve(v)) if transposed else solve(solver.mass_product(v))
    return 2 * z - v


def _summed(
    lb: PairMethods, x: Tensor, time: Tensor, tolerance: float, order: int, transposed: bool
) -> tuple[Tensor, Tensor]:
    """Derivatives of the flow, or of the transposed flow, of an order in t and of the next; at t = 0, (−M⁻¹K)^j x."""
    result, slope = torch.zeros_like(x), torch.zeros_like(x)
    solver, at_zero = pair_system(lb), time == 0
    x = solver.inside(x)

    def generated(v: Tensor) -> Tensor:
        inverse = partial(solver.solve, time=torch.zeros_like(v[0]), tolerance=tolerance)
        if transposed:
            return -solver.stiffness_product(inverse(v))
        return -inverse(solver.stiffness_product(v))

    if bool(at_zero.any()):
        start = x[:, at_zero]
        for _ in range(order):
            start = generated(start)
        result[:, at_zero], slope[:, at_zero] = start, generated(start)
    for pole, columns, ratios, solve in _poles(solver, time, tolerance):
        doubled, scale = partial(_doubled, solver, solve, transposed), pole ** -float(order)
        c, derivative = rational_coefficients(ratios, tolerance, order)
        for k, v in enumerate(chebyshev_vectors(doubled, x[:, columns], len(c))):
            result[:, columns] += scale * torch.from_numpy(c[k]).to(x) * v
            slope[:, columns] += scale / pole * torch.from_numpy(derivative[k]).to(x) * v
    return solver.inside(result), solver.inside(slope)  # Zᵀ is nonzero at Dirichlet points


def _forms(
    lb: PairMethods, x: Tensor, g: Tensor, time: Tensor, tolerance: float
) -> list[BilinearForm]:
    """Forms with the derivative of ⟨g, Σ_k c_k v_k⟩ in K and M, v_k = T_k(2Z − 1)x.

    dZ = S(dM(1 − Z) − γ dK Z) with S = (M + γK)⁻¹; what v_k is multiplied by follows from Clenshaw's recurrence,
    b_k = c_k g + 2Aᵀb_{k+1} − b_{k+2}, A = 2Z − 1, and 2⟨b_{k+1}, dA v_k⟩ add up, the first one once. They are the
    columns of one form for each matrix.
    """
    solver = pair_system(lb)
    terms: list[tuple[Tensor, ...]] = []
    x, g = solver.inside(x), solver.inside(g)
    for pole, columns, ratios, solve in _poles(solver, time, tolerance):
        doubled, own = partial(_doubled, solver, solve, False), g[:, columns]
        c, _ = rational_coefficients(ratios, tolerance)
        v = list(chebyshev_vectors(doubled, x[:, columns], len(c)))
        after = before = applied = torch.zeros_like(own)  # b_{k+2}, b_{k+1}, Aᵀb_{k+1}
        for k in range(len(c) - 1, 0, -1):
            after, before = before, torch.from_numpy(c[k]).to(x) * own + 2 * applied - after
            solved = solve(before)
            applied = 2 * solver.mass_product(solved) - before
            # A v_{k−1} by the recurrence, and Z = (1 + A)/2
            advanced = v[1] if k == 1 else (v[k] + v[k - 2]) / 2
            smooth = (v[k - 1] + advanced) / 2
            weight = x.new_full((len(columns),), 2.0 if k == 1 else 4.0)
            terms.append((solved, smooth, v[k - 1] - smooth, -pole * weight, weight))
    if not terms:
        return []
    w, smooth, rough, *weights = (torch.cat(columns, -1) for columns in zip(*terms, strict=True))
    return [
        BilinearForm("energy", w, smooth, weights[0]),
        BilinearForm("mass", w, rough, weights[1]),
    ]
