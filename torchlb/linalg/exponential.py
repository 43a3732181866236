r"""e^{tL}x for many channels, each with its own time, in one differentiable operation (`method.md`, section 8).

Two expansions e^{tL}x = Σ_k c_k(t) v_k, whose vectors v_k all channels and times share:

- "chebyshev": v_k = r^{−k} T_k((L + a)/d) x, c_k = 2 r^k e^{−ta} I_k(td), for a spectrum in the ellipse around −a
  with the half axes a and b, d² = a² − b², r = (a + b)/d. It touches 0, so that no c_k v_k is larger than x; b = 0 is
  the interval. About √(4ta ln 1/ε) + tb products.
- "contour": v_k = (z_k − L)⁻¹x on a hyperbola in the left half plane (Weideman, Trefethen 2007), by sparse LU on
  the CPU; about 15 of them, for any spectrum in a sector around the negative axis and all times within a factor 10.

"either" is the first unless that takes more than `PRODUCTS` of them, where slivers make the spectrum long. In both
p(0) = 1 is restored exactly, so that Σ π u is conserved to rounding. The derivatives come from the adjoint
expansion w_k of the gradient g: Σ c_k w_k in x, and Σ c_k'(t) ⟨w_k, x⟩ in t.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from scipy.special import ive
from torch import Tensor

from torchlb.errors import DiffusionError
from torchlb.linalg.factor import factorized
from torchlb.linalg.sparse import csr_product, multiply

MAX_TERMS = 30_000
PRODUCTS = 5_000
"""Beyond this many the sparse factors of the contour sum are quicker."""
SECTOR = 0.4
"""Half angle (radians) around the negative axis that the hyperbola stays clear of; the largest seen is 0.35."""
WINDOW = 10.0
"""Ratio of the times that share one hyperbola."""
CACHED = 2**18
"""Values of a vector that stays in a processor's cache from product to product."""
Term = tuple[tuple[slice, Any], Tensor, np.ndarray, np.ndarray]


def heat(
    pattern: Sequence[Tensor],
    values: Float[Tensor, " nnz"],
    x: Float[Tensor, "N C"],
    time: Float[Tensor, " C"],
    bounds: Float[Tensor, 2],
    expansion: str,
    tolerance: float,
    sizes: Sequence[int],
) -> Float[Tensor, "N C"]:
    """e^{t_c L}x_c for every channel c, differentiable once in x and t.

    Parameters
    ----------
    pattern : [crow, col, crow_t, col_t, order_t] of L and its transpose.
    values : of L, 1/ℓ²; no gradient goes there.
    time : t ≥ 0, ℓ².
    bounds : (R, b), in float64 on the CPU: the spectrum lies in the ellipse of half axes R/2, b around −R/2; b is NaN
        where no ellipse is known. A tensor, since numbers would be compiled anew for every operator.
    expansion : "chebyshev", "contour" or "either".
    tolerance : of the result, relative to x.
    sizes : numbers of rows of the diagonal blocks of L; (N,) for one shape.
    """
    options = bounds, expansion, tolerance, list(sizes)
    return _heat(list(pattern), values, x, time, *options, False)


SCHEMA = (
    "(Tensor[] pattern, Tensor values, Tensor x, Tensor time, Tensor bounds, str expansion, "
    "float tolerance, SymInt[] sizes, bool transposed"
)


@torch.library.custom_op("torchlb::heat", mutates_args=(), schema=SCHEMA + ") -> Tensor")
def _heat(pattern: Any, values: Tensor, x: Tensor, time: Tensor, *options: Any) -> Tensor:
    dtype, terms = _terms(pattern, values, x, time, *options)
    y = torch.zeros_like(x, dtype=dtype, memory_format=torch.contiguous_format)
    for where, vector, coefficient, _ in terms:
        _add_scaled(y, where, vector, coefficient)
    return y.to(x.dtype)


