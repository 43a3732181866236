"""Low-order rows, for points where no stencil passes: positive weights, stable, and first order at best.

On triangles, those of a mesh or of the surface through a cloud, they are robust_laplacian's, on the segments of a curve
those of linear elements. Elsewhere they are finite volumes of the Voronoi cell in the tangent plane, built from
admissible neighbours alone.
"""

from __future__ import annotations

from functools import cached_property
from math import factorial

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor
from torch.nn.functional import pad

from torchlb.baseline.robust import LEAST_AREA, robust_rows
from torchlb.geometry.boundary import Boundary
from torchlb.geometry.neighbors import GraphBalls, nearest_neighbors
from torchlb.geometry.voronoi import (
    cell_laplacian,
    cell_volume,
    rows_at_once,
    unrolled,
)


def simplex_shares(
    vertices: Float[Tensor, "N n"], faces: Int[Tensor, "F v"]
) -> Float[Tensor, " N"]:
    """Of each vertex an equal share of the length, area or volume of its simplices, ℓ^d: half, a third, a quarter.

    >>> simplex_shares(torch.tensor([[0.0], [1.0], [3.0]]), torch.tensor([[0, 1], [1, 2]])).tolist()
    [0.5, 1.5, 1.0]
    """
    dim = faces.shape[1] - 1
    edges = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    upper = torch.linalg.qr(edges.mT).R
    volume = torch.diagonal(upper, dim1=-2, dim2=-1).prod(-1).abs() / factorial(dim)
    share = (volume / (dim + 1)).repeat_interleave(dim + 1)
    return torch.zeros_like(vertices[:, 0]).index_add_(0, faces.reshape(-1), share)


class CurveLowOrder:
    """Linear elements on the segments of a curve with lumped mass; where several meet, what flows in flows out."""

    def __init__(self, vertices: Float[Tensor, "N n"], segments: Int[Tensor, "F 2"]) -> None:
        self.vertices, self.segments = vertices, segments

    def rows(self, centers: Int[Tensor, " B"]) -> sparse.csr_array:
        """Rows (B, N) of Δ, 1/ℓ²."""
        return sparse.csr_array(self._matrix[centers.numpy()])

    @cached_property
    def _matrix(self) -> sparse.csr_array:
        i, j = self.segments.T.numpy()
        length = (self.vertices[self.segments[:, 1]] - self.vertices[self.segments[:, 0]]).norm(
            dim=1
        )
        count = len(self.vertices)
        weights = sparse.csr_array((1 / length.numpy(), (i, j)), shape=(count, count))
        weights = sparse.csr_array(weights + weights.T)
        strong = weights - sparse.diags_array(weights.sum(axis=1))
        half = simplex_shares(self.vertices, self.segments).numpy()
        return sparse.csr_array(sparse.diags_array(1 / half) @ strong)


class MeshLowOrder:
    """Rows and areas of robust_laplacian on a triangle mesh."""

    def __init__(self, vertices: Float[Tensor, "N n"], faces: Int[Tensor, "F 3"]) -> None:
        self.vertices, self.faces = vertices, faces

    @cached_property
    def _robust(self) -> tuple[sparse.csr_array, Float[Tensor, " N"]]:
        return robust_rows(self.vertices, self.faces)

    def areas(self) -> Float[Tensor, " N"]:
        """A third of the triangles around each vertex, ℓ²; robust_laplacian's where some have next to none."""
        corners = pad(self.vertices, (0, 3 - self.vertices.shape[1]))[self.faces]
        sides = corners - corners.roll(1, 1)
        area = torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=1) / 2
        thirds, longest = torch.zeros(2, len(self.vertices), dtype=self.vertices.dtype)
        flat = self.faces.reshape(-1)
        thirds.index_add_(0, flat, (area / 3).repeat_interleave(3))
        square = sides.square().sum(2).amax(1)
        longest.scatter_reduce_(0, flat, square.repeat_interleave(3), "amax")
        return thirds if (thirds > LEAST_AREA * longest).all() else self._robust[1]

    def rows(self, centers: Int[Tensor, " B"]) -> sparse.csr_array:
        """Rows (B, N) of Δ, 1/ℓ²."""
        return sparse.csr_array(self._robust[0][centers.numpy()])


