"""From values at the vertices to values at the nodes (`method.md`, section 9)."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Int
from scipy import sparse
from torch import Tensor

from torchlb.fits.weights import cardinal
from torchlb.galerkin.curving import CurvedMesh, CurvingPlan, Ends, node_ends
from torchlb.geometry.local_fits import FitPlan, LocalFits
from torchlb.geometry.vectors import at
from torchlb.linalg.precision import AT_ONCE


def prolongation(
    plan: FitPlan, fits: LocalFits, curving: CurvingPlan, mesh: CurvedMesh
) -> sparse.csr_array:
    """P, (N + X, N): what the vertices' fits say at the nodes, weighted by barycentrics. Its rows sum to one.

    Identity rows at the vertices, linear ones at flat nodes, and those of the boundary's own curves along it.
    """
    count, ends = len(fits.points), node_ends(curving.nodes)
    row, col, value, by_fit = _without_fits(count, curving, mesh, ends)
    rows = torch.cat([row, count + ends.node[by_fit]])
    length = torch.cat([torch.ones_like(row), plan.size[ends.vertex[by_fit]]])
    indptr, start = _places(rows, length, len(mesh.places))
    total = int(indptr[-1])
    indices, data = torch.empty(total, dtype=torch.int32), value.new_empty(total)
    alone, first = start[: len(row)], torch.zeros_like(ends.node)
    indices[alone], data[alone] = col.int(), value
    first[by_fit] = start[len(row) :]
    order = by_fit.nonzero()[:, 0]
    order = order[ends.vertex[order].argsort(stable=True)]
    for block, coefficients in zip(plan.functions, fits.coefficients, strict=True):
        for part, own in _of_vertices(block.vertices, ends, order, count):
            used, vertex = own >= 0, block.vertices[part]
            end = own.clamp_min(0)
            node = at(mesh.places, count + at(ends.node, end))
            offset = plan.reach * (node - fits.points[vertex, None])
            y = offset @ fits.initial[vertex] / fits.radius[vertex, None, None]
            weights = cardinal(coefficients[part], y, min(block.degree, plan.jet))
            weights = weights * at(ends.share, end)[..., None]
            place = first[own[used]][:, None] + torch.arange(weights.shape[2])
            indices[place] = block.points[part][used.nonzero()[:, 0]]
            data[place] = weights[used]
    shape = len(mesh.places), count
    p = sparse.csr_array((data.numpy(), indices.numpy(), indptr.numpy()), shape=shape)
    p.sum_duplicates()
    p.data, p.indices = p.data.copy(), p.indices.copy()  # without the room of the duplicates
    return p


def _without_fits(
    count: int, curving: CurvingPlan, mesh: CurvedMesh, ends: Ends
) -> tuple[Tensor, Tensor, Tensor, Bool[Tensor, " E"]]:
    """(row, column, value) of the vertices, of flat nodes and of those along the boundary; and which ends are left."""
    vertices = torch.arange(count)
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


def _places(
    row: Int[Tensor, " E"], length: Int[Tensor, " E"], num_rows: int
) -> tuple[Int[Tensor, " rows_plus_1"], Int[Tensor, " E"]]:
    """Row pointers of so many entries in the given rows, and where each lot of them starts."""
    total = torch.zeros(num_rows + 1, dtype=torch.int64).index_add_(0, row + 1, length)
    order = row.argsort(stable=True)
    start = torch.empty_like(row)
    start[order] = length[order].cumsum(0) - length[order]
    return total.cumsum(0), start


def _of_vertices(
    vertices: Int[Tensor, " b"], ends: Ends, order: Int[Tensor, " e"], count: int
) -> Iterator[tuple[Int[Tensor, " c"], Int[Tensor, "c E"]]]:
    """Some of the vertices at a time, and the numbers of the ends at each of them, padded by −1; `order` has these."""
    number = torch.bincount(ends.vertex[order], minlength=count)
    start = number.cumsum(0) - number
    uses = number[vertices]
    for part in uses.argsort().split(AT_ONCE) if len(order) else []:  # of about as many ends each
        slot = torch.arange(int(uses[part].max()))
        own = order[(start[vertices[part], None] + slot).clamp_max(len(order) - 1)]
        yield part, torch.where(slot < uses[part, None], own, -1)
