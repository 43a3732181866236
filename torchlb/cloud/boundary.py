"""Boundary of a cloud, marked by the user or to be detected: its points, and the conormals there."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from torchlb.cloud.frames import cloud_frames
from torchlb.cloud.voronoi import cell_volume, nearest_graph, unrolled
from torchlb.geometry.boundary import BoundaryPlan
from torchlb.geometry.neighbors import nearest_neighbors
from torchlb.geometry.thresholds import RING


@dataclass(frozen=True)
class CloudBoundaryPlan(BoundaryPlan):
    """Neighbours of the boundary points of a cloud, where a mask gives the boundary and not a complex.

    `inside` are the nearest points off the boundary, which tell the side of the shape; `near` the nearest boundary
    points, by their position in `members`, for the initial tangents.
    """

    inside: Int[Tensor, "_ q"]
    near: Int[Tensor, "_ K"]

    def initial(self, points: Float[Tensor, "N n"]) -> Float[Tensor, "b n d_minus_1"]:
        """Initial tangents of the boundary."""
        return cloud_frames(points[self.members], self.near, self.sides.shape[1] - 1)

    def measures(
        self, points: Float[Tensor, "N n"]
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
    points: Float[Tensor, "N n"], mask: Bool[Tensor, " N"], dim: int, degree: int
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
