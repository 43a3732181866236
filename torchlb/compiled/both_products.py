"""Products of two matrices on one pattern with the same columns, compiled: these are read once."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit(
    "UniTuple(float64[:, ::1], 2)(int32[::1], int32[::1], float64[::1], float64[::1], float64[:, ::1])",
    error_model="numpy",
    cache=True,
    nogil=True,
)
@no_type_check
def both_products(
    indptr: np.ndarray, indices: np.ndarray, one: np.ndarray, two: np.ndarray, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """As `linalg.sparse.both_products`, of CSR matrices with these values."""
    rows, columns = len(indptr) - 1, x.shape[1]
    first, second = np.empty((rows, columns)), np.empty((rows, columns))
    for row in range(rows):
        for c in range(columns):
            first[row, c], second[row, c] = 0.0, 0.0
        for entry in range(indptr[row], indptr[row + 1]):
            place, a, b = indices[entry], one[entry], two[entry]
            for c in range(columns):
                first[row, c] += a * x[place, c]
                second[row, c] += b * x[place, c]
    return first, second
