"""Simplices through a cloud of any codimension, from the star of every point in its tangent plane.

The star is that of the Delaunay triangulation of the neighbours, projected there: the tangential Delaunay complex
(Boissonnat and Ghosh 2014). On a surface the stars nearly agree; where they do not, triangles are taken greedily, those
of more stars first, unless they fold back on another or share an edge with two; one fan around each point stays, and
short loops are closed by ear clipping. In higher dimensions all simplices count, each by its share in the Voronoi cells
of the points whose stars have it: the share is 1 if all do, and cells of cospherical points do not depend on which of
their triangulations a star has.
"""

from __future__ import annotations

from functools import partial
from itertools import permutations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import QhullError

from torchlb.cloud.cocone import best_manifold
from torchlb.cloud.complexes import Complex
from torchlb.cloud.frames import cloud_frames
from torchlb.cloud.manifold import boundary_loops, ears_of, with_single_fans
from torchlb.errors import InputError, first_few
from torchlb.geometry.compatibility import mutually_compatible, planes_of
from torchlb.geometry.complex import Faces, delaunay, edges_of
from torchlb.geometry.neighbors import nearest_neighbors
from torchlb.geometry.thresholds import AROUND, FACTOR
from torchlb.geometry.vectors import Frames, Near, Points, lengths
from torchlb.linalg.precision import NEGLIGIBLE

CANDIDATES = {2: 24, 3: 64}
"""Number of nearest points that hold those of a star, by dimension."""
LOOP = 12
"""Number of edges of the largest loop that is closed."""


def cloud_stars(points: Points, dim: int) -> Complex:
    """Complex of dimension d ≥ 2 through a cloud in Rⁿ, n > d: a surface of triangles, or all simplices of stars."""
    near = nearest_neighbors(points, min(CANDIDATES[dim], len(points)))
    frames = cloud_frames(points, near, dim)
    stars, places, shares = delaunay_stars(points, frames, near), points.numpy(), None
    if dim == 2:
        cells = glued(places, stars)
    else:
        cells, parts = shared(places, stars)
        shares = torch.from_numpy(parts)
    # where all stars count, a point far from all others is only in its own
    alone = np.setdiff1d(np.arange(len(places)), cells if shares is None else stars[:, 1:])
    if len(alone):
        raise InputError(
            f"points: no cell of dimension {dim} reaches {len(alone)} of {len(places)} "
            f"({first_few(torch.from_numpy(alone))}); leave them out, add points around them, or pass another `dim`"
        )
    return Complex(points=points, cells=torch.from_numpy(cells), shares=shares)


def delaunay_stars(
    points: Points, frames: Frames, candidates: Near
) -> Int[np.ndarray, "S corners"]:
    """Simplices of the star of every point, the point first."""
    dim, found = frames.shape[2], []
    _, _, good = mutually_compatible(points, planes_of(frames), candidates)
    offset = points[candidates[:, 1:]] - points[:, None]
    coords, near = (offset @ frames).numpy(), candidates.numpy()
    reach = FACTOR * offset.norm(dim=2)[:, min(AROUND, offset.shape[1]) - 1].numpy()
    for point, mask in enumerate(good.numpy()):
        others = near[point, 1:][mask]
        if len(others) <= dim:
            continue
        places = np.concatenate([np.zeros((1, dim)), coords[point][mask]])
        try:
            cells = delaunay(places).simplices
        except QhullError:  # the points are on a line, or in a plane
            continue
        cells = cells[(cells == 0).any(1)]
        cells = cells[cells != 0].reshape(-1, dim)
        corners = places[cells]
        sound = np.abs(np.linalg.det(corners)) > NEGLIGIBLE * lengths(corners).prod(1)
        cells, corners = cells[sound], corners[sound]
        square = (corners**2).sum(2)[..., None] / 2
        radius = np.linalg.norm(np.linalg.solve(corners, square)[..., 0], axis=1)
        cells = cells[radius <= reach[point]]
        first = np.full((len(cells), 1), point)
        found.append(np.concatenate([first, others[cells - 1]], 1))
    return np.concatenate([np.zeros((0, dim + 1), dtype=np.int64), *found])


def shared(
    points: Float[np.ndarray, "N n"], stars: Int[np.ndarray, "S corners"]
) -> tuple[Int[np.ndarray, "F corners"], Float[np.ndarray, " F"]]:
    """(simplices of all stars; share of each that counts)."""
    cells, number, votes = np.unique(
        np.sort(stars, 1), axis=0, return_inverse=True, return_counts=True
    )
    part = np.bincount(number.ravel(), voronoi_shares(points[stars]), minlength=len(cells))
    part = np.where(votes == stars.shape[1], 1.0, part.clip(0.0, 1.0))
    return cells[part > 0], part[part > 0]


def voronoi_shares(corners: Float[np.ndarray, "S corners n"]) -> Float[np.ndarray, " S"]:
    """Signed share of each simplex in the Voronoi cell of its first corner; the shares of all corners sum to 1.

    The cell consists of simplices from the corner over the midpoint of an edge there, the circumcentre of a triangle at
    the edge, and so on to the circumcentre.
    """
    dim = corners.shape[1] - 1
    edges = corners[:, 1:] - corners[:, :1]
    places = np.linalg.qr(edges.transpose(0, 2, 1))[1].transpose(0, 2, 1)  # intrinsic coordinates
    whole = np.linalg.det(places)
    total, sound = np.zeros(len(places)), np.abs(whole) > NEGLIGIBLE * lengths(places).prod(1)
    places, whole = places[sound], whole[sound]
    for order in permutations(range(dim)):
        chain = places[:, list(order)]
        square = (chain**2).sum(2)[..., None] / 2
        gram = chain @ chain.transpose(0, 2, 1)
        centers = []
        for k in range(1, dim + 1):
            shares = np.linalg.solve(gram[:, :k, :k], square[:, :k])
            centers.append((shares.transpose(0, 2, 1) @ chain[:, :k])[:, 0])
        side = np.sign(np.linalg.det(chain))
        total[sound] += side * np.linalg.det(np.stack(centers, 1)) / np.abs(whole)
    return total


def glued(points: Float[np.ndarray, "N n"], stars: Faces) -> Faces:
    """Triangles of the stars that form a surface, those of more stars first, then smaller ones; short loops closed."""
    triangles, votes = np.unique(np.sort(stars, 1), axis=0, return_counts=True)
    order, count = np.lexsort((circumradii(points, triangles), -votes)), len(points)
    faces = with_single_fans(best_manifold(points, triangles[order]), count)
    known = set(edges_of(faces, count).keys.tolist())
    loops = [loop for loop in boundary_loops(faces, count) if len(loop) <= LOOP]
    found = [ears_of(loop, known, count, partial(circumradii, points)) for loop in loops]
    return np.concatenate([faces, *(np.array(ears) for ears in found if ears)])


def circumradii(points: Float[np.ndarray, "N n"], faces: Faces) -> Float[np.ndarray, " F"]:
    """Circumradii of triangles, ℓ; infinite for those without area."""
    a, b, c = (
        np.linalg.norm(points[faces[:, k - 1]] - points[faces[:, k]], axis=1) for k in range(3)
    )
    square = np.maximum((a + b + c) * (b + c - a) * (c + a - b) * (a + b - c), 0.0)
    with np.errstate(divide="ignore"):
        return a * b * c / np.sqrt(square)
