"""The boundary of a shape: its points, and the conormals there (`method.md`, section 6).

The conormal ν at a boundary point is the outward unit vector tangent to the shape and normal to its boundary. The
boundary is itself a manifold of dimension d − 1, so its tangents come from the same fits; at a crease or a corner of a
mesh's boundary ν is the mean of the outer normals around.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from math import factorial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import normalize

from torchlb.geometry.fit_search import FitSearch
from torchlb.geometry.frames import mesh_frames, normals_of_frames
from torchlb.geometry.local_fits import FitPlan, LocalFits
from torchlb.geometry.neighbors import GraphNeighborhoods, mesh_graph
from torchlb.geometry.thresholds import CREASE, KINK
from torchlb.geometry.vectors import Frames, Points
from torchlb.linalg.precision import SMALL, TINY


@dataclass(frozen=True)
class Boundary:
    """Boundary points of a shape, and their outward unit conormals, which are zero elsewhere.

    `sizes`, ℓ^{d−1}, are first-order shares in the boundary's length or area, 1 at the end of a curve. `folds` is 1
    over the length of the mean of the outer normals where ν is that mean, 1 elsewhere: if ∂_n f = g for each of these
    normals n, ∂_ν f is `folds` times g.
    """

    mask: Bool[Tensor, " N"]
    conormals: Points
    sizes: Float[Tensor, " N"]
    folds: Float[Tensor, " N"]


@dataclass(frozen=True)
class BoundaryPlan:
    """Combinatorial data of the boundary of a mesh, from which `at` computes a `Boundary` for given coordinates.

    A boundary condition holds at the points in `mask`, of all boundary points `members`; `crease` tells which of these
    are at a crease or a corner of the boundary. `fits` plans the fits of its tangents, points numbered by their
    position in `members`, and is None at the ends of curves. `sides` are the unpaired sides of the cells, `opposite`
    the corner opposite each.
    """

    mask: Bool[Tensor, " N"]
    members: Int[Tensor, " b"]
    fits: FitPlan | None
    sides: Int[Tensor, "G d"]
    opposite: Int[Tensor, " G"]
    crease: Bool[Tensor, " b"]

    def at(self, points: Points, frames: Frames) -> Boundary:
        """Boundary at these coordinates, of a shape with these frames."""
        frames, (outward, *shares) = frames[self.members], self.measures(points)
        conormal = frames[..., 0]  # of a curve
        if self.fits is not None:
            tangents = LocalFits.at(self.fits, points[self.members], self.initial(points)).frames
            along, _ = torch.linalg.qr(frames.mT @ tangents)
            conormal = (frames @ normals_of_frames(along)[..., None])[..., 0]
        side = (conormal * outward).sum(-1, keepdim=True)
        conormal = torch.where(side < 0, -conormal, conormal)
        within = (frames @ (frames.mT @ outward[..., None]))[..., 0]
        within = normalize(within, dim=-1, eps=TINY)
        conormal = torch.where(self.crease[:, None], within, conormal)
        mask, zero = self.mask.to(points), points.new_zeros(len(points))
        parts = zip((torch.zeros_like(points), zero, zero + 1), (conormal, *shares), strict=True)
        conormals, sizes, folds = (x.index_put((self.members,), part) for x, part in parts)
        return Boundary(self.mask, conormals * mask[:, None], sizes * mask, folds)

    def initial(self, points: Points) -> Float[Tensor, "b n d_minus_1"]:
        """Initial tangents of the boundary."""
        return mesh_frames(points[self.members], torch.searchsorted(self.members, self.sides))

    def measures(
        self, points: Points
    ) -> tuple[Float[Tensor, "b n"], Float[Tensor, " b"], Float[Tensor, " b"]]:
        """Outward vectors, sizes and folds of the boundary points, the last two as in `Boundary`."""
        outward, size = outward_sums(points, self.sides, self.opposite)
        outward, size = outward[self.members], size[self.members]
        length = outward.norm(dim=1)
        folds = torch.where(self.crease & (length > 0), size / length, 1.0)
        return outward, size / factorial(self.sides.shape[1]), folds

    def with_fits(self, points: Points, graph: sparse.csr_array, degree: int) -> BoundaryPlan:
        """Return the plan with fits of the boundary's tangents, of this degree or, at few points, lower."""
        own = GraphNeighborhoods(points[self.members], graph, self.initial(points))
        search = FitSearch(own, degree)
        search.refine(torch.arange(len(self.members)))
        return replace(self, fits=search.finish()[0])


