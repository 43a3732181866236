"""Smooth surfaces of real shapes: limits of Loop's subdivision, sampled at nested levels."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor, from_numpy

from torchlb.errors import InputError


def limit_surface(
    vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"], levels: int
) -> tuple[Float[Tensor, "P 3"], list[Int[Tensor, "_ 3"]]]:
    """Points on the limit surface of a closed mesh under Loop's subdivision, and the meshes of its levels on them.

    The surface is that of a real shape, and smooth: twice continuously differentiable except at extraordinary vertices
    (valence not six), where it is C¹. All meshes are inscribed in the same surface, so that results on a coarse one can
    be compared with those on a fine one. (Loop, *Smooth Subdivision Surfaces Based on Triangles*, 1987; limit positions
    as in Hoppe et al., *Piecewise smooth surface reconstruction*, 1994.)

    Parameters
    ----------
    vertices, faces, levels
        The control mesh, closed, two triangles at every edge, and the number of subdivisions.

    Returns the points of the finest level, (P, 3), and the triangles of the levels 0 to `levels`:
    `points[: faces[i].max() + 1]` are the vertices of level i. Raises InputError for meshes that are not closed.

    Examples
    --------
    >>> from torchlb.surfaces import Sphere
    >>> points, faces = limit_surface(*Sphere().mesh(100), 2)
    >>> len(points), [len(f) for f in faces]
    (1570, [196, 784, 3136])
    """
    import trimesh  # takes long to load

    points, triangles = vertices.detach().cpu().double().numpy(), faces.cpu().numpy()
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    shared, counts = np.unique(edges, axis=0, return_counts=True)
    if not (counts == 2).all():
        a, b = shared[counts != 2][0]
        raise InputError(
            f"limit_surface: expected a closed mesh, got {int((counts != 2).sum())} edges without two triangles, the "
            f"first one from vertex {a} to {b}"
        )
    meshes = [triangles]
    for _ in range(levels):
        points, triangles = trimesh.remesh.subdivide_loop(points, triangles)
        meshes.append(triangles)
    # limit positions of the vertices: (1 − nχ)v + χ Σ neighbours, n of them, χ = 1/(3/(8β) + n)
    ends = triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2).T
    half = sparse.csr_array((np.full(ends.shape[1], 0.5), ends), shape=(len(points),) * 2)
    graph = half + half.T
    valence = graph.sum(1)
    beta = (5 / 8 - (3 / 8 + np.cos(2 * np.pi / valence) / 4) ** 2) / valence
    share = 1 / (3 / (8 * beta) + valence)
    points = (1 - valence * share)[:, None] * points + share[:, None] * (graph @ points)
    return from_numpy(points), [from_numpy(mesh.astype(np.int64)) for mesh in meshes]
