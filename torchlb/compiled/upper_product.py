"""Rows of the upper triangle of PᵀAP, compiled: two real matrices A on one pattern at once."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit(
    "Tuple((int64[::1], int32[::1], complex128[::1]))(int64, int64, int64[::1], int32[::1], float64[::1], "
    "int64[::1], int32[::1], complex128[::1], int64[::1], int32[::1], float64[::1])",
    cache=True,
    nogil=True,
)
@no_type_check
def upper_product(
    first: int,
    room: int,
    left_ends: np.ndarray,
    left_nodes: np.ndarray,
    left: np.ndarray,
    ends: np.ndarray,
    nodes: np.ndarray,
    matrix: np.ndarray,
    right_ends: np.ndarray,
    columns: np.ndarray,
    right: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Entries in each of the rows from `first` on, their columns and values, zeros left out.

    Parameters
    ----------
    room : entries at most, N or more: there are as many rows as go into that.
    left_ends, …, right : of Pᵀ, A and P row pointers, columns and values; columns of P ascend.
    """
    count, num_nodes = len(left_ends) - 1, len(ends) - 1
    met, half = np.zeros(num_nodes, np.int32), np.empty(num_nodes, np.complex128)  # a row of PᵀA
    order = np.empty(num_nodes, np.int32)
    seen, total = np.zeros(count, np.int32), np.empty(count, np.complex128)  # and of the product
    found = np.empty(count, np.int32)
    indices, data = np.empty(room, np.int32), np.empty(room, np.complex128)
    length, rows, filled = np.empty(count - first, np.int64), 0, 0
    for row in range(first, count):
        mark, size = row + 1, 0
        for a in range(left_ends[row], left_ends[row + 1]):
            for b in range(ends[left_nodes[a]], ends[left_nodes[a] + 1]):
                node, value = nodes[b], left[a] * matrix[b]
                if met[node] == mark:
                    half[node] += value
                else:
                    met[node], half[node], order[size] = mark, value, node
                    size += 1
        entries = 0
        for a in range(size - 1, -1, -1):  # as SciPy does, so that sums are the same
            node = order[a]
            for b in range(right_ends[node + 1] - 1, right_ends[node] - 1, -1):
                column = columns[b]
                if column < row:
                    break
                value = half[node] * right[b]
                if seen[column] == mark:
                    total[column] += value
                else:
                    seen[column], total[column], found[entries] = mark, value, column
                    entries += 1
        if filled + entries > room:
            break
        start = filled
        for a in range(entries):
            if total[found[a]] != 0:
                indices[filled], data[filled] = found[a], total[found[a]]
                filled += 1
        length[rows] = filled - start
        rows += 1
    return length[:rows], indices[:filled], data[:filled]
