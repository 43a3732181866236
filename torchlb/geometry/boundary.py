"""The boundary of a shape: which points lie on it, and the conormals there (`method.md`, section 6).

The conormal ν at a boundary point is the unit tangent vector of the shape that leaves it at a right angle to the
boundary. The boundary is itself a manifold of dimension d − 1, so its tangents come from the same fits; where that of a
mesh has a crease, or a corner, ν is the mean of the outer normals around.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import cos, radians

import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.spatial import KDTree
from torch import Tensor

from torchlb.errors import InputError
from torchlb.geometry.fit_search import FitSearch
from torchlb.geometry.frames import cloud_frames, mesh_frames, normals_of_frames
from torchlb.geometry.local_fits import FitPlan, LocalFits
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


@dataclass(frozen=True)
class BoundaryPlan:
    """What is decided about the boundary of a shape.

    Attributes
    ----------
    mask
        (N,), where a condition holds.
    members
        (b,), all points of the boundary; the numbers of the others refer to their places here where they are local.
    sides, opposite
        (G, d), (G,), of a mesh: the faces' unpaired sides, and the corners across from them; none for a cloud.
    inside
        (b, q), of a cloud: points off the boundary, on whose side the shape is.
    near
        (b, K), of a cloud: the nearest boundary points, local, from which the first tangents are.
    fits
        Of the boundary's own tangents, local; None at the ends of curves.
    crease
        (b,), where the boundary of a mesh has one, or a corner.
    """

    mask: Bool[Tensor, " N"]
    members: Int[Tensor, " b"]
    sides: Int[Tensor, "G d"]
    opposite: Int[Tensor, " G"]
    inside: Int[Tensor, "_ q"]
    near: Int[Tensor, "_ K"]
    fits: FitPlan | None
    crease: Bool[Tensor, " b"]

    def at(self, points: Float[Tensor, "N n"], frames: Float[Tensor, "N n d"]) -> Boundary:
        """The boundary at these points, of a shape with these frames."""
        own, tangents = (
            points[self.members],
            frames.new_zeros(len(self.members), points.shape[1], 0),
        )
        if self.fits is not None:
            tangents = LocalFits.at(self.fits, own, self.initial(points)).frames
        if len(self.sides):
            outward = _outward_sums(points, self.sides, self.opposite)[0][self.members]
        else:
            outward = (own[:, None] - points[self.inside]).mean(1)
        conormals = torch.zeros_like(points)
        conormals[self.members] = _conormals(frames[self.members], tangents, outward, self.crease)
        return Boundary(self.mask, conormals * self.mask[:, None])

    def initial(self, points: Float[Tensor, "N n"]) -> Float[Tensor, "b n d_minus_1"]:
        """The boundary's first tangents."""
        own = points[self.members]
        if len(self.sides):
            return mesh_frames(own, torch.searchsorted(self.members, self.sides))
        return cloud_frames(own, self.near, self.sides.shape[1] - 1)


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
    vertices: Float[Tensor, "N n"], faces: Int[Tensor, "F v"], degree: int
) -> BoundaryPlan | None:
    """Boundary of a mesh from its unpaired sides; None for a closed one.

    `degree` is that of the fits to the boundary's tangents.
    """
    sides, opposite = _open_sides(faces)
    if len(sides) == 0:
        return None
    mask = torch.zeros(len(vertices), dtype=torch.bool)
    mask[sides.reshape(-1)] = True
    members = mask.nonzero()[:, 0]
    outward, size = _outward_sums(vertices, sides, opposite)
    crease = (outward.norm(dim=1) < SMOOTH * size)[members]
    none = members.new_zeros(0, 0)
    plan = BoundaryPlan(mask, members, sides, opposite, none, none, None, crease)
    if sides.shape[1] == 1:
        return plan
    graph = mesh_graph(torch.searchsorted(members, sides), len(members))
    return _with_fits(plan, vertices, graph, degree)


def boundary_creases(
    vertices: Float[Tensor, "N n"], cells: Int[Tensor, "F v"]
) -> Bool[Tensor, " N"]:
    """Vertices where the boundary of a mesh turns by 60° and more: at the edges and corners of a cube."""
    outward, size = _outward_sums(vertices, *_open_sides(cells))
    return outward.norm(dim=1) < SHARP * size


def boundary_of_cloud(
    points: Float[Tensor, "N n"], mask: Bool[Tensor, " N"], dim: int, degree: int
) -> BoundaryPlan | None:
    """Boundary of a cloud of dimension d from the mask of its boundary points; None if there are none."""
    if not mask.any():
        return None
    members = mask.nonzero()[:, 0]
    others = (~mask).nonzero()[:, 0] if not mask.all() else members
    near = min(INSIDE, len(others))
    _, index = KDTree(points[others].numpy()).query(points[members].numpy(), k=near)
    inside = others[torch.from_numpy(index.reshape(len(members), near))]
    none, crease = members.new_zeros(0, dim), torch.zeros_like(members, dtype=torch.bool)
    plan = BoundaryPlan(mask, members, none, none[:, 0], inside, none, None, crease)
    if dim == 1:
        return plan
    own = points[members]
    plan = replace(plan, near=nearest_neighbors(own, min(8 * (dim - 1), len(own))))
    return _with_fits(plan, points, nearest_graph(own, plan.initial(points), plan.near), degree)


def _with_fits(
    plan: BoundaryPlan, points: Float[Tensor, "N n"], graph: sparse.csr_array, degree: int
) -> BoundaryPlan:
    """The same with fits of the boundary's tangents."""
    search = FitSearch(GraphBalls(points[plan.members], graph, plan.initial(points)), degree)
    search.refine(torch.arange(len(plan.members)))
    return replace(plan, fits=search.finish()[0])


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


def _conormals(
    frames: Float[Tensor, "b n d"],
    tangents: Float[Tensor, "b n d_minus_1"],
    outward: Float[Tensor, "b n"],
    crease: Bool[Tensor, " b"],
) -> Float[Tensor, "b n"]:
    """The direction of the frame orthogonal to the boundary's, on the side of `outward`; on a crease `outward`."""
    if tangents.shape[-1] == 0:
        conormal = frames[..., 0]
    else:
        along, _ = torch.linalg.qr(frames.mT @ tangents)
        conormal = (frames @ normals_of_frames(along)[..., None])[..., 0]
    side = (conormal * outward).sum(-1, keepdim=True)
    conormal = torch.where(side < 0, -conormal, conormal)
    within = (frames @ (frames.mT @ outward[..., None]))[..., 0]
    return torch.where(crease[:, None], _unit(within), conormal)


def _unit(vectors: Float[Tensor, "G n"]) -> Float[Tensor, "G n"]:
    """Of length one; zero stays zero."""
    return torch.nn.functional.normalize(vectors, dim=-1, eps=torch.finfo(vectors.dtype).tiny)
