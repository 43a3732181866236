"""Prolongation of functions from the vertices to the Lagrange nodes (`method.md`, section 9)."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Bool, Float
from scipy import sparse
from torch import Tensor

from torchlb.fits.weights import cardinal
from torchlb.galerkin.curving import CurvedMesh, CurvingPlan
from torchlb.geometry.local_fits import FitPlan, LocalFits
from torchlb.geometry.vectors import at
from torchlb.linalg.once import computed_again


def prolongation(
    plan: FitPlan, fits: LocalFits, curving: CurvingPlan, mesh: CurvedMesh
) -> sparse.csr_array:
    """P, (N + X, N): fits of the vertices at the nodes, averaged by barycentric coordinates. Its rows sum to one.

    Rows are those of the identity at the vertices, linear at flat nodes, and Lagrange weights along boundary curves.
    """
    count = len(fits.points)
    row, col, value, by_fit = _without_fits(count, curving, mesh)
    parts = [(row, torch.ones_like(row), col.int(), value)]
    for asked, used, points, weights in _by_fits(plan, fits, mesh, by_fit):
        points = at(points, used.nonzero()[:, 0])
        length = torch.full((len(points),), points.shape[1])
        parts.append((count + asked[used], length, points.flatten(), weights[used].flatten()))
    row, length, col, value = (torch.cat(columns) for columns in zip(*parts, strict=True))
    del parts
    indptr = torch.cat([length.new_zeros(1), length.cumsum(0)]).int()
    each = row.int().numpy(), torch.arange(len(row)).int().numpy()
    which = torch.ones(len(row)).numpy(), each
    added: Any = sparse.csr_array(which, shape=(len(mesh.places), len(row)))
    entries = value.numpy(), col.numpy(), indptr.numpy()
    return added @ sparse.csr_array(entries, shape=(len(row), count))


def prolonged(
    plan: FitPlan,
    fits: LocalFits,
    curving: CurvingPlan,
    mesh: CurvedMesh,
    values: Float[Tensor, "N C"],
) -> Float[Tensor, "NX C"]:
    """P times functions, without the matrix, differentiable in the points that the fits are of."""
    count = len(fits.points)
    row, col, weight, by_fit = _without_fits(count, curving, mesh)
    found = values.new_zeros(len(mesh.places), values.shape[1])
    found = found.index_add(0, row, weight[:, None] * values[col])
    for asked, used, points, weights in _by_fits(plan, fits, mesh, by_fit):
        said = computed_again(_said, weights, values, points, used)
        found = found.index_add(0, count + asked[used], said)
    return found


def _said(weights: Tensor, values: Tensor, points: Tensor, used: Tensor) -> Tensor:
    return (weights @ at(values, points))[used]


def _by_fits(
    plan: FitPlan, fits: LocalFits, mesh: CurvedMesh, by_fit: Bool[Tensor, " E"]
) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
    """(nodes (c, e), which of them count, points (c, K), weights (c, e, K)) of some vertices' fits at a time."""
    count, ends = len(fits.points), mesh.ends
    for block, coefficients in zip(plan.functions, fits.coefficients, strict=True):
        for part, own, used in ends.of(block.vertices):
            used, vertex = used & at(by_fit, own), block.vertices[part]
            asked = at(ends.node, own)
            offset = plan.reach * (at(mesh.places, count + asked) - fits.points[vertex, None])
            y = offset @ fits.initial[vertex] / fits.radius[vertex, None, None]
            weights = cardinal(coefficients[part], y, min(block.degree, plan.jet))
            weights *= at(ends.share, own)[..., None]
            yield asked, used, block.points[part], weights


def _without_fits(
    count: int, curving: CurvingPlan, mesh: CurvedMesh
) -> tuple[Tensor, Tensor, Tensor, Bool[Tensor, " E"]]:
    """(row, column, value) of vertices, flat nodes and boundary nodes, and the mask of pairs left to the fits."""
    vertices, ends = torch.arange(count), mesh.ends
    node, vertex, weight = mesh.boundary.entries
    bent, flat, by_fit = curving.bent[node], ~curving.bent[ends.node], curving.bent.clone()
    by_fit[node] = False
    parts = [
        (vertices, vertices, mesh.places.new_ones(count)),
        (count + node[bent], vertex[bent], weight[bent]),
        (count + ends.node[flat], ends.vertex[flat], ends.share[flat]),
    ]
    row, col, value = (torch.cat(columns) for columns in zip(*parts, strict=True))
    return row, col, value, by_fit[ends.node]
