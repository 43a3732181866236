"""From values at the vertices to values at the nodes (`method.md`, section 9)."""

from __future__ import annotations

import torch
from scipy import sparse
from torch import Tensor

from torchlb.fits.polynomials import monomials
from torchlb.galerkin.curving import CurvedMesh, Surface, node_ends

CHUNK = 2**15
"""Pairs of a node and a vertex at a time: some 100 MB at degree 4."""


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
    fits, top = surface.fits, int(surface.fits.degree.max())
    for part in by_fit[ends.node].nonzero()[:, 0].split(CHUNK):
        node, vertex, share = ends.node[part], ends.vertex[part], ends.share[part, None]
        offset = mesh.places[count + node] - surface.points[vertex]
        y = (offset[:, None] @ surface.frames[vertex])[:, 0] / fits.radius[vertex, None]
        powers = monomials(y, top)
        others = (powers[:, None] @ fits.coefficients[vertex, : powers.shape[1]])[:, 0]
        row = torch.cat([1 - others.sum(1, keepdim=True), others], 1) * share
        rows.append((count + node)[:, None].expand_as(row).flatten())
        cols.append(fits.index[vertex].flatten())
        values.append(row.flatten())
    where = torch.cat(rows).int().numpy(), torch.cat(cols).int().numpy()
    shape = (len(mesh.places), count)
    return sparse.csr_array((torch.cat(values).numpy(), where), shape=shape)


def _rim_entries(mesh: CurvedMesh) -> tuple[Tensor, Tensor, Tensor]:
    """(node, vertex, weight) of the bent nodes along the boundary."""
    nodes, on_edge = mesh.nodes, mesh.nodes.degree - 1
    steps = torch.arange(1, nodes.degree, dtype=mesh.places.dtype) / nodes.degree
    weights = mesh.curves.weights(steps.expand(len(mesh.rim), -1))  # (G, r − 1, S)
    node = (mesh.rim[:, None] * on_edge + torch.arange(on_edge))[..., None].expand_as(weights)
    vertex = mesh.curves.index[:, None].expand_as(weights)
    used = mesh.curves.valid[:, None] & mesh.bent[node]
    return node[used], vertex[used], weights[used]
