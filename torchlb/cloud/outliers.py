"""Lone points, which scanners leave in mid-air: they lie on no surface, and must not join what is apart.

At the edges of a depth image pixels hang between the front and the back; other scanners leave points about.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from torchlb.geometry.thresholds import AROUND, RING, ROUGH
from torchlb.geometry.vectors import inner, lengths

LONE = 2.5
"""Least spacing of a lone point, over the lower quartile of its neighbours'."""
HIGH = 0.2
"""Least sine of the angle at which a lone point stands above the plane of its neighbours, seen from their centroid."""


def spacing_at(
    points: Float[np.ndarray, "N 3"], near: Int[np.ndarray, "N K"], number: int = AROUND
) -> Float[np.ndarray, " N"]:
    """Spacing around each point: the distance to its neighbour of this number, ℓ."""
    return lengths(points[near[:, min(number, near.shape[1] - 1)]] - points)


def lone_points(
    points: Float[np.ndarray, "N 3"], near: Int[np.ndarray, "N K"]
) -> Bool[np.ndarray, " N"]:
    """Points with a far larger spacing than their neighbours, off the plane of these, and in none with their like.

    At a jump in density half a disc of twice the spacing holds twelve other points of a like spacing.
    """
    lone = np.zeros(len(points), dtype=bool)
    spacing = spacing_at(points, near)
    usual = np.partition(spacing[near[:, 1:]], near.shape[1] // 4, axis=1)[:, near.shape[1] // 4]
    far = np.flatnonzero(spacing > LONE * usual)
    if len(far) == 0:
        return lone
    around = points[near[far, 1:]]
    middle = around.mean(1)
    normal = np.linalg.svd(around - middle[:, None], full_matrices=False)[2][:, 2]
    above = points[far] - middle
    lone[far] = np.abs(inner(above, normal)) > HIGH * lengths(above)
    octave = np.floor(np.log2(spacing[far]))
    for scale in np.unique(octave):
        alike = points[spacing >= 2.0 ** (scale - 1)]
        if len(alike) > RING:
            own = far[octave == scale]
            found = KDTree(alike).query(points[own], k=RING + 1)
            distance, mates = (np.asarray(part) for part in found)
            offset = alike[mates[:, 1:]] - points[own, None]
            offset = np.concatenate([0 * offset[:, :1], offset], 1)
            offset -= offset.mean(1, keepdims=True)
            _, middle, least = np.linalg.svd(offset, compute_uv=False).T
            lone[own] &= (least >= ROUGH * middle) | (distance[:, -1] > 2 * spacing[own])
    return lone


def put_beside(
    points: Float[np.ndarray, "N 3"], lone: Bool[np.ndarray, " N"]
) -> Float[np.ndarray, "N 3"]:
    """All points, the lone ones moved beside the nearest other, at most a third of the way to a neighbour of that."""
    moved, others = points.copy(), np.flatnonzero(~lone)
    tree = KDTree(points[others])
    host = np.asarray(tree.query(points[lone])[1])
    ring = np.asarray(tree.query(points[others[host]], k=min(AROUND + 1, len(others)))[1])
    order, size = np.argsort(host, kind="stable"), ring.shape[1] - 1
    turn = np.empty_like(host)  # index of a lone point among those of its host
    turn[order] = np.arange(len(host)) - np.searchsorted(host[order], host[order])
    end = points[others[ring[np.arange(len(host)), 1 + turn % size]]]
    start = points[others[host]]
    share = 1 / (3.0 + turn // size)
    moved[lone] = start + share[:, None] * (end - start)
    return moved
