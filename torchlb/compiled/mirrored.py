"""A symmetric matrix from its upper triangle, compiled: transposing what is sorted in no way sorts it."""

from __future__ import annotations

from typing import Any, no_type_check

import numpy as np
from numba import njit


@njit(
    "Tuple((int64[::1], int64[::1], float64[:, ::1], int64[::1]))(int64[::1], int32[::1], complex128[::1], int64[::1])",
    cache=True,
    nogil=True,
)
@no_type_check
def mirrored(indptr: np.ndarray, indices: np.ndarray, data: np.ndarray, number: np.ndarray) -> Any:
    """CSR with ascending columns: row pointers, columns, real and imaginary parts, and where the diagonal is.

    Parameters
    ----------
    indptr, indices, data : CSR, of each pair of rows one entry.
    number : the numbers that rows and columns get.
    """
    count = len(number)
    crow = np.zeros(count + 1, np.int64)
    for row in range(count):
        for entry in range(indptr[row], indptr[row + 1]):
            here, there = number[row], number[indices[entry]]
            crow[here + 1] += 1
            if here != there:
                crow[there + 1] += 1
    for row in range(count):
        crow[row + 1] += crow[row]
    free, partner, source = (
        crow.copy(),
        np.empty(crow[count], np.int32),
        np.empty(crow[count], np.int32),
    )
    for row in range(count):
        for entry in range(indptr[row], indptr[row + 1]):
            here, there = number[row], number[indices[entry]]
            partner[free[here]], source[free[here]] = there, entry
            free[here] += 1
            if here != there:
                partner[free[there]], source[free[there]] = here, entry
                free[there] += 1
    col, values = np.empty(crow[count], np.int64), np.empty((2, crow[count]))
    free, diagonal = crow.copy(), crow[:-1].copy()
    for row in range(count):
        for place in range(crow[row], crow[row + 1]):
            other, entry = partner[place], source[place]
            if other == row:
                diagonal[row] = free[row]
            col[free[other]] = row
            values[0, free[other]] = data[entry].real
            values[1, free[other]] = data[entry].imag
            free[other] += 1
    return crow, col, values, diagonal
