"""The weak pair: K = PᵀK_FE P and M = PᵀM_FE P, and the positive mass (`method.md`, section 9)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor
from torch.nn.functional import pad

from torchlb.errors import first_few, warn
from torchlb.galerkin.assembly import (
    Elements,
    area_element,
    entries_of,
    metric,
    squares,
    summed,
    upper_congruence,
)
from torchlb.galerkin.boundary import boundary_nodes
from torchlb.galerkin.coarse import boundary_shares
from torchlb.galerkin.curving import CurvedMesh, CurvingPlan, curve
from torchlb.galerkin.delaunay import sound_lengths
from torchlb.galerkin.device import congruence, summed_entries, without_row_sums
from torchlb.galerkin.elements import edge_lengths, simplex
from torchlb.galerkin.forms import BilinearForm, Forms
from torchlb.galerkin.matrices import PairMatrices
from torchlb.galerkin.medium import Medium
from torchlb.galerkin.nodes import lagrange_nodes
from torchlb.galerkin.prolongation import Prolongation
from torchlb.geometry.local_fits import FitPlan, LocalFits
from torchlb.geometry.numbering import Numbering
from torchlb.linalg.csr import Csr
from torchlb.linalg.precision import LOW
from torchlb.linalg.sparse import to_scipy


@dataclass(frozen=True)
class Pattern:
    """Map from a computed upper triangle, (indptr, indices), to the full CSR pattern in the user's numbers.

    `order` has the index of every entry in the triangle, `diagonal` the indices of the diagonal entries.
    """

    crow: Int[Tensor, " N_plus_1"]
    col: Int[Tensor, " nnz"]
    order: Int[np.ndarray, " nnz"]
    diagonal: Int[np.ndarray, " N"]
    indptr: Int[np.ndarray, " N_plus_1"]
    indices: Int[np.ndarray, " upper"]

    @classmethod
    def of(cls, upper: Any, given: Int[Tensor, " N"]) -> Pattern:
        """Full pattern of an upper triangle, whose rows have the user's numbers `given`."""
        count, number = upper.shape[0], given.numpy().astype(np.int32)
        row, col = number.repeat(np.diff(upper.indptr)), number[upper.indices]
        beyond = np.flatnonzero(row != col).astype(np.int32)
        places = np.concatenate([np.arange(upper.nnz, dtype=np.int32), beyond])
        where = np.concatenate([row, col[beyond]]), np.concatenate([col, row[beyond]])
        whole: Any = sparse.csr_array((places, where), shape=upper.shape)
        del places, where, beyond
        row = np.arange(count, dtype=np.int32).repeat(np.diff(whole.indptr))
        diagonal = np.flatnonzero(row == whole.indices)
        crow, col = (torch.from_numpy(part).long() for part in (whole.indptr, whole.indices))
        return cls(crow, col, whole.data, diagonal, upper.indptr, upper.indices)

    def is_of(self, upper: Any) -> bool:
        """Whether this is the pattern of `upper`: products drop entries that are zero at some points only."""
        ours, theirs = (self.indptr, self.indices), (upper.indptr, upper.indices)
        return all(np.array_equal(x, y) for x, y in zip(ours, theirs, strict=True))

    def whole(self, upper: Float[np.ndarray, " upper"], out: Any = None) -> np.ndarray:
        """The values of the full matrix, (nnz,), from those of the upper triangle."""
        return upper.copy().take(self.order, out=out, mode="clip")  # this mode is not buffered

    def pair(self, upper: Any) -> Csr:
        """Unpack K + iM into real matrices, rows of K summing to zero."""
        values = np.empty((2, len(self.order)))
        for part, full in zip((upper.data.real, upper.data.imag), values, strict=True):
            self.whole(part, out=full)
        values[0, self.diagonal] -= np.add.reduceat(values[0], self.crow.numpy()[:-1])
        return Csr(self.crow, self.col, torch.from_numpy(values))