class CloudLowOrder:
    """Finite-volume rows and cell volumes of a cloud in any dimension.

    Parameters
    ----------
    balls : admissible neighbourhoods.
    boundary : where cells end.
    """

    def __init__(self, balls: GraphBalls, boundary: Boundary | None) -> None:
        self.balls, self.boundary = balls, boundary
        dim = balls.frames.shape[-1]
        self.size = min(6 * 2**dim + 1, len(balls.points))
        self.few = min(4 * dim + 1, len(balls.points))
        self.at_once = rows_at_once(self.size, dim)

    def areas(self) -> Float[Tensor, " N"]:
        """Volumes of the Voronoi cells, ℓ^d: second order in the spacing."""
        return self._volumes

    @cached_property
    def _volumes(self) -> Float[Tensor, " N"]:
        volumes = []
        for centers in torch.arange(len(self.balls.points)).split(self.at_once):
            _, coords, valid = self._cells(centers)
            outward = torch.zeros_like(coords[:, 0])
            if self.boundary is not None:
                conormals = self.boundary.conormals[centers, None]
                outward = (conormals @ self.balls.frames[centers])[:, 0]
            volumes.append(cell_volume(coords, valid, outward))
        return torch.cat(volumes)

    def rows(self, centers: Int[Tensor, " B"]) -> sparse.csr_array:
        """Rows (B, N) of Δ, 1/ℓ²."""
        return sparse.csr_array(self._matrix[centers.numpy()])

    @cached_property
    def _matrix(self) -> sparse.csr_array:
        """W/m less its sums, with m the volumes and W the mean of what both ends make of the flux.

        So these rows alone are an M-matrix, symmetric in m. A flux that one end alone knows is its own.
        """
        chunks = torch.arange(len(self._volumes)).split(self.at_once)
        rows = sparse.vstack([self._one_sided(chunk) for chunk in chunks], format="csr")
        volumes = self._volumes.numpy()
        flux = sparse.csr_array(sparse.diags_array(volumes) @ rows)
        flux = sparse.csr_array(flux - sparse.diags_array(flux.diagonal()))
        flux.eliminate_zeros()
        ends = flux.astype(bool).astype(float)
        flux = (flux + flux.T).multiply((ends + ends.T).power(-1))
        flux = flux - sparse.diags_array(flux.sum(axis=1))
        return sparse.csr_array(sparse.diags_array(1 / volumes) @ flux)

    def _one_sided(self, centers: Int[Tensor, " B"]) -> sparse.csr_array:
        """Rows as each point by itself would have them."""
        index, coords, valid = self._cells(centers)
        flux = cell_laplacian(coords, valid, self._volumes[centers])
        weights = torch.cat([-flux.sum(1, keepdim=True), flux], dim=1)
        row = np.arange(len(centers)).repeat(index.shape[1])
        shape = (len(centers), len(self.balls.points))
        cells = sparse.csr_array((weights.flatten(), (row, index.flatten())), shape=shape)
        cells.sum_duplicates()
        return cells

    def _cells(
        self, centers: Int[Tensor, " B"]
    ) -> tuple[Int[Tensor, "B K"], Float[Tensor, "B neighbors d"], Bool[Tensor, "B neighbors"]]:
        """Neighbours, their coordinates, and which are real.

        A point with hardly an admissible neighbour takes the few nearest points, whatever they are.
        """
        points, frames = self.balls.points, self.balls.frames
        index, count = self.balls(centers, self.size)
        alone = count <= 2 * frames.shape[-1]
        if alone.any():
            index[alone, : self.few] = self._nearest[centers[alone]]
            count[alone] = self.few
        offset = points[index[:, 1:]] - points[centers, None]
        valid = torch.arange(1, self.size) < count[:, None]
        return index, unrolled(offset, frames[centers]), valid

    @cached_property
    def _nearest(self) -> Int[Tensor, "N K"]:
        return nearest_neighbors(self.balls.points, self.few)
