"""Stiffness and mass of a complex from its elements, in any medium, and bilinear forms of both (`method.md`, 14)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.galerkin.assembly import ElementMatrices, Elements, spread, upper_congruence
from torchlb.galerkin.elements import Element, edge_lengths
from torchlb.galerkin.medium import Field, Jumps, Medium, orthonormal
from torchlb.galerkin.prolongation import Prolongation
from torchlb.geometry.numbering import Numbering
from torchlb.geometry.vectors import Points, at
from torchlb.linalg.once import computed_again, once_differentiable

Linear = Callable[[Tensor], Tensor]
Values = list[Tensor] | None
FIELDS = {"stiffness": "conductivity", "mass": "density", "potential": "potential"}


class BilinearForm(NamedTuple):
    """Σ_k c_k w_kᵀA u_k of constant functions w, u (N, C) and numbers c (C,).

    A is K, "stiffness"; M, "mass"; ∫cwu of the potential c, "potential"; the sum of K, that, and the term of a
    condition, "energy"; the boundary mass B, "boundary"; or the mass of the vertices, "lumped". Of "stiffness" with
    components (k, l) `along`, the conductivity is multiplied by Π_kl of the projector onto the tangent plane.
    """

    name: Literal["stiffness", "mass", "potential", "energy", "boundary", "lumped"]
    w: Float[Tensor, "N C"]
    u: Float[Tensor, "N C"]
    c: Float[Tensor, " C"]
    along: tuple[int, int] | None = None


@dataclass(frozen=True)
class Forms:
    """Elements of a weak pair, which assemble it for any medium.

    The values of a field of the medium are a list: those at the Gauss points of each lot of elements. `given` has the
    vertices in an order along the shape, of which the computed triangles of matrices are; `places` the positions of the
    nodes, ℓ, the vertices first; `prolongation` is P, from the vertices to the nodes. The `lots` are the curved
    elements, then flat ones in their place or beside them; `linear` are P1 elements on the cells of the curved ones.
    `fits` are what P follows from, not in the user's numbers but in the order of the `numbering`; None for P1 elements.
    """

    given: Int[Tensor, " N"]
    places: Float[Tensor, "NX n"]
    prolongation: Any
    lots: list[Elements]
    linear: Elements
    fits: Prolongation | None = None
    numbering: Numbering | None = None

    @classmethod
    def flat(
        cls, points: Points, faces: Int[Tensor, "F corners"], mass: Float[Tensor, " N"]
    ) -> Forms:
        """Build flat P1 elements, whose stiffness for κ = 1 is the cotangent matrix, with this lumped mass."""
        ones = torch.ones_like(mass)
        own = Elements.flat(faces, edge_lengths(points, faces), lumped=ones)
        area = own.matrices().row_sums(len(points))
        mix, same = (sparse.eye_array(len(x), format="csr") for x in (faces, points))
        own = replace(own, mix=mix, lumped=mass / area)
        return cls(torch.arange(len(points)), points, same, [own], own)

    def restored(self, numbering: Numbering, order: Int[Tensor, " G"], num_faces: int) -> Forms:
        """Renumber to the user's points and `num_faces` faces; `order` has the user's numbers of the faces here."""
        given = numbering.given
        number, rows = numbering.of_nodes(len(self.places))
        lots = [
            replace(
                lot,
                nodes=number[lot.nodes],
                mix=None if lot.mix is None else _renumbered(lot.mix, order, num_faces),
                lumped=None if lot.lumped is None else numbering.restored(lot.lumped),
            )
            for lot in self.lots
        ]
        return Forms(
            given,
            self.places[rows],
            _restored(self.prolongation, numbering),
            lots,
            replace(self.linear, nodes=given[self.linear.nodes]),
            self.fits,
            numbering,
        )

    def in_medium(self, medium: Medium) -> Forms:
        """The same in the user's numbers with P by fits on one side of a jump, where solutions have a kink."""
        jumps, p, numbering = self.jumps(medium), self.fits, self.numbering
        if jumps is None or p is None or numbering is None:
            return self
        here = jumps._replace(at=numbering.sorted(jumps.at), cells=numbering.here[jumps.cells])
        p = p.one_sided(here)
        return replace(self, prolongation=_restored(p.matrix(), numbering), fits=p)

    def jumps(self, medium: Medium) -> Jumps | None:
        """Jumps of a conductivity on the faces; None without any, as in a medium at the vertices."""
        field, parts = medium.get("conductivity"), []
        if field is None or not field.on_faces:
            return None
        for lot in self.lots:
            a = _along(partial(times, lot.mix), field.values.detach())
            if a.ndim == 3:
                a = _tangential(a, orthonormal(lot.slopes(self.places)[:, 0]))
            logs = field.transforms[0](a)
            parts.append((lot.nodes[:, : lot.element.dim + 1], logs.view(len(a), -1)))
        cells, logs = (torch.cat(column) for column in zip(*parts, strict=True))
        found = Jumps.of(cells, logs, len(self.given))
        return found if bool(found.at.any()) else None

    def values(self, field: Field, prolong: Linear | None = None) -> list[Tensor]:
        """Values of a field, differentiable in it.

        From vertices the logarithm of a positive field is prolonged, which keeps it positive, and of high order where
        the fits are; a field that may be zero is prolonged as it is, and cut off at zero. `prolong` takes functions to
        the nodes where the matrix P does not.
        """
        if field.on_faces:
            own = (_along(partial(times, lot.mix), field.values) for lot in self.lots)
            return [spread(x, lot.element) for x, lot in zip(own, self.lots, strict=True)]
        before, after = field.transforms
        nodes = _along(prolong or partial(times, self.prolongation), before(field.values))
        found = []
        for lot in self.lots:
            inside = at(nodes, lot.nodes)
            own = after(torch.einsum("qn,tn...->tq...", lot.element.values, inside))
            found.append(_mean(own, lot.element, lot.element) if lot.element.is_linear else own)
        return found

    def factors(
        self, medium: Medium, along: bool, prolong: Linear | None = None
    ) -> dict[str, list[Tensor]]:
        """`values` of the fields of a medium, and, for forms `along`, the projectors Π onto the tangent plane."""
        found = {name: self.values(field, prolong) for name, field in medium.items()}
        if along:
            found["projectors"] = [frame @ frame.mT for frame in self.tangents()]
        return found

    def tangents(self) -> list[Float[Tensor, "T Q n d"]]:
        """Orthonormal tangent vectors, oriented as the cells are, at the Gauss points of each lot."""
        return [orthonormal(lot.slopes(self.places)) for lot in self.lots]

    def matrix(self, conductivity: Values = None, density: Values = None) -> sparse.csr_array:
        """Upper triangle of K + iM, as `upper` has it, positive semidefinite in every medium; K1 = 0."""
        return self.upper(self.prolongation, self._matrices(self.lots, conductivity, density))

    def near(self, conductivity: Values = None, density: Values = None) -> sparse.csr_array:
        """Upper triangle of K₁ + iM₁ of P1 elements on flat simplices, with the mean of the medium on each."""
        flat, lots = [self.linear, *self.lots[1:]], (conductivity, density)
        same: Any = sparse.eye_array(len(self.given), format="csr")
        return self.upper(same, self._matrices(flat, *(x and self.flattened(x) for x in lots)))

    def flattened(self, values: list[Tensor]) -> list[Tensor]:
        """Values on `linear` and the flat lots: means over each cell."""
        return [_mean(values[0], self.lots[0].element, self.linear.element), *values[1:]]

    def _matrices(
        self, lots: list[Elements], conductivity: Values, density: Values
    ) -> list[ElementMatrices]:
        none = [None] * len(lots)
        medium = zip(lots, conductivity or none, density or none, strict=True)
        return [lot.matrices(lot.conductivity(a, self.places), rho) for lot, a, rho in medium]

    def upper(self, p: Any, lots: Sequence[ElementMatrices]) -> sparse.csr_array:
        """Upper triangle of PᵀAP in the order of `given`; A is made of element matrices."""
        return upper_congruence(_renumbered(p, self.given.argsort(), p.shape[1]), lots)

    def bilinear(self, forms: Sequence[BilinearForm], medium: Medium) -> Float[Tensor, ""]:
        """Σ of bilinear forms, differentiable in the medium; of "lumped" and "boundary", which depend on none, 0."""
        self = self.in_medium(medium)
        values = self.factors(medium, any(form.along for form in forms))
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
        stiffness, total = form.name == "stiffness", []
        none: list[Any] = [None] * len(self.lots)
        values = medium.get(FIELDS.get(form.name, ""), none)
        projectors = medium.get("projectors", none)
        for lot, a, projector in zip(self.lots, values, projectors, strict=True):
            a = lot.conductivity(a, self.places) if stiffness else a
            blocks = lot.outer(nodes, form.c)
            if lot.lumped is not None and not stiffness:
                corners = lot.lumped[lot.nodes] * blocks[:, :: lot.nodes.shape[1] + 1]
                blocks = corners.mean(1, keepdim=True).expand_as(blocks)
            if form.along is not None and lot.turns is not None:
                one, two = (lot.turns[..., k] for k in form.along)
                blocks = blocks * (one @ two.mT).flatten(1)
            density = lot.weighted_slopes if stiffness else lot.weighted_products
            own = computed_again(density, blocks, a)
            if form.along is not None and lot.turns is None:
                own = projector[(..., *form.along)] * own
            total.append(lot.shared(own).sum())
        return torch.stack(total).sum()


