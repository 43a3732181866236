"""Which points may enter a stencil, compiled for hypersurfaces."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit(
    "boolean[::1](float64[:, ::1], float64[:, ::1], int64[::1], int64[::1], float64, float64)",
    cache=True,
    nogil=True,
)
@no_type_check
def admissible(
    points: np.ndarray,
    normals: np.ndarray,
    centers: np.ndarray,
    others: np.ndarray,
    slope: float,
    alignment: float,
) -> np.ndarray:
    """As `geometry.admission.admissible`, with unit normals; `slope` and `alignment` are its bounds."""
    found = np.empty(len(centers), np.bool_)
    for pair in range(len(centers)):
        center, other = centers[pair], others[pair]
        total, height, cosine = 0.0, 0.0, 0.0
        for x in range(points.shape[1]):
            step = points[other, x] - points[center, x]
            total += step * step
            height += step * normals[center, x]
            cosine += normals[other, x] * normals[center, x]
        found[pair] = height * height <= slope**2 * total and abs(cosine) >= alignment
    return found
