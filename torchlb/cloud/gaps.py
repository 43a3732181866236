"""Gaps of a triangulated cloud: filled from their boundary, closed where they are small, and points in no triangle.

A true boundary stays: no triangle is taken whose circumradius exceeds the reach of its corners. Where no sheet passes
there are local stars: triangles of each point by itself, each counted by a third. A Delaunay triangle of the plane
belongs to the stars of its three corners, and so counts once.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial.distance import pdist

from torchlb.cloud.cocone import REACH, Cloud, conormals
from torchlb.cloud.manifold import beside_of, boundary_loops, ears_of
from torchlb.cloud.voronoi import natural_neighbors, unrolled
from torchlb.geometry.complex import Edges, Faces, edges_of, pieces_of, spanning_pairs
from torchlb.geometry.thresholds import CREASE, NEAREST, ROUGH, SLIGHT
from torchlb.geometry.vectors import Mask, inner, largest, smallest, unit
from torchlb.linalg.precision import LOW

Pairs = tuple[Int[np.ndarray, " P"], Int[np.ndarray, " P"]]
"""Edges of the neighbour graph."""


def filled(cloud: Cloud, faces: Faces, pool: Faces, *, oriented: bool, strict: bool) -> Faces:
    """Faces extended by triangles that neither fold nor overlap; the very array if there are none.

    Triangles of the pool, or ears between two boundary edges, are added best first, in rounds, until none fits; no ear
    has all its corners on a declared boundary. If `oriented`, faces and normals agree on the outward side, and
    triangles have to agree with them. If not `strict`, triangles may tilt from the normals by nearly a right angle, and
    overlap faces with which they share no edge.
    """
    count, every = len(cloud.points), np.arange(len(cloud.points))
    outer = edges_of(faces, count).outer  # only there can anything be added
    near = outer[faces].any(1)
    away, around = faces[~near], faces[near]
    while True:
        edges = edges_of(around, count)
        half = edges.boundary
        half = half[np.all([outer[end[half]] for end in edges.ends], axis=0)]
        free = outer & ~np.isin(every, around) | np.isin(every, [end[half] for end in edges.ends])
        pool = pool[free[pool].all(1)]
        point, beside = beside_of(edges, half)
        ears = np.insert(beside, 1, point, axis=1)
        candidates = np.concatenate([pool, ears[~cloud.boundary[ears].all(1)]])
        new = _proposals(cloud, edges, half, candidates, oriented, ROUGH if strict else LOW)
        new = new[~overlapping(cloud, new, around)] if strict else new
        if len(new) == 0:
            same = len(away) + len(around) == len(faces)
            return faces if same else np.concatenate([away, around])
        best = np.full(count, len(new))
        np.minimum.at(best, new.ravel(), np.arange(len(new)).repeat(3))
        chosen = (best[new] == np.arange(len(new))[:, None]).all(1)
        around = np.concatenate([around, new[chosen]])


def _proposals(
    cloud: Cloud, edges: Edges, half: np.ndarray, faces: Faces, oriented: bool, least: float
) -> Faces:
    """Faces that fit to boundary half-edges without a fold or third face, aligned to the normals; best first."""
    faces = np.unique(np.sort(faces, axis=1), axis=0)
    tail, head = np.roll(faces, -1, 1), np.roll(faces, -2, 1)
    edge, uses = edges.find(tail, head)
    ok = (uses <= 1).all(1) & (uses == 1).any(1)
    faces, tail, head, edge, uses = faces[ok], tail[ok], head[ok], edge[ok], uses[ok]
    of, starts, stops = edges.of[half], edges.ends[0][half], edges.ends[1][half]
    first = np.full(len(edges.keys), -1)
    first[of] = starts
    against = np.where(uses == 1, np.where(first[edge] == head, 1, -1), 0)  # 1: runs the other way
    plus, minus = (against >= 0).all(1), (against <= 0).all(1)
    radius, normal = cloud.circles(faces)
    cosine = inner(normal[:, None], cloud.normals.take(faces, 0))
    if oriented:
        alignment = np.where(plus, smallest(cosine), np.where(minus, -largest(cosine), -1.0))
    else:
        alignment = smallest(np.abs(cosine))
    conormal = np.zeros((len(edges.keys), 3))
    conormal[of] = conormals(cloud.points, starts, stops, edges.faces.ravel()[half])
    folds = inner(conormal.take(edge, 0), conormals(cloud.points, tail, head, faces)) > CREASE
    ok = alignment > least
    ok &= radius <= cloud.limits(faces)
    ok &= ~((uses == 1) & folds).any(1)
    faces = np.where(plus.reshape(-1, 1), faces, faces[:, ::-1])[ok]
    cost = radius[ok] / alignment[ok] ** 2
    return faces[np.argsort(cost, kind="stable")]


def overlapping(cloud: Cloud, new: Faces, faces: Faces, corners: int = 3) -> Bool[np.ndarray, " T"]:
    """Which new triangles overlap a face at one of their first `corners` corners, seen along the normal there."""
    rows, places = np.nonzero(np.isin(faces, new[:, :corners]))
    theirs = _wedges(cloud, faces[rows], places)
    result = np.zeros(len(new), dtype=bool)
    for k in range(corners):
        ours = _wedges(cloud, new, np.full(len(new), k))
        i, j = _matches(new[:, k], faces[rows, places], len(cloud.points))
        result[i[_meet(ours[i], theirs[j]) | _meet(theirs[j], ours[i])]] = True
    return result


def _matches(wanted: Int[np.ndarray, " W"], found: Int[np.ndarray, " F"], count: int) -> Pairs:
    """All (i, j) with wanted[i] = found[j], two lists of numbers below `count`."""
    order, number = np.argsort(found, kind="stable"), np.bincount(found, minlength=count)
    uses, start = number[wanted], np.cumsum(number) - number
    i = np.arange(len(wanted)).repeat(uses)
    first = start[wanted] - (np.cumsum(uses) - uses)
    return i, order[np.arange(len(i)) + first[i]]


def _wedges(cloud: Cloud, faces: Faces, corner: np.ndarray) -> Float[np.ndarray, "T 4 3"]:
    """(two sides of a face at a corner, their bisector, the normal of the turn): unit, the first three tangential."""
    rows = np.arange(len(faces))
    apex = faces[rows, corner]
    normal = cloud.normals[apex]
    sides = []
    for turn in (1, 2):
        side = cloud.points[faces[rows, (corner + turn) % 3]] - cloud.points[apex]
        sides.append(unit(side - inner(side, normal)[:, None] * normal))
    turn = np.sign(inner(np.cross(*sides), normal))[:, None] * normal
    return np.stack([*sides, unit(sides[0] + sides[1]), turn], 1)


def _meet(one: Float[np.ndarray, "P 4 3"], two: Float[np.ndarray, "P 4 3"]) -> np.ndarray:
    """Whether a side or the bisector of wedge one lies inside wedge two."""
    rays, (first, second, _, turn) = one[:, :3], two[:, :, None].swapaxes(0, 1)
    after = inner(np.cross(first, rays), turn) > SLIGHT
    before = inner(np.cross(rays, second), turn) > SLIGHT
    return np.any(after & before, axis=1)


def closed(cloud: Cloud, faces: Faces, kept: Mask) -> tuple[Faces, int]:
    """(faces with narrow boundary loops closed by ear clipping; number of these loops).

    The reach of a point is at least that of the triangles at it. A loop stays open if two neighbouring points of it are
    on the declared boundary, or one is in `kept`.
    """
    count = len(cloud.points)
    known, new = set(edges_of(faces, count).keys.tolist()), [faces]

    def cost(turn: Faces) -> Float[np.ndarray, " T"]:
        radius, normal = cloud.circles(turn)
        alignment = np.abs(inner(normal[:, None], cloud.normals[turn])).mean(1)
        return radius / np.maximum(alignment, SLIGHT) ** 2

    reach = cloud.reach.copy()
    np.maximum.at(reach, faces, cloud.limits(faces)[:, None])
    for loop in boundary_loops(faces, count):
        wide = REACH * reach[loop].mean()
        places = cloud.points[loop]
        declared = cloud.boundary[loop] & cloud.boundary[np.roll(loop, 1)]
        if declared.any() or kept[loop].any() or np.ptp(places, axis=0).max() > wide:
            continue
        ears = ears_of(loop, known, count, cost) if pdist(places).max() <= wide else None
        new += [] if ears is None else [np.array(ears)]
    return np.concatenate(new) if len(new) > 1 else faces, len(new) - 1


def with_left_points(cloud: Cloud, faces: Faces) -> Faces:
    """Faces with each point in no face inserted into the one that it stands over, if there is one."""
    count = len(cloud.points)
    while True:
        left = np.flatnonzero(~np.isin(np.arange(count), faces))
        near = cloud.neighbors[left, 1:NEAREST]
        row, corner = _matches(near.ravel(), faces.ravel(), count)
        points, under = left.repeat(near.shape[1])[row], corner // 3
        triangle = faces[under]
        radius, normal = cloud.circles(triangle)
        corners = cloud.points[triangle] - cloud.points[points, None]
        height = np.abs(inner(corners[:, 0], normal))
        shares = [inner(np.cross(corners[:, k - 2], corners[:, k - 1]), normal) for k in range(3)]
        aligned = np.abs(inner(normal, cloud.normals[points])) > ROUGH
        over = np.flatnonzero((np.min(shares, axis=0) > 0) & aligned & (height < radius))
        over = over[np.argsort(height[over], kind="stable")]
        over = over[np.unique(points[over], return_index=True)[1]]
        over = over[np.unique(under[over], return_index=True)[1]]
        if len(over) == 0:
            return faces
        point, triangle = points[over], triangle[over]
        parts = [np.stack([triangle[:, k - 1], triangle[:, k], point], 1) for k in range(3)]
        faces = np.concatenate([np.delete(faces, under[over], 0), *parts])


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


def at_gaps(faces: Faces, pairs: Pairs, count: int) -> Mask:
    """Points of pairs in different components, one without a closed fan of faces: sheets do not grow together."""
    i, j = pairs
    piece, outer = pieces_of(faces, count), edges_of(faces, count).outer
    across = (piece[i] != piece[j]) & (outer[i] | outer[j])
    return np.isin(np.arange(count), [i[across], j[across]])


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
