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
    crow, column, here = (
        np.zeros(count + 1, np.int64),
        np.zeros(count + 1, np.int64),
        np.empty(count, np.int64),
    )
    for row in range(count):
        here[number[row]] = row
        for entry in range(indptr[row], indptr[row + 1]):
            other = indices[entry]
            crow[number[row] + 1] += 1
            if other != row:
                crow[number[other] + 1] += 1
                column[other + 1] += 1
    for row in range(count):
        crow[row + 1] += crow[row]
        column[row + 1] += column[row]
    free, above, source = (
        column.copy(),
        np.empty(column[count], np.int32),
        np.empty(column[count], np.int32),
    )
    for row in range(count):
        for entry in range(indptr[row], indptr[row + 1]):
            other = indices[entry]
            if other != row:
                above[free[other]], source[free[other]] = row, entry
                free[other] += 1
    free, diagonal = crow.copy(), crow[:-1].copy()
    col, values = np.empty(crow[count], np.int64), np.empty((2, crow[count]))
    for row in range(count):  # into all rows that it has an entry in
        old = here[row]
        right = indptr[old + 1] - indptr[old]
        for step in range(right + column[old + 1] - column[old]):
            if step < right:
                entry = indptr[old] + step
                other = number[indices[entry]]
            else:
                place = column[old] + step - right
                entry, other = source[place], number[above[place]]
            if other == row:
                diagonal[row] = free[row]
            col[free[other]] = row
            values[0, free[other]] = data[entry].real
            values[1, free[other]] = data[entry].imag
            free[other] += 1
    return crow, col, values, diagonal
