"""The edges of triangles, compiled: half-edges sorted by both ends, by counting."""

from __future__ import annotations

from typing import Any, no_type_check

import numpy as np
from numba import njit


@njit(
    "Tuple((int64[::1], int64[::1], int64[::1], int64[::1]))(int64[:, ::1], int64)",
    cache=True,
    nogil=True,
)
@no_type_check
def edges(faces: np.ndarray, count: int) -> Any:
    """The arrays of `geometry.manifold.Edges`: keys, of, uses and order."""
    size = 3 * len(faces)
    ends = np.empty((2, size), np.int64)
    for face in range(len(faces)):
        for k in range(3):
            one, two = faces[face, (k + 1) % 3], faces[face, (k + 2) % 3]
            ends[0, 3 * face + k], ends[1, 3 * face + k] = min(one, two), max(one, two)
    order = np.arange(size)
    for end in (1, 0):
        place = np.zeros(count + 1, np.int64)
        for half in range(size):
            place[ends[end, half] + 1] += 1
        for point in range(count):
            place[point + 1] += place[point]
        before, order = order, np.empty(size, np.int64)
        for half in before:
            order[place[ends[end, half]]] = half
            place[ends[end, half]] += 1
    keys, of, uses = np.empty(size, np.int64), np.empty(size, np.int64), np.zeros(size, np.int64)
    found, last = 0, np.int64(-1)
    for half in order:
        key = ends[0, half] * count + ends[1, half]
        if key != last:
            keys[found], last = key, key
            found += 1
        of[half] = found - 1
        uses[found - 1] += 1
    return keys[:found].copy(), of, uses[:found].copy(), order
