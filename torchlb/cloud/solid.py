"""Delaunay tetrahedra of the points of a solid in R³, without those outside of it.

Random points of density ρ leave a ball of volume V empty with probability e^{−ρV}. So the empty spheres around the
tetrahedra of a solid are no larger than chance makes one in the cloud; those across a notch, a hole or a cavity are (an
*alpha shape*, Edelsbrunner and Mücke 1994, of a radius that follows the local spacing).
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchlb.cloud.complexes import Complex
from torchlb.errors import InputError, first_few
from torchlb.geometry.complex import circumcenters, components, delaunay
from torchlb.geometry.neighbors import nearest_neighbors
from torchlb.geometry.thresholds import RING, WIDER
from torchlb.geometry.vectors import lengths
from torchlb.linalg.precision import NEGLIGIBLE, TINY

SURE = 5.0
"""One cloud in e to this power has a wrong cavity by chance."""
SHEAR = np.eye(3) + 1e-3 * np.array([[0, 0.9, 0.7], [0, 0, 0.8], [0, 0, 0]])
"""Shear of the points before they are triangulated, by which the cells of a grid are all cut alike."""


def cloud_solid(points: Float[Tensor, "N 3"]) -> Complex:
    """The solid filled by the points; they must not lie in a plane, nor some of them far from all others."""
    places = points.numpy()
    spread = np.linalg.svd(places - places.mean(0), compute_uv=False)
    if spread[2] <= NEGLIGIBLE * spread[0]:
        raise InputError(
            f"points: all {len(points)} lie in a plane, and fill no solid; a surface has dim=2"
        )
    near = nearest_neighbors(points, min(2 * RING + 1, len(points))).numpy()
    reach = lengths(places[near[:, -1]] - places)
    found = delaunay(places @ SHEAR)
    cells, beside = (x.astype(np.int64) for x in (found.simplices, found.neighbors))
    center, six = circumcenters(places, cells)
    radius = lengths(center) / np.maximum(np.abs(six), TINY)
    ends = [places[cells[:, k]] for k in range(4)]
    longest = np.max([lengths(a - b) for a, b in combinations(ends, 2)], axis=0)
    flat = np.abs(six) / 6 <= NEGLIGIBLE * longest**3
    count = near.shape[1] - 1
    even = count * np.mean((lengths(places[near[:, 1]] - places) / reach) ** 3)
    # random points have 24π²/35 Delaunay tetrahedra each (Meijering 1953)
    chance = (np.log(24 / 35 * np.pi**2 * len(points)) + SURE) / count / max(1.0, even / WIDER)
    kept = flat | (radius <= chance ** (1 / 3) * np.sort(reach[cells], 1)[:, 2])
    i, j = np.arange(len(kept)).repeat(4), beside.ravel()
    both = (j >= 0) & ~kept[i] & ~kept[j]
    piece = components(i[both], j[both], len(kept))
    kept |= np.bincount(piece)[piece] < RING  # a dent of few cells is none
    beyond = np.append(kept, False)  # index −1 is beyond the hull, where nothing is kept
    while (peeled := kept & flat & ~beyond[beside].all(1)).any():
        kept &= ~peeled
        beyond[:-1] = kept
    alone = np.setdiff1d(np.arange(len(points)), cells[kept])
    if len(alone):
        raise InputError(
            f"points: {len(alone)} ({first_few(torch.from_numpy(alone))}) are farther from all others than points of "
            "a solid are apart, and no tetrahedron reaches them; leave them out, or add points between"
        )
    return Complex(points=points, cells=torch.from_numpy(cells[kept]))
