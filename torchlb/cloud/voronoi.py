"""Voronoi cells in the tangent plane: natural neighbours, a graph and volumes for points in any dimension.

Seen from a point, its Voronoi cell among neighbours at y_j ends in the direction u at r(u) = min_j |y_j|² / (2 y_j·u).
Neighbours that attain the minimum are its natural neighbours; the mean of r^d over all directions gives its volume. By
these the boundary of a cloud is that of a mask, where cells overlap.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from math import gamma, pi

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import normalize

from torchlb.cloud.frames import cloud_frames
from torchlb.geometry.boundary import BoundaryPlan
from torchlb.geometry.compatibility import mutually_compatible, planes_of
from torchlb.geometry.neighbors import adjacency, nearest_neighbors
from torchlb.geometry.thresholds import CREASE, RING, WIDER
from torchlb.geometry.vectors import Frames, Near, Points
from torchlb.linalg.precision import TINY, rows_at_once


@cache
def unit_directions(dim: int) -> Float[Tensor, "u d"]:
    """Evenly spread unit vectors: 2, 128 or 1024 of them for d = 1, 2 or more."""
    if dim == 1:
        return torch.tensor([[-1.0], [1.0]], dtype=torch.float64)
    if dim == 2:
        angle = 2 * pi * torch.arange(128, dtype=torch.float64) / 128
        return torch.stack([angle.cos(), angle.sin()], dim=1)
    # scrambled, since the plain sequence holds its centre, which has no direction
    uniform = torch.quasirandom.SobolEngine(dim, scramble=True, seed=0).draw(1024).double()
    normal = torch.special.ndtri(uniform)
    return normal / normal.norm(dim=1, keepdim=True)


def _directions(
    coords: Float[Tensor, "B K d"], valid: Bool[Tensor, "B K"]
) -> Float[Tensor, "B u d"]:
    """Directions at each point: in the plane they start at the nearest neighbour, and so turn with the points."""
    table = unit_directions(coords.shape[-1]).to(coords)
    if coords.shape[-1] != 2:
        return table.expand(len(coords), -1, -1)
    square = coords.square().sum(-1).masked_fill(~valid, torch.inf)
    nearest = coords[torch.arange(len(coords)), square.argmin(1)]
    x, y = normalize(nearest, dim=-1, eps=TINY).unbind(-1)  # the default, 1e-12, is a length
    x = torch.where((x == 0) & (y == 0), 1.0, x)
    turn = torch.stack([torch.stack([x, y], -1), torch.stack([-y, x], -1)], dim=-2)
    return table @ turn


def _inverse_radius(
    coords: Float[Tensor, "B K d"], valid: Bool[Tensor, "B K"], directions: Float[Tensor, "B u d"]
) -> Float[Tensor, "B K u"]:
    """2 y_j·u / |y_j|², whose maximum over j is 1 / r(u) if positive; 0 for invalid neighbours."""
    square = coords.square().sum(-1, keepdim=True).clamp_min(TINY)
    return (2 * coords / square).masked_fill(~valid[..., None], 0.0) @ directions.mT


def natural_neighbors(
    coords: Float[Tensor, "B K d"], valid: Bool[Tensor, "B K"]
) -> Bool[Tensor, "B K"]:
    """Which of the valid neighbours bound the cell; those that bound less than 3° of it may be missed."""
    nearest, first = _inverse_radius(coords, valid, _directions(coords, valid)).max(dim=1)
    natural = torch.zeros_like(valid)
    natural.scatter_reduce_(1, first, nearest > 0, "amax")
    return natural & valid


def cell_volume(coords: Float[Tensor, "B K d"], valid: Bool[Tensor, "B K"]) -> Float[Tensor, " B"]:
    """Volume of the cell, ℓ^d: that of the unit ball times the mean of r^d.

    An open cell ends half-way to the farthest valid neighbour; in directions without one within 60° it ends at the
    point itself, as at the end of a curve.
    """
    dim = coords.shape[-1]
    distance = coords.norm(dim=-1).masked_fill(~valid, 0)
    farthest = distance.amax(1, keepdim=True).clamp_min(TINY)
    directions = _directions(coords, valid)
    inverse = _inverse_radius(coords, valid, directions)
    ahead = (inverse * distance[..., None] / 2).amax(1) > CREASE
    volume = inverse.amax(1).maximum(2 / farthest).pow(-dim) * ahead
    unit_ball = pi ** (dim / 2) / gamma(dim / 2 + 1)
    return unit_ball * volume.mean(1)


def unrolled(
    offset: Float[Tensor, "B K n"], frames: Float[Tensor, "B n d"]
) -> Float[Tensor, "B K d"]:
    """Coordinates in the tangent plane at the true distance, so that neighbours above one another do not collapse."""
    coords = offset @ frames
    length = coords.norm(dim=-1, keepdim=True).clamp_min(TINY)
    return coords * (offset.norm(dim=-1, keepdim=True) / length)


def nearest_graph(points: Points, frames: Frames, candidates: Near) -> sparse.csr_array:
    """Neighbour graph of a cloud in place of the edges of a mesh, symmetric (N, N).

    Each point is joined to its 2^(d+1) nearest compatible neighbours (4, 8, 16 for curves, surfaces, solids) and to its
    natural neighbours in the tangent plane, which bridge the voids of an uneven cloud. `candidates` come from
    `nearest_neighbors`; an edge is compatible from both its ends.
    """
    dim, others = frames.shape[-1], candidates[:, 1:]
    num_rows, size = others.shape
    if size == 0:  # a single point
        return sparse.csr_array((num_rows, num_rows), dtype=np.float32)
    centers, flat, good = mutually_compatible(points, planes_of(frames), candidates)
    chosen = good & (good.cumsum(1) <= 2 ** (dim + 1))
    for rows in torch.arange(num_rows).split(rows_at_once(size * len(unit_directions(dim)))):
        offset = points[others[rows]] - points[rows, None]
        distance = offset.norm(dim=-1)
        near = good[rows]
        if dim > 1:
            near &= distance <= WIDER * (distance * chosen[rows]).amax(1, keepdim=True)
        chosen[rows] |= natural_neighbors(offset @ frames[rows], near)
    pick = chosen.reshape(-1).numpy()
    return adjacency(centers.numpy()[pick], flat.numpy()[pick], num_rows)


@dataclass(frozen=True)
class CloudBoundaryPlan(BoundaryPlan):
    """Neighbours of the boundary points of a cloud, where a mask gives the boundary and not a complex.

    `inside` are the nearest points off the boundary, which tell the side of the shape; `near` the nearest boundary
    points, by their position in `members`, for the initial tangents.
    """

    inside: Int[Tensor, "_ q"]
    near: Int[Tensor, "_ K"]

    def initial(self, points: Points) -> Float[Tensor, "b n d_minus_1"]:
        """Initial tangents of the boundary."""
        return cloud_frames(points[self.members], self.near, self.sides.shape[1] - 1)

    def measures(
        self, points: Points
    ) -> tuple[Float[Tensor, "b n"], Float[Tensor, " b"], Float[Tensor, " b"]]:
        """Outward vectors; volumes of the Voronoi cells within the boundary; folds, all 1."""
        own, ends = points[self.members], self.sides.shape[1] == 1
        size = torch.full_like(own[:, 0], float(ends))  # a single point of a boundary has no length
        if self.near.shape[1] > 1:
            offset = own[self.near[:, 1:]] - own[:, None]
            valid = torch.ones_like(self.near[:, 1:], dtype=torch.bool)
            size = cell_volume(unrolled(offset, self.initial(points)), valid)
        outward = (own[:, None] - points[self.inside]).mean(1)
        return outward, size, torch.ones_like(size)


def boundary_of_cloud(
    points: Points, mask: Bool[Tensor, " N"], dim: int, degree: int
) -> BoundaryPlan | None:
    """Boundary of a cloud of dimension d from the mask of its boundary points; None if there are none."""
    if not mask.any():
        return None
    members = mask.nonzero()[:, 0]
    own, others = points[members], (~mask).nonzero()[:, 0] if not mask.all() else members
    count = min(RING, len(others))
    _, index = KDTree(points[others].numpy()).query(own.numpy(), k=count)
    inside = others[torch.from_numpy(index.reshape(len(members), count))]
    near = nearest_neighbors(own, min(max(8 * (dim - 1), 1), len(own)))
    none, crease = members.new_zeros(0, dim), torch.zeros_like(members, dtype=torch.bool)
    plan = CloudBoundaryPlan(mask, members, None, none, none[:, 0], crease, inside, near)
    if dim == 1:
        return plan
    return plan.with_fits(points, nearest_graph(own, plan.initial(points), near), degree)
