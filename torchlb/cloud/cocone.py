"""Delaunay tetrahedra of a cloud, and the triangles among them that may form its surface (`method.md`, section 12).

A triangle belongs to the surface if one of the two tetrahedra beside it is outside and the other inside; or else if its
dual edge, between their circumcentres, reaches into the *cocone* at each corner, which is the complement of the double
cone around the normal (Amenta, Choi, Dey and Leekha 2000).
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import mul
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from torchlb.cloud.manifold import face_vectors
from torchlb.geometry.complex import Faces, circumcenters, delaunay, edges_of
from torchlb.geometry.thresholds import CREASE, LEVEL, WIDER
from torchlb.geometry.vectors import Mask, Vectors, inner, largest, lengths, smallest, unit
from torchlb.linalg.precision import LOW, NEGLIGIBLE, ROUNDING, SINGLE

COCONE = np.sqrt((1 - LEVEL) / 2)
"""Sine of the largest angle, 22.5°, between the tangent plane and a direction in the cocone."""
REACH = 2.0
"""Reach of a point over the distance to its eighth neighbour; and width of a loop that is closed, over the reach."""
RAISED = 1e-2
"""Share of the random displacements before a triangulation that is kept along the normals: points on a circle then have
one layer of triangles, not several that mix."""


@dataclass(frozen=True)
class Cloud:
    """Points from which triangles are made, with their unit normals and nearest points, each point itself first.

    `reach` is the largest circumradius, ℓ, that a triangle at each point may have, twice that of one whose corners are
    all on the boundary.
    """

    points: Vectors
    normals: Vectors
    neighbors: Int[np.ndarray, "N K"]
    reach: Float[np.ndarray, " N"]
    boundary: Mask

    def circles(self, faces: Faces) -> tuple[Float[np.ndarray, " F"], Float[np.ndarray, "F 3"]]:
        """Circumradii, ℓ, and unit normals of triangles."""
        a, b, c = (self.points.take(corner, 0) for corner in faces.T)
        sides = b - a, c - b, a - c
        one, two, three = map(lengths, sides)
        normal = np.cross(sides[0], -sides[2])
        longest = reduce(np.maximum, (one, two, three))
        twice = np.maximum(lengths(normal), ROUNDING * longest**2)
        return one * two * three / (2 * twice), normal / twice[:, None]

    def limits(self, faces: Faces) -> Float[np.ndarray, " F"]:
        """Largest circumradii of triangles, ℓ: the least reach of the corners, or their mean if these are level.

        All neighbours of a point on the dense side of a jump in density lie on that side. Level triangles across it
        have the largest reach of their corners.
        """
        reach = self.reach.take(faces)
        widest, level = largest(reach), self.alignment(self.circles(faces)[1], faces) > LEVEL
        across = widest > WIDER * smallest(self.around.take(faces))
        limit = np.where(level, np.where(across, widest, reach.mean(1)), smallest(reach))
        return limit / np.where(smallest(self.boundary.take(faces)), 2, 1)

    def alignment(self, normal: Float[np.ndarray, "F 3"], faces: Faces) -> Float[np.ndarray, " F"]:
        """Least |cosine| between the normal of each triangle and those of its corners."""
        return smallest(np.abs(inner(normal[:, None], self.normals.take(faces, 0))))

    @cached_property
    def around(self) -> Float[np.ndarray, " N"]:
        """Reach of each point by all its neighbours, ℓ."""
        far = lengths(self.points[self.neighbors[:, -1]] - self.points)
        return np.maximum(self.reach, REACH * far)

    def small(self, faces: Faces) -> Faces:
        """Triangles within the reach of their corners."""
        return faces[self.circles(faces)[0] <= self.limits(faces)]


@dataclass(frozen=True)
class Tetrahedra:
    """Delaunay tetrahedra of a cloud, each triangle once, and which triangles are on the convex hull.

    `sides` index the circumcentres on the two sides of each triangle; those beyond the hull are points far away.
    """

    points: Vectors
    cells: Int[np.ndarray, "T 4"]
    centers: Float[np.ndarray, "_ 3"]
    triangles: Faces
    sides: tuple[Int[np.ndarray, " F"], Int[np.ndarray, " F"]]
    hull: Bool[np.ndarray, " F"]

    @classmethod
    def of(cls, points: Vectors, normals: Vectors, spacing: Float[np.ndarray, " N"]) -> Tetrahedra:
        """Triangulate a cloud in no plane, with unit normals; `spacing` is the distance to the nearest point, ℓ.

        Points are perturbed first, mostly along the surface: cospherical points form one cell with as many corners, for
        which Qhull takes a time quadratic in their number (7,000: 15 s, perturbed 0.3 s).
        """
        random = np.random.default_rng(0).standard_normal(points.shape)
        random -= (1 - RAISED) * inner(random, normals)[:, None] * normals
        moved = points + SINGLE * spacing[:, None] * random
        found = delaunay(moved)
        cells, beyond = (x.astype(np.int64) for x in (found.simplices, found.neighbors))
        del found
        total, volume = circumcenters(moved, cells)
        most = np.ptp(moved, axis=0).max() / NEGLIGIBLE  # bounds the centres of nearly flat cells
        with np.errstate(all="ignore"):
            centers = np.nan_to_num(total / volume[:, None]).clip(-most, most)
        centers += moved.take(cells[:, 0], 0)
        number, first = np.nonzero(np.arange(len(cells)) > beyond.T)
        others = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
        triangles = cells[first[:, None], others[number]]
        second, apex = beyond[first, number], cells[first, number]
        hull = second < 0
        a, b, c = moved[triangles[hull]].swapaxes(0, 1)
        normal, inside = unit(np.cross(b - a, c - a)), a - moved[apex[hull]]
        away = np.sign(inner(inside, normal))[:, None] * normal
        second[hull] = len(cells) + np.arange(hull.sum())
        far = centers[first[hull]] + np.ptp(points, axis=0).max() / NEGLIGIBLE * away
        centers = np.concatenate([centers, far])
        return cls(points, cells, centers, triangles, (first, second), hull)

    def ends(self, triangles: Any = slice(None)) -> tuple[np.ndarray, np.ndarray]:
        """Circumcentres on the two sides of triangles, (F, 3) each, ℓ."""
        one, two = (self.centers[side[triangles]] for side in self.sides)
        return one, two

    def candidates(self, cloud: Cloud, side: Float[np.ndarray, " S"]) -> Candidates:
        """Candidate triangles of the surface; `side` is 1 for spheres outside of it, −1 for those inside."""
        radius, normal = cloud.circles(self.triangles)
        kept = radius <= cloud.limits(self.triangles)
        triangles, radius, normal = self.triangles[kept], radius[kept], normal[kept]
        ends = self.ends(kept)
        alignment = cloud.alignment(normal, triangles)
        tangent = alignment > LOW  # walls between two boundaries are not
        for corner in triangles.T:
            left = np.flatnonzero(tangent)
            apex, axis = (x.take(corner[left], 0) for x in (cloud.points, cloud.normals))
            offsets = [end.take(left, 0) - apex for end in ends]
            one, two = (inner(unit(x), axis) for x in offsets)
            tangent[left] = (np.abs(one) <= COCONE) | (np.abs(two) <= COCONE) | (one * two < 0)
        one, two = (side[number[kept]] for number in self.sides)
        parting = one != two
        out = (ends[0] - ends[1])[parting] * one[parting, None]
        vector = face_vectors(cloud.points, triangles[parting])
        vector *= np.sign(inner(out, vector))[:, None]
        outward = np.zeros_like(cloud.points)
        np.add.at(outward, triangles[parting], vector[:, None])
        cost = radius / np.maximum(alignment, LOW) ** 2
        found = np.flatnonzero(tangent | parting)
        found = found[np.argsort(cost[found], kind="stable")]
        return Candidates(triangles, triangles[found], tangent[found], parting[found], outward)


@dataclass(frozen=True)
class Candidates:
    """Candidate triangles of a surface, best first: those that pass the cocone test, or part outside from inside.

    `small` are all triangles within the reach of their corners, in no order; `outward` is the sum of the outward area
    vectors of the parting ones among these at each point, ℓ².
    """

    small: Faces
    triangles: Faces
    tangent: Bool[np.ndarray, " F"]
    parting: Bool[np.ndarray, " F"]
    outward: Vectors


def conormals(
    points: Float[np.ndarray, "N n"], tail: np.ndarray, head: np.ndarray, tip: np.ndarray
) -> np.ndarray:
    """Unit vectors normal to the edges tail–head, towards the points `tip`."""
    start = points.take(tail, 0)
    along, out = unit(points.take(head, 0) - start), points.take(tip, 0) - start
    return unit(out - inner(out, along)[..., None] * along)


def best_manifold(points: Float[np.ndarray, "N n"], faces: Faces) -> Faces:
    """Greedy choice of triangles, best first, such that no edge has three faces or two that fold back.

    Only triangles at an edge where not all can stay are decided one by one.
    """
    edges = edges_of(faces, len(points))
    tail, head, of = (part.reshape(-1, 3) for part in (*edges.ends, edges.of))
    conormal = conormals(points, tail, head, faces)
    one, two = (conormal.reshape(-1, points.shape[1]).take(twin, 0) for twin in edges.twins)
    contested = edges.uses > 2
    contested[edges.of[edges.twins[0][inner(one, two) > CREASE]]] = True
    rows, taken = np.flatnonzero(contested[of].any(1)), np.ones(len(faces), dtype=bool)
    beside: dict[int, list[list[float]]] = defaultdict(list)  # conormals of taken faces, by edge
    parts = (part[rows].tolist() for part in (conormal, of, contested[of]))
    for face, *sides in zip(rows.tolist(), *parts, strict=True):
        mine = [(out, edge) for out, edge, doubtful in zip(*sides, strict=True) if doubtful]
        full = any(len(beside[edge]) > 1 for _, edge in mine)
        pairs = [(out, other) for out, edge in mine for other in beside[edge]]
        taken[face] = not full and all(sum(map(mul, *pair)) <= CREASE for pair in pairs)
        for out, edge in mine if taken[face] else ():
            beside[edge].append(out)
    return faces[taken]
