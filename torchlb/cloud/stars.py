"""Local stars, where a cloud has no surface of one sheet: triangles of each point by itself, each counted by a third.

A Delaunay triangle of the plane belongs to the stars of its three corners, and so counts once.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Int

from torchlb.cloud.cocone import Cloud
from torchlb.cloud.gaps import overlapping
from torchlb.cloud.voronoi import natural_neighbors, unrolled
from torchlb.geometry.complex import Faces, edges_of, pieces_of, spanning_pairs
from torchlb.geometry.thresholds import ROUGH

Pairs = tuple[Int[np.ndarray, " P"], Int[np.ndarray, " P"]]
"""Edges of the neighbour graph."""


def local_stars(cloud: Cloud, centers: Int[np.ndarray, " B"]) -> Faces:
    """Delaunay triangles around each centre in its tangent plane, among neighbours with similar normals.

    There is no triangle across a gap of half a turn, nor any wider than the reach.
    """
    near = torch.from_numpy(cloud.neighbors[centers])
    points, normals = torch.from_numpy(cloud.points), torch.from_numpy(cloud.normals)
    offset, normal = points[near[:, 1:]] - points[near[:, :1]], normals[near[:, :1]]
    valid = (normals[near[:, 1:]] * normal).sum(-1).abs() > ROUGH
    frame = torch.linalg.qr(normal.mT, mode="complete")[0][..., 1:]
    coords = unrolled(offset, frame)
    natural = natural_neighbors(coords, valid)
    angle = torch.atan2(coords[..., 1], coords[..., 0]).masked_fill(~natural, torch.inf)
    angle, order = angle.sort(dim=1)
    place, number = torch.arange(angle.shape[1]), natural.sum(1, keepdim=True)
    following = torch.where(place + 1 < number, place + 1, 0)
    turn = (angle.take_along_dim(following, 1) - angle) % (2 * torch.pi)
    use = (place < number) & (turn > 0) & (turn < torch.pi)
    ends = near[:, 1:].take_along_dim(order, 1)
    after = ends.take_along_dim(following, 1)
    found = torch.stack([near[:, :1].expand_as(ends)[use], ends[use], after[use]], 1)
    return cloud.small(found.numpy())


def at_gaps(faces: Faces, pairs: Pairs, count: int) -> Bool[np.ndarray, " N"]:
    """Points of pairs in different components, one without a closed fan of faces: sheets do not grow together."""
    i, j = pairs
    piece, outer = pieces_of(faces, count), edges_of(faces, count).outer
    across = (piece[i] != piece[j]) & (outer[i] | outer[j])
    result = np.zeros(count, dtype=bool)
    result[i[across]] = result[j[across]] = True
    return result


def stars_in_gaps(cloud: Cloud, faces: Faces, pairs: Pairs) -> Faces:
    """Stars of points in no face or at a gap between components, unless they overlap faces; then bridges."""
    count = len(cloud.points)
    centers = at_gaps(faces, pairs, count) & edges_of(faces, count).outer
    centers |= np.bincount(faces.ravel(), minlength=count) == 0
    stars = local_stars(cloud, np.flatnonzero(centers))
    around = faces[np.isin(faces, stars[:, 0]).any(1)]
    stars = stars[~overlapping(cloud, stars, around, corners=1)]
    return np.concatenate([stars, bridges(cloud, np.concatenate([faces, stars]), pairs)])


def bridges(cloud: Cloud, faces: Faces, pairs: Pairs) -> Faces:
    """Two triangles, one from either side, at the shortest pairs that connect the components still apart."""
    count = len(cloud.points)
    piece = pieces_of(faces, count)
    i, j = (end[piece[pairs[0]] != piece[pairs[1]]] for end in pairs)
    length = np.linalg.norm(cloud.points[i] - cloud.points[j], axis=1)
    order = np.argsort(length, kind="stable")
    number = order[spanning_pairs(piece[i[order]], piece[j[order]], count)]
    sides = (i[number], j[number]), (j[number], i[number])
    return np.concatenate([_beside(cloud, piece, *ends) for ends in sides])


def _beside(
    cloud: Cloud, piece: np.ndarray, here: Int[np.ndarray, " B"], there: Int[np.ndarray, " B"]
) -> Faces:
    """Triangles (here, there, k) with k the neighbour of `here` nearest to both, in its component if there is one."""
    near = cloud.neighbors[here, 1:]
    ends = cloud.points[here, None], cloud.points[there, None]
    cost = np.sum([np.linalg.norm(cloud.points[near] - end, axis=2) for end in ends], axis=0)
    cost = cost + np.where(piece[near] == piece[here, None], 0.0, cost.max(initial=0.0))
    cost[near == there[:, None]] = np.inf
    return np.stack([here, there, near[np.arange(len(near)), cost.argmin(1)]], 1)
