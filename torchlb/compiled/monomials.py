"""Monomials at many places, compiled."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit("float64[:, :, ::1](float64[:, :, ::1], int64[:, ::1])", cache=True, nogil=True)
@no_type_check
def monomials(coords: np.ndarray, factors: np.ndarray) -> np.ndarray:
    """Values (B, M, K) at the places (B, K, d).

    Parameters
    ----------
    factors : (M, 2), of each monomial its first variable, and the place of what is left without that.
    """
    batch, size, dim = coords.shape
    found = np.empty((batch, len(factors), size))
    for b in range(batch):
        for m in range(dim):
            for k in range(size):
                found[b, m, k] = coords[b, k, m]
        for m in range(dim, len(factors)):
            first, rest = factors[m]
            for k in range(size):
                found[b, m, k] = found[b, first, k] * found[b, rest, k]
    return found
