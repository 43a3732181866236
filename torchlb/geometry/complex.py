"""Which triangles meet where: edges, fans, patches, boundary loops, and which way round triangles are wound.

Half-edge 3f + k is the side of face f opposite its corner k; it runs from corner k + 1 to corner k + 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Int
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor

from torchlb import compiled

Faces = Int[np.ndarray, "_ 3"]
BY_GRAPH, BY_TREE, BY_KEYS = 1e-7, 4e-7, 2e-7
"""Seconds a pair by a graph, and by its spanning tree; a triangle to find its edges."""


@dataclass(frozen=True)
class Edges:
    """The edges of triangles on `count` points.

    Attributes
    ----------
    keys : (E,), low · count + high of the two ends, ascending.
    of : (3F,), number of the edge that each half-edge lies on.
    uses : (E,), how many faces meet there.
    order : (3F,), the half-edges by the number of their edge.
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
    def rim(self) -> Int[np.ndarray, " G"]:
        """Half-edges of edges that have one face."""
        return np.flatnonzero(self.uses[self.of] == 1)

    @cached_property
    def twins(self) -> tuple[Int[np.ndarray, " T"], Int[np.ndarray, " T"]]:
        """The two half-edges of every edge that has two faces."""
        first = (np.cumsum(self.uses) - self.uses)[self.uses == 2]
        return self.order[first], self.order[first + 1]

    @cached_property
    def outer(self) -> Bool[np.ndarray, " N"]:
        """Which points lie on the rim or in no face."""
        result = np.ones(self.count, dtype=bool)
        result[self.faces.ravel()] = False
        for end in self.ends:
            result[end[self.rim]] = True
        return result

    def find(
        self, tail: np.ndarray, head: np.ndarray
    ) -> tuple[Int[np.ndarray, "*batch"], Int[np.ndarray, "*batch"]]:
        """(number of the edge between two points, how many faces it has; 0 if there is no such edge)."""
        key = np.minimum(tail, head) * self.count + np.maximum(tail, head)
        place = np.searchsorted(self.keys, key)
        place[place == len(self.keys)] = 0
        there = self.keys[place] == key if len(self.keys) else np.zeros(key.shape, dtype=bool)
        return place, np.where(there, self.uses[place] if len(self.uses) else 0, 0)


def _ascending(
    key: Int[np.ndarray, " K"], bound: int
) -> tuple[Int[np.ndarray, " K"], Int[np.ndarray, " K"]]:
    """The stable order of keys below a bound, and the keys in it.

    >>> _ascending(np.array([5, 3, 5, 0]), 6)
    (array([3, 1, 0, 2]), array([0, 3, 5, 5]))
    """
    if bound * len(key) < 2**63:
        # With the place as one number, that is sorted in a sixth of the time.
        both = key * len(key) + np.arange(len(key))
        both.sort()
        ascending = both // max(len(key), 1)
        return both - ascending * len(key), ascending
    order = key.argsort(kind="stable")
    return order, key[order]


def edges_of(faces: Faces, count: int) -> Edges:
    """The edges of triangles.

    >>> edges_of(np.array([[0, 1, 2], [1, 3, 2]]), 4).uses.tolist()
    [1, 1, 2, 1, 1]
    """
    found = compiled.kernel("edges", BY_KEYS * len(faces)) or _by_keys
    return Edges(faces, count, *found(np.require(faces, np.int64, ["C", "W"]), count))


@compiled.standing_in()
def _by_keys(
    faces: Faces, count: int
) -> tuple[
    Int[np.ndarray, " E"], Int[np.ndarray, " H"], Int[np.ndarray, " E"], Int[np.ndarray, " H"]
]:
    tail, head = np.roll(faces, -1, 1).ravel(), np.roll(faces, -2, 1).ravel()
    key = np.minimum(tail, head) * count + np.maximum(tail, head)
    order, ascending = _ascending(key, count**2)
    first = np.flatnonzero(np.diff(ascending, prepend=-1))
    uses = np.diff(first, append=len(key))
    of = np.empty_like(order)
    of[order] = np.arange(len(first)).repeat(uses)
    return ascending[first], of, uses, order


