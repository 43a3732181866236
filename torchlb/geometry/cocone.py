"""Triangles for a cloud (`method.md`, section 12): normals, Delaunay triangles near the surface, the best of them.

A triangle of the Delaunay tetrahedra belongs to the surface where its dual edge, between the circumcentres of the two
tetrahedra beside it, comes close to the tangent planes of its corners: leaves their double cone, the *cocone*.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import Delaunay
from torch import Tensor
from torch.nn.functional import normalize

from torchlb.fits.polynomials import monomials
from torchlb.fits.weights import window
from torchlb.geometry.frames import complete_frames
from torchlb.geometry.manifold import Faces, edges_of
from torchlb.geometry.neighbors import admissible

COCONE = np.sin(np.pi / 8)
"""Sine of the half-angle between a tangent plane and the double cone that a dual edge has to leave."""
FOLD = 0.5
"""Cosine of the least angle between two triangles at an edge."""
TILTED = 0.1
"""Least cosine between the normal of a triangle and those of its corners: walls between two rims have none."""
RIDGE = 1e-13
TINY = np.finfo(float).tiny


@dataclass(frozen=True)
class Cloud:
    """What triangles are made from.

    Attributes
    ----------
    points : (N, 3), ℓ.
    normals : (N, 3), unit.
    neighbors : (N, K), nearest points, itself first.
    reach : (N,), ℓ: the largest circumradius of a triangle at each point.
    """

    points: Float[np.ndarray, "N 3"]
    normals: Float[np.ndarray, "N 3"]
    neighbors: Int[np.ndarray, "N K"]
    reach: Float[np.ndarray, " N"]

    def circles(self, faces: Faces) -> tuple[Float[np.ndarray, " F"], Float[np.ndarray, "F 3"]]:
        """Circumradii, ℓ, and unit normals of triangles."""
        corners = self.points[faces]
        sides = corners[:, [1, 2, 0]] - corners
        normal = np.cross(sides[:, 0], -sides[:, 2])
        twice = np.maximum(np.linalg.norm(normal, axis=1), TINY)
        lengths = np.linalg.norm(sides, axis=2).prod(1)
        return lengths / (2 * twice), normal / twice[:, None]

    def small(self, faces: Faces) -> Faces:
        """Those within the reach of all their corners."""
        return faces[self.circles(faces)[0] <= self.reach[faces].min(1)]


def refined_normals(
    points: Float[Tensor, "N 3"],
    frames: Float[Tensor, "N 3 2"],
    candidates: Int[Tensor, "N K"],
    rounds: int = 2,
) -> Float[Tensor, "N 3"]:
    """Unit normals from quadratics through the admissible candidates, error O(h²); not oriented.

    The quadratics need not go through the point itself, which lessens what noise does to the slope.
    """
    offset = points[candidates] - points[:, None]
    distance = offset.norm(dim=-1)
    centers = torch.arange(len(points)).repeat_interleave(candidates.shape[1])
    normals = torch.linalg.cross(*frames.unbind(-1))
    unit = torch.eye(6, dtype=points.dtype)
    for _ in range(rounds):
        good = admissible(points, frames, centers, candidates.flatten(), normals)
        good = good.view(candidates.shape)
        good[:, 0] = True
        reach = (distance * good).amax(1, keepdim=True).clamp_min(TINY)
        weight = window((distance / reach).clamp_max(1.1)) * good
        terms = monomials(offset @ frames / reach[..., None], 2)
        terms = torch.cat([torch.ones_like(terms[..., :1]), terms], -1) * weight[..., None]
        heights = weight * (offset * normals[:, None]).sum(-1) / reach
        square = terms.mT @ terms
        square += RIDGE * square.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None] * unit
        slope = torch.linalg.solve(square, terms.mT @ heights[..., None])[:, 1:3]
        found = normalize(normals - (frames @ slope)[..., 0])
        sound = (good.sum(1) > 7) & (slope[..., 0].norm(dim=1) < 1)
        normals = torch.where(sound[:, None], found, normals)
        frames = complete_frames(normals)
    return normals


def delaunay_triangles(cloud: Cloud) -> tuple[Faces, Faces]:
    """(triangles of the surface, best first; all small triangles) of the Delaunay tetrahedra."""
    points = cloud.points
    delaunay = Delaunay(points)
    cells, beyond = delaunay.simplices.astype(np.int64), delaunay.neighbors
    centers = _circumcenters(points, cells)
    faces, first, second, apex = [], [], [], []
    for k in range(4):  # each triangle once
        own = np.flatnonzero(beyond[:, k] < np.arange(len(cells)))
        faces.append(np.delete(cells[own], k, 1))
        first.append(own)
        second.append(beyond[own, k])
        apex.append(cells[own, k])
    triangles, here, there = np.concatenate(faces), np.concatenate(first), np.concatenate(second)
    radius, normal = cloud.circles(triangles)
    kept = radius <= cloud.reach[triangles].min(1)
    triangles, here, there, radius = triangles[kept], here[kept], there[kept], radius[kept]
    normal, tip = normal[kept], points[np.concatenate(apex)[kept]]
    away = np.sign(((points[triangles[:, 0]] - tip) * normal).sum(1))[:, None] * normal
    far = 1e6 * np.ptp(points, axis=0).max() * away
    ends = centers[here], np.where((there < 0)[:, None], centers[here] + far, centers[there])
    near = np.ones(len(triangles), dtype=bool)
    for corner in triangles.T:
        near &= _leaves_cone(points[corner], cloud.normals[corner], ends)
    alignment = np.abs((normal[:, None] * cloud.normals[triangles]).sum(-1)).min(1)
    surface = np.flatnonzero(near & (alignment > TILTED))
    cost = radius / np.maximum(alignment, TILTED) ** 2
    return triangles[surface[np.argsort(cost[surface], kind="stable")]], triangles


def _circumcenters(points: np.ndarray, cells: Int[np.ndarray, "T 4"]) -> Float[np.ndarray, "T 3"]:
    origin = points[cells[:, 0]]
    u, v, w = (points[cells[:, k]] - origin for k in (1, 2, 3))
    crosses = np.cross(v, w), np.cross(w, u), np.cross(u, v)
    halves = ((x * x).sum(1, keepdims=True) / 2 for x in (u, v, w))
    determinant = (u * crosses[0]).sum(1, keepdims=True)
    total = sum(h * c for h, c in zip(halves, crosses, strict=True))
    with np.errstate(all="ignore"):
        center = total / determinant
    most = 1e6 * np.ptp(points, axis=0).max()
    return origin + np.clip(np.nan_to_num(center, posinf=most, neginf=-most), -most, most)


def _leaves_cone(
    apex: np.ndarray, normal: np.ndarray, ends: tuple[np.ndarray, np.ndarray]
) -> Bool[np.ndarray, " F"]:
    """Whether a part of the segment between `ends` lies outside of the double cone around the normal."""
    rise = []
    for end in ends:
        offset = end - apex
        length = np.maximum(np.linalg.norm(offset, axis=1), TINY)
        rise.append((offset * normal).sum(1) / length)
    one, two = rise
    return (np.abs(one) <= COCONE) | (np.abs(two) <= COCONE) | (one * two < 0)


def wings(
    points: Float[np.ndarray, "N 3"],
    tail: Int[np.ndarray, "*batch"],
    head: Int[np.ndarray, "*batch"],
    tip: Int[np.ndarray, "*batch"],
) -> Float[np.ndarray, "*batch 3"]:
    """Unit vectors at a right angle from the edges tail–head to the points `tip`."""
    along, out = points[head] - points[tail], points[tip] - points[tail]
    along = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), TINY)
    out = out - (out * along).sum(-1, keepdims=True) * along
    return out / np.maximum(np.linalg.norm(out, axis=-1, keepdims=True), TINY)


def best_manifold(points: Float[np.ndarray, "N 3"], faces: Faces) -> Faces:
    """Of triangles, best first, each that leaves no edge with three faces or two that fold back.

    Taken in rounds, those first that are the best at all their edges; the result is that of taking them one by one.
    """
    edges = edges_of(faces, len(points))
    of = edges.of.reshape(-1, 3)
    tail, head = (end.reshape(-1, 3) for end in edges.ends)
    wing = wings(points, tail, head, faces)
    uses, first = np.zeros(len(edges.keys), dtype=int), np.zeros((len(edges.keys), 3))
    left, taken = np.arange(len(faces)), []
    while len(left):
        best = np.full(len(uses), len(faces))
        np.minimum.at(best, of[left].ravel(), left.repeat(3))
        now = (best[of[left]] == left[:, None]).all(1)
        chosen, left = left[now], left[~now]
        taken.append(chosen)
        uses[of[chosen].ravel()] += 1
        first[of[chosen].ravel()] = wing[chosen].reshape(-1, 3)
        folds = (first[of[left]] * wing[left]).sum(-1) > FOLD
        there = uses[of[left]]
        left = left[~((there > 1) | ((there == 1) & folds)).any(1)]
    return faces[np.concatenate(taken)] if taken else faces