def sub_simplices(
    cells: Int[Tensor, "F v"], places: Sequence[Sequence[int]]
) -> tuple[Int[Tensor, "S size"], Int[Tensor, "F c"], Int[Tensor, " S"]]:
    """(distinct sub-simplices at these corners, ascending; their numbers by cell; number of cells at each)."""
    ascending = cells.sort(1).values
    every = torch.stack([ascending[:, list(corners)] for corners in places], 1)
    base = int(cells.max()) + 1 if len(cells) else 1
    key = every[..., 0]
    for column in every[..., 1:].unbind(-1):
        key = key * base + column
    key, of, uses = torch.unique(key, return_inverse=True, return_counts=True)
    columns = [key // base**power % base for power in reversed(range(every.shape[2]))]
    return torch.stack(columns, 1), of, uses


def open_sides(cells: Int[Tensor, "F v"]) -> tuple[Int[Tensor, "G w"], Int[Tensor, " G"]]:
    """(sides of one cell only: edges of triangles, ends of segments; the corner opposite each).

    >>> open_sides(torch.tensor([[0, 1, 2], [1, 3, 2]]))[0].tolist()
    [[0, 1], [0, 2], [1, 3], [2, 3]]
    """
    count = cells.shape[1]
    sides, of, uses = sub_simplices(cells, list(combinations(range(count), count - 1)))
    cell, place = (uses[of] == 1).nonzero(as_tuple=True)
    number, order = of[cell, place].sort()
    return sides[number], cells[cell[order]].sum(1) - sides[number].sum(1)


def outer_faces(points: Points, cells: Int[Tensor, "F 4"]) -> Int[Tensor, "G 3"]:
    """Boundary triangles of tetrahedra, in R³ oriented so that their normals point outwards."""
    sides, opposite = open_sides(cells)
    if points.shape[1] != 3:
        return sides
    a, b, c = points[sides].unbind(1)
    turned = (torch.linalg.cross(b - a, c - a) * (points[opposite] - a)).sum(1) > 0
    return torch.where(turned[:, None], sides.flip(1), sides)


def folded_sides(points: Points, cells: Int[Tensor, "F 4"]) -> Int[Tensor, "G 3"]:
    """Boundary triangles of tetrahedra that lie on another: at an edge both are in one half-plane."""
    sides, _ = open_sides(cells)
    ends = sides[:, [[1, 2], [0, 2], [0, 1]]]
    start, stop = points[ends].unbind(2)
    along, inward = normalize(stop - start, dim=-1), points[sides] - start
    away = normalize(inward - (inward * along).sum(-1, keepdim=True) * along, dim=-1)
    edge = (ends[..., 0] * len(points) + ends[..., 1]).unique(return_inverse=True)[1]
    tree = KDTree(torch.cat([edge[..., None], away], -1).flatten(0, 1).numpy())
    return sides[np.unique(tree.query_pairs(SMALL, output_type="ndarray") // 3)]


def boundary_of_mesh(
    vertices: Points, faces: Int[Tensor, "F v"], degree: int
) -> BoundaryPlan | None:
    """Boundary of a mesh from its unpaired sides, its tangents fitted up to `degree`; None for a closed mesh."""
    sides, opposite = open_sides(faces)
    if len(sides) == 0:
        return None
    mask = torch.zeros(len(vertices), dtype=torch.bool)
    mask[sides.reshape(-1)] = True
    members = mask.nonzero()[:, 0]
    outward, size = outward_sums(vertices, sides, opposite)
    crease = (outward.norm(dim=1) < KINK * size)[members]
    plan = BoundaryPlan(mask, members, None, sides, opposite, crease)
    if sides.shape[1] == 1:
        return plan
    graph = mesh_graph(torch.searchsorted(members, sides), len(members))
    return plan.with_fits(vertices, graph, degree)


def boundary_creases(vertices: Points, cells: Int[Tensor, "F v"]) -> Bool[Tensor, " N"]:
    """Vertices where the boundary of a mesh turns by 60° or more, as at the edges and corners of a cube."""
    outward, size = outward_sums(vertices, *open_sides(cells))
    return outward.square().sum(1) < (1 + CREASE) / 2 * size.square()


def outward_sums(
    vertices: Points, sides: Int[Tensor, "G w"], opposite: Int[Tensor, " G"]
) -> tuple[Points, Float[Tensor, " N"]]:
    """(sum over the boundary sides at each vertex of their outer normals, weighted by their sizes; sum of the sizes).

    The size of a side is (d − 1)! times its volume.
    """
    corners = vertices[sides]
    basis, triangle = torch.linalg.qr((corners[:, 1:] - corners[:, :1]).mT)
    size = torch.diagonal(triangle, dim1=-2, dim2=-1).prod(-1).abs()
    offset = (corners[:, 0] - vertices[opposite])[..., None]
    height = (offset - basis @ (basis.mT @ offset))[..., 0]
    normal = size[:, None] * normalize(height, dim=-1, eps=TINY)
    outward, total = torch.zeros_like(vertices), torch.zeros_like(vertices[:, 0])
    for corner in sides.T:
        outward.index_add_(0, corner, normal)
        total.index_add_(0, corner, size)
    return outward, total
