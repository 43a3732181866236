"""Plan of the frames, normals and boundary of a shape, and their evaluation at given points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize, pad

from torchlb.geometry.boundary import Boundary, BoundaryPlan
from torchlb.geometry.frames import complete_frames, mesh_frames, normals_of_frames, vertex_normals
from torchlb.geometry.local_fits import FitPlan, LocalFits
from torchlb.geometry.vectors import dot
from torchlb.linalg.precision import TINY


class Beside(NamedTuple):
    """Normals and displacements of a cloud's surface, relative to its triangles and so without a unit.

    Attributes
    ----------
    neighbor
        (N,), neighbour of each point, in the direction of its first tangent.
    normals
        (N, 3), initial normals, by components along the triangles' normal, that tangent, and their cross product.
    moved
        (m,), displaced points: noisy ones, and those off the surface.
    offsets
        (m, 3), their displacements, by the same components, relative to the distance to the neighbour.
    """

    neighbor: Int[Tensor, " N"]
    normals: Float[Tensor, "N 3"]
    moved: Int[Tensor, " m"]
    offsets: Float[Tensor, "m 3"]

    @classmethod
    def of(
        cls,
        given: Float[Tensor, "N n"],
        places: Float[Tensor, "N 3"],
        triangles: Int[Tensor, "F 3"],
        nearest: Int[Tensor, " N"],
        normals: Float[Tensor, "N 3"],
    ) -> Beside:
        """Encode the surface positions `places` of the given points, and the normals there."""
        neighbor = nearest.clone()
        neighbor[triangles.flatten()] = triangles.roll(1, 1).flatten()
        given = pad(given, (0, 3 - given.shape[1]))
        moved = (places != given).any(1).nonzero()[:, 0]
        axes, size = _axes(given, triangles, neighbor)
        offset = (places - given)[moved] / size[moved, None]
        axes, offsets = _axes(places, triangles, neighbor)[0], (axes[moved] @ offset[..., None])
        return cls(neighbor, (axes @ normals[..., None])[..., 0], moved, offsets[..., 0])

    def places(
        self, points: Float[Tensor, "N n"], triangles: Int[Tensor, "F 3"]
    ) -> Float[Tensor, "N n"]:
        """Positions on the surface for given points."""
        if len(self.moved) == 0:
            return points
        space = pad(points, (0, 3 - points.shape[1]))
        axes, size = _axes(space, triangles, self.neighbor)
        offset = (self.offsets[:, None] @ axes[self.moved])[:, 0] * size[self.moved, None]
        return space.index_add(0, self.moved, offset)[:, : points.shape[1]]

    def frames(
        self, places: Float[Tensor, "N n"], triangles: Int[Tensor, "F 3"]
    ) -> Float[Tensor, "N n 2"]:
        """Initial frames, orthogonal to the initial normals in R³."""
        if places.shape[1] == 2:
            return mesh_frames(places, triangles)
        axes, _ = _axes(places, triangles, self.neighbor)
        normal = normalize((self.normals[:, None] @ axes)[:, 0])
        first = normalize(axes[:, 1] - dot(axes[:, 1], normal)[:, None] * normal)
        return torch.stack([first, torch.linalg.cross(normal, first)], -1)


def _axes(
    points: Float[Tensor, "N 3"], triangles: Int[Tensor, "F 3"], neighbor: Int[Tensor, " N"]
) -> tuple[Float[Tensor, "N 3 3"], Float[Tensor, " N"]]:
    """Normal of the triangles around each point, two tangents, the first towards its neighbour, and the distance to it.

    Where a direction is undefined, it is arbitrary.
    """
    normal = vertex_normals(points, triangles)
    normal = torch.where((normal == 0).all(1, keepdim=True), normal.new_tensor([0.0, 0, 1]), normal)
    edge = points[neighbor] - points
    along = edge - dot(edge, normal)[:, None] * normal
    flat = dot(along, along)[:, None] == 0
    along = normalize(torch.where(flat, complete_frames(normal)[..., 0], along), eps=TINY)
    return torch.stack([normal, along, torch.linalg.cross(normal, along)], 1), edge.norm(dim=1)


@dataclass(frozen=True)
class ShapePlan:
    """Plan of a shape of simplices.

    Attributes
    ----------
    cells
        (F, d + 1), simplices whose planes give the initial frames.
    shares
        (F,), fraction of each cell that is integrated; None for all of it.
    fits
        Plan of the fits of heights, and of functions where a weak pair is built.
    beside
        Data of the surface through a cloud; None where points stay as given and frames start from the cells.
    side
        (N,), sign of each normal along that of the cells around the vertex; None for shapes without sides.
    boundary
        Plan of the boundary; None for a closed shape, or where no condition holds.
    """

    cells: Int[Tensor, "F corners"]
    shares: Float[Tensor, " F"] | None
    fits: FitPlan
    beside: Beside | None
    side: Int[Tensor, " N"] | None
    boundary: BoundaryPlan | None

    def at(self, points: Float[Tensor, "N n"]) -> tuple[Placed, LocalFits]:
        """Frames, normals and boundary at these points, and the fits behind them."""
        if self.beside is None:
            places, initial = points, mesh_frames(points, self.cells)
        else:
            places = self.beside.places(points, self.cells)
            initial = self.beside.frames(places, self.cells)
        fits = LocalFits.at(self.fits, places, initial)
        return self.placed(fits), fits

    def placed(self, fits: LocalFits) -> Placed:
        """Frames, normals and boundary from given fits."""
        reference = None
        if self.side is not None:
            reference = self.side[:, None] * vertex_normals(fits.points, self.cells)
        frames, normals = righthanded(fits.frames, reference)
        boundary = None if self.boundary is None else self.boundary.at(fits.points, frames)
        return Placed(fits.points, frames, normals, boundary)


@dataclass(frozen=True)
class Placed:
    """Points, frames, normals and boundary of a shape.

    Attributes
    ----------
    points
        (N, n), ℓ, float64.
    frames
        (N, n, d), orthonormal; [frames, normal] is right-handed where there is a normal.
    normals
        (N, n) unit normals of a hypersurface, else None. Oriented by the cells, or consistently on a cloud.
    boundary
        Boundary points and conormals; None for a closed shape, or where no condition holds.
    """

    points: Float[Tensor, "N n"]
    frames: Float[Tensor, "N n d"]
    normals: Float[Tensor, "N n"] | None
    boundary: Boundary | None


def turned(normals: Tensor, reference: Tensor) -> Tensor:
    """Flip the normals to the side of `reference`."""
    return torch.where(((normals * reference).sum(1) < 0)[:, None], -normals, normals)


def righthanded(
    frames: Float[Tensor, "N n d"], reference: Float[Tensor, "N n"] | None
) -> tuple[Float[Tensor, "N n d"], Float[Tensor, "N n"] | None]:
    """Frames with [frames, normal] right-handed, and normals of a hypersurface on the side of `reference`."""
    if frames.shape[2] != frames.shape[1] - 1:
        return frames, None
    righthanded = normals_of_frames(frames)
    normals = righthanded if reference is None else turned(righthanded, reference)
    hand = (normals * righthanded).sum(1)[:, None, None].sign()
    return torch.cat([hand * frames[..., :1], frames[..., 1:]], -1), normals
