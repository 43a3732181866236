"""The boundary of a shape: which points lie on it, and the conormals there (`method.md`, section 6).

The conormal ν at a boundary point is the unit tangent vector of the shape that leaves it at a right angle to the
boundary. The boundary is itself a manifold of dimension d − 1, so its tangents come from the same fits; where that of a
mesh has a crease, or a corner, ν is the mean of the outer normals around.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from torchlb.errors import InputError
from torchlb.geometry.candidates import list_candidates
from torchlb.geometry.frames import cloud_frames, mesh_frames, normals_of_frames, refine_frames
from torchlb.geometry.neighbors import (
    AT_ONCE,
    GraphBalls,
    mesh_graph,
    nearest_graph,
    nearest_neighbors,
)
from torchlb.geometry.voronoi import largest_gap

INSIDE = 4
"""Nearest points off the boundary, on whose side the shape is."""
OPEN_ANGLE, NEAREST = 2.3, 32
"""Radians of the tangent plane without any of so many nearest points that make a point of a cloud a boundary point.
Of 16, two in a hundred random points leave as much open, of 32 none in a thousand."""

SMOOTH = cos(radians(20))
"""Where the mean of the outer normals around a boundary vertex is shorter there is a crease: two that are 40° apart."""
SHARP = cos(radians(30))
"""The same of two that are 60° apart, from where on the surface of a solid is flat along it."""


@dataclass(frozen=True)
class Boundary:
    """Boundary points of a shape.

    Attributes
    ----------
    mask : (N,), which points lie on the boundary.
    conormals : (N, n), unit and outward there, zero elsewhere.
    """

    mask: Bool[Tensor, " N"]
    conormals: Float[Tensor, "N n"]


def boundary_faces(faces: Int[Tensor, "F v"]) -> Int[Tensor, "G w"]:
    """Sides of the faces that belong to one face only: edges of triangles, ends of segments.

    >>> boundary_faces(torch.tensor([[0, 1, 2], [1, 3, 2]])).tolist()
    [[0, 1], [0, 2], [1, 3], [2, 3]]
    """
    return _open_sides(faces)[0]


def _open_sides(faces: Int[Tensor, "F v"]) -> tuple[Int[Tensor, "G w"], Int[Tensor, " G"]]:
    """`boundary_faces`, and of each the corner of its face that lies opposite."""
    corners = faces.shape[1]
    sides = torch.cat(
        [faces[:, [c for c in range(corners) if c != left]] for left in range(corners)]
    )
    opposite = faces.T.reshape(-1)
    if len(faces) == 0:
        return sides, opposite
    sides = sides.sort(dim=1).values
    base = int(faces.max()) + 1
    key = sides[:, 0]
    for column in sides.T[1:]:
        key = key * base + column
    order = key.argsort(stable=True)
    _, count = torch.unique_consecutive(key[order], return_counts=True)
    first = order[(count.cumsum(0) - count)[count == 1]]
    return sides[first], opposite[first]


def boundary_of_mesh(
    vertices: Float[Tensor, "N n"],
    faces: Int[Tensor, "F v"],
    frames: Float[Tensor, "N n d"],
    degree: int,
) -> Boundary | None:
    """Boundary of a mesh from its unpaired sides; None for a closed one.

    `degree` is that of the fits to the boundary's tangents.
    """
    sides, opposite = _open_sides(faces)
    if len(sides) == 0:
        return None
    mask = torch.zeros(len(vertices), dtype=torch.bool)
    mask[sides.reshape(-1)] = True
    members = mask.nonzero()[:, 0]
    tangents = frames.new_zeros(len(members), vertices.shape[1], 0)
    if sides.shape[1] > 1:
        number = torch.cumsum(mask, 0) - 1
        local, own = number[sides], vertices[members]
        graph = mesh_graph(local, len(members))
        balls = GraphBalls(own, graph, mesh_frames(own, local))
        tangents = _refined_tangents(balls, degree)
    outward, size = _outward_sums(vertices, sides, opposite)
    crease = outward.norm(dim=1) < SMOOTH * size
    return _with_conormals(frames, mask, tangents, outward[members], crease[members])


def boundary_creases(
    vertices: Float[Tensor, "N n"], cells: Int[Tensor, "F v"]
) -> Bool[Tensor, " N"]:
    """Vertices where the boundary of a mesh turns by 60° and more: at the edges and corners of a cube."""
    outward, size = _outward_sums(vertices, *_open_sides(cells))
    return outward.norm(dim=1) < SHARP * size


def boundary_of_cloud(
    points: Float[Tensor, "N n"],
    mask: Bool[Tensor, " N"],
    frames: Float[Tensor, "N n d"],
    degree: int,
) -> Boundary | None:
    """Boundary of a cloud from the mask of its boundary points; None if there are none."""
    if not mask.any():
        return None
    members, dim = mask.nonzero()[:, 0], frames.shape[-1] - 1
    own = points[members]
    tangents = frames.new_zeros(len(members), points.shape[1], 0)
    if dim > 0:
        candidates = nearest_neighbors(own, min(8 * dim, len(own)))
        initial = cloud_frames(own, candidates, dim)
        balls = GraphBalls(own, nearest_graph(own, initial, candidates), initial)
        tangents = _refined_tangents(balls, degree)
    inside = points[~mask] if not mask.all() else points
    near = min(INSIDE, len(inside))
    _, index = KDTree(inside.numpy()).query(own.numpy(), k=near)
    nearest = inside[torch.from_numpy(index.reshape(len(members), near))]
    outward = (own[:, None] - nearest).mean(1)
    return _with_conormals(frames, mask, tangents, outward, crease=mask.new_zeros(len(members)))


def detect_boundary(
    points: Float[Tensor, "N n"], frames: Float[Tensor, "N n d"], balls: GraphBalls
) -> Bool[Tensor, " N"]:
    """Points of a surface cloud whose 32 nearest leave an angle of 130° or more open in the tangent plane.

    Raises ValueError for other dimensions: give the mask there.
    """
    if frames.shape[-1] != 2:
        raise InputError("boundary: can be detected on surfaces only; give the mask of its points")
    masks = []
    for centers in torch.arange(len(points)).split(AT_ONCE):
        index, count = balls(centers, NEAREST)
        coords = (points[index[:, 1:]] - points[centers, None]) @ frames[centers]
        masks.append(largest_gap(coords, torch.arange(1, NEAREST) < count[:, None]) > OPEN_ANGLE)
    return torch.cat(masks)


def _refined_tangents(balls: GraphBalls, degree: int) -> Tensor:
    candidates = list_candidates(balls.frames.shape[-1], range(degree, 0, -1))
    return refine_frames(balls, torch.arange(len(balls.points)), candidates)[0]


def _outward_sums(
    vertices: Float[Tensor, "N n"], sides: Int[Tensor, "G w"], opposite: Int[Tensor, " G"]
) -> tuple[Float[Tensor, "N n"], Float[Tensor, " N"]]:
    """Sums at every vertex over its boundary sides: of their outer normals, weighted by their sizes, and of these."""
    corners = vertices[sides]
    basis, triangle = torch.linalg.qr((corners[:, 1:] - corners[:, :1]).mT)
    size = torch.diagonal(triangle, dim1=-2, dim2=-1).prod(-1).abs()
    offset = (corners[:, 0] - vertices[opposite])[..., None]
    height = (offset - basis @ (basis.mT @ offset))[..., 0]
    normal = size[:, None] * _unit(height)
    outward, total = torch.zeros_like(vertices), torch.zeros_like(vertices[:, 0])
    for corner in sides.T:
        outward.index_add_(0, corner, normal)
        total.index_add_(0, corner, size)
    return outward, total


def _with_conormals(
    frames: Float[Tensor, "N n d"],
    mask: Bool[Tensor, " N"],
    tangents: Float[Tensor, "b n d_minus_1"],
    outward: Float[Tensor, "b n"],
    crease: Bool[Tensor, " b"],
) -> Boundary:
    """ν = the direction of the frame orthogonal to the boundary's, on the side of `outward`; on a crease `outward`."""
    own = frames[mask]
    if tangents.shape[-1] == 0:
        conormal = own[..., 0]
    else:
        along, _ = torch.linalg.qr(own.mT @ tangents)
        conormal = (own @ normals_of_frames(along)[..., None])[..., 0]
    side = (conormal * outward).sum(-1, keepdim=True)
    conormal = torch.where(side < 0, -conormal, conormal)
    within = (own @ (own.mT @ outward[..., None]))[..., 0]
    conormals = frames.new_zeros(frames.shape[:2])
    conormals[mask] = torch.where(crease[:, None], _unit(within), conormal)
    return Boundary(mask, conormals)


def _unit(vectors: Float[Tensor, "G n"]) -> Float[Tensor, "G n"]:
    """Of length one; zero stays zero."""
    return torch.nn.functional.normalize(vectors, dim=-1, eps=torch.finfo(vectors.dtype).tiny)