@torch.library.custom_op(
    "torchlb::heat_backward",
    mutates_args=(),
    schema=SCHEMA + ", Tensor grad) -> (Tensor, Tensor)",
)
def _heat_backward(
    pattern: Any, values: Tensor, x: Tensor, time: Tensor, *options: Any
) -> tuple[Tensor, Tensor]:
    bounds, expansion, tolerance, sizes, transposed, grad = options
    rest = bounds, expansion, tolerance, sizes, not transposed
    dtype, terms = _terms(pattern, values, grad, time, *rest)
    grad_x = torch.zeros_like(x, dtype=dtype, memory_format=torch.contiguous_format)
    grad_t = torch.zeros_like(time)
    for where, vector, coefficient, derivative in terms:
        _add_scaled(grad_x, where, vector, coefficient)
        along = (vector * x[where]).sum(0)
        grad_t[where[1]] += _real(along * _like(derivative, vector)).to(time)
    return grad_x.to(x.dtype), grad_t


@_heat.register_fake
def _(pattern: Any, values: Any, x: Tensor, *_: Any) -> Tensor:
    return torch.empty_like(x, memory_format=torch.contiguous_format)


@_heat_backward.register_fake
def _(pattern: Any, values: Any, x: Tensor, time: Tensor, *_: Any) -> tuple[Tensor, Tensor]:
    return torch.empty_like(x, memory_format=torch.contiguous_format), torch.empty_like(time)


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    pattern, values, x, time, *ctx.options = inputs
    ctx.save_for_backward(*pattern, values, x, time)


def _backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
    *pattern, values, x, time = ctx.saved_tensors
    gradients = _heat_backward(pattern, values, x, time, *ctx.options, grad)
    return [None] * len(pattern), None, *gradients, None, None, None, None, None


_heat.register_autograd(_backward, setup_context=_save)


def _add_scaled(
    y: Tensor, where: tuple[slice, Any], vector: Tensor, coefficient: np.ndarray
) -> None:
    """Add the real part of c_k v_k to some rows and columns of y."""
    if isinstance(where[1], slice) and not vector.is_complex():
        y[where].addcmul_(vector, _like(coefficient, vector))
    else:
        y[where] += _real(vector * _like(coefficient, vector))


def _real(t: Tensor) -> Tensor:
    return t.real if t.is_complex() else t


def _like(coefficient: np.ndarray, vector: Tensor) -> Tensor:
    return torch.from_numpy(coefficient).to(vector.device, vector.dtype)


def _terms(
    pattern: Sequence[Tensor],
    values: Tensor,
    x: Tensor,
    time: Tensor,
    bounds: Tensor,
    expansion: str,
    tolerance: float,
    sizes: Sequence[int],
    transposed: bool,
) -> tuple[torch.dtype, Iterator[Term]]:
    """The terms ((rows, columns), v_k, c_k, c_k') of the expansion, with L or its transpose, and the type to sum in.

    "either" is settled here: outside the operation times have no values yet. The contour sum cancels, its terms are
    some hundred times larger than it.
    """
    times = time.detach().double().cpu().numpy()
    if len(times) == 0 or len(x) == 0:
        return x.dtype, iter(())
    radius, height = bounds.tolist()
    products = _estimate(float(times.max()), radius / 2, height, tolerance)  # NaN without a height
    if expansion == "chebyshev" or (expansion == "either" and products < PRODUCTS):
        options = times, radius, height, tolerance, sizes, transposed
        return x.dtype, _chebyshev(pattern, values, x, *options)
    return torch.float64, _contour(
        pattern, values, x.double(), times, radius, tolerance, transposed
    )


def _estimate(longest: float, a: float, b: float, tolerance: float) -> float:
    """Products that the Chebyshev series takes, from above."""
    digits = math.log(1 / tolerance)
    return longest * b + math.sqrt(4 * digits * longest * a) + 2 * digits + 8


