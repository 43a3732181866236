"""Low-order rows, for points where no stencil passes: positive weights, stable, and first order at best.

On a triangle mesh they are robust_laplacian's. On a cloud they are finite volumes of the Voronoi cell in the tangent
plane, built from admissible neighbours alone; only where a crease leaves a surface of R³ without a tangent plane,
and robust_laplacian's own row stays on this side of every gap, that row is better and is taken.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor

from torchlb.baseline.robust import robust_rows
from torchlb.errors import warn
from torchlb.geometry.boundary import Boundary
from torchlb.geometry.neighbors import GraphBalls, nearest_neighbors
from torchlb.geometry.voronoi import cell_laplacian, cell_volume

SMALL_REACH = 2
"""How much farther a point of a small component looks than the few nearest."""
MAX_HOPS = 3
"""Neighbours of a row of robust_laplacian farther than this along the graph lie across a gap."""


class MeshLowOrder:
    """Rows and areas of robust_laplacian on a triangle mesh."""

    def __init__(self, vertices: Float[Tensor, "N n"], faces: Int[Tensor, "F 3"]) -> None:
        self._matrix, self._areas = robust_rows(vertices, faces)

    def areas(self) -> Float[Tensor, " N"]:
        """A third of the triangles around each vertex, ℓ²."""
        return self._areas

    def rows(self, centers: Int[Tensor, " B"]) -> sparse.csr_array:
        """Rows (B, N) of Δ, 1/ℓ²."""
        return sparse.csr_array(self._matrix[centers.numpy()])


class CloudLowOrder:
    """Finite-volume rows and cell volumes of a cloud in any dimension.

    Parameters
    ----------
    balls : admissible neighbourhoods.
    boundary : where cells end.
    surface : whether robust_laplacian can be asked (a surface in R² or R³).
    """

    def __init__(self, balls: GraphBalls, boundary: Boundary | None, surface: bool) -> None:
        self.balls, self.boundary, self.surface = balls, boundary, surface
        dim = balls.frames.shape[-1]
        self.size = min(6 * 2**dim + 1, len(balls.points))
        self.few = min(4 * dim + 1, len(balls.points))

    def areas(self) -> Float[Tensor, " N"]:
        """Volumes of the Voronoi cells, ℓ^d: second order in the spacing."""
        return self._volumes

    @cached_property
    def _volumes(self) -> Float[Tensor, " N"]:
        volumes = []
        for centers in torch.arange(len(self.balls.points)).split(4096):
            _, coords, valid = self._cells(centers, self._in_small)
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
        """All rows. Small components that they leave are looked at once more."""
        matrix = self._joined(self._in_small)
        pieces = self._small_pieces(matrix)
        if (pieces & ~self._in_small).any():
            matrix = self._joined(pieces | self._in_small)
        return matrix

    def _joined(self, small: Bool[Tensor, " N"]) -> sparse.csr_array:
        """W/m less its sums, with m the volumes and W the mean of what both ends make of the flux.

        So these rows alone are an M-matrix, symmetric in m. A flux that one end alone knows is its own.
        """
        chunks = torch.arange(len(self._volumes)).split(4096)
        parts = [self._one_sided(chunk, small) for chunk in chunks]
        volumes = np.concatenate([volume for volume, _ in parts])
        rows = sparse.vstack([row for _, row in parts], format="csr")
        flux = sparse.csr_array(sparse.diags_array(volumes) @ rows)
        flux = sparse.csr_array(flux - sparse.diags_array(flux.diagonal()))
        flux.eliminate_zeros()
        ends = flux.astype(bool).astype(float)
        flux = (flux + flux.T).multiply((ends + ends.T).power(-1))
        flux = flux - sparse.diags_array(flux.sum(axis=1))
        return sparse.csr_array(sparse.diags_array(1 / volumes) @ flux)

    def _one_sided(
        self, centers: Int[Tensor, " B"], small: Bool[Tensor, " N"]
    ) -> tuple[np.ndarray, sparse.csr_array]:
        """Volumes and rows as each point by itself would have them."""
        index, coords, valid = self._cells(centers, small)
        flux = cell_laplacian(coords, valid)
        weights = torch.cat([-flux.sum(1, keepdim=True), flux], dim=1)
        row = np.arange(len(centers)).repeat(index.shape[1])
        shape = (len(centers), len(self.balls.points))
        cells = sparse.csr_array((weights.flatten(), (row, index.flatten())), shape=shape)
        cells.sum_duplicates()
        volumes = self._volumes[centers].numpy()
        if self._robust is None:
            return volumes, cells
        matrix, areas, reachable = self._robust
        robust = sparse.csr_array(matrix[centers.numpy()])
        joined = robust.astype(bool)
        near = joined.multiply(reachable[centers.numpy()])
        clean = (near.sum(axis=1) == joined.sum(axis=1)) & (joined.sum(axis=1) > 1)
        ours, theirs = (sparse.diags_array(rows.astype(float)) for rows in (~clean, clean))
        volumes = np.where(clean, areas[centers].numpy(), volumes)
        return volumes, sparse.csr_array(ours @ cells + theirs @ robust)

    def _cells(
        self, centers: Int[Tensor, " B"], small: Bool[Tensor, " N"]
    ) -> tuple[Int[Tensor, "B K"], Float[Tensor, "B neighbors d"], Bool[Tensor, "B neighbors"]]:
        """Neighbours, their coordinates, and which are real.

        A point with hardly an admissible neighbour takes the few nearest points, whatever they are. One of a component
        of fewer points than a row looks `SMALL_REACH` times as far, at as many as a row has, some of which lie beyond:
        crumpled corners of a scan hang together with the rest.
        """
        points, frames = self.balls.points, self.balls.frames
        index, count = self.balls(centers, self.size)
        far = small[centers]
        alone = far | (count <= 2 * frames.shape[-1])
        if alone.any():
            nearest = self._nearest[centers[alone]]
            distance = (points[nearest] - points[centers[alone], None]).norm(dim=-1)
            reach = distance[:, self.few - 1] * torch.where(far[alone], SMALL_REACH, 1)
            index[alone], count[alone] = nearest, (distance <= reach[:, None]).sum(1)
        offset = points[index[:, 1:]] - points[centers, None]
        coords = offset @ frames[centers]
        # Unrolled to their true distance, so that neighbours above one another do not collapse.
        length = coords.norm(dim=-1, keepdim=True).clamp_min(torch.finfo(coords.dtype).tiny)
        coords = coords * (offset.norm(dim=-1, keepdim=True) / length)
        return index, coords, torch.arange(1, self.size) < count[:, None]

    @cached_property
    def _in_small(self) -> Bool[Tensor, " N"]:
        return self._small_pieces(self.balls.graph)

    def _small_pieces(self, graph: sparse.csr_array) -> Bool[Tensor, " N"]:
        """Points of components with fewer points than a row looks at."""
        _, component = csgraph.connected_components(graph, directed=False)
        return torch.from_numpy(np.bincount(component)[component] < self.size)

    @cached_property
    def _nearest(self) -> Int[Tensor, "N K"]:
        return nearest_neighbors(self.balls.points, self.size)

    @cached_property
    def _robust(self) -> tuple[sparse.csr_array, Tensor, sparse.csr_array] | None:
        """Rows and areas of robust_laplacian, and who is a few hops between close or admissible neighbours away.

        None where it cannot be asked, or refuses: a point has no triangle, as on a line.
        """
        points = self.balls.points
        spread = torch.linalg.svdvals(points - points.mean(0))
        if not self.surface or len(points) < 4 or spread[1] <= 1e-9 * spread[0]:
            return None
        try:
            rows, areas = robust_rows(points, None)
        except RuntimeError as error:
            warn(
                f"robust_laplacian refuses the cloud ({error}); Voronoi cells give all low-order rows"
            )
            return None
        close = self._nearest[:, : self.balls.frames.shape[-1] + 1]
        row = np.arange(len(points)).repeat(close.shape[1])
        ones = np.ones(len(row), dtype=bool)
        step = sparse.csr_array((ones, (row, close.flatten().numpy())), self.balls.graph.shape)
        step = step + step.T + self.balls.graph.astype(bool)
        reach = step
        for _ in range(MAX_HOPS - 1):
            reach = reach @ step
        return rows, areas, reach