ELEMENTS = {1: (2, (2,)), 2: (2, (2,)), 3: (2, (3, 2)), 4: (3, (4, 2)), 5: (4, (6, 4, 2))}
"""Degree r of the elements and degrees m of the fits of functions, best first, for each order p; p > 5 as p = 5."""


@dataclass(frozen=True)
class PairPlan:
    """Plan of the weak pair of a complex of d-simplices.

    Simplices of local `stars` are weighted by 1/(d + 1); `shares` are the fractions of the cells that are integrated,
    None for all; rows of P at the nodes `lowered`, which are no vertices, are linear for the lumped mass.
    """

    fits: FitPlan
    curving: CurvingPlan
    stars: Int[Tensor, "S corners"]
    shares: Float[Tensor, " F"] | None
    lowered: Int[Tensor, " L"]

    def __getstate__(self) -> dict[str, Any]:
        """State for files, without the patterns."""
        return {name: part for name, part in vars(self).items() if name != "patterns"}

    @cached_property
    def patterns(self) -> dict[str, Pattern]:
        """Patterns of the matrices evaluated so far, "whole" and "linear"."""
        return {}

    def forms(
        self, fits: LocalFits, mesh: CurvedMesh | None = None, *, prolong: bool = True
    ) -> Forms:
        """Elements of curved cells, of the cover that replaces coarse triangles, and of local stars.

        They are from the fits at given points; `mesh` has the curved cells there, if they are known already. A simplex
        belongs to the stars of all its corners, each of which counts an equal share of it.
        """
        mesh = self.curving.at(self.fits, fits) if mesh is None else mesh
        plan, shares, stars, count = self.curving, self.shares, self.stars, len(fits.points)
        nodes, own = plan.nodes, ~plan.coarse
        mix: Any = sparse.eye_array(len(own), format="csr")
        parts, flats = (nodes.cells, mesh.lengths, nodes.elements, mesh.metric), []
        if mesh.cover is not None:
            cover, beside = mesh.cover, {"share": 0.5, "lumped": torch.ones(count).double()}
            beside["mix"] = cover.mixed() @ mix[plan.coarse.cpu().numpy()]
            flats.append(Elements.flat(cover.faces, cover.lengths, **beside))
            parts, mix = (x[own] for x in parts), mix[own.cpu().numpy()]
            shares = None if shares is None else shares[own]
        if len(stars):
            lengths = sound_lengths(edge_lengths(fits.points, stars), stars)
            flats.append(Elements.flat(stars, lengths, share=1 / stars.shape[1]))
        share = 1.0 if shares is None else shares
        cells, lengths, elements, metric = parts
        bent = Elements(elements, metric, simplex(nodes.dim, nodes.degree), share, mix)
        linear = Elements.flat(cells, lengths, share=share)
        p = Prolongation(self.fits, fits, plan, mesh)
        matrix = p.matrix() if prolong else None
        return Forms(torch.arange(count), mesh.places, matrix, [bent, *flats], linear, p)

    def at(
        self, fits: LocalFits, numbering: Numbering, warned: set[Any]
    ) -> tuple[PairPlan, PairMatrices, Float[Tensor, " N"]]:
        """Weak pair and lumped mass from the fits at given points, in the user's numbers and in those of the plan.

        The plan returned with them also has the rows of P that a positive lumped mass wants lowered at these points.
        Warns once for a line of a program, in `warned`, of nodes that are flat since the points moved too far.
        """
        mesh = self.curving.at(self.fits, fits)
        if len(mesh.astray):
            warn(
                f"at: {len(mesh.astray)} points ({first_few(mesh.astray)}) moved too far from where degrees and "
                "neighbours were decided: the surface fitted there leaves the triangles, which are flat there instead; "
                "build the operator of these points anew",
                once=warned,
            )
        pair, mass, lowered = self.assembled(fits, mesh, numbering)
        plan = self if len(lowered) == len(self.lowered) else replace(self, lowered=lowered)
        return plan, pair, mass

    def bilinear(
        self,
        fits: LocalFits,
        forms: Sequence[BilinearForm],
        medium: Medium,
        for_fields: Callable[[Forms], Forms] = lambda elements: elements,
    ) -> Float[Tensor, ""]:
        """Σ of bilinear forms, differentiable in the points of the fits and in the medium: no matrix is made.

        "lumped" is "mass" with the rows of P that the mass of the vertices is found by: with w = 1 it is Σ_i m_i u_i.
        `for_fields` gives the elements of forms `along` components of tangent fields.
        """
        mesh = self.curving.at(self.fits, fits)
        elements = self.forms(fits, mesh, prolong=False)
        p = Prolongation(self.fits, fits, self.curving, mesh)
        needed = {bool(form.along) for form in forms}
        kinds = {along: for_fields(elements) if along else elements for along in needed}
        jumps = elements.jumps(medium)
        here = p if jumps is None else p.one_sided(jumps)
        values = {along: own.factors(medium, along, here.times) for along, own in kinds.items()}
        flat = self.curving.bent.index_fill(0, self.lowered, False)
        lower = p._replace(curving=replace(self.curving, bent=flat))
        total = []
        for lumped, prolong in ((False, here), (True, lower)):
            chosen = [form for form in forms if (form.name == "lumped") == lumped]
            functions = {id(f): f for form in chosen for f in (form.w, form.u)}
            if not chosen:
                continue
            widths = [f.shape[1] for f in functions.values()]
            every = torch.cat(list(functions.values()), 1)
            at_nodes = prolong.times(every).split(widths, 1)
            nodes = dict(zip(functions, at_nodes, strict=True))
            for form in chosen:
                both, along = [nodes[id(form.w)], nodes[id(form.u)]], bool(form.along)
                if form.name == "boundary":
                    total.append(self._on_boundary(form, both, mesh))
                else:
                    total.append(kinds[along].form(form, both, values[along]))
        return torch.stack(total).sum()

    def _on_boundary(self, form: BilinearForm, nodes: list[Tensor], mesh: CurvedMesh) -> Tensor:
        """The value of a form of the boundary mass, as `boundary_mass` has it."""
        rim, shares = boundary_elements(self.curving, mesh)
        total = rim.weighted_products(rim.outer(nodes, form.c)).sum()
        return total + (shares[:, None] * form.w * form.u * form.c).sum()

    def assembled(
        self, fits: LocalFits, mesh: CurvedMesh, numbering: Numbering | None
    ) -> tuple[PairMatrices, Float[Tensor, " N"], Int[Tensor, " L"]]:
        """The matrices in the user's numbers, and the lumped mass with the rows of P lowered for it."""
        if fits.points.device.type != "cpu":
            assert numbering is not None
            return self._assembled_on_device(fits, mesh, numbering)
        forms = self.forms(fits, mesh)
        p, count = forms.prolongation, len(fits.points)
        given = torch.arange(count) if numbering is None else numbering.given
        boundary = boundary_mass(self.curving, mesh, p)
        lots = forms.lots[0], forms.linear, *forms.lots[1:]
        own, linear, *flats = (lot.matrices() for lot in lots)
        del forms, lots, mesh  # some of these are as large as the pair
        fits.let_go()
        weights = own.row_sums(p.shape[0]).numpy()
        mass, lowered = positive_mass(p, weights, self, linear.row_sums(count).numpy())
        mass += sum(lot.row_sums(count).numpy() for lot in flats)
        same: Any = sparse.eye_array(count, format="csr")
        near, upper = upper_congruence(same, [linear, *flats]), upper_congruence(p, [own, *flats])
        del p, own, linear, flats
        found = {}
        for name, matrix in {"linear": near, "whole": upper}.items():
            if name not in self.patterns or not self.patterns[name].is_of(matrix):
                self.patterns[name] = Pattern.of(matrix, given)
            found[name] = self.patterns[name].pair(matrix)
        whole = found["whole"].beside([] if boundary is None else [boundary], given.numpy())
        matrices = PairMatrices(whole.crow, whole.col, whole.values, found["linear"])
        return matrices, torch.from_numpy(mass), lowered

    def _assembled_on_device(
        self, fits: LocalFits, mesh: CurvedMesh, numbering: Numbering
    ) -> tuple[PairMatrices, Float[Tensor, " N"], Int[Tensor, " L"]]:
        """As `assembled`, on the device of the points; the few rows of P to be lowered are found on the CPU."""
        forms, shape = self.forms(fits, mesh, prolong=False), (len(mesh.places), len(fits.points))
        row, length, col, value = Prolongation(self.fits, fits, self.curving, mesh).entries()
        parts = [(row.repeat_interleave(length), col.long(), value[:, None])]
        crow, col, value = summed_entries(parts, shape)
        size, count = shape
        lots = forms.lots[0], forms.linear, *forms.lots[1:]
        own, linear, *flats = (lot.matrices() for lot in lots)
        sums = own.row_sums(size), linear.row_sums(count)
        weights, least = (x.cpu().numpy() for x in sums)
        mass, lowered = positive_mass(to_scipy(crow, col, value[:, 0], shape), weights, self, least)
        mass = torch.from_numpy(mass).to(value) + sum(lot.row_sums(count) for lot in flats)
        given, every = numbering.given, torch.arange(count)
        parts = [entries_of(nodes, torch.view_as_real(blocks)) for nodes, blocks in (own, *flats)]
        if len(self.curving.nodes.boundary()[0]):
            rim, shares = boundary_elements(self.curving, mesh)
            blocks = (rim.element.weights * area_element(rim.metric)) @ squares(rim.element)
            parts = [(row, col, pad(values, (0, 1))) for row, col, values in parts]
            parts += [entries_of(rim.nodes, pad(blocks[..., None], (2, 0)))]
            parts += [(every, every, pad(shares[:, None], (2, 0)))]
        row = torch.arange(size).repeat_interleave(crow.diff())
        p = summed_entries([(row, given[col], value)], shape)
        whole = without_row_sums(congruence(p, summed_entries(parts, (size, size)), count))
        parts = [entries_of(given[n], torch.view_as_real(blocks)) for n, blocks in (linear, *flats)]
        near = without_row_sums(summed_entries(parts, (count, count)))
        matrices = PairMatrices(whole.crow, whole.col, whole.values, near)
        return matrices, mass, lowered.to(given)

    @property
    def counts(self) -> Int[Tensor, "4 N"]:
        """Per vertex: degree of its fit (0 if flat), why no higher (index into `REASONS`), edges, curved edges."""
        fits, edges = self.fits, self.curving.nodes.edges
        ends = edges, edges[self.curving.curved]
        uses = [torch.bincount(e.flatten(), minlength=len(fits.degree)) for e in ends]
        return torch.stack(
            [torch.where(fits.degree > 0, fits.surface_degree, 0), fits.reason, *uses]
        )


