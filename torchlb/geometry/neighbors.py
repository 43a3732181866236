"""Neighbourhoods: who may enter a point's stencil, and in which order (`method.md`, section 4).

A plain ball of the nearest points mixes the two sides of a thin sheet, whose tangent planes agree. So a stencil is
drawn from a *graph ball*: walk the edges of a mesh, or of the graph of each point's few nearest admissible neighbours
on a cloud, and step only on points that are admissible from the centre. The `size` nearest of what was reached are the
pool, ordered by distance. A path across a crease is cut there, where the tangent planes turn away.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from math import ceil
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.spatial import KDTree
from torch import Tensor

from torchlb import compiled
from torchlb.geometry.admission import (
    MAX_SLOPE,
    MIN_ALIGNMENT,
    admissible,
    planes_of,
)
from torchlb.geometry.vectors import at, dot

AT_ONCE = 2**13
"""Points whose neighbours are looked at together: of small arrays the memory is used again."""
WALKS_AT_ONCE = 2**22
"""Walks of two edges whose ends are looked at together: through the middle of a fan of n triangles there are n²."""
EDGES = 6
"""The longest edges of a point, in whose middles its fit is judged."""
BY_MATRICES = 1.5e-6
"""Seconds a point of a ball without a kernel, those of larger balls that follow included."""
BALL_SURPLUS = 1.5
"""A graph ball holds this many times the points asked for, so that its round core lies inside the ragged edge."""


def nearest_neighbors(points: Float[Tensor, "N n"], size: int) -> Int[Tensor, "N K"]:
    """The `size` nearest points of each point by distance, the point itself first, also where others coincide with it.

    >>> nearest_neighbors(torch.tensor([[0.0], [1.0], [3.0]]), 2).tolist()
    [[0, 1], [1, 0], [2, 1]]
    """
    tree = KDTree(points.numpy())
    _, index = tree.query(points.numpy(), k=size, workers=torch.get_num_threads())
    found = torch.from_numpy(np.asarray(index, dtype=np.int64).reshape(len(points), size))
    own = torch.arange(len(points))[:, None]
    others = found != own
    others[:, -1] &= ~others.all(1)  # it was crowded out by points at the same place
    return torch.cat([own, found[others].view(len(points), size - 1)], 1)


def adjacency(i: np.ndarray, j: np.ndarray, num_points: int) -> sparse.csr_array:
    """Symmetric 0/1 adjacency with the pairs (i, j), without loops."""
    keep = i != j
    ones = np.ones(int(keep.sum()), dtype=np.float32)
    graph = sparse.csr_array((ones, (i[keep], j[keep])), shape=(num_points, num_points))
    graph = sparse.csr_array(graph + graph.T)
    graph.data[:] = 1
    return graph


def mesh_graph(faces: Int[Tensor, "F v"], num_points: int) -> sparse.csr_array:
    """Edges of a mesh of simplices as a symmetric (N, N) adjacency.

    >>> mesh_graph(torch.tensor([[0, 1, 2]]), 4).toarray().astype(int).tolist()
    [[0, 1, 1, 0], [1, 0, 1, 0], [1, 1, 0, 0], [0, 0, 0, 0]]
    """
    corners = faces.numpy()
    pairs = [(a, b) for a in range(corners.shape[1]) for b in range(a)]
    i = np.concatenate([corners[:, a] for a, _ in pairs])
    j = np.concatenate([corners[:, b] for _, b in pairs])
    return adjacency(i, j, num_points)


def longest_edges(
    points: Float[Tensor, "N n"], graph: sparse.csr_array, count: int
) -> Int[Tensor, "N count"]:
    """The other ends of the longest edges of every point; padded by the point itself.

    >>> path = mesh_graph(torch.tensor([[0, 1], [1, 2]]), 3)
    >>> longest_edges(torch.tensor([[0.0], [1.0], [3.0]]), path, 1).tolist()
    [[1], [2], [1]]
    """
    row, col = (torch.from_numpy(end.astype(np.int64)) for end in sparse.coo_array(graph).coords)
    length = (points[col] - points[row]).square().sum(1)
    order = torch.from_numpy(np.lexsort((-length.numpy(), row.numpy())))
    row, col = row[order], col[order]
    number = torch.bincount(row, minlength=len(points))
    place = torch.arange(len(row)) - (number.cumsum(0) - number)[row]
    result = torch.arange(len(points))[:, None].repeat(1, count)
    keep = place < count
    result[row[keep], place[keep]] = col[keep]
    return result


class _Level:
    """Balls of one size, of those points that have been asked for."""

    def __init__(self, size: int, num_points: int) -> None:
        self.size, self.held = size, 0
        self.place = torch.full((num_points,), -1, dtype=torch.int32)
        self.index = torch.empty(0, size, dtype=torch.int32)
        self.count = torch.empty(0, dtype=torch.int32)

    def add(self, centers: Tensor, index: Tensor, count: Tensor) -> None:
        """Balls of further points."""
        first, self.held = self.held, self.held + len(centers)
        if self.held > len(self.count):  # double the room, up to that for all
            room = min(max(2 * len(self.count), self.held), len(self.place))
            for name in ("index", "count"):
                old = getattr(self, name)
                new = old.new_empty(room, *old.shape[1:])
                new[:first] = old[:first]
                setattr(self, name, new)
        self.index[first : self.held], self.count[first : self.held] = index.int(), count.int()
        self.place[centers] = torch.arange(first, self.held, dtype=torch.int32)


class GraphBalls:
    """The nearest points of a graph ball, for any chunk of centres. What has been found is kept.

    Parameters
    ----------
    points : (N, n), length ℓ.
    graph : (N, N) symmetric adjacency, from `mesh_graph` or `nearest_graph`.
    frames : (N, n, d) tangent frames that decide admission.
    sides : (N, n) from `thin_sides`: also refused is a point on the other side of a thin shape. None if not known.
    """

    def __init__(
        self,
        points: Float[Tensor, "N n"],
        graph: sparse.csr_array,
        frames: Float[Tensor, "N n d"],
        sides: Float[Tensor, "N n"] | None = None,
    ) -> None:
        self.points = points
        self.graph = graph
        self.frames = frames
        self.sides = sides
        self._planes = planes_of(frames)
        self._kept: list[_Level] = []

    @property
    def dim(self) -> int:
        """Dimension d of the tangent planes."""
        return self.frames.shape[-1]

    def with_frames(
        self, frames: Float[Tensor, "N n d"], sides: Float[Tensor, "N n"] | None
    ) -> GraphBalls:
        """The same balls for slightly other frames; those not found yet are admitted by the new ones."""
        balls = GraphBalls(self.points, self.graph, frames, sides)
        balls._kept = self._kept
        return balls

    @cached_property
    def _arrays(self) -> tuple[np.ndarray, ...]:
        """What the compiled walk takes; normals are zero in a flat space, where all is in the plane."""
        flat = self.frames.shape[1] == self.frames.shape[2]
        normals = torch.zeros_like(self.points) if flat else self._planes
        sides = normals[:0] if self.sides is None else self.sides
        shape = (x.contiguous().numpy() for x in (self.points, normals, sides))
        return *shape, self.graph.indptr.astype(np.int32), self.graph.indices.astype(np.int32)

    @cached_property
    def _walks(self) -> Int[Tensor, " N"]:
        """Of how many walks of two edges every point is the start."""
        return torch.from_numpy(self.graph @ np.diff(self.graph.indptr).astype(np.int64)).long()

    @cached_property
    def longest(self) -> Int[Tensor, "N edges"]:
        """The other ends of the longest `EDGES` edges of every point, see `longest_edges`."""
        return longest_edges(self.points, self.graph, EDGES)

    def middles(self, centers: Int[Tensor, " B"]) -> Float[Tensor, "B edges d"]:
        """The middles of those edges in the centre's tangent plane, in its frame, ℓ."""
        ends = at(self.points, self.longest[centers])
        return (ends - self.points[centers, None]) @ self.frames[centers] / 2

    def __call__(
        self, centers: Int[Tensor, " B"], size: int
    ) -> tuple[Int[Tensor, "B K"], Int[Tensor, " B"]]:
        """The `size` nearest admissible points of each centre, itself first.

        Returns
        -------
        index : (B, size), padded by the centre itself where the ball holds fewer.
        count : (B,), how many are real.
        """
        level = next((kept for kept in self._kept if kept.size >= size), None)
        if level is None:
            level = _Level(size, len(self.points))
            self._kept.append(level)
        missing = centers[level.place[centers] < 0]
        if len(missing):
            for found in self._grown(missing, level.size):
                level.add(*found)
        place = level.place[centers]
        return level.index[place, :size].long(), level.count[place].long().clamp_max(size)

    def _grown(
        self, centers: Int[Tensor, " B"], size: int
    ) -> Iterator[tuple[Int[Tensor, " b"], Int[Tensor, "b K"], Int[Tensor, " b"]]]:
        """In turn some of the centres, their balls, and how many points these hold."""
        dim, codimension = self.frames.shape[2], self.points.shape[1] - self.frames.shape[2]
        curved = codimension and self._planes.ndim == 3  # for which nothing is compiled
        seconds = BY_MATRICES * size * len(self.points)
        kernel = None if curved else compiled.kernel("graph_balls", seconds)
        if kernel is None:
            number = self._walks[centers].cumsum(0) // WALKS_AT_ONCE
            for part in centers.split(number.unique_consecutive(return_counts=True)[1].tolist()):
                yield part, *self._walked(part, size)
            return
        wanted = BALL_SURPLUS * size
        bounds = wanted, ceil(wanted ** (1 / dim)), MAX_SLOPE, MIN_ALIGNMENT if codimension else 0.0
        index, count = kernel(*self._arrays, centers.numpy(), size, *bounds)
        yield centers, torch.from_numpy(index), torch.from_numpy(count)

    @compiled.standing_in()
    def _walked(
        self, centers: Int[Tensor, " B"], size: int
    ) -> tuple[Int[Tensor, "B K"], Int[Tensor, " B"]]:
        """The same by sparse matrices, for all codimensions, and where nothing is compiled."""
        local, others = self._reach(centers, size)
        center = at(centers, local)
        offset = at(self.points, others) - at(self.points, center)
        square = dot(offset, offset)
        square[others == center] = -1.0  # before all that coincide with it
        total = torch.bincount(local, minlength=len(centers))
        place = torch.arange(len(local)) - (total.cumsum(0) - total)[local]
        shape = len(centers), max([size, *total.tolist()])
        distance = square.new_full(shape, torch.inf).index_put((local, place), square)
        index = centers[:, None].repeat(1, shape[1]).index_put((local, place), others)
        order = distance.argsort(dim=1, stable=True)  # equal ones stay in the order of the points
        return index.gather(1, order[:, :size]), total.clamp_max(size)

    def _admissible(
        self, centers: Int[Tensor, " P"], others: Int[Tensor, " P"]
    ) -> Bool[Tensor, " P"]:
        good = admissible(self.points, self._planes, centers, others)
        if self.sides is not None:
            good &= dot(at(self.sides, centers), at(self.sides, others)) >= 0
        return good

    def _reach(
        self, centers: Int[Tensor, " B"], size: int
    ) -> tuple[Int[Tensor, " P"], Int[Tensor, " P"]]:
        """Pairs (row of `centers`, point) of the graph balls, sorted; they grow ring by ring until they are large.

        A round ball has about half as many rings as they have at most: what grows along a strip alone is none.
        """
        width, known, wanted = len(self.points), np.float32(2**20), BALL_SURPLUS * size
        active = np.arange(len(centers))  # rows that still grow: no others are looked at
        total = np.ones(len(centers), dtype=int)
        start = np.ones(len(centers), np.float32), centers.numpy(), np.arange(len(centers) + 1)
        frontier = recent = sparse.csr_array(start, shape=(len(centers), width))
        found = [(active, centers.numpy())]
        for _ in range(ceil(wanted ** (1 / self.frames.shape[-1]))):
            ring: Any = frontier @ self.graph + recent * known
            row = np.arange(len(active)).repeat(np.diff(ring.indptr))
            new = ring.data < known
            row, col = row[new], ring.indices[new].astype(np.int64)
            rows = torch.from_numpy(active[row])
            good = self._admissible(centers[rows], torch.from_numpy(col)).numpy()
            row, col = row[good], col[good]
            found.append((active[row], col))
            number = np.bincount(row, minlength=len(active))
            entries = np.ones(len(row), np.float32), col, np.append(0, number.cumsum())
            before, frontier = frontier, sparse.csr_array(entries, shape=(len(active), width))
            total += number
            grows = (total < wanted) & (number > 0)
            if not grows.any():
                break
            if not grows.all():
                active, total = active[grows], total[grows]
                before, frontier = before[grows], frontier[grows]
            # Neighbours are in this ring, the last, or the next.
            recent = sparse.csr_array(before + frontier)
        where = tuple(np.concatenate(ends) for ends in zip(*found, strict=True))
        balls = sparse.csr_array((np.ones(len(where[0]), np.int8), where), (len(centers), width))
        balls.sort_indices()
        pairs = sparse.coo_array(balls)
        return (
            torch.from_numpy(pairs.coords[0].astype(np.int64)),
            torch.from_numpy(pairs.coords[1].astype(np.int64)),
        )
