"""The weak pair: K = PᵀK_FE P and M = PᵀM_FE P, and the positive mass (`method.md`, section 9)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.galerkin.assembly import area_element, assemble_mass, metric, summed
from torchlb.galerkin.boundary import boundary_nodes
from torchlb.galerkin.coarse import boundary_shares
from torchlb.galerkin.curving import CurvedMesh, CurvingPlan, curve
from torchlb.galerkin.elements import simplex
from torchlb.galerkin.forms import Forms, upper_congruence
from torchlb.galerkin.nodes import lagrange_nodes
from torchlb.galerkin.prolongation import prolonged
from torchlb.geometry.local_fits import FitPlan, LocalFits
from torchlb.geometry.numbering import Numbering
from torchlb.linalg.precision import LOW


@dataclass(frozen=True)
class SparsePair:
    """Symmetric matrices on one pattern: stiffness, without a unit on a surface, mass, ℓ², mass of the boundary, ℓ.

    Attributes
    ----------
    crow, col
        (N + 1,), (nnz,), CSR with ascending columns.
    values
        (2, nnz), of K and of M; (3, nnz) on a shape with a boundary.
    """

    crow: Int[Tensor, " N_plus_1"]
    col: Int[Tensor, " nnz"]
    values: Float[Tensor, "terms nnz"]


@dataclass(frozen=True)
class Pattern:
    """Where the entries of a symmetric matrix, of which the upper triangle was computed, are in the user's numbers.

    Attributes
    ----------
    crow, col
        As of a `SparsePair`.
    order
        (nnz,), of each entry the place in the upper triangle.
    diagonal
        (N,), places of the diagonal.
    indptr, indices
        (N + 1,), (upper,), of that triangle as it was computed.
    given
        (N,), the user's numbers of the rows there.
    """

    crow: Int[Tensor, " N_plus_1"]
    col: Int[Tensor, " nnz"]
    order: Int[np.ndarray, " nnz"]
    diagonal: Int[np.ndarray, " N"]
    indptr: Int[np.ndarray, " N_plus_1"]
    indices: Int[np.ndarray, " upper"]
    given: Int[np.ndarray, " N"]

    @classmethod
    def of(cls, upper: Any, numbering: Numbering | None = None) -> Pattern:
        """That of a matrix from its upper triangle; without a numbering it is in the user's numbers."""
        count = upper.shape[0]
        given = np.arange(count) if numbering is None else numbering.given.numpy()
        given = given.astype(np.int32)
        row, col = given.repeat(np.diff(upper.indptr)), given[upper.indices]
        beyond = np.flatnonzero(row != col).astype(np.int32)
        places = np.concatenate([np.arange(upper.nnz, dtype=np.int32), beyond])
        where = np.concatenate([row, col[beyond]]), np.concatenate([col, row[beyond]])
        whole: Any = sparse.csr_array((places, where), shape=upper.shape)
        del places, where, beyond
        row = np.arange(count, dtype=np.int32).repeat(np.diff(whole.indptr))
        diagonal = np.flatnonzero(row == whole.indices)
        crow, col = (torch.from_numpy(part).long() for part in (whole.indptr, whole.indices))
        return cls(crow, col, whole.data, diagonal, upper.indptr, upper.indices, given)

    def is_of(self, upper: Any) -> bool:
        """Whether it is that of a triangle: products leave out what is zero at some points, but not at others."""
        ours, theirs = (self.indptr, self.indices), (upper.indptr, upper.indices)
        return all(np.array_equal(x, y) for x, y in zip(ours, theirs, strict=True))

    def pair(self, upper: Any, *others: Any) -> SparsePair:
        """K + iM as real matrices, the rows of K summing to zero; beside them others, such as the boundary's mass."""
        values = np.empty((2, len(self.order)))
        for value, part in zip(values, (upper.data.real, upper.data.imag), strict=True):
            np.take(part.copy(), self.order, out=value, mode="clip")  # which is not buffered
        values[0, self.diagonal] -= np.add.reduceat(values[0], self.crow.numpy()[:-1])
        for other in others:
            line: Any = sparse.coo_array((other + other.T) / 2)
            first, second = (self.given[place].astype(np.int64) for place in line.coords)
            count, crow = len(self.given), self.crow.numpy()
            places = np.arange(count).repeat(np.diff(crow)) * count + self.col.numpy()
            extra = np.zeros((1, len(places)))
            extra[0, np.searchsorted(places, first * count + second)] = line.data
            values = np.concatenate([values, extra])
        return SparsePair(self.crow, self.col, torch.from_numpy(values))


@dataclass(frozen=True)
class WeakPair:
    """(K, M), and the pair of linear elements that is near it, None where it is the same.

    Attributes
    ----------
    matrices, linear
        The pairs.
    mass
        (N,), ℓ^d, positive, sums to the area; None for that of the operator's shape.
    """

    matrices: SparsePair
    linear: SparsePair | None = None
    mass: Float[Tensor, " N"] | None = None


