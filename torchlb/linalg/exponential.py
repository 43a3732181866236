r"""e^{tL}x of a symmetric L ≤ 0 for many channels, each with its own time, in one differentiable operation.

The spectrum lies in [−R, 0]. All channels and times share the vectors v_k of e^{tL}x = Σ_k c_k(t) v_k (`method.md`, 8):

- a Chebyshev series, v_k = T_k(1 + 2L/R) x and c_k = 2 e^{−tR/2} I_k(tR/2), about √(2tR ln 1/ε) products;
- where that would be more than `PRODUCTS`, as slivers make the spectrum long, a Chebyshev series of Z = (1 − γL)⁻¹: in
  z = 1/(1 + γλ), between 0 and 1, e^{−tλ} is smooth for all t between 5γ and 50γ, and takes about 20 solves.

Both preserve constants exactly. Derivatives use the expansion w_k of the gradient g: Σ c_k w_k in x, and Σ c_k'(t)
⟨w_k, x⟩ in t.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from itertools import accumulate
from math import inf, log, sqrt
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from scipy.fft import dct
from scipy.special import ive
from torch import Tensor

from torchlb.errors import DerivativeError
from torchlb.linalg.factor import Factor
from torchlb.linalg.once import DIFFERENTIABLE_ONCE
from torchlb.linalg.precision import AT_ONCE, NEGLIGIBLE, ROUNDS, TINY
from torchlb.linalg.sparse import multiply

PRODUCTS = 5_000
"""Number of products beyond which a few factorisations are faster."""
SHORTEST = 5.0
"""Ratio t/γ of the shortest time that shares a pole γ, a power of ten; the longest is ten times longer."""
POINTS = 256
"""Number of Chebyshev points that the coefficients of rational functions are interpolated at."""
Term = tuple[tuple[slice, Any], Tensor, np.ndarray, np.ndarray]


def spectral_radius(stiffness: sparse.csr_array, mass: Float[np.ndarray, " N"]) -> float:
    """Upper bound of the eigenvalues of D⁻¹K, K positive semidefinite and D the diagonal mass, in 1/ℓ².

    It is the Collatz–Wielandt bound max_i (|K|x)_i / (Dx)_i, x > 0, of D⁻¹|K|, whose spectral radius is no smaller.

    >>> path = sparse.csr_array([[1.0, -1.0], [-1.0, 1.0]])
    >>> spectral_radius(path, np.ones(2))
    2.0
    """
    size, x, radius = abs(stiffness), np.ones(len(mass)), np.inf
    for _ in range(ROUNDS):
        y = size @ x / mass
        radius = min(radius, float((y / x).max(initial=0.0)))
        x = np.sqrt(x) * np.sqrt(y)  # the geometric mean prevents oscillation
        x = np.maximum(x / (x.max(initial=0.0) or 1.0), NEGLIGIBLE)
    return radius


SCHEMA = (
    "(Tensor[] pattern, Tensor values, Tensor x, Tensor time, Tensor radius, float tolerance, "
    "SymInt[] sizes"
)


@torch.library.custom_op("torchlb::heat", mutates_args=(), schema=SCHEMA + ") -> Tensor")
def heat(pattern: Any, values: Tensor, x: Tensor, time: Tensor, *options: Any) -> Tensor:
    """e^{t_c L}x_c for every channel c, differentiable once in x and in the times t ≥ 0, ℓ².

    `pattern` is [crow, col] of L; its values, 1/ℓ², get no gradient. The radius R is a float64 tensor on the CPU, since
    a number would be compiled anew for every operator. The tolerance is relative to x; `sizes` are the numbers of rows
    of the diagonal blocks of L, (N,) for one shape.
    """
    y = torch.zeros_like(x, memory_format=torch.contiguous_format)
    for where, vector, coefficient, _ in _terms(pattern, values, x, time, *options):
        _add_scaled(y, where, vector, coefficient)
    return y


@torch.library.custom_op(
    "torchlb::heat_backward",
    mutates_args=(),
    schema=SCHEMA + ", Tensor grad) -> (Tensor, Tensor)",
)
def _heat_backward(
    pattern: Any, values: Tensor, x: Tensor, time: Tensor, *options: Any
) -> tuple[Tensor, Tensor]:
    *rest, grad = options
    grad_x = torch.zeros_like(x, memory_format=torch.contiguous_format)
    grad_t = torch.zeros_like(time)
    for where, vector, coefficient, slope in _terms(pattern, values, grad, time, *rest):
        _add_scaled(grad_x, where, vector, coefficient)
        grad_t[where[1]] += ((vector * x[where]).sum(0) * _like(slope, vector)).to(time)
    return grad_x, grad_t


@heat.register_fake
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
    return [None] * len(pattern), None, *gradients, None, None, None


def _refuse(ctx: Any, *grads: Tensor) -> Any:
    raise DerivativeError(DIFFERENTIABLE_ONCE)


heat.register_autograd(_backward, setup_context=_save)
_heat_backward.register_autograd(_refuse)


def _add_scaled(
    y: Tensor, where: tuple[slice, Any], vector: Tensor, coefficient: np.ndarray
) -> None:
    """Add c_k v_k to some rows and columns of y."""
    if isinstance(where[1], slice):
        y[where].addcmul_(vector, _like(coefficient, vector))
    else:
        y[where] += (vector * _like(coefficient, vector)).to(y)


def _like(coefficient: np.ndarray, vector: Tensor) -> Tensor:
    return torch.from_numpy(coefficient).to(vector.device, vector.dtype)


def _terms(
    pattern: Sequence[Tensor],
    values: Tensor,
    x: Tensor,
    time: Tensor,
    radius: Tensor,
    tolerance: float,
    sizes: Sequence[int],
) -> Iterator[Term]:
    """Terms ((rows, columns), v_k, c_k, c_k') of the shorter expansion; the choice cannot be traced."""
    times = time.detach().double().cpu().numpy()
    if len(times) == 0 or len(x) == 0:
        return iter(())
    if _estimate(float(times.max()) * float(radius), tolerance) < PRODUCTS:
        return _polynomial(pattern, values, x, times, float(radius), tolerance, sizes)
    return _rational(pattern, values, x.double(), times, tolerance)


def _estimate(scaled: float, tolerance: float) -> float:
    """Upper bound on the products that the Chebyshev series takes for tR."""
    digits = log(1 / tolerance)
    return sqrt(2 * digits * scaled) + 2 * digits + 8


def chebyshev_coefficients(scaled: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients c_k for tR and their derivatives in tR, (K, C), up to a tail that sums to less than the tolerance.

    >>> chebyshev_coefficients(np.array([0.0]), 1e-7)[0].tolist()
    [[1.0], [0.0]]
    """
    half, place = np.unique(scaled / 2, return_inverse=True)
    k = np.arange(-1, int(_estimate(float(scaled.max()), tolerance)) + 2)[:, None]
    bessel = ive(np.abs(k), half)
    c = 2 * bessel[1:-1]
    slope = (bessel[:-2] + bessel[2:] - 2 * bessel[1:-1]) / 2
    c[0] /= 2
    slope[0] /= 2
    tail = np.cumsum(c[::-1], axis=0)[::-1].max(1)
    count = max(int((tail > tolerance).sum()), 2)
    c, slope = c[:count], slope[:count]
    c[0] += 1 - c.sum(0)
    slope[0] -= slope.sum(0)
    return c[:, place], slope[:, place]


def _polynomial(
    pattern: Sequence[Tensor],
    values: Tensor,
    x: Tensor,
    times: np.ndarray,
    radius: float,
    tolerance: float,
    sizes: Sequence[int],
) -> Iterator[Term]:
    c, slope = chebyshev_coefficients(times * radius, tolerance)
    crow, col = pattern
    scaled = values * (2 / max(radius, TINY))
    for rows, matrix in _blocks(crow, col, scaled, x, sizes):

        def shifted(v: Tensor, matrix: tuple[Tensor, Tensor, Tensor] = matrix) -> Tensor:
            return multiply(*matrix, v).add_(v)

        for k, v in enumerate(chebyshev_vectors(shifted, x[rows], len(c))):
            yield (rows, slice(None)), v, c[k], radius * slope[k]


def chebyshev_vectors(
    operator: Callable[[Tensor], Tensor], x: Tensor, count: int
) -> Iterator[Tensor]:
    """T_k(A)x for k < count."""
    yield x
    before, v = x, x
    for k in range(1, count):
        before, v = v, operator(v) if k == 1 else 2 * operator(v) - before
        yield v


def _blocks(
    crow: Tensor, col: Tensor, values: Tensor, x: Tensor, sizes: Sequence[int]
) -> Iterator[tuple[slice, tuple[Tensor, Tensor, Tensor]]]:
    """Yield diagonal blocks (rows, (crow, col, values)): on the CPU as many as stay in its cache, else all at once."""
    limit = AT_ONCE if x.device.type == "cpu" else len(x)
    ends = list(accumulate(sizes))
    start = 0
    for end, following in zip(ends, [*ends[1:], inf], strict=True):
        if following - start > limit:
            first, last = int(crow[start]), int(crow[end])
            pattern = crow[start : end + 1] - first, col[first:last] - start
            yield slice(start, end), (*pattern, values[first:last])
            start = end


def _rational(
    pattern: Sequence[Tensor], values: Tensor, x: Tensor, times: np.ndarray, tolerance: float
) -> Iterator[Term]:
    crow, col = pattern
    parts = [t.cpu().numpy() for t in (values.detach().double(), col, crow)]
    matrix: Any = sparse.csr_array(tuple(parts), shape=(len(x), len(x)))
    every, still = slice(None), np.flatnonzero(times == 0)
    if len(still):
        columns = torch.from_numpy(still).to(x.device)
        part, one = x[:, columns].contiguous(), np.ones(len(still))
        yield (every, columns), part, one, 0 * one
        yield (every, columns), multiply(crow, col, values.double(), part), 0 * one, one
    for pole, chosen in poles(times):
        factor = Factor(sparse.csr_array(sparse.eye_array(len(x)) - pole * matrix))
        c, slope = rational_coefficients(times[chosen] / pole, tolerance)
        columns = torch.from_numpy(chosen).to(x.device)

        def doubled(v: Tensor, factor: Factor = factor) -> Tensor:
            return 2 * factor.solve(v) - v

        for k, v in enumerate(chebyshev_vectors(doubled, x[:, columns].contiguous(), len(c))):
            yield (every, columns), v, c[k], slope[k] / pole


def poles(times: np.ndarray) -> Iterator[tuple[float, np.ndarray]]:
    """Yield (γ, indices of its times) for positive times; γ is a power of ten, shared by similar times."""
    level = np.floor(np.log10(np.where(times > 0, times / SHORTEST, 1.0)))
    for exponent in np.unique(level[times > 0]).tolist():
        yield 10.0**exponent, np.flatnonzero((level == exponent) & (times > 0))


def rational_coefficients(
    ratios: np.ndarray, tolerance: float, order: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of T_k(2Z − 1) for several t/γ, (K, C): of e^{tL}'s derivative of an order in t/γ, and of the next.

    Exact for constants, z = 1.

    >>> c, slope = rational_coefficients(np.array([10.0]), 1e-7)
    >>> bool(abs(np.polynomial.chebyshev.chebval(2 / (1 + 0.3) - 1, c[:, 0]) - np.exp(-10 * 0.3)) < 1e-7)
    True
    """
    parts = zip(*(_coefficients(ratio, tolerance, order) for ratio in ratios.tolist()), strict=True)
    c, slope = (np.stack(part, 1) for part in parts)
    count = int(c.any(1).sum())
    return c[:count], slope[:count]


@lru_cache(maxsize=4096)
def _coefficients(ratio: float, tolerance: float, order: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients for one ratio, with a negligible tail set to zero."""
    decay = 2 / (1 + np.cos(np.pi * (np.arange(POINTS) + 0.5) / POINTS)) - 1
    flow = (-decay) ** order * np.exp(-ratio * decay)
    c, slope = np.asarray(dct(np.stack([flow, -decay * flow]))) / POINTS
    c[0], slope[0] = c[0] / 2, slope[0] / 2
    count = int((np.cumsum(np.abs(c[::-1]))[::-1] > tolerance / 2).sum())
    c[count:] = slope[count:] = 0
    c[0] += (order == 0) - c.sum()
    slope[0] -= slope.sum()
    return c, slope
