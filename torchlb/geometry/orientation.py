"""Which way is out: normals made consistent, so that the two sides of a thin shape are told apart.

Across an edge a surface is taken for an arc: the normal at one end is the mirror image of that at the other in the
plane that bisects the edge. So the sign is carried round a crease, where the normals turn, and straight through a thin
sheet, whose two sides face away from each other.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor

from torchlb.geometry.admission import MIN_ALIGNMENT, mutually_admissible
from torchlb.geometry.vectors import at, dot

SMOOTH = 0.97
"""An edge whose ends' normals mirror each other better than this (within 14°) and that lies flat is trusted first."""
FLAT = 0.35
"""Largest share of an edge's length that may be height over the tangent plane at either end of such an edge."""


def nearest_pairs(candidates: Int[Tensor, "N K"]) -> tuple[Int[Tensor, " P"], Int[Tensor, " P"]]:
    """Pairs (i, j), i < j, of points one of which is among the nearest of the other, each pair once.

    >>> [end.tolist() for end in nearest_pairs(torch.tensor([[0, 1], [1, 0], [2, 1]]))]
    [[0, 1], [1, 2]]
    """
    num_points, size = candidates.shape
    i = torch.arange(num_points).repeat_interleave(size - 1)
    j = candidates[:, 1:].reshape(-1)
    code = (torch.minimum(i, j) * num_points + torch.maximum(i, j)).numpy()
    code.sort()  # in a quarter of the time of `torch.unique`
    code = torch.from_numpy(code[np.flatnonzero(np.diff(code, prepend=-1))])
    low, high = code // num_points, code % num_points
    return low[low != high], high[low != high]


def _across(
    points: Float[Tensor, "N n"],
    normals: Float[Tensor, "N n"],
    i: Int[Tensor, " P"],
    j: Int[Tensor, " P"],
) -> tuple[Float[Tensor, " P"], Float[Tensor, " P"]]:
    """(cosine between n_j and the mirror image of n_i, larger slope of the edge over the planes at its two ends)."""
    edge, ends = at(points, j) - at(points, i), [at(normals, end) for end in (i, j)]
    edge = edge / edge.norm(dim=1, keepdim=True)
    rise_i, rise_j = (dot(edge, end) for end in ends)
    cosine = dot(*ends) - 2 * rise_i * rise_j
    return cosine, torch.maximum(rise_i.abs(), rise_j.abs())


def orient_normals(
    points: Float[Tensor, "N n"],
    normals: Float[Tensor, "N n"],
    candidates: Int[Tensor, "N K"],
) -> Float[Tensor, "N n"]:
    """Signs of the normals made consistent along a spanning tree of the nearest points, the surest edges first.

    Every component is then turned so that the normal at its extreme point (largest last coordinate) points outward.
    On a surface with one side only there is a seam.
    """
    num_points, pairs = len(points), nearest_pairs(candidates)
    cosine, slope = _across(points, normals, *pairs)
    smooth = (cosine.abs() >= SMOOTH) & (slope <= FLAT)
    cost = 1.0001 - cosine.abs() + ~smooth  # positive: zeros would be no edges
    ends = tuple(end.numpy() for end in pairs)
    weighted = sparse.csr_array((cost.numpy(), ends), shape=(num_points, num_points))
    tree = csgraph.minimum_spanning_tree(weighted)
    _, component = csgraph.connected_components(tree, directed=False)
    # The extreme point of each component, which a lexicographic order puts last.
    order = np.lexsort((points[:, -1].numpy(), component))
    roots = torch.from_numpy(order[np.append(np.diff(component[order]) > 0, True)])
    parent = _parents(tree, roots)
    away = _across(points, normals, parent, torch.arange(num_points))[0] < 0
    sign = torch.where(away, -1.0, 1.0)
    sign[roots] = 1.0
    while not torch.equal(parent, parent[parent]):  # products along the paths, by doubling
        sign, parent = sign * sign[parent], parent[parent]
    sign = torch.where(normals[parent, -1] < 0, -sign, sign)
    return normals * sign[:, None]


def _parents(tree: sparse.csr_array, roots: Int[Tensor, " R"]) -> Int[Tensor, " N"]:
    """Parent of every point in the forest hung up at `roots`, which are their own."""
    num_points = len(tree.indptr) - 1
    edges = sparse.coo_array(tree)
    above = np.concatenate([edges.coords[0], np.full(len(roots), num_points)])
    below = np.concatenate([edges.coords[1], roots.numpy()])
    shape = (num_points + 1, num_points + 1)
    hung = sparse.csr_array((np.ones(len(above)), (above, below)), shape=shape)
    _, found = csgraph.breadth_first_order(hung, num_points, directed=False)
    parent = torch.from_numpy(found[:num_points].astype(np.int64))
    parent[roots] = roots
    return parent


def thin_sides(
    points: Float[Tensor, "N n"], oriented: Float[Tensor, "N n"], candidates: Int[Tensor, "N K"]
) -> Float[Tensor, "N n"]:
    """The oriented normals in and next to thin places, zero elsewhere.

    Points whose sides have a negative product lie on different sides. It is thin where a near point stands above or
    below the tangent plane and yet has nearly the same one. Elsewhere a shape may have one side only.
    """
    i, j, good = mutually_admissible(points, oriented, candidates)
    refused = ~good.view(-1)
    both = torch.stack([i[refused], j[refused]])
    alike = dot(at(oriented, both[0]), at(oriented, both[1])).abs() >= MIN_ALIGNMENT
    thin = torch.zeros(len(points), dtype=torch.bool)
    thin[both[:, alike]] = True
    beside = thin[i] | thin[j]
    thin[torch.cat([i[beside], j[beside]])] = True
    return oriented * thin[:, None]


def consistently_wound(faces: Int[Tensor, "F v"]) -> bool:
    """Whether neighbouring triangles (or segments) agree on which way is out: no directed edge is used twice.

    >>> [consistently_wound(torch.tensor([[0, 1, 2], other])) for other in ([2, 1, 3], [1, 2, 3])]
    [True, False]
    """
    if faces.shape[1] == 2:
        return all(len(torch.unique(end)) == len(end) for end in faces.T)
    edges = torch.cat([faces[:, a] * (faces.max() + 1) + faces[:, a - 2] for a in range(3)])
    return len(torch.unique(edges)) == len(edges)
