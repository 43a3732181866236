"""Triangles too coarse for polynomial fits: long ones along the boundary, and regions without interior vertices."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchlb.galerkin.delaunay import EDGES, Cover
from torchlb.galerkin.nodes import Nodes
from torchlb.geometry.complex import edges_of
from torchlb.geometry.fit_search import IN_ROWS
from torchlb.geometry.local_fits import FitPlan
from torchlb.geometry.thresholds import CREASE, FACTOR, KINK
from torchlb.geometry.vectors import Points, at
from torchlb.linalg.precision import SINGLE, rows_at_once


def with_area(points: Points, faces: Int[Tensor, "F 3"]) -> Bool[Tensor, " F"]:
    """Mask of triangles that drops boundary slivers of rounding height, unless a vertex would lose its last one."""
    kept, count = torch.ones(len(faces), dtype=torch.bool), len(points)
    corners = at(points, faces)
    sides = (corners.roll(-1, 1) - corners.roll(-2, 1)).norm(dim=2)  # across from the corners
    longest, place = sides.max(1)
    spare = sides.sum(1) - 2 * longest
    low = spare < 2 * SINGLE**2 * longest  # the height is at most √(spare · longest / 2)
    while low.any():
        found = edges_of(faces[kept].numpy(), count)
        on_boundary = torch.zeros(len(faces), 3, dtype=torch.bool)
        on_boundary[kept] = torch.from_numpy(np.asarray(found.uses)[found.of] == 1).view(-1, 3)
        out = low & kept & (on_boundary.sum(1) == 1) & on_boundary[torch.arange(len(faces)), place]
        left = torch.bincount(faces[kept & ~out].flatten(), minlength=count)
        out &= (left[faces] > 0).all(1)
        if not out.any():
            break
        kept &= ~out
    return kept


def reaching_out(nodes: Nodes, fits: FitPlan, coarse: Bool[Tensor, " F"]) -> Bool[Tensor, " N"]:
    """Vertices whose fit of functions uses a vertex of coarse triangles only.

    Such a vertex may hang on by slivers, and has almost no energy of its own; a fit that uses it would add far more.
    """
    beyond, result = (torch.zeros_like(fits.degree, dtype=torch.bool) for _ in range(2))
    beyond[nodes.cells[coarse].flatten()] = True
    beyond[nodes.cells[~coarse].flatten()] = False
    for block in fits.functions:
        result[block.vertices[beyond[block.points].any(1)]] = True
    return result


def lying_triangles(points: Points, nodes: Nodes, free: Bool[Tensor, " E"]) -> Bool[Tensor, " F"]:
    """Triangles with an obtuse angle opposite a free boundary edge, or opposite an edge of another such triangle.

    The angle opposite an edge without length counts as obtuse, so that a chain of such triangles may lead through
    triangles without area.
    """
    corners = at(points, nodes.cells)
    apex = corners.roll(-2, 1)  # across from the sides of `EDGES`
    one, other = corners - apex, corners.roll(-1, 1) - apex
    obtuse = (one * other).sum(2) <= -CREASE * one.norm(dim=2) * other.norm(dim=2)
    met, lying = free.clone(), torch.zeros(len(nodes.cells), dtype=torch.bool)
    while True:
        new = (met[nodes.edge] & obtuse).any(1) & ~lying
        if not new.any():
            return lying
        lying |= new
        met[nodes.edge[new].flatten()] = True


def without_inside(points: Points, nodes: Nodes, fits: FitPlan) -> Bool[Tensor, " F"]:
    """Triangles without a fit at any corner, or with almost only crease or boundary vertices around every corner."""
    lone = fits.degree == 0
    bound = lone.clone()
    if points.shape[1] == 3:
        turn, pairs = _cosines(points, nodes), nodes.edges
        bound[pairs[turn < CREASE].flatten()] = True
        kinked = torch.zeros_like(bound).index_fill(0, pairs[turn < KINK].flatten(), True)
        bound |= kinked & (fits.reason == IN_ROWS)
    rim = nodes.edges[nodes.sides[2].uses != 2].flatten()
    on_boundary = torch.zeros_like(bound).index_fill(0, rim, True)
    bound |= on_boundary & (_around(nodes, (~bound & ~on_boundary).long()) == 0)
    around = _around(nodes, torch.where(bound, 1, -FACTOR))
    return (around > 0)[nodes.cells].all(1) | lone[nodes.cells].all(1)


def _cosines(points: Float[Tensor, "N 3"], nodes: Nodes) -> Float[Tensor, " E"]:
    """Cosine of the angle between the two triangle normals at each edge; 1 where not two triangles have an area."""
    corners = at(points, nodes.faces)
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = torch.nn.functional.normalize(normal, eps=torch.finfo(normal.dtype).tiny)
    normal = torch.cat([normal, normal.square().sum(1, keepdim=True).round()], 1)
    total = points.new_zeros(len(nodes.edges), 4)
    total.index_add_(0, nodes.edge.flatten(), normal.repeat_interleave(3, 0))
    # |m + n|² = 2 + 2 m·n of two units
    return torch.where(total[:, 3] == 2, total[:, :3].square().sum(1) / 2 - 1, 1.0)


def _around(nodes: Nodes, values: Shaped[Tensor, " N"]) -> Shaped[Tensor, " N"]:
    """Sums over each vertex and its neighbours."""
    one, other = nodes.edges.T
    return values.index_add(0, one, values[other]).index_add(0, other, values[one])


def boundary_shares(points: Points, ends: Int[Tensor, "G 2"], cover: Cover) -> Float[Tensor, " N"]:
    """Lumped boundary mass of coarse triangles at the vertices, ℓ; its sum is the length of their boundary edges.

    An edge of the cover that joins a vertex to its own copy crosses a boundary edge, half its length away from the
    vertex. That vertex takes a share of the boundary edge there, and the ends of the edge take less.
    """
    result, start = torch.zeros_like(points[:, 0]), points[ends[:, 0]]
    if len(ends) == 0:
        return result
    along = points[ends[:, 1]] - start
    square = along.square().sum(1).clamp_min(torch.finfo(along.dtype).tiny)
    own = torch.stack([cover.faces[:, i] == cover.faces[:, j] for i, j in EDGES], 1)
    vertex, half = cover.faces[own], cover.lengths[own] / 2
    edge = [torch.arange(len(ends)).repeat(2)]
    where, who = [torch.cat([0 * square, 0 * square + 1])], [ends.T.flatten()]
    few = rows_at_once(ends.numel() * points.shape[1])
    for x, distance in zip(vertex.split(few), half.split(few), strict=True):
        offset = points[x, None] - start
        share = ((offset * along).sum(2) / square).clamp(0, 1)
        away = (offset - share[..., None] * along).norm(dim=2)
        away = torch.where((x[:, None, None] == ends).any(2), torch.inf, away)
        nearest = (away - distance[:, None]).abs().argmin(1)
        edge.append(nearest)
        where.append(share.gather(1, nearest[:, None])[:, 0])
        who.append(x)
    edge, where, who = torch.cat(edge), torch.cat(where), torch.cat(who)
    order = where.argsort(stable=True)
    order = order[edge[order].argsort(stable=True)]
    edge, where, who = edge[order], where[order], who[order]
    piece = torch.where(edge[1:] == edge[:-1], where.diff() * square.sqrt()[edge[1:]], 0.0) / 2
    return result.index_add_(0, who[1:], piece).index_add_(0, who[:-1], piece)
