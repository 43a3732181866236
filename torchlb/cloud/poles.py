"""Poles of the Voronoi cells of a cloud, which tell its inside (`method.md`, section 12).

The Voronoi cell of a point is long across the surface. Of its vertices, the centres of Delaunay spheres through the
point, those farthest up and down the normal are its two *poles* (Amenta and Bern 1999), on different sides.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.linalg import cg
from torch import Tensor

from torchlb.cloud.cocone import Tetrahedra
from torchlb.cloud.frames import refined_normals
from torchlb.geometry.complex import edges_of, tree_sides
from torchlb.geometry.thresholds import FACTOR
from torchlb.geometry.vectors import Near, Points, at, dot, inner, lengths
from torchlb.linalg.precision import LOW, ROUNDING, STEPS, TINY

LONG = 1.4
"""Length of a Voronoi cell over its extent along the normal above which the normal is replaced."""
SHARP, RESIDUAL = 16.0, 0.01
"""Relations weigh exp(SHARP (cosine − 1)) in the vote on two sides, which is solved to this relative residual."""


@dataclass(frozen=True)
class Poles:
    """Rays from every point to the vertices of its Voronoi cell; beyond the convex hull these are far away.

    `ball` numbers the sphere around the end of each ray, of a tetrahedron, or of a hull triangle after these.
    """

    tetrahedra: Tetrahedra
    point: Int[Tensor, " R"]
    ball: Int[Tensor, " R"]
    ray: Float[Tensor, "R 3"]

    @classmethod
    def of(cls, tetrahedra: Tetrahedra) -> Poles:
        """Rays of all points, except to flat tetrahedra."""
        points, cells, hull = tetrahedra.points, tetrahedra.cells, tetrahedra.hull
        first = points.take(cells[:, 0], 0)
        u, v, w = (points.take(cells[:, k], 0) - first for k in (1, 2, 3))
        longest = reduce(np.maximum, map(lengths, (u, v, w)))
        solid = np.flatnonzero(np.abs(inner(u, np.cross(v, w))) > ROUNDING * longest**3)
        point = np.concatenate([cells[solid].ravel(), tetrahedra.triangles[hull].ravel()])
        ball = np.concatenate([solid.repeat(4), tetrahedra.sides[1][hull].repeat(3)])
        ray = tetrahedra.centers.take(ball, 0) - points.take(point, 0)
        return cls(tetrahedra, *(torch.from_numpy(x) for x in (point, ball, ray)))

    def farthest(self, value: Float[Tensor, " R"]) -> Int[Tensor, " N"]:
        """Index of the ray with the largest value at every point."""
        count = len(self.tetrahedra.points)
        most = value.new_full((count,), -torch.inf).scatter_reduce(0, self.point, value, "amax")
        rays = (value == at(most, self.point)).nonzero()[:, 0]
        last = torch.full((count,), len(value) - 1)
        return last.scatter_reduce(0, self.point[rays], rays, "amin")

    def sides(self, normals: Float[Tensor, "N 3"]) -> tuple[Float[np.ndarray, " S"], bool]:
        """(1 for spheres outside of the surface, −1 for those inside; whether it has two sides at all).

        The two poles of a point lie on different sides, the more surely the straighter they are opposed; two spheres
        that share a triangle lie on the same side, the more surely the deeper they intersect. The sides are those of a
        vote with the convex hull outside; or of a spanning tree of the surest relations if that contradicts far fewer,
        as on an open surface. On a one-sided surface either contradicts many.
        """
        rise = dot(self.ray, at(normals, self.point))
        up, down = self.farthest(rise), self.farthest(-rise)
        opposed = -_cosine(self.ray[up], self.ray[down]).numpy()
        one, two, sure = self._touching()
        ends = torch.stack([self.ball[up], self.ball[down]]).numpy()
        first = len(self.tetrahedra.cells)
        outside = np.arange(first + int(self.tetrahedra.hull.sum())) >= first
        cosine = np.concatenate([sure, opposed])
        i, j = np.concatenate([one, ends[0]]), np.concatenate([two, ends[1]])
        order = torch.from_numpy(cosine).argsort(descending=True, stable=True).numpy()
        order = order[i[order] != j[order]]
        i, j, against = i[order], j[order], order >= len(one)
        weight = np.exp(SHARP * (cosine[order] - 1))
        side = _vote(i, j, np.where(against, -weight, weight), outside)
        tree = np.where(tree_sides(i, j, against, len(outside)), 1.0, -1.0)
        wrong, by_tree = (float(weight @ (against ^ (x[i] != x[j]))) for x in (side, tree))
        if FACTOR * by_tree < wrong:  # a ratio of 8 and more on open surfaces, else 1.4
            side, wrong = tree, by_tree
        # a share of 0.13 and more on one-sided bands, else 0.04
        two_sided = wrong <= LOW * float(weight[against].sum())
        around = side[first:].mean()
        if abs(around) < 2 * (1 - LOW) - 1:  # an open surface faces up
            upward = normals[:, -1].numpy()
            around = ((side[ends[0]] - side[ends[1]]) * upward).sum()
        return side if around >= 0 else -side, two_sided

    def _touching(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pairs of circumscribed spheres that meet, and the cosine of the angle between their radii there.

        Spheres of two tetrahedra meet at a common triangle, those of the convex hull's triangles at a common edge.
        """
        every = self.tetrahedra
        apex, hull = every.points[every.triangles[:, 0]], every.hull
        radii = [torch.from_numpy(end - apex) for end in every.ends()]
        near, far = every.ends(hull)
        away, number = torch.from_numpy(far - near), every.sides[1][hull]
        edges = edges_of(every.triangles[hull], len(every.points))
        left, right = (half // 3 for half in edges.twins)
        one, two = (
            np.concatenate([side, number[face]])
            for side, face in zip(every.sides, (left, right), strict=True)
        )
        return one, two, torch.cat([_cosine(*radii), _cosine(away[left], away[right])]).numpy()


def _vote(
    i: np.ndarray, j: np.ndarray, weight: np.ndarray, outside: Bool[np.ndarray, " S"]
) -> Float[np.ndarray, " S"]:
    """Signs of the minimiser x of Σ |w| (x_i − sign(w) x_j)² over all pairs, x = 1 outside; in float32."""
    count, free = len(outside), np.flatnonzero(~outside)
    ends = i.astype(np.int32), j.astype(np.int32)
    one: Any = sparse.coo_array((weight.astype(np.float32), ends), shape=(count, count))
    total = np.bincount(np.concatenate(ends), np.tile(np.abs(weight), 2), count)[free]
    around = np.maximum(total.astype(np.float32), np.finfo(np.float32).tiny)
    rows = sparse.csr_array(one + one.T)[free]
    matrix = sparse.csr_array(sparse.diags_array(around) - rows[:, free])
    scale = sparse.diags_array(1 / around)
    x, _ = cg(matrix, rows @ outside, rtol=RESIDUAL, maxiter=STEPS, M=scale)
    side = np.ones(count)
    side[free] = np.where(x > 0, 1.0, -1.0)
    return side


def _cosine(a: Float[Tensor, "B 3"], b: Float[Tensor, "B 3"]) -> Float[Tensor, " B"]:
    return dot(a, b) / (dot(a, a) * dot(b, b)).sqrt().clamp_min(TINY)


def corrected_normals(points: Points, normals: Points, candidates: Near, poles: Poles) -> Points:
    """Normals replaced by the longest ray where the Voronoi cell is short along them, and refined around that.

    Where points lie on rings or other curves far apart, the planes through the nearest of them are those of the curves,
    which shows neither in their extent nor in their fit.
    """
    length = dot(poles.ray, poles.ray).sqrt()
    first = poles.farthest(length)
    longest, length = poles.ray[first] / length[first, None], length[first]

    def corrected(normals: Tensor, where: Tensor) -> Tensor:
        seen = at(where, poles.point).nonzero()[:, 0]
        point = poles.point[seen]
        along = dot(poles.ray[seen], at(normals, point)).abs()
        most = torch.full_like(length, torch.inf)
        most.scatter_reduce_(0, point, along, "amax", include_self=False)
        return torch.where((most * LONG < length)[:, None], longest, normals)

    where = torch.ones(len(points), dtype=torch.bool)
    for _ in range(3):
        before, normals = normals, corrected(normals, where)
        where = (normals != before).any(1)[candidates].any(1)
        normals = refined_normals(points, normals, candidates, where.nonzero()[:, 0])
    return corrected(normals, where)
