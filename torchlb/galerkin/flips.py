"""Edge flips that remove folded triangles and slivers, for the integrals only (`method.md`, section 9).

Flips to intrinsic Delaunay everywhere would harm good meshes, whose edges follow the curvature. Flips that only reduce
a fold do not help: creases of the surface itself have such triangles.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchlb.galerkin.delaunay import apart
from torchlb.geometry.complex import edges_of
from torchlb.geometry.frames import vertex_normals
from torchlb.geometry.thresholds import CREASE
from torchlb.geometry.vectors import dot
from torchlb.linalg.precision import LOW, ROOT_EPS

FAIR = 0.5
"""Quality below which a triangle is flipped where the surface is planar."""


def flipped(vertices: Tensor, faces: Tensor) -> Tensor:
    """Flip an edge of every folded triangle or sliver that improves by it and is not folded afterwards.

    Only edges of two triangles are flipped, and only to edges that do not exist yet. Normals are recomputed each round.
    An edge that was flipped away never returns, since two flips could otherwise alternate for ever.
    """
    faces, normals = faces.clone(), vertex_normals(vertices, faces)
    alignment, quality = _scores(vertices, normals, faces)
    gone, size = faces.new_zeros(0), len(vertices)
    while True:
        poor = (alignment < CREASE) | (quality < LOW)
        bad = (poor | ((quality < FAIR) & (alignment > 1 - ROOT_EPS))).nonzero()[:, 0]
        if len(bad) == 0:
            return faces
        left, right, after = _flips(faces, bad, gone, size)
        before = torch.stack([faces[left], faces[right]], dim=1)
        gain = _value(vertices, normals, after) - _value(vertices, normals, before)
        even = torch.minimum(alignment[left], alignment[right]) > 1 - ROOT_EPS
        gain[~(poor[left] | even)] = -1.0
        gain[_scores(vertices, normals, after)[0].amin(1) < CREASE] = -1.0
        # improving flips, best first, that share neither a face nor the new edge with a better one
        order = (gain > 1e-9).nonzero()[:, 0]
        order = order[apart(left[order], right[order], -gain[order], len(faces))]
        made = _keys(after[order, 0, 0], after[order, 0, 1], size)
        chosen = order[np.sort(np.unique(made.numpy(), return_index=True)[1])]
        if len(chosen) == 0:
            return faces
        faces[left[chosen]], faces[right[chosen]] = after[chosen, 0], after[chosen, 1]
        gone = torch.cat([gone, _keys(after[chosen, 0, 2], after[chosen, 1, 2], size)])
        part = _touching(faces, after[chosen])
        renewed = torch.unique(after[chosen])
        normals[renewed] = vertex_normals(vertices, faces[part])[renewed]
        alignment[part], quality[part] = _scores(vertices, normals, faces[part])


def _keys(one: Tensor, other: Tensor, size: int) -> Tensor:
    """Integer key of each undirected edge."""
    return torch.minimum(one, other) * size + torch.maximum(one, other)


def _touching(faces: Tensor, corners: Tensor) -> Tensor:
    """Indices of the faces with one of these vertices, ascending."""
    touched = torch.zeros(int(faces.max()) + 1, dtype=torch.bool)
    touched[corners] = True
    return touched[faces].any(1).nonzero()[:, 0]


def _scores(vertices: Tensor, normals: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """Least cosine between a triangle's normal and its vertex normals, and the triangle's quality."""
    corners = vertices[faces]
    sides = corners.roll(-1, dims=-2) - corners
    normal = torch.linalg.cross(sides[..., 0, :], sides[..., 1, :])
    twice = normal.norm(dim=-1, keepdim=True)
    unit = normal / twice.clamp_min(torch.finfo(normal.dtype).tiny)
    alignment = dot(unit[..., None, :], normals[faces]).amin(-1)
    return alignment, 2 * 3**0.5 * twice[..., 0] / sides.square().sum((-1, -2))


def _value(vertices: Tensor, normals: Tensor, pairs: Tensor) -> Tensor:
    """Objective of a flip: the lesser alignment of the two triangles, up to `CREASE`, then the lesser quality."""
    alignment, quality = _scores(vertices, normals, pairs)
    return 1e3 * alignment.amin(1).clamp_max(CREASE) + quality.amin(1)


def _flips(faces: Tensor, bad: Tensor, gone: Tensor, size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Flips of edges of the bad faces: the faces (a, b, c) and (b, a, d), and (c, d, b) and (d, c, a) afterwards.

    Flips to an edge that exists, or was flipped away before, are excluded.
    """
    around = bad
    for _ in range(2):  # every face that may have the new edge of a flip
        around = _touching(faces, faces[around])
    faces, bad = faces[around], torch.searchsorted(around, bad)
    edges, corners = edges_of(faces.numpy(), size), faces.flatten()
    start, end, one, two = (torch.from_numpy(x) for x in (*edges.ends, *edges.twins))
    twin = torch.full_like(corners, -1)
    twin[one], twin[two] = two, one
    sides = (3 * bad[:, None] + torch.tensor([2, 0, 1])).flatten()
    sides = sides[twin[sides] >= 0]
    c, d = corners[sides], corners[twin[sides]]
    there = torch.from_numpy(edges.find(c.numpy(), d.numpy())[1] > 0)
    wound = start[sides] == end[twin[sides]]
    keep = wound & (c != d) & ~there & ~torch.isin(_keys(c, d, size), gone)
    sides, c, d = sides[keep], c[keep], d[keep]
    a, b = start[sides], end[sides]
    after = torch.stack([torch.stack([c, d, b], 1), torch.stack([d, c, a], 1)], dim=1)
    return around[sides // 3], around[twin[sides] // 3], after
