"""Delaunay simplices, edges, connected components and orientations of a simplicial complex.

Half-edge 3f + k is the side of face f opposite its corner k; it runs from corner k + 1 to corner k + 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import Delaunay
from torch import Tensor

from torchlb.geometry.vectors import Coords, Mask, Vectors, inner

Faces = Int[np.ndarray, "_ 3"]


def delaunay(points: Coords) -> Delaunay:
    """Delaunay simplices by Qhull, of centred points of size about one, since its tolerances are lengths."""
    centered = points - points.mean(0)
    return Delaunay(np.ldexp(centered, -np.frexp(np.abs(centered).max())[1]))


def circumcenters(
    points: Vectors, cells: Int[np.ndarray, "T 4"]
) -> tuple[Float[np.ndarray, "T 3"], Float[np.ndarray, " T"]]:
    """(c, v) of tetrahedra: the circumcentre is the first corner + c/v, and v six times the signed volume.

    >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    >>> [x.tolist() for x in circumcenters(corners, np.array([[0, 1, 2, 3]]))]
    [[[0.5, 0.5, 0.5]], [1.0]]
    """
    origin = points.take(cells[:, 0], 0)
    u, v, w = (points.take(cells[:, k], 0) - origin for k in (1, 2, 3))
    crosses = np.cross(v, w), np.cross(w, u), np.cross(u, v)
    parts = zip((u, v, w), crosses, strict=True)
    total = sum(inner(x, x)[:, None] / 2 * cross for x, cross in parts)
    return np.asarray(total), inner(u, crosses[0])


@dataclass(frozen=True)
class Edges:
    """Edges of triangles on `count` points, by their keys low · count + high, ascending.

    `of` numbers the edge of each half-edge, `uses` counts the faces at each edge, and `order` sorts the half-edges by
    the number of their edge.
    """

    faces: Faces
    count: int
    keys: Int[np.ndarray, " E"]
    of: Int[np.ndarray, " three_F"]
    uses: Int[np.ndarray, " E"]
    order: Int[np.ndarray, " three_F"]

    @cached_property
    def ends(self) -> tuple[Int[np.ndarray, " three_F"], Int[np.ndarray, " three_F"]]:
        """First and last point of every half-edge."""
        return np.roll(self.faces, -1, 1).ravel(), np.roll(self.faces, -2, 1).ravel()

    @cached_property
    def boundary(self) -> Int[np.ndarray, " G"]:
        """Half-edges whose edge has one face."""
        return np.flatnonzero(self.uses[self.of] == 1)

    @cached_property
    def twins(self) -> tuple[Int[np.ndarray, " T"], Int[np.ndarray, " T"]]:
        """The two half-edges of each edge with two faces."""
        first = (np.cumsum(self.uses) - self.uses)[self.uses == 2]
        return self.order[first], self.order[first + 1]

    @cached_property
    def against(self) -> Bool[np.ndarray, " T"]:
        """Whether the two faces at such an edge run along it in one direction: they are wound against each other."""
        one, two = self.twins
        return self.ends[0][one] == self.ends[0][two]

    @cached_property
    def outer(self) -> Mask:
        """Points on the boundary or in no face."""
        every, rim = np.arange(self.count), [end[self.boundary] for end in self.ends]
        return np.isin(every, rim) | ~np.isin(every, self.faces)

    def find(
        self, tail: np.ndarray, head: np.ndarray
    ) -> tuple[Int[np.ndarray, "*batch"], Int[np.ndarray, "*batch"]]:
        """(number of the edge between two points; number of its faces, 0 if there is no such edge)."""
        key = np.minimum(tail, head) * self.count + np.maximum(tail, head)
        place = np.searchsorted(self.keys, key)
        there = np.append(self.keys, -1)[place] == key
        return place * there, np.append(self.uses, 0)[place] * there


def _order(key: Int[np.ndarray, " K"], count: int) -> Int[np.ndarray, " K"]:
    """Stable order of keys below `count`, by the counting sort that transposes a sparse matrix."""
    size, narrow = len(key), key.astype(np.int32)  # SciPy would scan wide indices to narrow them
    ends = np.arange(size + 1, dtype=np.int32)
    rows = sparse.csr_array((np.ones(size, np.int8), narrow, ends), (size, count))
    return rows.tocsc().indices.astype(np.int64)


def edges_of(faces: Faces, count: int) -> Edges:
    """The edges of triangles."""
    ends = np.roll(faces, -1, 1).ravel(), np.roll(faces, -2, 1).ravel()
    low, high = np.minimum(*ends), np.maximum(*ends)
    order = _order(high, count)
    order = order[_order(low[order], count)]
    ascending = (low * count + high)[order]
    first = np.flatnonzero(np.diff(ascending, prepend=-1))
    uses = np.diff(first, append=len(order))
    of = np.empty_like(order)
    of[order] = np.arange(len(first)).repeat(uses)
    return Edges(faces, count, ascending[first], of, uses, order)


def components(i: np.ndarray, j: np.ndarray, count: int) -> Int[np.ndarray, " count"]:
    """Label of the connected component of each of `count` nodes, joined by the pairs (i, j); that of node 0 is 0."""
    graph = sparse.csr_array((np.ones(len(i)), (i, j)), (count, count))
    return csgraph.connected_components(graph, directed=False)[1].astype(np.int64)


def spanning_pairs(i: np.ndarray, j: np.ndarray, count: int) -> Int[np.ndarray, " T"]:
    """Numbers of the pairs (i, j), sorted best first, in the minimum spanning forest of `count` nodes."""
    order = _order(i, count)  # repeated pairs stay separate entries
    ends = np.append(0, np.bincount(i, minlength=count).cumsum()).astype(np.int32)
    rows = order + 1.0, j.astype(np.int32)[order], ends
    ranks = sparse.csr_array(rows, (count, count))
    return csgraph.minimum_spanning_tree(ranks).data.astype(np.int64) - 1


def two_orientations(
    i: np.ndarray, j: np.ndarray, against: Bool[np.ndarray, " P"], count: int
) -> tuple[Int[np.ndarray, " F"], Int[np.ndarray, " F"]]:
    """Components of the orientation double cover: labels of (face, +) and of (face, −).

    `against` marks the pairs (i, j) of faces that are wound against each other. The cover of an orientable component
    has two components, that of a one-sided one is connected.
    """
    turned, plain = np.where(against, j + count, j), np.where(against, j, j + count)
    both = components(np.concatenate([i, i + count]), np.concatenate([turned, plain]), 2 * count)
    own, other = both.reshape(2, count)
    return own, other


def tree_sides(
    i: np.ndarray, j: np.ndarray, against: Bool[np.ndarray, " P"], count: int
) -> Bool[np.ndarray, " count"]:
    """Side of each node along the spanning forest of the pairs, best first; False for the first of a component."""
    chosen = spanning_pairs(i, j, count)
    own, other = two_orientations(i[chosen], j[chosen], against[chosen], count)
    return own > other


def pieces_of(faces: Faces, count: int) -> Int[np.ndarray, " N"]:
    """Label of the component of each point, in which triangles join their corners."""
    i, j = faces[:, [0, 1, 1, 2]].reshape(-1, 2).T
    return components(i, j, count)


def seams(faces: Int[Tensor, "F v"], count: int) -> Bool[Tensor, " N"]:
    """Mask of the points where triangles (or segments) are wound against each other, or three and more meet.

    >>> seams(torch.tensor([[0, 1, 2], [0, 1, 3]]), 4).tolist()
    [True, True, False, False]
    """
    if faces.shape[1] == 2:
        return (torch.stack([torch.bincount(end, minlength=count) for end in faces.T]) > 1).any(0)
    tail, head = faces.flatten(), faces.roll(-1, 1).flatten()
    _, number, uses = torch.unique(tail * count + head, return_inverse=True, return_counts=True)
    again = uses[number] > 1  # a directed edge
    return torch.isin(torch.arange(count), torch.stack([tail[again], head[again]]))


def consistently_wound(faces: Int[Tensor, "F v"]) -> bool:
    """Whether neighbouring triangles (or segments) are consistently oriented."""
    return not bool(seams(faces, int(faces.max()) + 1).any())