def chebyshev_coefficients(
    times: np.ndarray, radius: float, height: float, tolerance: float
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Coefficients c_k(t) and their derivatives, (K, C), with d and r of the ellipse; see the module.

    K is the smallest number whose tail sums to less than `tolerance` for every time.

    >>> c, _, d, r = chebyshev_coefficients(np.array([0.0]), 1.0, 0.0, 1e-7)
    >>> c.tolist(), d, r
    ([[1.0], [0.0]], 0.5, 1.0)
    """
    a, b = radius / 2, height
    if math.isnan(b):
        raise DiffusionError(
            "method='chebyshev': no ellipse in the left half plane holds the spectrum, as on an operator that is not "
            "stable; build it with certify=True, or use method='contour'"
        )
    d = np.sqrt(a * a - b * b)
    r = (a + b) / d
    longest = float(times.max())
    estimate = _estimate(longest, a, b, tolerance)
    if not estimate < MAX_TERMS:
        raise DiffusionError(
            f"a diffusion time of {longest:.3g} with a spectral radius of {radius:.3g} takes {estimate:.0f} products; "
            "use shorter times, method='contour' or method='spectral', or mend the slivers that make the radius large"
        )
    distinct, place = np.unique(times, return_inverse=True)
    k = np.arange(-1, int(estimate) + 2)[:, None]
    with np.errstate(divide="ignore"):
        log_bessel = np.log(ive(np.abs(k), distinct * d))
    base = np.exp(log_bessel + distinct * (d - a) + k * np.log(r))
    slope = -a * base[1:-1] + d / 2 * (r * base[:-2] + base[2:] / r)
    c, slope = 2 * base[1:-1], 2 * slope
    c[0] /= 2
    slope[0] /= 2
    tail = np.cumsum(c[::-1], axis=0)[::-1].max(1)
    count = max(int((tail > tolerance).sum()), 2)
    c, slope = c[:count], slope[:count]
    at_zero = (1 + r ** (-2.0 * np.arange(count)))[:, None] / 2
    c[0] += 1 - (c * at_zero).sum(0)
    slope[0] -= (slope * at_zero).sum(0)
    return c[:, place], slope[:, place], float(d), float(r)


def _chebyshev(
    pattern: Sequence[Tensor],
    values: Tensor,
    x: Tensor,
    times: np.ndarray,
    radius: float,
    height: float,
    tolerance: float,
    sizes: Sequence[int],
    transposed: bool,
) -> Iterator[Term]:
    c, slope, d, r = chebyshev_coefficients(times, radius, height, tolerance)
    crow, col, crow_t, col_t, order_t = pattern
    if transposed:
        crow, col, values = crow_t, col_t, values[order_t]
    shift = radius / (r * d)
    for rows, matrix in _blocks(crow, col, values * (2 / (r * d)), x, sizes):
        where = rows, slice(None)
        before = x[rows]
        yield where, before, c[0], slope[0]
        v = (multiply(*matrix, before) + shift * before) / 2
        yield where, v, c[1], slope[1]
        for k in range(2, len(c)):
            after = multiply(*matrix, v).add_(v, alpha=shift)
            before, v = v, after.sub_(before, alpha=r**-2)
            yield where, v, c[k], slope[k]


def _blocks(
    crow: Tensor, col: Tensor, values: Tensor, x: Tensor, sizes: Sequence[int]
) -> Iterator[tuple[slice, tuple[Tensor, Tensor, Tensor]]]:
    """Diagonal blocks (rows, (crow, col, values)): on the CPU as many together as stay in its cache, else all."""
    limit = CACHED // x.shape[1] if x.device.type == "cpu" else len(x)
    ends = list(accumulate(sizes))
    start = 0
    for end, following in zip(ends, [*ends[1:], math.inf], strict=True):
        if following - start > limit:
            first, last = int(crow[start]), int(crow[end])
            pattern = crow[start : end + 1] - first, col[first:last] - start
            yield slice(start, end), (*pattern, values[first:last])
            start = end


def hyperbola(spread: float, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Poles z_k and weights w_k with e^{−τx} ≈ Re Σ w_k e^{τ z_k}/(z_k + x), for τ in [1/spread, 1], x in the sector.

    Σ over half of the symmetric rule on z = μ(1 + sin(iu − α)), with the angle α that balances the errors of the step,
    from the left and from the right, and of the truncation.

    >>> z, w = hyperbola(1.0, 1e-8)
    >>> len(z), bool(abs((w * np.exp(z) / (z + 2.0)).sum().real - np.exp(-2.0)) < 1e-8)
    (16, True)
    """
    from scipy.optimize import minimize_scalar

    def reach(alpha: float) -> float:
        left, right = np.pi - 2 * (alpha + SECTOR), 4 * alpha - np.pi + 2 * SECTOR
        return float(np.arccosh((spread * left + right) / (right * np.sin(alpha))))

    def rate(alpha: float) -> float:
        return np.pi * (np.pi - 2 * (alpha + SECTOR)) / reach(alpha)

    bounds = (np.pi / 4 - SECTOR / 2 + 1e-3, np.pi / 2 - SECTOR - 1e-3)
    alpha = float(minimize_scalar(lambda s: -rate(s), bounds=bounds, method="bounded").x)  # pyright: ignore[reportAttributeAccessIssue]
    count = int(np.ceil((np.log(1 / tolerance) + 4) / rate(alpha)))
    step = reach(alpha) / count
    u = (np.arange(count) + 0.5) * step
    mu = np.pi * (4 * alpha - np.pi + 2 * SECTOR) / step
    z = mu * (1 + np.sin(1j * u - alpha))
    return z, step / np.pi * mu * np.cos(1j * u - alpha)


def _windows(times: np.ndarray) -> Iterator[np.ndarray]:
    """Indices of times that share a hyperbola."""
    order = np.argsort(times, kind="stable")
    while len(order):
        together = int(np.searchsorted(times[order], WINDOW * times[order[0]], side="right"))
        yield order[:together]
        order = order[together:]


def _contour(
    pattern: Sequence[Tensor],
    values: Tensor,
    x: Tensor,
    times: np.ndarray,
    radius: float,
    tolerance: float,
    transposed: bool,
) -> Iterator[Term]:
    every = slice(None)
    short = np.flatnonzero(times * radius <= 1e-5)
    if len(short):  # 1 + tL, exact to 1e-10; a hyperbola would lose digits
        columns = torch.from_numpy(short).to(x.device)
        part, t = x[:, columns].contiguous(), times[short]
        yield (every, columns), part, np.ones_like(t), np.zeros_like(t)
        yield (every, columns), csr_product(pattern, values, part, transposed), t, np.ones_like(t)
    rest = np.flatnonzero(times * radius > 1e-5)
    crow, col = (p.cpu().numpy() for p in pattern[:2])
    entries = values.detach().double().cpu().numpy()
    matrix = sparse.csr_array((entries, col, crow), shape=(len(x), len(x)))
    for window in _windows(times[rest]):
        chosen = rest[window]
        columns = torch.from_numpy(chosen).to(x.device)
        part, t = x[:, columns], times[chosen]
        right = part.detach().cpu().numpy().astype(np.complex128)
        poles, weights = hyperbola(float(t.max() / t.min()), tolerance)
        lack, slope = np.ones_like(t), np.zeros_like(t)
        for z, w in zip(poles / t.max(), weights / t.max(), strict=True):
            lu = factorized(sparse.csc_array(z * sparse.eye_array(len(x)) - matrix), 1e-1)
            vector = torch.from_numpy(lu.solve(right, "T" if transposed else "N"))
            c = w * np.exp(t * z)
            lack, slope = lack - (c / z).real, slope - c.real
            yield (every, columns), vector.to(x.device, x.dtype.to_complex()), c, z * c
        yield (every, columns), part, lack, slope
