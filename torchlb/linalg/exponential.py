r"""The rational series of e^{tL}, L ≤ 0, for many channels, each with its own time (`method.md`, 8).

It is a Chebyshev series of Z = (1 − γL)⁻¹: in z = 1/(1 + γλ), between 0 and 1, e^{−tλ} is smooth for all t between 5γ
and 50γ, and takes about 20 solves. It preserves constants exactly.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache

import numpy as np
from scipy.fft import dct
from torch import Tensor

SHORTEST = 5.0
"""Ratio t/γ of the shortest time that shares a pole γ, a power of ten; the longest is ten times longer."""
POINTS = 256
"""Number of Chebyshev points that the coefficients of rational functions are interpolated at."""


def chebyshev_vectors(
    operator: Callable[[Tensor], Tensor], x: Tensor, count: int
) -> Iterator[Tensor]:
    """T_k(A)x for k < count."""
    yield x
    before, v = x, x
    for k in range(1, count):
        before, v = v, operator(v) if k == 1 else 2 * operator(v) - before
        yield v


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
