"""Delaunay tetrahedra, compiled or by Qhull."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import Delaunay

from torchlb import compiled

BY_QHULL = 2e-5
"""Seconds a point that Qhull takes."""
THIN = 8
"""One of so many points in their order comes first, and of these again."""
ROOM = 16
"""Tetrahedra for a point while they are made; most often 7 to 9, of random points on a cylinder 14."""
BEYOND = -1

Cells = tuple[Int[np.ndarray, "T 4"], Int[np.ndarray, "T 4"]]
"""Corners, and which tetrahedron is beside each, opposite to that corner: `BEYOND` for none."""


def delaunay_tetrahedra(points: Float[np.ndarray, "N 3"]) -> Cells:
    """The tetrahedra of points in general position, corners and rows in ascending order.

    QhullError if they are in a plane.
    """
    kernel = compiled.kernel("delaunay", BY_QHULL * len(points))
    if kernel is not None and len(points) > 3:
        order = _by_rounds(points)
        corners, beside = kernel(np.ascontiguousarray(points), order, ROOM * len(points) + 256)
        if len(corners):
            return corners, beside
    return _by_qhull(points)


@compiled.standing_in()
def _by_qhull(points: Float[np.ndarray, "N 3"]) -> Cells:
    found = Delaunay(points - points.mean(0))  # far from the origin it merges what is apart
    by_number = found.simplices.argsort(axis=1)
    both = (found.simplices, found.neighbors)
    corners, beside = (np.take_along_axis(x, by_number, 1).astype(np.int64) for x in both)
    order = np.lexsort(corners.T[::-1])
    number = np.append(np.empty_like(order), BEYOND)
    number[order] = np.arange(len(order))
    return corners[order], number[beside[order]]


def _by_rounds(points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"]:
    """The order in which points come: four far apart first, then ever more, along the order in which they are."""
    offset = points - points[0]
    second = (offset**2).sum(1).argmax()
    third = (np.cross(offset, offset[second]) ** 2).sum(1).argmax()
    volume = offset @ np.cross(offset[second], offset[third])
    fourth = np.abs(volume).argmax()
    first = [0, second, third, fourth] if volume[fourth] < 0 else [second, 0, third, fourth]
    last_round = np.zeros(len(points), dtype=int)
    step = THIN
    while step < len(points):
        last_round[::step] -= 1
        step *= THIN
    last_round[first] = np.arange(-4, 0) + last_round.min()
    return last_round.argsort(kind="stable")
