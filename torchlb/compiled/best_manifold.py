"""The choice of triangles for a manifold, compiled: one after the other, best first."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit


@njit("boolean[::1](int64[:, ::1], float64[:, :, ::1], int64, float64)", cache=True, nogil=True)
@no_type_check
def best_manifold(edges: np.ndarray, wings: np.ndarray, count: int, fold: float) -> np.ndarray:
    """Which triangles are taken.

    Parameters
    ----------
    edges : (F, 3), numbers below `count`.
    wings : (F, 3, 3), unit vectors from them into the triangle.
    fold : cosine between two of these above which they fold back.
    """
    taken = np.zeros(len(edges), np.bool_)
    uses, first = np.zeros(count, np.int8), np.empty((count, 3))
    for face in range(len(edges)):
        fits = True
        for side in range(3):
            edge = edges[face, side]
            if uses[edge] > 1:
                fits = False
            elif uses[edge] == 1:
                cosine = 0.0
                for x in range(3):
                    cosine += first[edge, x] * wings[face, side, x]
                if cosine > fold:
                    fits = False
        if fits:
            taken[face] = True
            for side in range(3):
                edge = edges[face, side]
                uses[edge] += 1
                for x in range(3):
                    first[edge, x] = wings[face, side, x]
    return taken
