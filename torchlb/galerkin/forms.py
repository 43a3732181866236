"""Stiffness and mass of a complex from its elements, for any conductivity, and derivatives in it (`method.md`, 10)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.galerkin.assembly import (
    area_element,
    cofactors,
    element_matrices,
    flat_metric,
    gradient_products,
    linear_elements,
    squares,
    summed,
)
from torchlb.galerkin.curving import CurvedMesh, CurvingPlan
from torchlb.galerkin.delaunay import sound_lengths
from torchlb.galerkin.elements import Element, simplex, subsets
from torchlb.galerkin.prolongation import prolongation
from torchlb.geometry.local_fits import FitPlan, LocalFits
from torchlb.geometry.numbering import Numbering
from torchlb.geometry.vectors import at
from torchlb.linalg.once import once_differentiable
from torchlb.linalg.precision import AT_ONCE, rows_at_once

Density = Callable[[Tensor, Element, Tensor], Tensor]


class FlatCells(NamedTuple):
    """Flat simplices with P1 elements, in place of curved cells or beside them.

    Attributes
    ----------
    cells
        (T, d + 1).
    lengths
        (T, e), edge lengths, ℓ.
    share
        Fraction of each simplex that is integrated.
    lumped
        Whether the mass is lumped in equal shares to the corners.
    mix
        (T, F), share of each face of the mesh in a cell; None where the cells replace no faces.
    """

    cells: Int[Tensor, "T corners"]
    lengths: Float[Tensor, "T e"]
    share: float
    lumped: bool
    mix: Any


@dataclass(frozen=True)
class Forms:
    """Elements of a weak pair, which assemble its stiffness for any conductivity.

    Attributes
    ----------
    cells, lengths
        (T, d + 1), (T, e), ℓ: simplices, and their edge lengths in the order of `subsets`.
    faces
        (T,), face of the mesh for each simplex.
    num_faces
        Number F of faces of the mesh.
    prolongation
        P, (N + X, N), from the vertices to the nodes.
    nodes
        (T, n), nodes of each element.
    metric
        (T, Q, S), metric at the Gauss points, ℓ².
    element
        Shape functions at the Gauss points.
    shares
        (T,), fraction of each simplex that is integrated; None for all of it.
    flats
        Flat simplices beside these.
    """

    cells: Int[Tensor, "T corners"]
    lengths: Float[Tensor, "T e"]
    faces: Int[Tensor, " T"]
    num_faces: int
    prolongation: Any
    nodes: Int[Tensor, "T n"]
    metric: Float[Tensor, "T Q S"]
    element: Element
    shares: Float[Tensor, " T"] | None
    flats: list[FlatCells]

    @classmethod
    def curved(
        cls,
        fit_plan: FitPlan,
        fits: LocalFits,
        plan: CurvingPlan,
        mesh: CurvedMesh,
        stars: Int[Tensor, "S corners"],
        shares: Float[Tensor, " F"] | None,
        *,
        prolong: bool = True,
    ) -> Forms:
        """Build the elements of curved cells, of the cover that replaces coarse triangles, and of local stars.

        A simplex belongs to the stars of all its corners, each of which counts an equal share of it.
        """
        nodes, flats, own = plan.nodes, [], ~plan.coarse
        if mesh.cover is not None:
            same: Any = sparse.eye_array(len(own), format="csr")
            mix = mesh.cover.mixed() @ same[plan.coarse.numpy()]
            flats.append(FlatCells(mesh.cover.faces, mesh.cover.lengths, 0.5, True, mix))
        if len(stars):
            lengths = sound_lengths(edge_lengths(fits.points, stars), stars)
            flats.append(FlatCells(stars, lengths, 1 / stars.shape[1], False, None))
        p = prolongation(fit_plan, fits, plan, mesh) if prolong else None
        every = torch.arange(len(own))
        parts = nodes.cells, mesh.lengths, every, nodes.elements, mesh.metric
        if mesh.cover is not None:
            parts, shares = [x[own] for x in parts], None if shares is None else shares[own]
        cells, lengths, faces, elements, metric = parts
        curved = p, elements, metric, simplex(nodes.dim, nodes.degree)
        return cls(cells, lengths, faces, len(own), *curved, shares, flats)

    @classmethod
    def linear(cls, points: Float[Tensor, "N n"], faces: Int[Tensor, "F corners"]) -> Forms:
        """Build P1 elements, whose stiffness for κ = 1 is the cotangent matrix."""
        lengths, element = edge_lengths(points, faces), simplex(faces.shape[1] - 1, 1)
        metric = flat_metric(lengths)[:, None].expand(-1, len(element.weights), -1)
        same: Any = sparse.eye_array(len(points), format="csr")
        every = torch.arange(len(faces))
        return cls(faces, lengths, every, len(faces), same, faces, metric, element, None, [])

    def restored(self, numbering: Numbering, order: Int[Tensor, " G"], num_faces: int) -> Forms:
        """Renumber to the user's points and `num_faces` faces; `order` has the user's numbers of the faces here."""
        given = numbering.given
        flats = [
            flat._replace(
                cells=given[flat.cells],
                mix=None if flat.mix is None else _renumbered(flat.mix, order, num_faces),
            )
            for flat in self.flats
        ]
        return replace(
            self,
            cells=given[self.cells],
            faces=order[self.faces],
            num_faces=num_faces,
            prolongation=_renumbered(self.prolongation, given, len(given)),
            flats=flats,
        )

    def conductivities(self, conductivity: Tensor) -> list[Tensor]:
        """Return κ at the Gauss points, (T, Q), and its means on flat cells; differentiable.

        The conductivity is given per vertex, (N,), or per face, (F,) with F ≠ N. From vertices its logarithm is
        prolonged, which keeps κ positive, and of high order where the fits are.
        """
        if len(conductivity) != self.prolongation.shape[1]:
            points = conductivity[self.faces, None].expand(-1, len(self.element.weights))
            return [points, *(_prolonged(conductivity, flat.mix) for flat in self.flats)]
        log = conductivity.log()
        found = [(_prolonged(log, self.prolongation)[self.nodes] @ self.element.values.T).exp()]
        for flat in self.flats:
            shape = simplex(self.element.dim, 1)
            means = (log[flat.cells] @ shape.values.T).exp() @ shape.weights
            found.append(means / shape.weights.sum())
        return found

    def matrix(self, conductivities: list[Tensor] | None = None) -> sparse.csr_array:
        """Upper triangle of K + iM, (N, N), positive semidefinite for every κ > 0; the rows of K sum to zero."""
        kappa = None if conductivities is None else conductivities[0]
        elements = summed(self.blocks(kappa), self.nodes, self.prolongation.shape[0])
        return upper_congruence(self.prolongation, elements) + self.flat(conductivities)

    def blocks(self, conductivity: Float[Tensor, "T Q"] | None = None) -> Tensor:
        """Element matrices K_FE + iM_FE of the curved elements, (T, n²)."""
        blocks = element_matrices(self.metric, self.element, conductivity)
        return blocks if self.shares is None else self.shares[:, None] * blocks

    def near(
        self, conductivities: list[Tensor] | None = None, flat: Any = None
    ) -> sparse.csr_array:
        """Upper triangle of K₁ + iM₁ of P1 elements on flat simplices, with the mean of κ on each.

        `flat` has the part of the flat cells, if it is known.
        """
        means = None
        if conductivities is not None:
            means = conductivities[0] @ self.element.weights / self.element.weights.sum()
        count = self.prolongation.shape[1]
        own = linear_elements(self.lengths, self.cells, count, means, shares=self.shares)
        upper: Any = sparse.triu(own, format="csr")
        if not self.flats:
            return upper
        return upper + (self.flat(conductivities) if flat is None else flat)

    def flat(self, conductivities: list[Tensor] | None = None) -> sparse.csr_array:
        """Upper triangle of K + iM of the flat cells."""
        count = self.prolongation.shape[1]
        total: Any = sparse.csr_array((count, count), dtype=complex)
        for number, flat in enumerate(self.flats, 1):
            kappa = None if conductivities is None else conductivities[number]
            part = linear_elements(flat.lengths, flat.cells, count, kappa, lumped=flat.lumped)
            total = total + flat.share * sparse.triu(part, format="csr")
        return total

    def sensitivity(self, w: Float[Tensor, "N C"], u: Float[Tensor, "N C"]) -> list[Tensor]:
        """∂/∂κ of Σ_c w_cᵀK(κ)u_c, in the shapes of `conductivities`: quadrature weights times ∇w·∇u."""
        at_nodes = [torch.from_numpy(self.prolongation @ x.numpy()) for x in (w, u)]
        own, *flat = self.densities(_slopes, at_nodes, [w, u], torch.ones(w.shape[1]).to(w))
        return [own, *(each.sum(1) for each in flat)]

    def form(
        self, name: str, nodes: list[Tensor], corners: list[Tensor], c: Float[Tensor, " C"]
    ) -> Float[Tensor, ""]:
        """Σ_k c_k w_kᵀK u_k, of "stiffness", or Σ_k c_k w_kᵀM u_k, from w and u at the nodes and at the vertices."""
        density = _slopes if name == "stiffness" else _products
        parts = self.densities(density, nodes, corners, c)
        return torch.stack([part.sum() for part in parts]).sum()

    def densities(
        self, density: Density, nodes: list[Tensor], corners: list[Tensor], c: Float[Tensor, " C"]
    ) -> list[Tensor]:
        """A density of two functions times the quadrature weights, differentiable in metric and functions.

        Of the curved elements, (T, Q), and of each lot of flat cells, (F, Q).
        """
        own = density(self.metric, self.element, _outer(self.nodes, nodes, c))
        found = [own if self.shares is None else self.shares[:, None] * own]
        for flat in self.flats:
            shape = simplex(self.element.dim, 1)
            metric = flat_metric(flat.lengths)[:, None].expand(-1, len(shape.weights), -1)
            blocks = _outer(flat.cells, corners, c)
            if flat.lumped and density is _products:
                share = area_element(metric[:, 0]) * shape.weights.sum() / flat.cells.shape[1]
                part = share[:, None] * blocks[:, :: flat.cells.shape[1] + 1]
            else:
                part = density(metric, shape, blocks)
            found.append(flat.share * part)
        return found


def edge_lengths(
    points: Float[Tensor, "N n"], cells: Int[Tensor, "T corners"]
) -> Float[Tensor, "T e"]:
    """Lengths of the edges of each cell, in the order of `subsets`, ℓ."""
    ends = points[cells[:, [list(pair) for pair in subsets(cells.shape[1] - 1, 2)]]]
    return (ends[:, :, 1] - ends[:, :, 0]).norm(dim=2)


def upper_congruence(p: Any, matrix: sparse.csr_array) -> sparse.csr_array:
    """Upper triangle of the symmetric PᵀAP, computed in blocks of rows."""
    left, parts, count = sparse.csr_array(p.T), [], p.shape[1]
    for first in range(0, count, AT_ONCE):
        part: Any = left[first : first + AT_ONCE] @ matrix @ p
        row = np.arange(first, first + part.shape[0], dtype=np.int32).repeat(np.diff(part.indptr))
        upper = np.flatnonzero(part.indices >= row)
        length = np.bincount(row[upper] - first, minlength=part.shape[0])
        parts.append((length, part.indices.take(upper), part.data.take(upper)))
    indptr = np.concatenate([[0], *(length for length, *_ in parts)]).cumsum()
    indices, data = np.empty(indptr[-1], np.int32), np.empty(indptr[-1], parts[0][2].dtype)
    for first in range(0, count, AT_ONCE):
        place = slice(indptr[first], indptr[min(first + AT_ONCE, count)])
        _, indices[place], data[place] = parts.pop(0)  # which frees it
    return sparse.csr_array((data, indices, indptr), shape=(count, count))


def _renumbered(matrix: Any, columns: Int[Tensor, " C"], count: int) -> sparse.csr_array:
    parts = matrix.data, columns.numpy()[matrix.indices], matrix.indptr
    return sparse.csr_array(parts, shape=(matrix.shape[0], count))


def _outer(
    nodes: Int[Tensor, "T n"], values: list[Tensor], c: Float[Tensor, " C"]
) -> Float[Tensor, "T n_times_n"]:
    """Σ_k c_k w_k(i) u_k(j) for all pairs of nodes of each element."""
    one, two = values[0] * c, values[1]
    parts = nodes.split(rows_at_once(nodes.shape[1] * len(c)))
    return torch.cat([(at(one, part) @ at(two, part).mT).flatten(1) for part in parts])


def _slopes(
    metric: Float[Tensor, "T Q S"], element: Element, blocks: Float[Tensor, "T n_times_n"]
) -> Float[Tensor, "T Q"]:
    """Quadrature weights times Σ_k c_k ∇w_k·∇u_k at the Gauss points."""
    entries = zip(cofactors(metric).unbind(-1), gradient_products(element).unbind(1), strict=True)
    total = torch.stack([entry * (blocks @ cross.T) for entry, cross in entries]).sum(0)
    return element.weights * total / area_element(metric)


def _products(
    metric: Float[Tensor, "T Q S"], element: Element, blocks: Float[Tensor, "T n_times_n"]
) -> Float[Tensor, "T Q"]:
    """Quadrature weights times Σ_k c_k w_k u_k at the Gauss points."""
    return element.weights * area_element(metric) * (blocks @ squares(element).T)


class _Prolonged(torch.autograd.Function):
    """P x for a vector x."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, matrix: Any) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.matrix = matrix
        return torch.from_numpy(np.asarray(matrix @ x.detach().numpy()))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return torch.from_numpy(np.asarray(ctx.matrix.T @ g.numpy())), None


_prolonged: Any = _Prolonged.apply
