"""The poles of a point, by which a cloud tells where its inside is (`method.md`, section 12).

The Voronoi cell of a point is long across the surface. Its corners, centres of the Delaunay spheres through the point,
that are farthest up and down the normal are its two *poles* (Amenta and Bern), and lie on two sides of the surface.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, reduce
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
from torchlb.geometry.vectors import at, dot, inner, lengths
from torchlb.linalg.precision import LOW, ROUNDING, STEPS, TINY

LONG = 1.4
"""A Voronoi cell that reaches so many times as far as along the normal has another normal."""
SHARP, RESIDUAL = 16.0, 0.01
"""In a vote on two sides relations weigh exp(SHARP (cosine − 1)); it is solved to this relative residual."""


@dataclass(frozen=True)
class Poles:
    """The corners of the Voronoi cells.

    Attributes
    ----------
    tetrahedra
        Their centres are the corners; beyond the convex hull, the far ends of its triangles are.
    point, ball
        (R,), a point, and the number of a sphere through it: of a tetrahedron, or of a triangle after them.
    ray
        (R, 3), ℓ, from the point to the centre.
    """

    tetrahedra: Tetrahedra
    point: Int[Tensor, " R"]
    ball: Int[Tensor, " R"]
    ray: Float[Tensor, "R 3"]

    @classmethod
    def of(cls, tetrahedra: Tetrahedra) -> Poles:
        """Those of all points, but for flat tetrahedra."""
        points, cells, hull = tetrahedra.points, tetrahedra.cells, tetrahedra.hull
        first = points.take(cells[:, 0], 0)
        u, v, w = (points.take(cells[:, k], 0) - first for k in (1, 2, 3))
        longest = reduce(np.maximum, map(lengths, (u, v, w)))
        solid = np.flatnonzero(np.abs(inner(u, np.cross(v, w))) > ROUNDING * longest**3)
        outer = tetrahedra.triangles[hull]
        point = np.concatenate([cells[solid].ravel(), outer.ravel()])
        ball = np.concatenate([solid.repeat(4), tetrahedra.sides[1][hull].repeat(3)])
        far = tetrahedra.ends(hull)[1]
        center = [tetrahedra.centers[solid].repeat(4, 0), far.repeat(3, 0)]
        ray = np.concatenate(center) - points.take(point, 0)
        return cls(tetrahedra, *(torch.from_numpy(x) for x in (point, ball, ray)))

    def farthest(self, value: Float[Tensor, " R"]) -> Int[Tensor, " N"]:
        """Of every point the number of the ray with the largest value."""
        count = len(self.tetrahedra.points)
        most = value.new_full((count,), -torch.inf).scatter_reduce(0, self.point, value, "amax")
        rays = (value == at(most, self.point)).nonzero()[:, 0]
        last = torch.full((count,), len(value) - 1)
        return last.scatter_reduce(0, self.point[rays], rays, "amin")

    @cached_property
    def _longest(self) -> tuple[Float[Tensor, "N 3"], Float[Tensor, " N"]]:
        """The longest ray of every point, and its length."""
        length = dot(self.ray, self.ray).sqrt()
        first = self.farthest(length)
        return self.ray[first], length[first]

    def corrected(
        self, normals: Float[Tensor, "N 3"], where: Bool[Tensor, " N"] | None = None
    ) -> Float[Tensor, "N 3"]:
        """The normals, but for those along which the Voronoi cell is short: there the direction where it is longest.

        Only those of the points `where` are looked at, if that is given.
        """
        seen = slice(None) if where is None else at(where, self.point).nonzero()[:, 0]
        point = self.point[seen]
        along = dot(self.ray[seen], at(normals, point)).abs()
        most = along.new_full((len(normals),), torch.inf).scatter_reduce(
            0, point, along, "amax", include_self=False
        )
        longest, length = self._longest
        short = most * LONG < length
        return torch.where(short[:, None], longest / length[:, None], normals)

    def sides(self, normals: Float[Tensor, "N 3"]) -> tuple[Float[np.ndarray, " S"], bool]:
        """(1 for the spheres outside of the surface, −1 for those inside; whether it has two sides at all).

        The two poles of a point lie on two sides, the surer the straighter they are opposed; two spheres that share a
        triangle lie on one side, the surer the deeper they intersect. Spheres have their sides by a tree of the surest
        of these, if that contradicts them far less, as on an open surface, or by all with the convex hull outside. On
        a band with one side that contradicts much, too.
        """
        rise = dot(self.ray, at(normals, self.point))
        up, down = self.farthest(rise), self.farthest(-rise)
        opposed = -_cosine(self.ray[up], self.ray[down]).numpy()
        one, two, sure = self._touching()
        ends = torch.stack([self.ball[up], self.ball[down]]).numpy()
        i, j = np.concatenate([one, ends[0]]), np.concatenate([two, ends[1]])
        first = len(self.tetrahedra.cells)
        outside = np.arange(first + int(self.tetrahedra.hull.sum())) >= first
        relations = _Relations.of(
            i, j, np.concatenate([sure, opposed]), np.arange(len(i)) >= len(one), outside
        )
        side, tree = relations.vote(), relations.tree()
        wrong, by_tree = relations.contradicted(side), relations.contradicted(tree)
        if FACTOR * by_tree < wrong:  # 8 times and more on open surfaces, else 1.4
            side, wrong = tree, by_tree
        # 0.13 and more on bands with one side, else 0.04
        two_sided = wrong <= LOW * float(relations.weight[relations.against].sum())
        around = side[first:].mean()
        if abs(around) < 2 * (1 - LOW) - 1:  # an open surface faces up
            upward = normals[:, -1].numpy()
            around = ((side[ends[0]] - side[ends[1]]) * upward).sum()
        return side if around >= 0 else -side, two_sided

    def _touching(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Spheres that share a triangle, or an edge of the convex hull; and the cosine of their radii there."""
        tetrahedra = self.tetrahedra
        apex, outer = tetrahedra.points[tetrahedra.triangles[:, 0]], tetrahedra.hull
        radii = [torch.from_numpy(end - apex) for end in tetrahedra.ends()]
        near, far = tetrahedra.ends(outer)
        away = torch.from_numpy(far - near)
        left, right = (
            half // 3
            for half in edges_of(tetrahedra.triangles[outer], len(tetrahedra.points)).twins
        )
        number = tetrahedra.sides[1][outer]
        return (
            np.concatenate([tetrahedra.sides[0], number[left]]),
            np.concatenate([tetrahedra.sides[1], number[right]]),
            torch.cat([_cosine(*radii), _cosine(away[left], away[right])]).numpy(),
        )