ELEMENTS = {1: (2, (2,)), 2: (2, (2,)), 3: (2, (3, 2)), 4: (3, (4, 2)), 5: (4, (6, 4, 2))}
"""Degree r of the elements, and degrees m of the fits of functions, best first, by the order p; above 5 as for 5."""


class BilinearForm(NamedTuple):
    """Σ_k c_k w_kᵀA u_k of constant functions w, u (N, C) and numbers c (C,), A by its name."""

    name: Literal["stiffness", "mass", "lumped"]
    w: Float[Tensor, "N C"]
    u: Float[Tensor, "N C"]
    c: Float[Tensor, " C"]


@dataclass(frozen=True)
class PairPlan:
    """What is decided about the weak pair of a complex of d-simplices.

    Attributes
    ----------
    fits, curving
        Of functions and of the surface at the vertices; of the cells.
    stars
        (S, d + 1), simplices of local stars, of which an equal share counts.
    shares
        (F,), which part of each cell counts; None where all of them do.
    lowered
        (L,), nodes beyond the vertices whose rows of P are linear where the mass of the vertices is found.
    """

    fits: FitPlan
    curving: CurvingPlan
    stars: Int[Tensor, "S corners"]
    shares: Float[Tensor, " F"] | None
    lowered: Int[Tensor, " L"]

    @cached_property
    def patterns(self) -> dict[str, Pattern]:
        """Those of the matrices, by their names in `WeakPair`, once they have been evaluated."""
        return {}

    def forms(self, fits: LocalFits, mesh: CurvedMesh | None = None) -> Forms:
        """The elements from the fits at given points; `mesh` is where the cells are there, if it is known."""
        mesh = self.curving.at(fits.points, self.fits, fits) if mesh is None else mesh
        return Forms.curved(self.fits, fits, self.curving, mesh, self.stars, self.shares)

    def at(self, fits: LocalFits, numbering: Numbering) -> WeakPair:
        """The pair from the fits at given points, its matrices in the user's numbers."""
        mesh = self.curving.at(fits.points, self.fits, fits)
        return assembled_pair(self, fits, mesh, numbering, self.patterns)[0]

    def bilinear(self, fits: LocalFits, forms: Sequence[BilinearForm]) -> Float[Tensor, ""]:
        """Σ of bilinear forms, differentiable in the points of the fits: no matrix is made.

        "lumped" is "mass" with the rows of P that the mass of the vertices is found by: with w = 1 it is Σ_i m_i u_i.
        """
        mesh = self.curving.at(fits.points, self.fits, fits)
        rest = self.stars, self.shares
        elements = Forms.curved(self.fits, fits, self.curving, mesh, *rest, prolong=False)
        flat = self.curving.bent.index_fill(0, self.lowered, False)
        total = []
        for lumped, curving in ((False, self.curving), (True, replace(self.curving, bent=flat))):
            chosen = [form for form in forms if (form.name == "lumped") == lumped]
            functions = {id(f): f for form in chosen for f in (form.w, form.u)}
            if functions:
                widths = [f.shape[1] for f in functions.values()]
                every = torch.cat(list(functions.values()), 1)
                at_nodes = prolonged(self.fits, fits, curving, mesh, every).split(widths, 1)
                nodes = dict(zip(functions, at_nodes, strict=True))
                for form in chosen:
                    both = [nodes[id(form.w)], nodes[id(form.u)]]
                    total.append(elements.form(form.name, both, [form.w, form.u], form.c))
        return torch.stack(total).sum()

    @property
    def counts(self) -> Int[Tensor, "4 N"]:
        """Of each vertex: degree of its fit, 0 if flat; why no higher, a place in `REASONS`; edges; curved edges."""
        fits, edges = self.fits, self.curving.nodes.edges
        ends = edges, edges[self.curving.curved]
        uses = [torch.bincount(e.flatten(), minlength=len(fits.degree)) for e in ends]
        return torch.stack(
            [torch.where(fits.degree > 0, fits.surface_degree, 0), fits.reason, *uses]
        )