def _renumbered(matrix: Any, columns: Int[Tensor, " C"], count: int) -> sparse.csr_array:
    parts = matrix.data, columns.numpy()[matrix.indices], matrix.indptr
    return sparse.csr_array(parts, shape=(matrix.shape[0], count))


def _tangential(
    a: Float[Tensor, "T n n"], tangents: Float[Tensor, "T n d"]
) -> Float[Tensor, "T n n"]:
    """Tensors with the same part along a cell, and the mean of that across it."""
    own = tangents.mT @ a @ tangents
    mean = own.diagonal(dim1=1, dim2=2).mean(1)[:, None, None]
    turn = torch.eye(own.shape[1], dtype=a.dtype)
    across = mean * torch.eye(a.shape[1], dtype=a.dtype)
    return across + tangents @ (own - mean * turn) @ tangents.mT


def _restored(p: Any, numbering: Numbering) -> sparse.csr_array:
    """P in the user's numbers of the points."""
    _, rows = numbering.of_nodes(p.shape[0])
    return _renumbered(p[rows.numpy()], numbering.given, p.shape[1])


def _mean(values: Float[Tensor, "T Q ..."], element: Element, other: Element) -> Tensor:
    """Mean over each cell of values at the Gauss points of an element, at those of the other."""
    weights = element.weights / element.weights.sum()
    return spread(torch.einsum("q,tq...->t...", weights, values), other)


def _along(linear: Linear, x: Tensor) -> Tensor:
    """A linear map of functions (N, C) applied to x, (N, …)."""
    return linear(x.reshape(len(x), -1)).view(-1, *x.shape[1:])


class _Times(torch.autograd.Function):
    """Product of a scipy matrix, a constant, with functions (N, C), differentiable once in these."""

    @staticmethod
    def forward(ctx: Any, matrix: Any, x: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.matrix = matrix
        return _product(matrix, x)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return None, _product(ctx.matrix.T, g)


def _product(matrix: Any, x: Tensor) -> Tensor:
    return torch.from_numpy(np.asarray(matrix @ x.detach().cpu().numpy())).to(x)


times: Any = _Times.apply
