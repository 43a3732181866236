"""The weak pair: K = PᵀK_FE P and M = PᵀM_FE P, and the positive mass (`method.md`, section 9)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.galerkin.assembly import area_element, assemble_mass, metric
from torchlb.galerkin.boundary import boundary_nodes
from torchlb.galerkin.coarse import boundary_shares
from torchlb.galerkin.curving import CurvedMesh, CurvingPlan, curve
from torchlb.galerkin.elements import simplex
from torchlb.galerkin.forms import Forms, congruence
from torchlb.galerkin.nodes import lagrange_nodes
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

    def restored(self, numbering: Numbering) -> SparsePair:
        """With the user's numbers."""
        crow, col, entry = numbering.restored_pattern(self.crow, self.col)
        return SparsePair(crow, col, self.values[:, entry])


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

    @property
    def buffers(self) -> dict[str, Tensor]:
        """The matrices by their names in an operator."""
        found = {f"weak_{name}": t for name, t in vars(self.matrices).items()}
        if self.linear is not None:
            found |= {f"linear_{name}": t for name, t in vars(self.linear).items()}
        return found

    def restored(self, numbering: Numbering) -> WeakPair:
        """With the user's numbers."""
        linear = None if self.linear is None else self.linear.restored(numbering)
        return WeakPair(self.matrices.restored(numbering), linear, self.mass)


ELEMENTS = {1: (2, (2,)), 2: (2, (2,)), 3: (2, (3, 2)), 4: (3, (4, 2)), 5: (4, (6, 4, 2))}
"""Degree r of the elements, and degrees m of the fits of functions, best first, by the order p; above 5 as for 5."""


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

    def forms(self, points: Float[Tensor, "N n"], fits: LocalFits) -> tuple[Forms, CurvedMesh]:
        """The elements at these points, from the fits there, and where their nodes stand."""
        mesh = self.curving.at(points, self.fits, fits)
        rest = self.stars, self.shares
        return Forms.curved(self.fits, fits, self.curving, mesh, *rest), mesh

    def at(self, points: Float[Tensor, "N n"], fits: LocalFits) -> WeakPair:
        """The pair at these points, from the fits there."""
        return assembled_pair(self, *self.forms(points, fits), points)[0]

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
) -> tuple[PairPlan, WeakPair]:
    """The pair of a mesh of d-simplices, from the fits of its vertices, with elements of degree r ≥ 2.

    Symmetric, K1 = 0, K ≥ 0, M > 0 whatever the fits are: rows of P sum to one, and it has full column rank. `degrees`
    are those of the fits of functions, best first; `held` marks where a Dirichlet condition holds. Cells of which only
    `shares` count may overlap, and have no boundary.
    """
    nodes = lagrange_nodes(cells, len(points), degree, closed=shares is not None)
    boundary = boundary_nodes(points, nodes, degrees, held)
    curving, mesh = curve(points, fit_plan, fits, nodes, boundary, held)
    stars = cells[:0] if stars is None else stars
    plan = PairPlan(fit_plan, curving, stars, shares, torch.zeros(0, dtype=torch.int64))
    forms = Forms.curved(fit_plan, fits, curving, mesh, stars, shares)
    pair, lowered = assembled_pair(plan, forms, mesh, points)
    return replace(plan, lowered=lowered), pair


def assembled_pair(
    plan: PairPlan, forms: Forms, mesh: CurvedMesh, points: Float[Tensor, "N n"]
) -> tuple[WeakPair, Int[Tensor, " L"]]:
    """The matrices and the mass, and the rows of P that were lowered for it."""
    elements, near, flat = forms.elements(), forms.near(), _row_sums(forms.flat())
    p, weights = forms.prolongation, _row_sums(elements)
    mass, lowered = positive_mass(p, weights, plan, _row_sums(near) - flat)
    rim = boundary_mass(points, plan.curving, mesh, p)
    linear = stored(near)
    del near
    pair = stored(congruence(p, elements) + forms.flat(), rim)
    return WeakPair(pair, linear, torch.from_numpy(mass + flat)), lowered


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


def _row_sums(pair: Any) -> Float[np.ndarray, " N"]:
    """M1."""
    sums: Any = pair.sum(axis=1)
    return sums.imag.copy()


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


def stored(matrix: Any, rim: Any = None) -> SparsePair:
    """K + iM, exactly symmetric and with rows of K that sum to zero, as real matrices; `rim` is the boundary's mass."""
    matrix = sparse.csr_array(matrix)
    matrix.sort_indices()
    other: Any = sparse.csr_array(matrix.T)
    count, crow, col = matrix.shape[0], matrix.indptr.astype(np.int64), matrix.indices
    data = other.data
    data += matrix.data
    data /= 2
    del matrix, other  # the largest of a build
    values = np.stack([data.real, data.imag])
    del data
    row = np.arange(count, dtype=col.dtype).repeat(np.diff(crow))
    values[0, row == col] -= np.add.reduceat(values[0], crow[:-1])
    found = torch.from_numpy(values)
    if rim is not None:
        line: Any = sparse.coo_array((rim + rim.T) / 2)
        extra = np.zeros_like(values[:1])
        wanted = line.coords[0].astype(np.int64) * count + line.coords[1]
        extra[0, np.searchsorted(row.astype(np.int64) * count + col, wanted)] = line.data
        found = torch.cat([found, torch.from_numpy(extra)])
    return SparsePair(torch.from_numpy(crow), torch.from_numpy(col).long(), found)
