"""Left inverses of many small matrices, compiled: 64 at a time, one beside the other in memory."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

LANES = 64
"""Matrices at a time; 16 to 128 take about as long."""


@njit(error_model="numpy")
@no_type_check
def _product(x: np.ndarray, y: np.ndarray, total: np.ndarray) -> None:
    """Inner products of columns."""
    size, lanes = x.shape
    for a in range(lanes):
        total[a] = x[0, a] * y[0, a]
    for k in range(1, size):
        for a in range(lanes):
            total[a] += x[k, a] * y[k, a]


@njit(error_model="numpy")
@no_type_check
def _subtract(factor: np.ndarray, x: np.ndarray, y: np.ndarray) -> None:
    """Take so much of one column from another."""
    size, lanes = x.shape
    for k in range(size):
        for a in range(lanes):
            y[k, a] -= factor[a] * x[k, a]


@njit(error_model="numpy")
@no_type_check
def _scale(x: np.ndarray, factor: np.ndarray) -> None:
    size, lanes = x.shape
    for k in range(size):
        for a in range(lanes):
            x[k, a] *= factor[a]


@njit(
    "Tuple((float64[:, :, ::1], float64[::1]))(float64[:, :, ::1], float64[:, ::1])",
    error_model="numpy",
    cache=True,
    nogil=True,
)
@no_type_check
def left_inverse(columns: np.ndarray, root: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """As `fits.least_squares.left_inverse`, from the columns of V one after the other, (B, M, K), and √ω, (B, K)."""
    batch, terms, size = columns.shape
    lanes = max(min(LANES, batch), 1)
    found, condition = np.empty_like(columns), np.empty(batch)
    a, r = np.ones((terms, size, lanes)), np.empty((terms, terms, lanes))
    square, total, some = np.empty((terms, lanes)), np.empty(lanes), np.empty(lanes)
    for first in range(0, batch, lanes):
        count = min(lanes, batch - first)
        for j in range(terms):
            for k in range(size):
                for b in range(count):
                    a[j, k, b] = columns[first + b, j, k] * root[first + b, k]
        for j in range(terms):
            _product(a[j], a[j], square[j])
        for j in range(terms):
            _product(a[j], a[j], total)
            for b in range(lanes):
                r[j, j, b] = 1 / np.sqrt(total[b])
            _scale(a[j], r[j, j])
            for i in range(j + 1, terms):
                _product(a[i], a[j], r[j, i])
                _subtract(r[j, i], a[j], a[i])
        total[:] = 0.0
        for j in range(terms - 1, -1, -1):
            _scale(a[j], r[j, j])
            for i in range(j):
                _subtract(r[i, j], a[j], a[i])
        for j in range(terms):
            _product(a[j], a[j], some)
            for b in range(lanes):
                total[b] += some[b] * square[j, b]
        for b in range(count):
            condition[first + b] = np.sqrt(total[b])
        for j in range(terms):
            for k in range(size):
                for b in range(count):
                    found[first + b, j, k] = a[j, k, b] * root[first + b, k]
    return found, condition
