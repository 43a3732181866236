"""Noise of a cloud, denoising by local quadratics, and lone points (`method.md`, section 12).

At the edges of a depth image pixels hang between the front and the back; other scanners leave points about. They lie on
no surface, and must not join what is apart.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from torchlb.cloud.frames import local_polynomials
from torchlb.fits.polynomials import num_monomials
from torchlb.geometry.thresholds import AROUND, KINK, RING, ROUGH
from torchlb.geometry.vectors import Frames, Mask, Near, Points, Vectors, inner, lengths, unit
from torchlb.linalg.precision import AT_ONCE, NEGLIGIBLE

SMOOTH = 4.0
"""F from which on the residual of quadratics is taken for shape: 6 and more of clean clouds, 1.5 to 4 with noise of a
twentieth of the spacing, 1 of pure noise."""
SAMPLE = 2000
"""Number of points by which a cloud is judged."""
LONE = 2.5
"""Least spacing of a lone point, over the lower quartile of its neighbours'."""
HIGH = 0.2
"""Least sine of the angle at which a lone point stands above the plane of its neighbours, seen from their centroid."""


def denoised(points: Points, planes: Points | Frames, candidates: Near) -> tuple[Points, float]:
    """(points on the shape; root mean square distance of the cloud from it, ℓ); the points and 0 if it is clean.

    Quartics follow a smooth shape where quadratics do not: F, the variance removed by the quartic terms over that which
    remains, is large. Noise has as much in every term. Noisy points move onto the quadratics through their
    neighbourhoods, along the normals of a surface or orthogonally to tangent frames.
    """
    dim = points.shape[1] - 1 if planes.ndim == 2 else planes.shape[2]
    size, terms = candidates.shape[1], [num_monomials(dim, degree) for degree in (2, 4)]
    if size < terms[1] + 3:
        return points, 0.0
    some = candidates[:: -(-len(points) // SAMPLE)]
    _, left, radius, count = local_polynomials(points, planes, some, 2, weighted=False)
    two = left.square().sum((1, 2))
    four = local_polynomials(points, planes, some, 4, weighted=False)[1].square().sum((1, 2))
    free = count - terms[0], count - terms[1]
    use = (free[1] > 2) & (two > free[0] * (NEGLIGIBLE * radius) ** 2)
    ratio = (two - four) / (free[0] - free[1]) / (four / free[1])
    if use.double().mean() < 0.5 or ratio[use].median() > SMOOTH:
        return points, 0.0
    moved, squares = points.clone(), []
    for part in candidates.split(AT_ONCE):
        found, left, _, count = local_polynomials(points, planes, part, 2, weighted=False)
        known = count > terms[0] + 2
        moved[part[:, 0]] += torch.where(known[:, None], found[:, 0], 0.0)
        squares.append((left.square().sum((1, 2)) / (count - terms[0]))[known])
    return moved, float(torch.cat(squares).median().sqrt())


def spacing_at(
    points: Vectors, near: Int[np.ndarray, "N K"], number: int = AROUND
) -> Float[np.ndarray, " N"]:
    """Spacing around each point: the distance to its neighbour of this number, ℓ."""
    return lengths(points[near[:, min(number, near.shape[1] - 1)]] - points)


def lone_points(points: Vectors, near: Int[np.ndarray, "N K"]) -> Mask:
    """Points with a far larger spacing than their neighbours, off the plane of these, and in none with their like.

    Others such as they do not tilt the plane, as the second of two that hang beside each other would. Points that see
    all neighbours in one direction may lie in it, as past the end of a limb: at the edge of a denser part neighbours
    spread along the edge. At a jump in density half a disc of twice the spacing holds twelve other points of a like
    spacing. Of many outliers some lie in one plane by chance, but most of their like are lone, too.
    """
    lone, spacing = np.zeros(len(points), dtype=bool), spacing_at(points, near)
    usual = np.partition(spacing[near[:, 1:]], near.shape[1] // 4, axis=1)[:, near.shape[1] // 4]
    apart = spacing > LONE * usual
    far = np.flatnonzero(apart)
    if len(far) == 0:
        return lone
    around, kept = points[near[far, 1:]], ~apart[near[far, 1:], None]
    kept |= ~kept.any(1, keepdims=True)
    middle = (kept * around).sum(1) / kept.sum(1)
    offset = kept * (around - middle[:, None])
    normal = np.linalg.svd(offset, full_matrices=False)[2][:, 2]
    above = points[far] - middle
    away = unit(points[far, None] - around)
    narrow = inner(away, unit(above)[:, None]).min(1, where=kept[..., 0], initial=1.0) > KINK
    left = far[narrow | (np.abs(inner(above, normal)) > HIGH * lengths(above))]
    mates = _mates_in_a_sheet(points, spacing, left)
    found = (mates == left[:, None]).all(1)
    while found.any():
        lone[left[found]] = True
        left, mates = left[~found], mates[~found]
        found = lone[mates].mean(1) > 0.5
    return lone


def _mates_in_a_sheet(
    points: Vectors, spacing: Float[np.ndarray, " N"], some: Int[np.ndarray, " M"]
) -> Int[np.ndarray, "M K"]:
    """The nearest points of at least half the spacing of each of some, if all lie on one sheet, else itself alone."""
    mates = some[:, None].repeat(RING, axis=1)
    octave = np.floor(np.log2(spacing[some]))
    for scale in np.unique(octave):
        alike, own = np.flatnonzero(spacing >= 2.0 ** (scale - 1)), np.flatnonzero(octave == scale)
        if len(alike) <= RING:
            continue
        found = KDTree(points[alike]).query(points[some[own]], k=RING + 1)
        distance, near = np.asarray(found[0])[:, -1], alike[np.asarray(found[1])]
        offset = points[near] - points[near].mean(1, keepdims=True)
        _, middle, least = np.linalg.svd(offset, compute_uv=False).T
        sheet = (least < ROUGH * middle) & (distance <= 2 * spacing[some[own]])
        mates[own[sheet]] = near[sheet, 1:]
    return mates


def put_beside(points: Vectors, lone: Mask) -> Vectors:
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