def mesh_pair(
    cells: Int[Tensor, "F corners"],
    fit_plan: FitPlan,
    fits: LocalFits,
    degree: int,
    degrees: tuple[int, ...],
    stars: Int[Tensor, "S corners"] | None = None,
    held: Bool[Tensor, " N"] | None = None,
    shares: Float[Tensor, " F"] | None = None,
    numbering: Numbering | None = None,
) -> tuple[PairPlan, PairMatrices, Float[Tensor, " N"]]:
    """Plan, weak pair and lumped mass of a mesh of d-simplices, from fits at its vertices, by elements of degree ≥ 2.

    K and M are symmetric, K1 = 0, K ≥ 0 and M > 0 whatever the fits are, since the rows of P sum to one and P has full
    column rank. `degrees` lists the degrees of the fits of functions, best first; `held` marks vertices with a
    Dirichlet condition. Cells with `shares` may overlap, and have no boundary.
    """
    nodes = lagrange_nodes(cells, len(fits.points), degree, closed=shares is not None)
    boundary = boundary_nodes(fits.points, nodes, degrees, held)
    curving, *mesh = curve(fit_plan, fits, boundary, held)
    stars = cells[:0] if stars is None else stars
    plan = PairPlan(fit_plan, curving, stars, shares, torch.zeros(0, dtype=torch.int64))
    found = plan.assembled(fits, mesh.pop(), numbering)  # keeps no reference
    return replace(plan, lowered=found[2]), *found[:2]


