"""Fans, patches, winding and boundary loops of the triangles of a cloud."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int

from torchlb.geometry.complex import Edges, Faces, components, edges_of, tree_sides
from torchlb.geometry.vectors import Vectors, inner, unit


def with_single_fans(faces: Faces, count: int) -> Faces:
    """Prune the faces until those around each point form one fan (umbrella): the closed one, or else the largest."""
    looked_at = np.ones(count, dtype=bool)  # points; later only those that lost a face
    while len(around := np.flatnonzero(looked_at.take(faces).any(1))):
        part = faces[around]
        one, two = edges_of(part, count).twins
        corner = part.ravel()
        near, far = (two - two % 3 + (two + turn) % 3 for turn in (1, 2))
        # the corners of both faces at the same end of their edge
        joined = np.concatenate([one - one % 3 + (one + turn) % 3 for turn in (1, 2)])
        near, far = np.tile(near, 2), np.tile(far, 2)
        beside = np.where(corner[near] == corner[joined], near, far)
        fan = components(joined, beside, len(corner))
        size = np.bincount(fan)
        closed = np.bincount(fan[joined], minlength=len(size)) == size
        point = np.zeros_like(size)
        point[fan] = corner
        order = np.lexsort((size, closed, point))
        best = ~looked_at[point]
        best[order[np.append(np.diff(point[order]) > 0, True)]] = True
        lost = ~best[fan].reshape(-1, 3).all(1)
        if not lost.any():
            break
        looked_at[:] = False
        looked_at[part[lost]] = True
        faces = np.delete(faces, around[lost], 0)
    return faces


def face_vectors(points: Vectors, faces: Faces) -> Float[np.ndarray, "F 3"]:
    """Area vectors of the faces: normals as long as the areas, ℓ²."""
    a, b, c = (points.take(corner, 0) for corner in faces.T)
    return np.cross(b - a, c - a) / 2


def wound_alike(points: Vectors, faces: Faces) -> tuple[Faces, Bool[np.ndarray, " F"]]:
    """(faces wound consistently, carried along the flattest edges; which faces lie at a seam).

    At a seam neighbours still disagree: the surface is one-sided, or a wrong triangle makes it seem so.
    """
    edges = edges_of(faces, len(points))
    one, two = edges.twins
    against, normals = edges.against, unit(face_vectors(points, faces))
    i, j, size = one // 3, two // 3, len(faces)
    bend = 1.001 - inner(normals.take(i, 0), normals.take(j, 0)) * np.where(against, -1, 1)
    order = np.argsort(bend, kind="stable")
    flip = tree_sides(i[order], j[order], against[order], size)
    seam = against ^ flip[i] ^ flip[j]
    at_seam = np.isin(np.arange(size), [i[seam], j[seam]])
    return np.where(flip[:, None], faces[:, ::-1], faces), at_seam


def facing_out(points: Vectors, faces: Faces, outward: Vectors) -> Faces:
    """Faces turned so that every patch, connected by edges, as a whole faces the outward vectors at its corners."""
    if len(faces) == 0:
        return faces
    one, two = edges_of(faces, len(points)).twins
    patch, vectors = components(one // 3, two // 3, len(faces)), face_vectors(points, faces)
    vote = inner(outward.take(faces, 0).sum(1), vectors)
    turned = (np.bincount(patch, vote) < 0)[patch]
    return np.where(turned[:, None], faces[:, ::-1], faces)


def beside_of(
    edges: Edges, half: Int[np.ndarray, " G"]
) -> tuple[Int[np.ndarray, " B"], Int[np.ndarray, "B 2"]]:
    """(points where two of these half-edges meet, and no more; the other ends of the two)."""
    ends = np.stack([end[half] for end in edges.ends])
    order = np.argsort(ends, axis=None, kind="stable")
    here, there = ends.ravel()[order], ends[::-1].ravel()[order]
    point, first, uses = np.unique(here, return_index=True, return_counts=True)
    first = first[uses == 2]
    return point[uses == 2], np.stack([there[first], there[first + 1]], 1)


def in_turn(links: Int[np.ndarray, "N 2"]) -> list[Int[np.ndarray, " M"]]:
    """Points of every chain in order, from an end if there is one; of a closed one the first comes again at the end.

    `links` are the two points beside each, −1 for none.
    """
    beside, left, chains = links.tolist(), [True] * len(links), []
    for start in np.argsort((links >= 0).all(1), kind="stable").tolist():  # ends first
        chain, here = [], start
        while here >= 0 and left[here]:
            left[here] = False
            chain.append(here)
            one, two = beside[here]
            here = one if one >= 0 and left[one] else two
        if len(chain) > 2 and start in beside[chain[-1]]:
            chain.append(start)
        if chain:
            chains.append(np.array(chain))
    return chains


def boundary_loops(faces: Faces, count: int) -> list[Int[np.ndarray, " M"]]:
    """Points of every boundary loop in order, of faces with single fans."""
    edges = edges_of(faces, count)
    point, beside = beside_of(edges, edges.boundary)
    return [point[loop[:-1]] for loop in in_turn(np.searchsorted(point, beside))]


def ears_of(
    loop: Int[np.ndarray, " M"], known: set[int], count: int, cost: Callable[[Faces], np.ndarray]
) -> list[list[int]] | None:
    """Triangles that close a loop, the ear of least cost first, and None if an edge would be used a third time.

    `known` are the keys of the edges in use, low · count + high, to which those of the triangles are added.
    """
    ears, own = [], set()
    while len(loop) > 3:
        turn = np.stack([np.roll(loop, 1), loop, np.roll(loop, -1)], 1)
        a, c = turn[:, 0], turn[:, 2]
        keys = (np.minimum(a, c) * count + np.maximum(a, c)).tolist()
        costs = cost(turn)
        costs[[key in known or key in own for key in keys]] = np.inf
        best = int(costs.argmin())
        if not np.isfinite(costs[best]):
            return None
        ears.append(turn[best].tolist())
        own.add(keys[best])
        loop = np.delete(loop, best)
    known |= own
    return [*ears, loop.tolist()]
