"""What a ladder needs to know of a shape: points, graph, tangent frames, areas and the rows of last resort."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor
from tqdm import tqdm

from torchlb.geometry.boundary import Boundary, boundary_of_cloud, boundary_of_mesh, detect_boundary
from torchlb.geometry.candidates import chunks, ladder_rungs
from torchlb.geometry.frames import (
    cloud_frames,
    complete_frames,
    mesh_frames,
    normals_of_frames,
    refine_frames,
    vertex_normals,
)
from torchlb.geometry.neighbors import GraphBalls, mesh_graph, nearest_graph, nearest_neighbors
from torchlb.geometry.orientation import (
    consistently_wound,
    nearest_pairs,
    orient_normals,
    thin_sides,
)
from torchlb.stencils.low_order import CloudFallback, MeshFallback

__all__ = ["Geometry", "cloud_geometry", "mesh_geometry"]

CANDIDATES = {1: 12, 2: 24, 3: 64}
"""Nearest points from which the frames and the graph of a cloud start, by dimension."""


@dataclass(frozen=True)
class Geometry:
    """A shape ready for stencils.

    Attributes
    ----------
    points : (N, n), ℓ, float64.
    frames : (N, n, d), orthonormal; [frames, normal] is right-handed where there is a normal.
    normals : (N, n) unit normals of a hypersurface, else None. Oriented by the faces, or consistently on a cloud.
    normal_order : (N,), the degree q of the fit behind each frame; 0 for a frame that stayed poor.
    sides : (N, n), those normals where the shape is thin, zero elsewhere, see `thin_sides`; None without normals.
    graph : (N, N) adjacency whose balls are the neighbourhoods.
    areas : (N,), ℓ^d, positive: a first-order share of the area.
    fallback : M-matrix rows for points without a stencil.
    boundary : its points and conormals; None for a closed shape, or where it is to be ignored.
    """

    points: Float[Tensor, "N n"]
    frames: Float[Tensor, "N n d"]
    normals: Float[Tensor, "N n"] | None
    sides: Float[Tensor, "N n"] | None
    normal_order: Int[Tensor, " N"]
    graph: sparse.csr_array
    areas: Float[Tensor, " N"]
    fallback: CloudFallback | MeshFallback
    boundary: Boundary | None


def cloud_geometry(
    points: Float[Tensor, "N n"],
    dim: int,
    normal_order: int,
    *,
    num_neighbors: int | None = None,
    normals: Float[Tensor, "N n"] | None = None,
    boundary: Bool[Tensor, " N"] | str | None = None,
    condition: str = "neumann",
    progress: bool = True,
) -> Geometry:
    """Geometry of a point cloud: graph and frames from the nearest neighbours.

    `boundary` is the mask of its boundary points, or "detect"; `condition` what holds there.
    """
    candidates = nearest_neighbors(points, min(CANDIDATES.get(dim, 128), len(points)))
    poor = cloud_frames(points, candidates, dim) if normals is None else complete_frames(normals)
    graph = nearest_graph(points, poor, candidates)
    sides = None
    if dim == points.shape[1] - 1:
        pairs = nearest_pairs(candidates)
        oriented = orient_normals(points, normals_of_frames(poor), pairs)
        normals = oriented if normals is None else normals
        sides = thin_sides(points, oriented, pairs)
    balls = GraphBalls(points, graph, poor, sides)
    frames, order = _refined(balls, normal_order, num_neighbors, progress)
    balls = GraphBalls(points, graph, frames, _follow(sides, frames))
    mask = detect_boundary(points, frames, balls) if isinstance(boundary, str) else boundary
    rim = None if mask is None else boundary_of_cloud(points, mask, frames, normal_order)
    fallback = CloudFallback(balls, rim, surface=dim == 2 and points.shape[1] <= 3)
    rim = None if rim is None else replace(rim, condition=condition)
    return _oriented(balls, normals, order, fallback, rim)


def mesh_geometry(
    vertices: Float[Tensor, "N n"],
    faces: Int[Tensor, "F v"],
    normal_order: int,
    *,
    num_neighbors: int | None = None,
    boundary: str | None = "neumann",
    progress: bool = True,
) -> Geometry:
    """Geometry of a mesh of triangles (or of segments, or tetrahedra in Rⁿ): graph and frames from the faces.

    `boundary` is the condition on its boundary; None leaves it alone.
    """
    poor = mesh_frames(vertices, faces)
    graph = mesh_graph(faces, len(vertices))
    reference = sides = None
    if faces.shape[1] == vertices.shape[1] and faces.shape[1] < 4:
        reference = vertex_normals(vertices, faces)
        if consistently_wound(faces):
            candidates = nearest_neighbors(vertices, min(CANDIDATES[2], len(vertices)))
            sides = thin_sides(vertices, reference, nearest_pairs(candidates))
    balls = GraphBalls(vertices, graph, poor, sides)
    frames, order = _refined(balls, normal_order, num_neighbors, progress)
    balls = GraphBalls(vertices, graph, frames, _follow(sides, frames))
    rim = boundary_of_mesh(vertices, faces, frames, normal_order) if boundary else None
    if faces.shape[1] == 3 and vertices.shape[1] <= 3:
        fallback = MeshFallback(vertices, faces)
    else:
        fallback = CloudFallback(balls, rim, surface=False)
    rim = None if rim is None or boundary is None else replace(rim, condition=boundary)
    return _oriented(balls, reference, order, fallback, rim)


def _follow(sides: Tensor | None, frames: Tensor) -> Tensor | None:
    """The sides by the normals of the refined frames, where they were set."""
    if sides is None:
        return None
    return _turned(normals_of_frames(frames), sides) * (sides != 0).any(1, keepdim=True)


def _turned(normals: Tensor, reference: Tensor) -> Tensor:
    """The normals, on the side of `reference`."""
    return torch.where(((normals * reference).sum(1) < 0)[:, None], -normals, normals)


def _refined(
    balls: GraphBalls, degree: int, num_neighbors: int | None, progress: bool
) -> tuple[Tensor, Tensor]:
    """Frames of order q, in chunks; the poor ones of `balls` if q = 0 or in a flat space."""
    points, poor = balls.points, balls.frames
    if degree == 0 or poor.shape[1] == poor.shape[2]:
        return poor, torch.full((len(points),), degree)
    rungs = ladder_rungs(poor.shape[-1], range(degree, 0, -1), num_neighbors=num_neighbors)
    parts = chunks(len(points), rungs, poor.shape[-1])
    bar = tqdm(parts, "tangent frames", delay=2, disable=not progress, leave=False)
    frames, order = zip(
        *(refine_frames(points, poor, balls, centers, rungs) for centers in bar), strict=True
    )
    return torch.cat(frames), torch.cat(order)


def _oriented(
    balls: GraphBalls,
    reference: Tensor | None,
    order: Tensor,
    fallback: CloudFallback | MeshFallback,
    boundary: Boundary | None,
) -> Geometry:
    """Turn normals to the side of `reference`, and frames so that [frames, normal] is right-handed."""
    points, frames = balls.points, balls.frames
    normals = None
    if frames.shape[-1] == points.shape[1] - 1:
        righthanded = normals_of_frames(frames)
        normals = righthanded if reference is None else _turned(righthanded, reference)
        hand = (normals * righthanded).sum(1)[:, None, None].sign()
        frames = torch.cat([hand * frames[..., :1], frames[..., 1:]], -1)
    areas = fallback.areas()
    return Geometry(
        points, frames, normals, balls.sides, order, balls.graph, areas, fallback, boundary
    )
