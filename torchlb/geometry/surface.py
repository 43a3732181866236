"""A surface through a cloud of points in R³ (`method.md`, section 12), for the weak pair, plots and export."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.spatial import Delaunay
from torch import Tensor

from torchlb.geometry.cocone import Cloud, best_manifold, delaunay_triangles, refined_normals
from torchlb.geometry.frames import cloud_frames, complete_frames, vertex_normals
from torchlb.geometry.gaps import closed, filled, with_left_points
from torchlb.geometry.manifold import (
    Faces,
    boundary_loops,
    components,
    facing_out,
    with_single_fans,
    without_specks,
    wound_alike,
)
from torchlb.geometry.neighbors import nearest_graph, nearest_neighbors
from torchlb.geometry.noise import denoised
from torchlb.geometry.stars import gaps_between, pieces_of, stars_in_gaps

NEAREST = 24
"""Nearest points from which normals, stars and neighbourhoods are made."""
SPACING, REACH = 8, 2.0
"""The reach of a point is so many times the distance to its neighbour of this number."""
SPECK = 4
"""Patches of fewer triangles are left out."""
FLAT = 1e-6
"""Thickness over width of a cloud that lies in a plane."""


@dataclass(frozen=True)
class SurfaceSummary:
    """What was found of the surface through a cloud.

    Attributes
    ----------
    points : number of points.
    reached : of those that faces of the surface reach; the others have local stars alone.
    stars : triangles of local stars.
    holes_closed : boundary loops that were taken for gaps and closed.
    boundary_loops : those that are left.
    components : connected components.
    noise : distance of the points from the surface, root mean square, ℓ; 0 if there is none to be seen.
    """

    points: int
    reached: int
    stars: int
    holes_closed: int
    boundary_loops: int
    components: int
    noise: float

    def __str__(self) -> str:
        """Two lines."""
        noise = f"; noise of {self.noise:.2g} smoothed" if self.noise else ""
        return (
            f"surface through the cloud: {self.reached} of {self.points} points, {self.stars} triangles of local stars"
            f"{noise}\n  {self.components} components, {self.boundary_loops} boundary loops, {self.holes_closed} gaps "
            "closed"
        )


@dataclass(frozen=True)
class CloudSurface:
    """Triangles through a cloud.

    Attributes
    ----------
    points : (N, 3), ℓ: where the surface is at each point, the point itself if the cloud has no noise.
    faces : (F, 3), a surface of one sheet: edges have at most two, and all are wound so that it faces out.
    stars : (S, 3), local triangles where it has gaps, of which a third counts.
    normals : (N, 3), unit, on the side of the faces.
    frames : (N, 3, 2), orthonormal, under the normals; they turn with the points.
    summary : how that was found.
    """

    points: Float[Tensor, "N 3"]
    faces: Int[Tensor, "F 3"]
    stars: Int[Tensor, "S 3"]
    normals: Float[Tensor, "N 3"]
    frames: Float[Tensor, "N 3 2"]
    summary: SurfaceSummary


def cloud_surface(
    points: Float[Tensor, "N 3"],
    *,
    normals: Float[Tensor, "N 3"] | None = None,
    boundary: Bool[Tensor, " N"] | None = None,
) -> CloudSurface:
    """The surface through all points, as far as they resolve one; `boundary` marks points of a real boundary."""
    candidates = nearest_neighbors(points, min(NEAREST, len(points)))
    given, frames = normals, cloud_frames(points, candidates, 2)
    if normals is None:
        normals = refined_normals(points, frames, candidates)
    points, noise = denoised(points, normals, candidates)
    if noise and given is None:
        normals = refined_normals(points, complete_frames(normals), candidates)
    graph = nearest_graph(points, complete_frames(normals), candidates)
    places, near, count = points.numpy(), candidates.numpy(), len(points)
    far = near[:, min(SPACING, near.shape[1] - 1)]
    reach = REACH * np.linalg.norm(places[far] - places, axis=1)
    rim = np.zeros(count, dtype=bool) if boundary is None else boundary.numpy()
    cloud = Cloud(places, normals.numpy(), near, reach)
    found, pool = planar_triangles(cloud) or delaunay_triangles(cloud)
    faces, seam = wound_alike(places, _clean(best_manifold(places, found), count))
    faces = facing_out(places, _clean(faces[~seam], count))
    cloud = _oriented(cloud, faces)
    for oriented in (True, False):  # a surface with one side only is closed in the second round
        faces = filled(cloud, faces, pool, rim, oriented=oriented, strict=True)
    faces = filled(cloud, _clean(faces, count), pool, rim, oriented=True, strict=False)
    faces, pairs = _clean(faces, count), _own_graph(cloud, graph)
    faces, done = closed(cloud, faces, rim, _at_gaps(faces, pairs, count))
    faces, _ = wound_alike(places, with_left_points(cloud, faces))
    faces = facing_out(places, faces)
    cloud = _oriented(cloud, faces)
    stars = stars_in_gaps(cloud, faces, pairs)
    loops = boundary_loops(faces, count)
    pieces = pieces_of(np.concatenate([faces, stars]), count)
    reached, components = len(np.unique(faces)), int(pieces.max()) + 1
    summary = SurfaceSummary(count, reached, len(stars), len(done), len(loops), components, noise)
    normals = torch.from_numpy(cloud.normals)
    upright = frames - normals[..., None] * (normals[:, None] @ frames)
    frames, triangles = torch.linalg.qr(upright)[0], torch.from_numpy(faces)
    return CloudSurface(points, triangles, torch.from_numpy(stars), normals, frames, summary)


def _at_gaps(
    faces: Faces, pairs: tuple[np.ndarray, np.ndarray], count: int
) -> Bool[np.ndarray, " N"]:
    """Points with a neighbour in another piece of the faces, so that the loop they are on is no hole."""
    used, result = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    used[faces.ravel()] = True
    both = used[pairs[0]] & used[pairs[1]]
    for end in gaps_between(faces, (pairs[0][both], pairs[1][both]), count):
        result[end] = True
    return result


def _clean(faces: Faces, count: int) -> Faces:
    return without_specks(with_single_fans(faces, count), count, SPECK)


def _oriented(cloud: Cloud, faces: Faces) -> Cloud:
    """The cloud with its normals on the side of the faces, where there are any."""
    points, normals = torch.from_numpy(cloud.points), torch.from_numpy(cloud.normals)
    away = (vertex_normals(points, torch.from_numpy(faces)) * normals).sum(1) < 0
    return replace(cloud, normals=torch.where(away[:, None], -normals, normals).numpy())


def planar_triangles(cloud: Cloud) -> tuple[Faces, Faces] | None:
    """As `delaunay_triangles`, of a cloud in a plane; None if it is in none."""
    centered = cloud.points - cloud.points.mean(0)
    _, spread, axes = np.linalg.svd(centered, full_matrices=False)
    if spread[2] > FLAT * spread[0]:
        return None
    cells = Delaunay(centered @ axes[:2].T).simplices.astype(np.int64)
    faces = cloud.small(cells)
    return faces, faces


def _own_graph(cloud: Cloud, graph: sparse.csr_array) -> tuple[np.ndarray, np.ndarray]:
    """Edges of the cloud's neighbour graph; pieces of fewer points than a neighbourhood have all their nearest, too."""
    i, j = sparse.coo_array(graph).coords
    piece = components(i, j, len(cloud.points))
    lone = np.flatnonzero((np.bincount(piece) < NEAREST)[piece])
    near = cloud.neighbors[lone, 1 : SPACING + 1]
    extra = lone.repeat(near.shape[1]), near.ravel()
    return np.concatenate([i, *extra]), np.concatenate([j, *extra[::-1]])
