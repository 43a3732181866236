"""Meshes and clouds as operators want them: no face or point twice, triangles for quads, one orientation."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from torchlb.geometry.manifold import edges_of, two_orientations
from torchlb.operator.inputs import ArrayLike, as_tensor, check_corners, check_points

COINCIDENT = 1e-12
"""Points closer than this share of the largest coordinate are one point: their difference is rounding."""


def coincident(
    points: Float[Tensor, "N n"],
) -> tuple[Float[Tensor, " N"], Int[Tensor, " N"], Int[Tensor, " T"]]:
    """(distance to the nearest other point, that point, those whose nearest is in the same place to rounding)."""
    tree = KDTree(points.numpy())
    distance, nearest = tree.query(points.numpy(), k=min(2, len(points)))
    distance = torch.from_numpy(distance).view(len(points), -1)[:, -1]
    nearest = torch.from_numpy(nearest).view(len(points), -1)
    index = torch.arange(len(points))
    other = torch.where(nearest[:, 0] == index, nearest[:, -1], nearest[:, 0])
    close = (distance <= COINCIDENT * points.abs().max()) & (other != index)
    return distance, other, close.nonzero()[:, 0]


def clean_points(points: ArrayLike) -> tuple[Tensor, Tensor]:
    """Cloud without duplicates: of points in the same place, to rounding, the first stays.

    Parameters
    ----------
    points : (N, n), ℓ, finite.

    Returns
    -------
    points : (N', n), in their order.
    kept : (N',), their indices in the input: `values[kept]` carries data over.

    Examples
    --------
    >>> points, kept = clean_points([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    >>> kept.tolist()
    [0, 1]
    """
    places, points = check_points(points), as_tensor(points)
    kept = torch.arange(len(points))
    while len(kept):
        _, other, twins = coincident(places[kept])
        if len(twins) == 0:
            break
        stays = torch.ones(len(kept), dtype=torch.bool)
        stays[twins[other[twins] < twins]] = False
        kept = kept[stays]
    kept = kept.to(points.device)
    return points[kept], kept


def clean_mesh(vertices: ArrayLike, faces: ArrayLike) -> tuple[Tensor, Tensor, Tensor]:
    """Mesh without unreferenced vertices and repeated faces, quads split into triangles, all wound alike.

    Faces that repeat a corner go, and all but the first of those with the same corners. Quads are split along the
    shorter diagonal. Triangles are turned so that they agree with their neighbours, the fewer of each component; a
    component with one side only, such as a Möbius band, stays as it is.

    Parameters
    ----------
    vertices : (N, n).
    faces : (F, 3) indices; (F, 4) for quads (or tetrahedra, which stay).

    Returns
    -------
    vertices : (N', n), those in use, in their order.
    faces : (F', 3), renumbered.
    kept : (N',), their indices in the input: `values[kept]` carries data over.

    Examples
    --------
    >>> vertices, faces, kept = clean_mesh(torch.eye(4), torch.tensor([[0, 1, 3], [0, 0, 1], [3, 1, 0]]))
    >>> faces.tolist(), kept.tolist()
    ([[0, 1, 2]], [0, 1, 3])
    """
    vertices = as_tensor(vertices)
    corners, faces = check_corners(faces, len(vertices)), as_tensor(faces)
    places = vertices.detach().cpu().double()
    if corners.shape[1] == 4 and are_quads(corners):
        corners = _triangles(places, corners)
    corners = proper_faces(corners)
    corners = corners[first_of_each(corners)]
    corners = torch.where(turned_faces(corners)[:, None], corners.flip(1), corners)
    kept, renumbered = torch.unique(corners, return_inverse=True)
    kept = kept.to(vertices.device)
    return vertices[kept], renumbered.to(faces), kept


def proper_faces(faces: Int[Tensor, "F v"]) -> Int[Tensor, "G v"]:
    """The faces whose corners are distinct; one that repeats a corner covers nothing."""
    ordered = faces.sort(dim=1).values
    return faces[(ordered[:, 1:] != ordered[:, :-1]).all(1)]


def first_of_each(faces: Int[Tensor, "F v"]) -> Bool[Tensor, " F"]:
    """Whether a face is the first with its corners, in whatever order they come."""
    corners = faces.sort(dim=1).values.numpy()
    order = np.lexsort(corners.T)
    repeated = (corners[order[1:]] == corners[order[:-1]]).all(1)
    first = torch.ones(len(faces), dtype=torch.bool)
    first[torch.from_numpy(order[1:][repeated])] = False
    return first


def are_quads(faces: Int[Tensor, "F 4"]) -> bool:
    """Whether faces of four corners are quads: tetrahedra share three corners with the next one, quads but two.

    >>> [are_quads(torch.tensor([[0, 1, 2, 3], other])) for other in ([2, 3, 4, 5], [1, 2, 3, 4])]
    [True, False]
    """
    faces = proper_faces(faces[first_of_each(faces)]).sort(1).values
    triples = torch.cat([faces[:, [j for j in range(4) if j != i]] for i in range(4)])
    _, number, count = torch.unique(triples, dim=0, return_inverse=True, return_counts=True)
    return 2 * int((count[number].view(4, -1) > 1).any(0).sum()) < max(len(faces), 1)


def _triangles(vertices: Float[Tensor, "N n"], quads: Int[Tensor, "F 4"]) -> Int[Tensor, "G 3"]:
    """Two triangles for every quad, along its shorter diagonal."""
    a, b = ((vertices[quads[:, i]] - vertices[quads[:, i + 2]]).norm(dim=1) for i in (0, 1))
    turned = torch.where((a <= b)[:, None], quads, quads.roll(-1, 1))
    return torch.stack([turned[:, :3], turned[:, [0, 2, 3]]], 1).flatten(0, 1)


def turned_faces(faces: Int[Tensor, "F v"]) -> Bool[Tensor, " F"]:
    """Which triangles to turn round so that the two at an edge run along it in opposite directions.

    Of the two orientations of a component the one with fewer turned faces is taken. One that has one side only stays as
    it is.

    >>> turned_faces(torch.tensor([[0, 1, 2], [1, 2, 3], [3, 2, 4]])).tolist()
    [True, False, False]
    """
    count = len(faces)
    if faces.shape[1] != 3 or count == 0:
        return torch.zeros(count, dtype=torch.bool)
    edges = edges_of(faces.numpy(), int(faces.max()) + 1)
    one, two = edges.twins
    against = edges.ends[0][one] == edges.ends[0][two]
    own, other = two_orientations(one // 3, two // 3, against, count)
    turned, component = own > other, np.minimum(own, other)
    share = np.bincount(component, turned) / np.maximum(np.bincount(component), 1)
    return torch.from_numpy(turned ^ (share > 0.5)[component])