@dataclass(frozen=True)
class _Relations:
    """Pairs (i, j) of spheres that lie on one side of a surface, or on two, the surest first.

    Attributes
    ----------
    i, j, against, weight
        (P,), the spheres, whether on two sides, how sure that is.
    outside
        (S,), which spheres are outside if the surface is closed.
    """

    i: Int[np.ndarray, " P"]
    j: Int[np.ndarray, " P"]
    against: Bool[np.ndarray, " P"]
    weight: Float[np.ndarray, " P"]
    outside: Bool[np.ndarray, " S"]

    @classmethod
    def of(
        cls,
        i: Int[np.ndarray, " R"],
        j: Int[np.ndarray, " R"],
        cosine: Float[np.ndarray, " R"],
        against: Bool[np.ndarray, " R"],
        outside: Bool[np.ndarray, " S"],
    ) -> _Relations:
        """Without those of a sphere to itself."""
        order = torch.from_numpy(cosine).argsort(descending=True, stable=True).numpy()
        order = order[i[order] != j[order]]
        weight = np.exp(SHARP * (cosine[order] - 1))
        return cls(i[order], j[order], against[order], weight, outside)

    def tree(self) -> Float[np.ndarray, " S"]:
        """Sides, 1 or −1, by the surest pairs that close no circle."""
        return np.where(tree_sides(self.i, self.j, self.against, len(self.outside)), 1.0, -1.0)

    def vote(self) -> Float[np.ndarray, " S"]:
        """Sides, 1 or −1: the signs of x, 1 outside, where Σ w (x_i ∓ x_j)² over all pairs is least; in float32."""
        count, free = len(self.outside), np.flatnonzero(~self.outside)
        signed = np.where(self.against, -self.weight, self.weight).astype(np.float32)
        ends = self.i.astype(np.int32), self.j.astype(np.int32)
        one: Any = sparse.coo_array((signed, ends), shape=(count, count))
        total = np.bincount(np.concatenate(ends), np.tile(self.weight, 2), count)
        around = total.astype(np.float32)
        rows = sparse.csr_array(one + one.T)[free]
        matrix = sparse.csr_array(sparse.diags_array(around[free]) - rows[:, free])
        scale = sparse.diags_array(1 / np.maximum(around[free], np.finfo(np.float32).tiny))
        x, _ = cg(matrix, rows @ self.outside, rtol=RESIDUAL, maxiter=STEPS, M=scale)
        side = np.ones(count)
        side[free] = np.where(x > 0, 1.0, -1.0)
        return side

    def contradicted(self, side: Float[np.ndarray, " S"]) -> float:
        """The weight of all pairs that are not as they should be."""
        return float(self.weight @ (self.against ^ (side[self.i] != side[self.j])))


def _cosine(a: Float[Tensor, "B 3"], b: Float[Tensor, "B 3"]) -> Float[Tensor, " B"]:
    return dot(a, b) / (dot(a, a) * dot(b, b)).sqrt().clamp_min(TINY)


def corrected_normals(
    points: Float[Tensor, "N 3"],
    normals: Float[Tensor, "N 3"],
    candidates: Int[Tensor, "N K"],
    poles: Poles,
    rounds: int = 3,
) -> Float[Tensor, "N 3"]:
    """The normals, refined again around those that the Voronoi cells contradict, which are replaced.

    A cell is long across the surface. Where points lie on rings or other curves far apart, the planes through the
    nearest of them are those of the curves, and neither their size nor their fit tells.
    """
    where = None
    for _ in range(rounds):
        before, normals = normals, poles.corrected(normals, where)
        where = (normals != before).any(1)[candidates].any(1)
        normals = refined_normals(points, normals, candidates, where.nonzero()[:, 0])
    return poles.corrected(normals, where)