def components(i: np.ndarray, j: np.ndarray, count: int) -> Int[np.ndarray, " count"]:
    """Number of the connected component of each of `count` nodes joined by the pairs (i, j); that of node 0 is 0."""
    kernel = compiled.kernel("components", BY_GRAPH * len(i))
    if kernel is None:
        return _by_graph(i, j, count)
    return kernel(*_in_turn(i, j), np.zeros(len(i), dtype=bool), count)[0]


@compiled.standing_in()
def _by_graph(i: np.ndarray, j: np.ndarray, count: int) -> Int[np.ndarray, " count"]:
    graph = sparse.coo_array((np.ones(len(i), dtype=np.int8), (i, j)), shape=(count, count))
    return csgraph.connected_components(graph, directed=False)[1].astype(np.int64)


def _in_turn(*ends: np.ndarray) -> tuple[Int[np.ndarray, " P"], ...]:
    """As kernels take them."""
    return tuple(np.require(end, np.int64, ["C", "W"]) for end in ends)


def spanning_pairs(i: np.ndarray, j: np.ndarray, count: int) -> Int[np.ndarray, " T"]:
    """Numbers of the pairs (i, j), best first, that join `count` nodes as far as all do, without a circle.

    >>> spanning_pairs(np.array([0, 0, 1, 2]), np.array([1, 1, 2, 0]), 4).tolist()
    [0, 2]
    """
    low, high = np.minimum(i, j), np.maximum(i, j)
    _, first = np.unique(low * count + high, return_index=True)
    ranks = sparse.csr_array((first + 1.0, (low[first], high[first])), shape=(count, count))
    return csgraph.minimum_spanning_tree(ranks).data.astype(np.int64) - 1


def two_orientations(
    i: np.ndarray, j: np.ndarray, against: Bool[np.ndarray, " P"], count: int
) -> tuple[Int[np.ndarray, " F"], Int[np.ndarray, " F"]]:
    """Component of each face as it is and turned round, where faces i and j agree, or are wound against each other.

    An orientable component falls into its two orientations; one that has one side only stays in one piece.
    """
    turned, plain = np.where(against, j + count, j), np.where(against, j, j + count)
    both = components(np.concatenate([i, i + count]), np.concatenate([turned, plain]), 2 * count)
    own, other = both.reshape(2, count)
    return own, other


def tree_sides(
    i: np.ndarray, j: np.ndarray, against: Bool[np.ndarray, " P"], count: int
) -> Bool[np.ndarray, " count"]:
    """Which of `count` nodes are on the second side, by the pairs (i, j), best first, that close no circle.

    The first node of each component is on the first.

    >>> against = np.array([True, False, False])
    >>> tree_sides(np.array([0, 1, 2]), np.array([1, 2, 0]), against, 3).tolist()
    [False, True, True]
    """
    kernel = compiled.kernel("components", BY_TREE * len(i))
    if kernel is None:
        return _by_tree(i, j, against, count)
    return kernel(*_in_turn(i, j), np.ascontiguousarray(against), count)[1]


@compiled.standing_in()
def _by_tree(
    i: np.ndarray, j: np.ndarray, against: Bool[np.ndarray, " P"], count: int
) -> Bool[np.ndarray, " count"]:
    chosen = spanning_pairs(i, j, count)
    own, other = two_orientations(i[chosen], j[chosen], against[chosen], count)
    return own > other


def pieces_of(faces: Faces, count: int) -> Int[np.ndarray, " N"]:
    """Number of the piece of each point: points that hang together by triangles."""
    i, j = faces[:, [0, 1, 1, 2]].reshape(-1, 2).T
    return components(i, j, count)


def consistently_wound(faces: Int[Tensor, "F v"]) -> bool:
    """Whether neighbouring triangles (or segments) agree on which way is out: no directed edge is used twice.

    >>> [consistently_wound(torch.tensor([[0, 1, 2], other])) for other in ([2, 1, 3], [1, 2, 3])]
    [True, False]
    """
    if faces.shape[1] == 2:
        return all(len(torch.unique(end)) == len(end) for end in faces.T)
    edges = torch.cat([faces[:, a] * (faces.max() + 1) + faces[:, a - 2] for a in range(3)])
    return len(torch.unique(edges)) == len(edges)
