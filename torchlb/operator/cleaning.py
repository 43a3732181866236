"""Clean meshes and clouds: no duplicate faces or points, triangles for quads, one orientation."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn.functional import pad

from torchlb.errors import InputError
from torchlb.geometry.complex import edges_of, two_orientations
from torchlb.geometry.vectors import Points
from torchlb.linalg.precision import ROUNDING
from torchlb.operator.inputs import ArrayLike, as_tensor, check_corners, check_mask, check_points


def coincident(points: Points) -> tuple[Float[Tensor, " N"], Int[Tensor, " N"], Int[Tensor, " T"]]:
    """Nearest other point of each: (distance, its index, indices of the points that coincide with it to rounding)."""
    tree: Any = KDTree(points.numpy())
    found = tree.query(points.numpy(), k=[1, min(2, len(points))])
    distance, nearest = (torch.from_numpy(each.T) for each in found)
    index = torch.arange(len(points))
    other = torch.where(nearest[0] == index, nearest[1], nearest[0])
    close = (distance[1] <= ROUNDING * points.abs().max()) & (other != index)
    return distance[1], other, close.nonzero()[:, 0]


def clean_points(points: ArrayLike, tolerance: float = 0.0) -> tuple[Tensor, Tensor]:
    """Cloud without duplicates: of points that coincide, to rounding or within a tolerance, the first stays.

    Parameters
    ----------
    points
        (N, n), ℓ, finite.
    tolerance
        ℓ, far below the spacing; points in a chain with steps of at most this length are merged into its first.

    Returns
    -------
    points
        (N', n), in the order of the input.
    kept
        (N',), their indices in the input: `values[kept]` carries data over.

    >>> points, kept = clean_points([[0.0, 0.0], [1.0, 0.0], [0.0, 0.0]])
    >>> kept.tolist()
    [0, 1]
    """
    places, points = check_points(points), as_tensor(points)
    if not 0 <= tolerance < torch.inf:
        raise InputError(f"tolerance: expected a length of 0 or more, got {tolerance}")
    reach = max(tolerance, ROUNDING * float(places.abs().max()))
    kept = merged(places, reach).unique().to(points.device)
    return points[kept], kept


def clean_mesh(
    vertices: ArrayLike, faces: ArrayLike, *, merge: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """Mesh without unreferenced vertices and duplicate faces, with quads split into triangles and one orientation.

    Faces that repeat a corner are removed, and all but the first of those with the same corners. Quads are split along
    the shorter diagonal that lies inside. Triangles are reversed so that they agree with their neighbours, the fewer of
    each component; a non-orientable component, such as a Möbius band, stays as it is.

    Parameters
    ----------
    vertices
        (N, n).
    faces
        (F, 3) indices; (F, 4) for quads (or tetrahedra, which stay).
    merge
        Whether to merge vertices that coincide, to rounding, into the first of them, which closes cuts along them.

    Returns
    -------
    vertices
        (N', n), the referenced vertices, in the order of the input.
    faces
        (F', 3), renumbered.
    kept
        (N',), indices of the vertices in the input: `values[kept]` carries data over.

    >>> vertices, faces, kept = clean_mesh(torch.eye(4), torch.tensor([[0, 1, 3], [0, 0, 1], [3, 1, 0]]))
    >>> faces.tolist(), kept.tolist()
    ([[0, 1, 2]], [0, 1, 3])
    """
    vertices = as_tensor(vertices)
    corners, faces = check_corners(faces, len(vertices)), as_tensor(faces)
    places = vertices.detach().cpu().double()
    if corners.shape[1] == 4 and are_quads(corners):
        corners = triangles_of(places, corners).flatten(0, 1)
    if merge:
        corners = merged(places, ROUNDING * float(places.abs().max()))[corners]
    corners = proper_faces(corners)
    corners = corners[first_of_each(corners)]
    corners = torch.where(turned_faces(corners)[:, None], corners.flip(1), corners)
    kept, renumbered = torch.unique(corners, return_inverse=True)
    kept = kept.to(vertices.device)
    return vertices[kept], renumbered.to(faces), kept


def submesh(
    vertices: ArrayLike, faces: ArrayLike, mask: ArrayLike
) -> tuple[Tensor, Tensor, Tensor]:
    """The part of a mesh whose faces have all corners in a mask (N,), such as a cortex without the medial wall.

    Vertices of the mask that belong to no such face are left out. Returned are vertices, faces and `kept`, as
    `clean_mesh` has them: `values[kept]` cuts data out, and ``whole[kept] = values`` puts them back. Where it is cut
    the part has a boundary, with the condition given to `from_mesh`, ∂f/∂ν = 0 by default. Modes, heat and
    distances are those of the part alone. Raises InputError for anything but a boolean mask, or without a face inside.

    >>> square = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    >>> submesh(square, [[0, 1, 2], [0, 2, 3]], [True, False, True, True])[1:]
    (tensor([[0, 1, 2]]), tensor([0, 2, 3]))
    """
    count = len(check_points(vertices, "vertices"))
    kept = check_mask(mask, count)
    whole = kept[check_corners(faces, count)].all(1)
    if not whole.any():
        raise InputError(f"mask: no face has all its corners among its {int(kept.sum())} vertices")
    return clean_mesh(vertices, as_tensor(faces)[whole])


def cleaned(vertices: ArrayLike, faces: ArrayLike | None) -> tuple[Tensor, Tensor | None]:
    """Vertices and faces by `clean_mesh`, or by `clean_points` without faces."""
    if faces is None or len(faces) == 0:
        return clean_points(vertices)[0], None
    return clean_mesh(vertices, faces)[:2]


def proper_faces(faces: Int[Tensor, "F v"]) -> Int[Tensor, "G v"]:
    """The faces whose corners are distinct; one that repeats a corner covers nothing."""
    ordered = faces.sort(dim=1).values
    return faces[(ordered[:, 1:] != ordered[:, :-1]).all(1)]


def first_of_each(faces: Int[Tensor, "F v"]) -> Bool[Tensor, " F"]:
    """Mask of the faces that are the first with their corners, in any order of the corners."""
    corners = faces.sort(dim=1).values.numpy()
    order = np.lexsort(corners.T)
    repeated = (corners[order[1:]] == corners[order[:-1]]).all(1)
    first = torch.ones(len(faces), dtype=torch.bool)
    first[torch.from_numpy(order[1:][repeated])] = False
    return first


def are_quads(faces: Int[Tensor, "F 4"]) -> bool:
    """Whether faces with four corners are quads: tetrahedra share three corners with a neighbour, quads only two.

    >>> [are_quads(torch.tensor([[0, 1, 2, 3], other])) for other in ([2, 3, 4, 5], [1, 2, 3, 4])]
    [True, False]
    """
    faces = proper_faces(faces[first_of_each(faces)]).sort(1).values
    triples = torch.cat([faces[:, [j for j in range(4) if j != i]] for i in range(4)])
    _, number, count = torch.unique(triples, dim=0, return_inverse=True, return_counts=True)
    return 2 * int((count[number].view(4, -1) > 1).any(0).sum()) < max(len(faces), 1)


def merged(
    places: Points, reach: float, apart: Int[Tensor, "E 2"] | None = None
) -> Int[Tensor, " N"]:
    """First point of each point's cluster (single linkage: clusters are chains with steps of at most `reach`).

    Where a cluster contains both points of a pair in `apart`, only points of it with equal coordinates are merged.

    >>> merged(torch.tensor([[0.0], [2.0], [0.1]]), 0.2).tolist()
    [0, 1, 0]
    """
    unique, number = np.unique(places.numpy(), axis=0, return_inverse=True)
    number = number.reshape(-1)
    near = KDTree(unique).query_pairs(reach, output_type="ndarray")
    ones, shape = np.ones(len(near), dtype=bool), (len(unique), len(unique))
    group = csgraph.connected_components(sparse.coo_array((ones, near.T), shape), directed=False)[1]
    if apart is not None:
        ends = number[apart.numpy()].T
        torn = group[ends[0]][(group[ends[0]] == group[ends[1]]) & (ends[0] != ends[1])]
        loose = np.isin(group, torn)
        group[loose] = len(unique) + np.flatnonzero(loose)
    _, first, back = np.unique(group[number], return_index=True, return_inverse=True)
    return torch.from_numpy(first[back.reshape(-1)])


def triangles_of(vertices: Points, polygons: Int[Tensor, "F c"]) -> Int[Tensor, "F t 3"]:
    """Triangles (F, c − 2, 3) of polygons with c corners each, in space or in the plane.

    Ears are cut off (Meisters 1975), the one with the shortest cut first; rounding and polygons without area may leave
    no ear, and then the shortest cut is made.

    >>> dart = torch.tensor([[0.0, 0.0], [1.0, 0.2], [0.0, 1.0], [0.4, 0.3]])
    >>> triangles_of(dart, torch.tensor([[0, 1, 2, 3]])).tolist()
    [[[1, 2, 3], [1, 3, 0]]]
    """
    places = pad(vertices, (0, max(3 - vertices.shape[1], 0)))
    around = (places[polygons] - places[polygons[:, :1]])[..., :3]
    normal = torch.linalg.cross(around, around.roll(-1, 1)).sum(1)[:, None, None]
    left, triangles = polygons, []
    for size in range(polygons.shape[1], 3, -1):
        ear = places[torch.stack([left, left.roll(-1, 1), left.roll(-2, 1)], -1)]
        across = ear[:, :, 2] - ear[:, :, 0]
        cut = across.norm(dim=-1)
        if places.shape[1] == 3:  # in higher dimensions a polygon has no interior side
            inward = torch.linalg.cross(normal, ear.roll(-1, 2) - ear)
            bad = (across * inward[:, :, 0]).sum(-1) <= 0
            some = bad.any(1).nonzero()[:, 0]  # all cuts of convex polygons are good
            offset = places[left[some]][:, None, None] - ear[some, :, :, None]
            sides = (offset * inward[some, :, :, None]).sum(-1)
            bad[some] |= ((sides >= 0) & (offset != 0).any(-1)).all(2).any(-1)
            cut = torch.where(bad, 1e30 * cut, cut)
        left = left.gather(1, (cut.argmin(1)[:, None] + torch.arange(size)) % size)
        triangles.append(left[:, :3])
        left = torch.cat([left[:, :1], left[:, 2:]], 1)
    return torch.stack([*triangles, left], 1)


def turned_faces(faces: Int[Tensor, "F v"]) -> Bool[Tensor, " F"]:
    """Mask of the triangles to reverse so that the two triangles at an edge run along it in opposite directions.

    The orientation of a component with fewer reversed faces is taken; a non-orientable component stays as it is.

    >>> turned_faces(torch.tensor([[0, 1, 2], [1, 2, 3], [3, 2, 4]])).tolist()
    [True, False, False]
    """
    count = len(faces)
    if faces.shape[1] != 3 or count == 0:
        return torch.zeros(count, dtype=torch.bool)
    edges = edges_of(faces.numpy(), int(faces.max()) + 1)
    one, two = edges.twins
    own, other = two_orientations(one // 3, two // 3, edges.against, count)
    turned, component = own > other, np.minimum(own, other)
    share = np.bincount(component, turned) / np.maximum(np.bincount(component), 1)
    return torch.from_numpy(turned ^ (share > 0.5)[component])
