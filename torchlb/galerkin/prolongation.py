"""Prolongation of functions from the vertices to the Lagrange nodes (`method.md`, section 9)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float
from scipy import sparse
from torch import Tensor

from torchlb.fits.weights import cardinal
from torchlb.galerkin.curving import CurvedMesh, CurvingPlan
from torchlb.galerkin.medium import Jumps
from torchlb.geometry.local_fits import FitPlan, LocalFits
from torchlb.geometry.vectors import at
from torchlb.linalg.once import computed_again
from torchlb.linalg.precision import ROUNDING


class Prolongation(NamedTuple):
    """P, (N + X, N): fits of the vertices at the nodes, averaged by barycentric coordinates. Its rows sum to one.

    Rows are those of the identity at the vertices, linear at flat nodes, and Lagrange weights along boundary curves.
    """

    plan: FitPlan
    fits: LocalFits
    curving: CurvingPlan
    mesh: CurvedMesh

    def one_sided(self, jumps: Jumps) -> Prolongation:
        """The same without fits that reach over a jump; linear at nodes where those left do not suffice.

        For the degrees 2 and 3 fits are exact at a node only together with those of its other vertices.
        """
        ends, boundary, bent = self.mesh.ends, self.mesh.boundary, self.curving.bent
        over = torch.zeros_like(jumps.at)
        for block in self.plan.functions:
            row = torch.arange(len(block.points)).repeat_interleave(block.points.shape[1])
            over[block.vertices] = jumps.inside(row, block.points.flatten(), len(block.points))
        kept = torch.where(over[ends.vertex], 0.0, ends.share)
        total = kept.new_zeros(len(bent)).index_add(0, ends.node, kept)
        sound = total > (0 if self.plan.reach == 1 else 1 - ROUNDING)
        node, vertex, _ = boundary.entries
        sound[boundary.nodes] = ~jumps.reached(node, vertex, len(bent))[boundary.nodes]
        bent, none = bent & sound, total == 0
        share = (kept / torch.where(none, 1.0, total)[ends.node]).where(bent[ends.node], ends.share)
        mesh = replace(self.mesh, ends=replace(ends, share=share))
        return self._replace(mesh=mesh, curving=replace(self.curving, bent=bent))

    def matrix(self) -> sparse.csr_array:
        """The matrix P."""
        row, length, col, value = self.entries()
        indptr = torch.cat([length.new_zeros(1), length.cumsum(0)]).int()
        each = row.int().numpy(), torch.arange(len(row)).int().numpy()
        which = torch.ones(len(row)).numpy(), each
        added: Any = sparse.csr_array(which, shape=(len(self.mesh.places), len(row)))
        parts = value.numpy(), col.numpy(), indptr.numpy()
        return added @ sparse.csr_array(parts, shape=(len(row), len(self.fits.points)))

    def entries(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """(row, length) of parts of rows, which add up, and (column, value) of their entries; differentiable."""
        row, col, value, by_fit = self._without_fits()
        parts = [(row, torch.ones_like(row), col.int(), value)]
        for nodes, used, points, weights in self._by_fits(by_fit):
            points = at(points, used.nonzero()[:, 0])
            length = torch.full((len(points),), points.shape[1])
            parts.append((nodes[used], length, points.flatten(), weights[used].flatten()))
        row, length, col, value = (torch.cat(columns) for columns in zip(*parts, strict=True))
        return row, length, col, value

    def times(self, values: Float[Tensor, "N C"]) -> Float[Tensor, "NX C"]:
        """P times functions, without the matrix, differentiable in the points that the fits are of."""
        row, col, weight, by_fit = self._without_fits()
        found = values.new_zeros(len(self.mesh.places), values.shape[1])
        found = found.index_add(0, row, weight[:, None] * values[col])
        for nodes, used, points, weights in self._by_fits(by_fit):
            said = computed_again(_said, weights, values, points, used)
            found = found.index_add(0, nodes[used], said)
        return found

    def _by_fits(
        self, by_fit: Bool[Tensor, " E"]
    ) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """(rows (c, e), which of them count, points (c, K), weights (c, e, K)) of some vertices' fits at a time."""
        plan, fits, ends = self.plan, self.fits, self.mesh.ends
        for block, coefficients in zip(plan.functions, fits.coefficients, strict=True):
            for part, own, used in ends.of(block.vertices):
                vertex, rows = block.vertices[part], len(fits.points) + at(ends.node, own)
                offset = plan.reach * (at(self.mesh.places, rows) - fits.points[vertex, None])
                y = offset @ fits.initial[vertex] / fits.radius[vertex, None, None]
                weights = cardinal(coefficients[part], y, min(block.degree, plan.jet))
                weights *= at(ends.share, own)[..., None]
                yield rows, used & at(by_fit, own), block.points[part], weights

    def _without_fits(self) -> tuple[Tensor, Tensor, Tensor, Bool[Tensor, " E"]]:
        """(row, column, value) of vertices, flat nodes and boundary nodes, and the mask of pairs left to the fits."""
        count, ends, curved = len(self.fits.points), self.mesh.ends, self.curving.bent
        vertices, (node, vertex, weight) = torch.arange(count), self.mesh.boundary.entries
        bent, flat, by_fit = curved[node], ~curved[ends.node], curved.clone()
        by_fit[node] = False
        parts = [
            (vertices, vertices, self.mesh.places.new_ones(count)),
            (count + node[bent], vertex[bent], weight[bent]),
            (count + ends.node[flat], ends.vertex[flat], ends.share[flat]),
        ]
        row, col, value = (torch.cat(columns) for columns in zip(*parts, strict=True))
        return row, col, value, by_fit[ends.node]


def _said(weights: Tensor, values: Tensor, points: Tensor, used: Tensor) -> Tensor:
    return (weights @ at(values, points))[used]
