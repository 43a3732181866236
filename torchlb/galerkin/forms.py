"""Stiffness and mass of a complex from its elements, in any medium, and bilinear forms of both (`method.md`, 14)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.galerkin.assembly import (
    ElementMatrices,
    area_element,
    element_matrices,
    flat_metric,
    in_cells,
    linear_blocks,
    spread,
    upper_congruence,
)
from torchlb.galerkin.bilinear import BilinearForm, outer, weighted_products, weighted_slopes
from torchlb.galerkin.curving import CurvedMesh, CurvingPlan
from torchlb.galerkin.delaunay import sound_lengths
from torchlb.galerkin.elements import Element, simplex, subsets
from torchlb.galerkin.medium import Field, Medium, orthonormal
from torchlb.galerkin.prolongation import prolongation
from torchlb.geometry.local_fits import FitPlan, LocalFits
from torchlb.geometry.numbering import Numbering
from torchlb.geometry.vectors import at
from torchlb.linalg.once import computed_again, once_differentiable

Linear = Callable[[Tensor], Tensor]
Values = list[Tensor] | None
FIELDS = {"stiffness": "conductivity", "mass": "density", "potential": "potential"}


class FlatCells(NamedTuple):
    """Flat simplices with P1 elements, in place of curved cells or beside them, of which a `share` is integrated.

    The mass is lumped in equal shares to the corners, times the factors `lumped`, None where it is not; `mix`, (T, F),
    has the share of each face of the mesh in a cell, None where the cells replace no faces.
    """

    cells: Int[Tensor, "T corners"]
    lengths: Float[Tensor, "T e"]
    share: float
    lumped: Float[Tensor, " N"] | None
    mix: Any


@dataclass(frozen=True)
class Forms:
    """Elements of a weak pair, which assemble it for any medium.

    The values of a field of the medium are a list: at the Gauss points of the curved elements, (T, Q, …), and the mean
    on each flat cell, (F, …), for each lot of these; a field that is left out is 1.

    Attributes
    ----------
    given
        The vertices in an order along the shape, of which the computed triangles of matrices are.
    places
        Positions of the nodes, ℓ; the first are the `points`, the vertices.
    cells, lengths, faces, shares
        Simplices, their edge lengths in the order of `subsets`, ℓ, the face of the mesh that each is, and the
        fractions of them that are integrated, None for all.
    prolongation
        P, from the vertices to the nodes.
    nodes, metric, element
        Nodes of each element, metric, ℓ², and shape functions at the Gauss points.
    flats
        Flat simplices beside these.
    """

    given: Int[Tensor, " N"]
    points: Float[Tensor, "N n"]
    places: Float[Tensor, "NX n"]
    cells: Int[Tensor, "T corners"]
    lengths: Float[Tensor, "T e"]
    faces: Int[Tensor, " T"]
    prolongation: Any
    nodes: Int[Tensor, "T lattice"]
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
            one = torch.ones(len(fits.points), dtype=torch.float64)
            flats.append(FlatCells(mesh.cover.faces, mesh.cover.lengths, 0.5, one, mix))
        if len(stars):
            lengths = sound_lengths(edge_lengths(fits.points, stars), stars)
            flats.append(FlatCells(stars, lengths, 1 / stars.shape[1], None, None))
        p = prolongation(fit_plan, fits, plan, mesh) if prolong else None
        every = torch.arange(len(own))
        parts = nodes.cells, mesh.lengths, every, nodes.elements, mesh.metric
        if mesh.cover is not None:
            parts, shares = [x[own] for x in parts], None if shares is None else shares[own]
        cells, lengths, faces, elements, metric = parts
        curved = p, elements, metric, simplex(nodes.dim, nodes.degree)
        every = torch.arange(len(fits.points))
        flat = every, fits.points, mesh.places, cells, lengths, faces
        return cls(*flat, *curved, shares, flats)

    @classmethod
    def linear(
        cls,
        points: Float[Tensor, "N n"],
        faces: Int[Tensor, "F corners"],
        mass: Float[Tensor, " N"],
    ) -> Forms:
        """Build flat P1 elements, whose stiffness for κ = 1 is the cotangent matrix, with a lumped mass."""
        lengths, element = edge_lengths(points, faces), simplex(faces.shape[1] - 1, 1)
        corners, same = faces.shape[1], sparse.eye_array(len(points), format="csr")
        g = flat_metric(lengths)
        area = area_element(g) * element.weights.sum() / corners
        shares = torch.zeros_like(mass).index_add(
            0, faces.flatten(), area.repeat_interleave(corners)
        )
        whole: Any = sparse.eye_array(len(faces), format="csr")
        flats = [FlatCells(faces, lengths, 1.0, mass / shares, whole)]
        metric = spread(g[:0], element)
        curved = faces[:0], lengths[:0], faces[:0, 0], same, faces[:0], metric, element
        return cls(torch.arange(len(points)), points, points, *curved, None, flats)

    def restored(self, numbering: Numbering, order: Int[Tensor, " G"], num_faces: int) -> Forms:
        """Renumber to the user's points and `num_faces` faces; `order` has the user's numbers of the faces here."""
        given = numbering.given
        beyond = torch.arange(len(given), len(self.places))  # nodes that are no vertices
        rows = torch.cat([numbering.here, beyond])
        flats = [
            flat._replace(
                cells=given[flat.cells],
                lumped=None if flat.lumped is None else numbering.restored(flat.lumped),
                mix=None if flat.mix is None else _renumbered(flat.mix, order, num_faces),
            )
            for flat in self.flats
        ]
        return replace(
            self,
            given=given,
            points=numbering.restored(self.points),
            places=self.places[rows],
            nodes=torch.cat([given, beyond])[self.nodes],
            cells=given[self.cells],
            faces=order[self.faces],
            prolongation=_renumbered(self.prolongation[rows.numpy()], given, len(given)),
            flats=flats,
        )

    def values(self, field: Field, prolong: Linear | None = None) -> list[Tensor]:
        """Values of a field, differentiable in it.

        From vertices the logarithm of a positive field is prolonged, which keeps it positive, and of high order where
        the fits are; a field that may be zero is prolonged as it is, and cut off at zero. `prolong` takes functions to
        the nodes where the matrix P does not.
        """
        x, corners = field.values, simplex(self.element.dim, 1)
        if field.on_faces:
            own = spread(x[self.faces], self.element)
            return [own, *(_along(partial(times, flat.mix), x) for flat in self.flats)]
        before, after = field.transforms
        y = before(x)
        nodes = at(_along(prolong or partial(times, self.prolongation), y), self.nodes)
        found = [after(torch.einsum("qn,tn...->tq...", self.element.values, nodes))]
        for flat in self.flats:
            inside = after(torch.einsum("qc,tc...->tq...", corners.values, at(y, flat.cells)))
            found.append(cell_mean(inside, corners))
        return found

    def factors(
        self, forms: Sequence[BilinearForm], medium: Medium, prolong: Linear | None = None
    ) -> dict[str, list[Tensor]]:
        """`values` of the fields of a medium, and the projectors Π onto the tangent plane, if a form has them."""
        found = {name: self.values(field, prolong) for name, field in medium.items()}
        if any(form.along for form in forms):
            found["projectors"] = [frame @ frame.mT for frame in self.tangents()]
        return found

    def tangents(self) -> list[Tensor]:
        """Orthonormal tangent vectors, (…, n, d), oriented as the cells are, where `values` has those of a field."""
        return [orthonormal(slopes) for slopes in self.slopes()]

    def slopes(self) -> list[Tensor]:
        """Derivatives of the position in reference coordinates, (…, n, d), where `values` has those of a field."""
        places = at(self.places, self.nodes)
        corners = [at(self.points, flat.cells) for flat in self.flats]
        own = torch.einsum("tnk,qnd->tqkd", places, self.element.gradients)
        return [own, *((x[:, 1:] - x[:, :1]).mT for x in corners)]

    def matrix(self, conductivity: Values = None, density: Values = None) -> sparse.csr_array:
        """Upper triangle of K + iM, as `upper` has it, positive semidefinite in every medium; K1 = 0."""
        medium = conductivity, density
        lots = [self.curved_elements(*medium), *self.flat_elements(*medium)]
        return self.upper(self.prolongation, lots)

    def near(self, conductivity: Values = None, density: Values = None) -> sparse.csr_array:
        """Upper triangle of K₁ + iM₁ of P1 elements on flat simplices, with the mean of the medium on each."""
        medium = conductivity, density
        lots = [self.linear_elements(*medium), *self.flat_elements(*medium)]
        return self.upper(sparse.eye_array(len(self.points), format="csr"), lots)

    def upper(self, p: Any, lots: Sequence[ElementMatrices]) -> sparse.csr_array:
        """Upper triangle of PᵀAP in the order of `given`; A is made of element matrices."""
        return upper_congruence(_renumbered(p, self.given.argsort(), p.shape[1]), lots)

    def curved_elements(
        self, conductivity: Values = None, density: Values = None
    ) -> ElementMatrices:
        """Element matrices of the curved elements."""
        kappa = None if conductivity is None else self.on_curved(conductivity[0])
        rho = None if density is None else density[0]
        blocks = element_matrices(self.metric, self.element, kappa, rho)
        return ElementMatrices(self.nodes, self.shared(blocks))

    def linear_elements(
        self, conductivity: Values = None, density: Values = None
    ) -> ElementMatrices:
        """P1 elements in place of the curved ones."""
        kappa, rho = (
            None if x is None else cell_mean(x[0], self.element) for x in (conductivity, density)
        )
        kappa = self.on_flat(kappa, self.cells, self.lengths)
        blocks = linear_blocks(self.lengths, self.cells, kappa, rho)
        return ElementMatrices(self.cells, self.shared(blocks))

    def flat_elements(
        self, conductivity: Values = None, density: Values = None
    ) -> list[ElementMatrices]:
        """P1 elements on the flat cells beside the curved ones, each lot of them."""
        found = []
        for number, flat in enumerate(self.flats, 1):
            kappa, rho = (None if x is None else x[number] for x in (conductivity, density))
            kappa = self.on_flat(kappa, flat.cells, flat.lengths)
            blocks = linear_blocks(flat.lengths, flat.cells, kappa, rho, flat.lumped)
            found.append(ElementMatrices(flat.cells, flat.share * blocks))
        return found

    def shared(self, x: Tensor) -> Tensor:
        """Values of the simplices, (T, …), times the fractions of these that are integrated."""
        return x if self.shares is None else self.shares.view(-1, *[1] * (x.ndim - 1)) * x

    def bilinear(self, forms: Sequence[BilinearForm], medium: Medium) -> Float[Tensor, ""]:
        """Σ of bilinear forms, differentiable in the medium; of "lumped" and "boundary", which depend on none, 0."""
        values = self.factors(forms, medium)
        total = [torch.zeros((), dtype=torch.float64)]
        # a function that stands in two forms is one
        prolong = cache(partial(times, self.prolongation))
        for form in forms:
            if form.name in FIELDS:
                total.append(self.form(form, [prolong(form.w), prolong(form.u)], values))
        return torch.stack(total).sum()

    def form(
        self, form: BilinearForm, nodes: list[Tensor], medium: Mapping[str, list[Tensor]]
    ) -> Float[Tensor, ""]:
        """The value of a form, from its functions at the nodes and the values of the medium; differentiable in all."""
        stiffness, corners, c = form.name == "stiffness", [form.w, form.u], form.c
        values = medium.get(FIELDS.get(form.name, ""))
        density = weighted_slopes if stiffness else weighted_products
        coefficient = None if values is None else values[0]
        coefficient = self.on_curved(coefficient) if stiffness else coefficient
        blocks = outer(self.nodes, nodes, c)
        own = computed_again(density, self.metric, self.element, blocks, coefficient)
        across = None
        if form.along is not None:
            across = [x[(..., *form.along)] for x in medium["projectors"]]
            own = across[0] * own
        total = [self.shared(own).sum()]
        for number, flat in enumerate(self.flats, 1):
            shape = simplex(self.element.dim, 1)
            metric = spread(flat_metric(flat.lengths), shape)
            blocks = outer(flat.cells, corners, c)
            mean = None if values is None else values[number]
            mean = self.on_flat(mean, flat.cells, flat.lengths) if stiffness else mean
            if flat.lumped is not None and not stiffness:
                own = flat.lumped[flat.cells] * blocks[:, :: flat.cells.shape[1] + 1]
                blocks = own.mean(1, keepdim=True).expand_as(blocks)
            mean = None if mean is None else spread(mean, shape)
            own = density(metric, shape, blocks, mean)
            own = own if across is None else across[number][:, None] * own
            total.append(flat.share * own.sum())
        return torch.stack(total).sum()

    def on_curved(self, a: Tensor | None) -> Tensor | None:
        """A conductivity as `conductance` takes it, at the Gauss points of the curved elements."""
        if a is None or a.ndim == 2:
            return a
        return in_cells(a, self.slopes()[0], self.metric)

    def on_flat(
        self, a: Tensor | None, cells: Int[Tensor, "T corners"], lengths: Float[Tensor, "T e"]
    ) -> Tensor | None:
        """As `on_curved`, on flat cells; their plane is that of their corners, whatever the edge lengths are."""
        if a is None or a.ndim == 1:
            return a
        corners = at(self.points, cells)
        return in_cells(a, (corners[:, 1:] - corners[:, :1]).mT, flat_metric(lengths))


def edge_lengths(
    points: Float[Tensor, "N n"], cells: Int[Tensor, "T corners"]
) -> Float[Tensor, "T e"]:
    """Lengths of the edges of each cell, in the order of `subsets`, ℓ."""
    ends = points[cells[:, [list(pair) for pair in subsets(cells.shape[1] - 1, 2)]]]
    return (ends[:, :, 1] - ends[:, :, 0]).norm(dim=2)


def _renumbered(matrix: Any, columns: Int[Tensor, " C"], count: int) -> sparse.csr_array:
    parts = matrix.data, columns.numpy()[matrix.indices], matrix.indptr
    return sparse.csr_array(parts, shape=(matrix.shape[0], count))


def cell_mean(values: Float[Tensor, "T Q ..."], element: Element) -> Float[Tensor, "T ..."]:
    """Mean over each cell of values at its Gauss points."""
    return torch.einsum("q,tq...->t...", element.weights / element.weights.sum(), values)


def _along(linear: Linear, x: Tensor) -> Tensor:
    """A linear map of functions (N, C) applied to x, (N, …)."""
    return linear(x.reshape(len(x), -1)).view(-1, *x.shape[1:])


class _Times(torch.autograd.Function):
    """Product of a scipy matrix, a constant, with functions (N, C), differentiable once in these."""

    @staticmethod
    def forward(ctx: Any, matrix: Any, x: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.matrix = matrix
        return torch.from_numpy(np.asarray(matrix @ x.detach().numpy()))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return None, torch.from_numpy(np.asarray(ctx.matrix.T @ g.numpy()))


times: Any = _Times.apply
