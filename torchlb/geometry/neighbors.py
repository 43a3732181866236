"""Neighbourhoods: which points form a stencil, and in which order (`method.md`, section 4).

A Euclidean ball mixes the two sides of a thin sheet, whose tangent planes agree. So a stencil is drawn from a *k-hop
neighbourhood*: a breadth-first walk along the edges of a mesh, or of the graph of each point's few nearest compatible
neighbours on a cloud, restricted to points compatible with the centre. The `size` nearest points reached are the pool,
ordered by distance. At a crease, where the tangent planes turn away, the walk ends.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations
from math import ceil

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.spatial import KDTree
from torch import Tensor

from torchlb.geometry.compatibility import plucker_coordinates
from torchlb.geometry.thresholds import AROUND, CREASE, HALF_CREASE, WIDER
from torchlb.geometry.vectors import Frames, Mask, Near, Points, at


def nearest_neighbors(points: Points, size: int) -> Near:
    """The `size` nearest points of each point by distance, itself first even where others coincide with it."""
    tree = KDTree(points.numpy())
    _, index = tree.query(points.numpy(), k=size, workers=torch.get_num_threads())
    found = torch.from_numpy(np.asarray(index, dtype=np.int64).reshape(len(points), size))
    own = torch.arange(len(points))[:, None]
    others = found != own
    others[:, -1] &= ~others.all(1)  # the point was crowded out by coincident ones
    return torch.cat([own, found[others].view(len(points), size - 1)], 1)


def adjacency(i: np.ndarray, j: np.ndarray, num_points: int) -> sparse.csr_array:
    """Symmetric 0/1 adjacency matrix of the pairs (i, j), without loops."""
    keep = i != j
    ones = np.ones(int(keep.sum()), dtype=np.float32)
    graph = sparse.csr_array((ones, (i[keep], j[keep])), shape=(num_points, num_points))
    graph = sparse.csr_array(graph + graph.T)
    graph.data[:] = 1
    return graph


def mesh_graph(faces: Int[Tensor, "F v"], num_points: int) -> sparse.csr_array:
    """Symmetric (N, N) adjacency matrix of the edges of a mesh of simplices."""
    corners = faces.numpy()
    i, j = np.concatenate([corners[:, pair] for pair in combinations(range(corners.shape[1]), 2)]).T
    return adjacency(i, j, num_points)


def restricted(
    graph: sparse.csr_array, starts: Mask, stops: Mask | bool = True
) -> sparse.csr_array:
    """The edges of a graph from some of its points, and to some of them: a walk ends at the others."""
    kept = sparse.csr_array(graph.multiply(starts[:, None]).multiply(stops))
    kept.eliminate_zeros()
    return kept


@dataclass(frozen=True, eq=False)
class GraphNeighborhoods:
    """Nearest points of a k-hop neighbourhood in a graph, for any chunk of centres; results are kept.

    The tangent frames decide compatibility. Points on the other side of a thin shape are refused by their `sides`, from
    `thin_sides`, if these are known.
    """

    points: Points
    graph: sparse.csr_array
    frames: Frames
    sides: Points | None = None
    # by size, indices and counts of all points; a count of 0 is not known yet; copies share what is found
    _kept: dict[int, tuple[Tensor, Tensor]] = field(default_factory=dict)

    @property
    def dim(self) -> int:
        """Dimension d of the tangent planes."""
        return self.frames.shape[-1]

    @cached_property
    def _arrays(self) -> tuple[tuple[np.ndarray, ...], tuple[np.ndarray, ...]]:
        """Shape and graph for the compiled walk."""
        sides = torch.zeros_like(self.points) if self.sides is None else self.sides
        shape = self.points, self.frames, plucker_coordinates(self.frames), sides
        rows = self.graph.indptr, self.graph.indices
        return tuple(x.contiguous().numpy() for x in shape), tuple(x.astype(np.int32) for x in rows)

    @cached_property
    def longest(self) -> Int[Tensor, "N edges"]:
        """Neighbours of every point along its longest `AROUND` edges; padded by the point itself."""
        points, ends = self.points, sparse.coo_array(self.graph).coords
        row, col = (torch.from_numpy(end.astype(np.int64)) for end in ends)
        length = (points[col] - points[row]).square().sum(1)
        order = torch.from_numpy(np.lexsort((-length.numpy(), row.numpy())))
        row, col = row[order], col[order]
        number = torch.bincount(row, minlength=len(points))
        place = torch.arange(len(row)) - (number.cumsum(0) - number)[row]
        result = torch.arange(len(points))[:, None].repeat(1, AROUND)
        keep = place < AROUND
        result[row[keep], place[keep]] = col[keep]
        return result

    def middles(self, centers: Int[Tensor, " B"]) -> Float[Tensor, "B edges d"]:
        """Midpoints of these edges in the centre's tangent plane, in its frame, ℓ."""
        ends = at(self.points, self.longest[centers])
        return (ends - self.points[centers, None]) @ self.frames[centers] / 2

    def __call__(
        self, centers: Int[Tensor, " B"], size: int
    ) -> tuple[Int[Tensor, "B K"], Int[Tensor, " B"]]:
        """The `size` nearest compatible points of each centre, itself first, and how many there are.

        Where the neighbourhood holds fewer, the centre is repeated.
        """
        largest = next((kept for kept in self._kept if kept >= size), size)
        if largest not in self._kept:  # rows take memory once they are filled
            index = torch.empty(len(self.points), largest, dtype=torch.int32)
            self._kept[largest] = index, torch.zeros(len(index), dtype=torch.int32)
        index, count = self._kept[largest]
        missing = centers[count[centers] == 0]
        if len(missing):
            from torchlb.linalg import kernels

            wanted = WIDER * largest
            # twice as many rings as in a round neighbourhood, so that none grows along a strip alone
            bounds = float(wanted), ceil(wanted ** (1 / self.dim)), HALF_CREASE, CREASE
            found = kernels.k_hop_neighborhoods(*self._arrays, missing.numpy(), largest, bounds)
            index[missing], count[missing] = map(torch.from_numpy, found)
        return index[centers, :size].long(), count[centers].long().clamp_max(size)
