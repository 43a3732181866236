"""From values at the vertices to values at the nodes (`method.md`, section 9)."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.fits.weights import cardinal
from torchlb.galerkin.curving import CurvedMesh, Ends, node_ends
from torchlb.geometry.vectors import at
from torchlb.geometry.vertex_fits import Fits, VertexFits

AT_ONCE = 2**11
"""Vertices whose nodes are looked at together: some 10 MB at degree 4."""


def prolongation(
    points: Float[Tensor, "N n"], fits: VertexFits, mesh: CurvedMesh
) -> sparse.csr_array:
    """P, (N + X, N): what the vertices' fits say at the nodes, weighted by barycentrics. Its rows sum to one.

    Identity rows at the vertices, linear ones at flat nodes, and those of the boundary's own curves along it.
    """
    count, ends = len(points), node_ends(mesh.nodes)
    row, col, value, by_fit = _without_fits(points, mesh, ends)
    rows = torch.cat([row, count + ends.node[by_fit]])
    length = torch.cat([torch.ones_like(row), fits.size[ends.vertex[by_fit]]])
    indptr, start = _places(rows, length, len(mesh.places))
    total = int(indptr[-1])
    indices, data = torch.empty(total, dtype=torch.int32), value.new_empty(total)
    alone, first = start[: len(row)], torch.zeros_like(ends.node)
    indices[alone], data[alone] = col.int(), value
    first[by_fit] = start[len(row) :]
    _fill((indices, data, first), points, fits, mesh, ends, by_fit)
    shape = len(mesh.places), count
    p = sparse.csr_array((data.numpy(), indices.numpy(), indptr.numpy()), shape=shape)
    p.sum_duplicates()
    p.data, p.indices = p.data.copy(), p.indices.copy()  # without the room of the duplicates
    return p


def _without_fits(
    points: Tensor, mesh: CurvedMesh, ends: Ends
) -> tuple[Tensor, Tensor, Tensor, Bool[Tensor, " E"]]:
    """(row, column, value) of the vertices, of flat nodes and of those along the boundary; and which ends are left."""
    vertices = torch.arange(len(points))
    node, vertex, weight = mesh.boundary.entries
    bent = mesh.bent[node]
    of_rim, flat, by_fit = (
        (node[bent], vertex[bent], weight[bent]),
        ~mesh.bent[ends.node],
        mesh.bent.clone(),
    )
    by_fit[node] = False
    entries = [(vertices, vertices, points.new_ones(len(vertices)))]
    for node, vertex, weight in (of_rim, (ends.node[flat], ends.vertex[flat], ends.share[flat])):
        entries.append((len(vertices) + node, vertex, weight))
    row, col, value = (torch.cat(parts) for parts in zip(*entries, strict=True))
    return row, col, value, by_fit[ends.node]


def _fill(
    entries: tuple[Int[Tensor, " nnz"], Float[Tensor, " nnz"], Int[Tensor, " E"]],
    points: Float[Tensor, "N n"],
    fits: VertexFits,
    mesh: CurvedMesh,
    ends: Ends,
    by_fit: Bool[Tensor, " E"],
) -> None:
    """The indices and data that come from fits, of each end from its `first` on; the fits are gone thereafter."""
    indices, data, first = entries
    for block, part, own in _of_fits(fits.hand_over(), ends, by_fit, len(points)):
        used, vertex = own >= 0, block.vertices[part]
        end = own.clamp_min(0)
        offset = fits.reach * (
            at(mesh.places, len(points) + at(ends.node, end)) - points[vertex, None]
        )
        y = offset @ fits.frames[vertex] / fits.radius[vertex, None, None]
        weights = cardinal(block.coefficients[part], y, block.degree)
        weights = weights * at(ends.share, end)[..., None]
        place = first[own[used]][:, None] + torch.arange(weights.shape[2])
        indices[place] = block.points[part].int()[used.nonzero()[:, 0]]
        data[place] = weights[used]


def _places(
    row: Int[Tensor, " E"], length: Int[Tensor, " E"], num_rows: int
) -> tuple[Int[Tensor, " rows_plus_1"], Int[Tensor, " E"]]:
    """Row pointers of so many entries in the given rows, and where each lot of them starts."""
    total = torch.zeros(num_rows + 1, dtype=torch.int64).index_add_(0, row + 1, length)
    order = row.argsort(stable=True)
    start = torch.empty_like(row)
    start[order] = length[order].cumsum(0) - length[order]
    return total.cumsum(0), start


def _of_fits(
    blocks: list[Fits], ends: Ends, used: Tensor, count: int
) -> Iterator[tuple[Fits, Int[Tensor, " b"], Int[Tensor, "b E"]]]:
    """Parts of the blocks of fits, and the numbers of the used ends at each of their vertices, padded by −1."""
    order = used.nonzero()[:, 0]
    order = order[ends.vertex[order].argsort(stable=True)]
    number = torch.bincount(ends.vertex[order], minlength=count)
    start = number.cumsum(0) - number
    for block in blocks if len(order) else []:
        uses = number[block.vertices]
        for part in uses.argsort().split(AT_ONCE):  # of about as many ends each
            slot = torch.arange(int(uses[part].max()))
            own = order[(start[block.vertices[part], None] + slot).clamp_max(len(order) - 1)]
            yield block, part, torch.where(slot < uses[part, None], own, -1)
