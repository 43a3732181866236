"""The boundary of a cloud that no complex goes through: its points, and the conormals there."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from torchlb.cloud.frames import cloud_frames
from torchlb.cloud.voronoi import cell_volume, largest_gap, nearest_graph, unrolled
from torchlb.errors import InputError
from torchlb.geometry.boundary import BoundaryPlan
from torchlb.geometry.neighbors import AT_ONCE, GraphBalls, nearest_neighbors

INSIDE = 4
"""Nearest points off the boundary, on whose side the shape is."""


OPEN_ANGLE, NEAREST = 2.3, 32
"""Radians of the tangent plane without any of so many nearest points that make a point of a cloud a boundary point.
Of 16, two in a hundred random points leave as much open, of 32 none in a thousand."""


@dataclass(frozen=True)
class CloudBoundaryPlan(BoundaryPlan):
    """What is decided about the boundary of a cloud that is marked, and is not that of a complex.

    Attributes
    ----------
    inside
        (b, q), points off the boundary, on whose side the shape is.
    near
        (b, K), the nearest boundary points by their places among `members`, from which the first tangents are.
    """

    inside: Int[Tensor, "_ q"]
    near: Int[Tensor, "_ K"]

    def initial(self, points: Float[Tensor, "N n"]) -> Float[Tensor, "b n d_minus_1"]:
        """The boundary's first tangents."""
        return cloud_frames(points[self.members], self.near, self.sides.shape[1] - 1)

    def measures(
        self, points: Float[Tensor, "N n"]
    ) -> tuple[Float[Tensor, "b n"], Float[Tensor, " b"], Float[Tensor, " b"]]:
        """Vectors that leave the shape; volumes of the boundary's own Voronoi cells, and no folds."""
        own, size = points[self.members], torch.ones_like(points[self.members, 0])
        if self.sides.shape[1] > 1:
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
    count = min(INSIDE, len(others))
    _, index = KDTree(points[others].numpy()).query(own.numpy(), k=count)
    inside = others[torch.from_numpy(index.reshape(len(members), count))]
    near = nearest_neighbors(own, min(max(8 * (dim - 1), 1), len(own)))
    none, crease = members.new_zeros(0, dim), torch.zeros_like(members, dtype=torch.bool)
    plan = CloudBoundaryPlan(mask, members, None, none, none[:, 0], crease, inside, near)
    if dim == 1:
        return plan
    return plan.with_fits(points, nearest_graph(own, plan.initial(points), near), degree)


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