def positive_mass(
    p: Any, weights: Float[np.ndarray, " NX"], plan: PairPlan, linear: Float[np.ndarray, " N"]
) -> tuple[Float[np.ndarray, " N"], Int[Tensor, " L"]]:
    """Lumped mass Pᵀw, w = M_FE 1: quadrature weights of high order at the vertices, which sum to the area.

    While a weight is below a tenth of that of P1 elements, the rows of P that contribute negatively to it are replaced
    by linear ones; this terminates, since linear rows contribute nothing negative. Return also the nodes of these rows.
    """
    nodes, count, mass = plan.curving.nodes, p.shape[1], p.T @ weights
    taking, lowered = count + plan.lowered.cpu().numpy(), np.zeros(p.shape[0], dtype=bool)
    left: Any = None
    while True:
        lowered[taking] = True
        shares = nodes.shares.cpu().numpy()[taking - count] * weights[taking, None]
        mass -= p[taking].T @ weights[taking]
        np.add.at(mass, nodes.corners.cpu().numpy()[taking - count], shares)
        few = np.flatnonzero(mass < LOW * linear)
        if len(few) == 0:
            break
        left = sparse.csr_array(p.T) if left is None else left
        low = left[few]
        takes = (weights[low.indices] * low.data < 0) & (low.indices >= count)
        taking = np.unique(low.indices[takes & ~lowered[low.indices]])
        if len(taking) == 0:
            break
    return mass, torch.from_numpy(np.flatnonzero(lowered) - count)


