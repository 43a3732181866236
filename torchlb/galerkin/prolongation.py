"""From values at the vertices to values at the nodes (`method.md`, section 9)."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from jaxtyping import Int
from scipy import sparse
from torch import Tensor

from torchlb.fits.weights import cardinal
from torchlb.galerkin.curving import CurvedMesh, Ends, Surface, node_ends
from torchlb.geometry.vertex_fits import Fits

AT_ONCE = 2**11
"""Vertices whose nodes are looked at together: some 10 MB at degree 4."""


def prolongation(surface: Surface, mesh: CurvedMesh) -> sparse.csr_array:
    """P, (N + X, N): what the vertices' fits say at the nodes, weighted by barycentrics. Its rows sum to one.

    Identity rows at the vertices, linear ones at flat nodes, and those of the boundary's own curves along it.
    """
    nodes, count = mesh.nodes, len(surface.points)
    ends = node_ends(nodes)
    first = torch.arange(count)
    flat = ~mesh.bent[ends.node]
    of_rim = _rim_entries(mesh)
    by_fit = mesh.bent.clone()
    by_fit[of_rim[0]] = False
    rows, cols, values = [first], [first], [surface.points.new_ones(count)]
    for node, vertex, weight in (of_rim, (ends.node[flat], ends.vertex[flat], ends.share[flat])):
        rows.append(count + node)
        cols.append(vertex)
        values.append(weight)
    for block, part, own in _of_fits(surface.fits.blocks, ends, by_fit[ends.node], count):
        used, vertex = own >= 0, block.vertices[part]
        node = count + ends.node[own]
        offset = mesh.places[node] - surface.points[vertex, None]
        y = offset @ surface.frames[vertex] / surface.fits.radius[vertex, None, None]
        row = cardinal(block.coefficients[part], y, block.degree) * ends.share[own][..., None]
        index = block.points[part, None].expand_as(row)
        rows.append(node[used].repeat_interleave(row.shape[2]))
        cols.append(index[used].flatten())
        values.append(row[used].flatten())
    where = torch.cat(rows).int().numpy(), torch.cat(cols).int().numpy()
    shape = (len(mesh.places), count)
    return sparse.csr_array((torch.cat(values).numpy(), where), shape=shape)


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


def _rim_entries(mesh: CurvedMesh) -> tuple[Tensor, Tensor, Tensor]:
    """(node, vertex, weight) of the bent nodes along the boundary."""
    nodes, on_edge = mesh.nodes, mesh.nodes.degree - 1
    steps = torch.arange(1, nodes.degree, dtype=mesh.places.dtype) / nodes.degree
    weights = mesh.curves.weights(steps.expand(len(mesh.rim), -1))  # (G, r − 1, S)
    node = (mesh.rim[:, None] * on_edge + torch.arange(on_edge))[..., None].expand_as(weights)
    vertex = mesh.curves.index[:, None].expand_as(weights)
    used = mesh.curves.valid[:, None] & mesh.bent[node]
    return node[used], vertex[used], weights[used]