def mesh_pair(
    points: Float[Tensor, "N n"],
    cells: Int[Tensor, "F corners"],
    fit_plan: FitPlan,
    fits: LocalFits,
    degree: int,
    degrees: tuple[int, ...],
    stars: Int[Tensor, "S corners"] | None = None,
    held: Bool[Tensor, " N"] | None = None,
    shares: Float[Tensor, " F"] | None = None,
    numbering: Numbering | None = None,
) -> tuple[PairPlan, WeakPair]:
    """The pair of a mesh of d-simplices, from the fits of its vertices, with elements of degree r ≥ 2.

    Symmetric, K1 = 0, K ≥ 0, M > 0 whatever the fits are: rows of P sum to one, and it has full column rank. `degrees`
    are those of the fits of functions, best first; `held` marks where a Dirichlet condition holds. Cells of which only
    `shares` count may overlap, and have no boundary.
    """
    nodes = lagrange_nodes(cells, len(points), degree, closed=shares is not None)
    boundary = boundary_nodes(points, nodes, degrees, held)
    curving, *mesh = curve(points, fit_plan, fits, nodes, boundary, held)
    stars = cells[:0] if stars is None else stars
    plan = PairPlan(fit_plan, curving, stars, shares, torch.zeros(0, dtype=torch.int64))
    pair, lowered = assembled_pair(plan, fits, mesh.pop(), numbering, {})  # which lets go of it
    return replace(plan, lowered=lowered), pair


def assembled_pair(
    plan: PairPlan,
    fits: LocalFits,
    mesh: CurvedMesh,
    numbering: Numbering | None,
    patterns: dict[str, Pattern],
) -> tuple[WeakPair, Int[Tensor, " L"]]:
    """The matrices in the user's numbers, the mass, and the rows of P that were lowered for it.

    Patterns that are not known yet are found and kept.
    """
    forms = plan.forms(fits, mesh)
    near, flat, p = forms.near(), forms.flat(), forms.prolongation
    boundary = boundary_mass(fits.points, plan.curving, mesh, p)
    blocks, nodes = [forms.blocks()], forms.nodes
    del forms, mesh  # some of what is here is as large as the pair, and is let go of in time
    fits.let_go()
    elements = summed(blocks.pop(), nodes, p.shape[0])
    weights, beside = elements.imag.sum(axis=1), _row_sums(flat)
    mass, lowered = positive_mass(p, weights, plan, _row_sums(near) - beside)
    upper = upper_congruence(p, elements)
    upper = upper + flat if flat.nnz else upper  # without a copy
    del p, elements
    found = {}
    for name, matrix in {"linear": near, "matrices": upper}.items():
        if name not in patterns or not patterns[name].is_of(matrix):
            patterns[name] = Pattern.of(matrix, numbering)
        more = () if boundary is None or matrix is near else (boundary,)
        found[name] = patterns[name].pair(matrix, *more)
    return WeakPair(**found, mass=torch.from_numpy(mass + beside)), lowered


def positive_mass(
    p: Any,
    weights: Float[np.ndarray, " NX"],
    plan: PairPlan,
    linear: Float[np.ndarray, " N"],
) -> tuple[Float[np.ndarray, " N"], Int[Tensor, " L"]]:
    """Pᵀw, w = M_FE 1: weights of the vertices that integrate to high order and sum to the area.

    Where one is below a tenth of that of linear elements, the rows of P that take from it are replaced by linear ones,
    until none is; that ends, since linear rows take nothing from anybody. Also which rows these are, beyond the
    vertices.
    """
    nodes, count, mass = plan.curving.nodes, p.shape[1], p.T @ weights
    taking, lowered = count + plan.lowered.numpy(), np.zeros(p.shape[0], dtype=bool)
    left: Any = None
    while True:
        lowered[taking] = True
        shares = nodes.shares.numpy()[taking - count] * weights[taking, None]
        mass -= p[taking].T @ weights[taking]
        np.add.at(mass, nodes.corners.numpy()[taking - count], shares)
        few = np.flatnonzero(mass < LOW * linear)
        if len(few) == 0 or len(plan.lowered):
            break
        left = sparse.csr_array(p.T) if left is None else left
        low = left[few]
        takes = (weights[low.indices] * low.data < 0) & (low.indices >= count)
        taking = np.unique(low.indices[takes & ~lowered[low.indices]])
        if len(taking) == 0:
            break
    return mass, torch.from_numpy(np.flatnonzero(lowered) - count)


def _row_sums(upper: Any) -> Float[np.ndarray, " N"]:
    """M1, from the upper triangle of K + iM."""
    mass = upper.imag
    return mass.sum(axis=1) + mass.sum(axis=0) - mass.diagonal()


def boundary_mass(points: Tensor, plan: CurvingPlan, mesh: CurvedMesh, p: Any) -> Any:
    """∫ φ_i φ_j along the boundary, 1 at the end of a curve, lumped at coarse triangles; None for a closed shape."""
    nodes, shape = plan.nodes, simplex(plan.nodes.dim - 1, plan.nodes.degree)
    cell, elements = nodes.boundary()
    if len(cell) == 0:
        return None
    coarse = plan.coarse[cell]
    size = area_element(metric(mesh.places, elements[~coarse], shape))
    result = p.T @ (assemble_mass(size, elements[~coarse], shape, len(mesh.places)) @ p)
    if mesh.cover is not None:
        shares = boundary_shares(points, elements[coarse, :2], mesh.cover)
        result = result + sparse.diags_array(shares.numpy(), format="csr")
    return result
