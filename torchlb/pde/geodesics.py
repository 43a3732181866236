"""Geodesic distance: shortest paths along edges, straightened across the triangles between them.

The heat method (Crane, Weischedel, Wardetzky 2013) computes the distance in the least-squares sense, which smooths the
cut locus, and its heat is negative at up to half of the points where triangles are obtuse. Updates across triangles
(Novotni, Klein 2002) avoid both: their mean error is 0.2 to 0.6 of its on real shapes of 4.8k points.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor

from torchlb.geometry.neighbors import mesh_graph
from torchlb.linalg.checks import check_operator, check_sources, takes_arrays
from torchlb.linalg.precision import NEGLIGIBLE
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.operator.through import without

FROM_MESH = ("mesh", "cotangent")
"""Sources of operators for which all edges are those of the faces."""


@takes_arrays
def geodesic_distance(
    lb: LaplaceBeltrami, sources: int | Sequence[Any] | Tensor, *, each: bool = False
) -> Float[Tensor, " N"] | Float[Tensor, "N S"]:
    """Distance along the surface to the nearest of the sources, ℓ; infinite where no path leads to one.

    On surfaces the error falls a little faster than the spacing: on a sphere of 2,000 vertices it is 0.4 % in the mean.
    For several sources, the result is the least of their distances, with about the same error. It is never below the
    straight line. On curves, in more dimensions, and without triangles, paths follow edges. Computed on the CPU,
    without derivatives.

    Parameters
    ----------
    lb
        Operator of one shape or of a batch. Edges and triangles are those of its mesh, or of the surface through a
        cloud; without one, edges are those of its stencils.
    sources
        Index of a point, indices of several, or a mask (N,).
    each
        Whether to return a column for each of S sources, (N, S). A source may then also be indices of several points
        or a mask, such as that of a parcel.

    Raises
    ------
    InputError
        For no sources, or indices out of range.

    Examples
    --------
    >>> from torchlb.surfaces import Sphere
    >>> vertices, faces = Sphere().mesh(500)
    >>> distance = geodesic_distance(LaplaceBeltrami.from_mesh(vertices, faces), 0)
    >>> exact = torch.acos((vertices @ vertices[0]).clamp(-1, 1))
    >>> bool((distance - exact).abs().mean() < 0.02)
    True
    """
    check_operator(lb)
    some: Any = sources if each and len(sources) else [sources]  # pyright: ignore[reportArgumentType]
    starts = [check_sources(one, lb.num_points).numpy() for one in some]
    points = np.ascontiguousarray(lb.points.detach().cpu().double().numpy())
    row, col = _edges(lb)
    length = _distances(points, row, col)
    graph = sparse.csr_array((length, (row, col)), shape=lb.shape)
    triangles = _triangles(lb, points) if lb.dim == 2 and len(row) else None
    enough = NEGLIGIBLE * float(length.mean()) if len(row) else 0.0
    found = [_distance(graph, points, triangles, start, enough) for start in starts]
    distance = torch.from_numpy(np.stack(found, 1) if each else found[0])
    return without(lb, distance.to(lb.mass), "distances")


def _distance(
    graph: Any, points: np.ndarray, triangles: Any, start: np.ndarray, enough: float
) -> Float[np.ndarray, " N"]:
    """Distance to the nearest of the points in `start`, along edges and then across triangles."""
    distance, _, nearest = csgraph.dijkstra(
        graph, indices=start, min_only=True, return_predecessors=True
    )
    if triangles is not None:
        from torchlb.linalg import kernels

        foot = np.maximum(nearest, 0).astype(np.int64)  # arbitrary where no path leads to a source
        order, fell = np.argsort(distance), np.ones(len(points), dtype=np.int64)
        kernels.straighten(distance, foot, order, points, *triangles, fell, enough)
    return distance


def _edges(lb: LaplaceBeltrami) -> tuple[np.ndarray, np.ndarray]:
    """Edges in both directions, of faces and of the P1 pair; without a weak pair, those of the stencils."""
    matrix: Any = mesh_graph(lb.faces.cpu(), lb.num_points)
    if len(lb.faces) == 0 or lb.source not in FROM_MESH:
        crow, col = (
            lb.weak.linear_pair[:2] if lb._has_weak_form else (lb.stencil.crow, lb.stencil.col)
        )
        where = (np.ones(len(col)), col.cpu().numpy(), crow.cpu().numpy())
        near = sparse.csr_array(where, shape=lb.shape)
        matrix = matrix + near + near.T
    row, column = sparse.coo_array(matrix).coords
    return row[row != column], column[row != column]


def _distances(points: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[a] - points[b], axis=1)


def _triangles(lb: LaplaceBeltrami, points: np.ndarray) -> tuple[np.ndarray, ...]:
    """The triangles at each point, as `kernels.straighten` takes them."""
    faces = lb.faces.cpu().numpy()
    i, j, k = (np.concatenate([faces[:, (c + shift) % 3] for c in range(3)]) for shift in range(3))
    order = np.argsort(i, kind="stable")
    i, j, k = i[order], j[order], k[order]
    first = np.searchsorted(i, np.arange(len(points) + 1))
    to_j, to_k, base = (_distances(points, a, b) for a, b in ((i, j), (i, k), (j, k)))
    with np.errstate(divide="ignore", invalid="ignore"):  # degenerate triangles
        along = (to_j**2 - to_k**2 + base**2) / (2 * base)
        height = np.sqrt(np.maximum(to_j**2 - along**2, 0.0))
    return first, np.stack([j, k], 1), np.stack([to_j, to_k, base, height, along], 1)
