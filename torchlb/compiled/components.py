"""Connected components, compiled: sets of nodes grow together, pair by pair, and each knows which side it is on."""

from __future__ import annotations

from typing import Any, no_type_check

import numpy as np
from numba import njit


@njit
@no_type_check
def _root(node: int, parent: np.ndarray, turned: np.ndarray) -> Any:
    """The root above a node, and whether it is on the other side; the way to it is halved as it is gone."""
    other = False
    while parent[node] != node:
        above = parent[node]
        turned[node] ^= turned[above]
        parent[node] = parent[above]
        other ^= turned[node]
        node = parent[node]
    return node, other


@njit(
    "Tuple((int64[::1], boolean[::1]))(int64[::1], int64[::1], boolean[::1], int64)",
    cache=True,
    nogil=True,
)
@no_type_check
def components(i: np.ndarray, j: np.ndarray, against: np.ndarray, count: int) -> Any:
    """Number of the component of each of `count` nodes, and whether it is on the other side than the first one there.

    Parameters
    ----------
    i, j : (P,), pairs of nodes.
    against : (P,), whether they lie on two sides, which counts for those that close no circle with those before.
    """
    parent, turned = np.arange(count), np.zeros(count, np.bool_)
    for pair in range(len(i)):
        a, one = _root(i[pair], parent, turned)
        b, two = _root(j[pair], parent, turned)
        if a != b:
            parent[max(a, b)] = min(a, b)
            turned[max(a, b)] = one ^ two ^ against[pair]
    number, second, found = np.empty(count, np.int64), np.empty(count, np.bool_), 0
    for node in range(count):
        root, second[node] = _root(node, parent, turned)
        if root == node:
            number[node] = found
            found += 1
        else:
            number[node] = number[root]
    return number, second