def boundary_elements(plan: CurvingPlan, mesh: CurvedMesh) -> tuple[Elements, Float[Tensor, " N"]]:
    """Elements along the boundary, and the lumped boundary mass of the vertices at coarse triangles."""
    nodes, (cell, elements) = plan.nodes, plan.nodes.boundary()
    coarse, shape = plan.coarse[cell], simplex(nodes.dim - 1, nodes.degree)
    own, points = elements[~coarse], mesh.places[: nodes.count]
    shares = torch.zeros_like(points[:, 0])
    if mesh.cover is not None:
        shares = boundary_shares(points, elements[coarse, :2], mesh.cover)
    return Elements(own, metric(mesh.places, own, shape), shape), shares


def boundary_mass(
    plan: CurvingPlan, mesh: CurvedMesh, p: Any, numbering: Numbering | None = None
) -> Any:
    """Boundary mass ∫ φ_i φ_j, 1 at the end of a curve, lumped at coarse triangles; None for a closed shape.

    It is in the user's numbers, as P is, if the numbering is given.
    """
    if len(plan.nodes.boundary()[0]) == 0:
        return None
    rim, shares = boundary_elements(plan, mesh)
    nodes = rim.nodes
    if numbering is not None:
        number, _ = numbering.of_nodes(len(mesh.places))
        nodes, shares = number[nodes], numbering.restored(shares)
    blocks = (rim.element.weights * area_element(rim.metric)) @ squares(rim.element)
    result = p.T @ summed(blocks, nodes, len(mesh.places)) @ p
    return (result + result.T) / 2 + sparse.diags_array(shares.numpy(), format="csr")
