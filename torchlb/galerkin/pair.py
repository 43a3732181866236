"""The weak pair of a mesh: K = PᵀK_FE P and M = PᵀM_FE P, and the positive mass (`method.md`, section 9)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor

from torchlb import compiled
from torchlb.galerkin.assembly import (
    area_element,
    assemble_mass,
    element_matrices,
    flat_metric,
    metric,
    summed,
)
from torchlb.galerkin.boundary import boundary_nodes
from torchlb.galerkin.coarse import boundary_shares
from torchlb.galerkin.curving import CurvedMesh, curve, mollified
from torchlb.galerkin.elements import simplex, subsets
from torchlb.galerkin.nodes import lagrange_nodes
from torchlb.galerkin.prolongation import prolongation
from torchlb.geometry.numbering import Numbering
from torchlb.geometry.vertex_fits import VertexFits

ROWS = 2**13
"""Rows of a product at a time."""
ROOM = 2**20
"""Entries of a product at a time, where it is compiled."""
SMALLEST = 0.1
"""Share of its linear mass that the mass of a vertex has at least."""


@dataclass(frozen=True)
class SparsePair:
    """Symmetric matrices on one pattern: stiffness, without a unit on a surface, mass, ℓ², mass of the boundary, ℓ.

    Attributes
    ----------
    crow, col : (N + 1,), (nnz,), CSR with ascending columns.
    values : (2, nnz), of K and of M; (3, nnz) on a shape with a boundary.
    """

    crow: Int[Tensor, " N_plus_1"]
    col: Int[Tensor, " nnz"]
    values: Float[Tensor, "terms nnz"]


@dataclass(frozen=True)
class WeakPair:
    """(K, M), and the pair of linear elements that is near it, None where it is the same.

    Attributes
    ----------
    matrices, linear : the pairs.
    mass : (N,), ℓ², positive, sums to the area; None for that of the operator's shape.
    fits : (4, N) of each vertex: degree of its fit, 0 if it is flat; why no higher, a place in `REASONS`; number of
        edges; number of those that are curved.
    """

    matrices: SparsePair
    linear: SparsePair | None = None
    mass: Float[Tensor, " N"] | None = None
    fits: Int[Tensor, "4 N"] | None = None

    @property
    def buffers(self) -> dict[str, Tensor]:
        """The matrices by their names in an operator."""
        found = {f"weak_{name}": t for name, t in vars(self.matrices).items()}
        if self.linear is not None:
            found |= {f"linear_{name}": t for name, t in vars(self.linear).items()}
        return found


ELEMENTS = {1: (2, (2,)), 2: (2, (2,)), 3: (2, (3, 2)), 4: (3, (4, 2)), 5: (4, (6, 4, 2))}
"""Degree r of the elements, and degrees m of the fits of functions, best first, by the order p; above 5 as for 5."""


def mesh_pair(
    points: Float[Tensor, "N n"],
    faces: Int[Tensor, "F corners"],
    fits: VertexFits,
    degree: int,
    stars: Int[Tensor, "S 3"] | None = None,
    numbering: Numbering | None = None,
    held: Bool[Tensor, " N"] | None = None,
) -> WeakPair:
    """The pair of a mesh of d-simplices, from the fits of its vertices, with elements of degree r ≥ 2.

    Symmetric, K1 = 0, K ≥ 0, M > 0 whatever the fits are: rows of P sum to one, and it has full column rank. A third of
    the flat triangles `stars` is added. The matrices have the user's numbers where there is a numbering. `held` marks
    where a Dirichlet condition holds. What is large is let go as soon as it was used.
    """
    count = len(points)
    nodes = lagrange_nodes(faces, count, degree)
    boundary = boundary_nodes(points, nodes, fits.degrees, held)
    mesh, g = curve(points, fits, nodes, boundary, held)
    del nodes, boundary
    del fits.surface.heights
    flat, of_fits = flat_pair(mesh, count), ~mesh.coarse
    linear = _linear(mesh.lengths[of_fits], mesh.nodes.cells[of_fits], count)
    p = prolongation(points, fits, mesh)
    blocks = element_matrices(g[of_fits], simplex(mesh.nodes.dim, degree))
    del g
    elements = summed(blocks, mesh.nodes.elements[of_fits], len(mesh.places))
    del blocks
    mass = positive_mass(p, _row_sums(elements), mesh, linear) + _row_sums(flat)
    linear = linear + flat
    rim = _boundary_mass(points, mesh, p)
    ends = mesh.nodes.edges, mesh.nodes.edges[mesh.curved]
    edges = [torch.bincount(e.flatten(), minlength=count) for e in ends]
    del mesh
    upper = [upper_product(p, elements) + sparse.triu(flat), sparse.triu(linear)]
    del p, elements
    if stars is not None and len(stars):
        extra = _star_pair(points, stars)
        upper = [part + sparse.triu(extra) for part in upper]
        mass = mass + _row_sums(extra)
    near = stored(upper.pop(), None, numbering)
    pair = stored(upper.pop(), rim, numbering)
    reached = torch.where(fits.degree > 0, fits.surface.degree, 0)
    counts = torch.stack([reached, fits.surface.reason, *edges])
    return WeakPair(pair, near, torch.from_numpy(mass), counts)


def upper_product(p: Any, matrix: sparse.csr_array) -> sparse.csr_array:
    """Upper triangle of PᵀAP for a symmetric A, a few rows at a time: neither the rest nor AP is ever held."""
    p.sort_indices()
    left: Any = sparse.csr_array(p.T)
    kernel = compiled.kernel("upper_product") if np.iscomplexobj(matrix) else None
    arrays = [] if kernel is None else [part for m in (left, matrix, p) for part in _arrays(m)]
    count, first, filled, length = p.shape[1], 0, 0, []
    indices, data = np.empty(0, dtype=np.int32), np.empty(0, dtype=matrix.dtype)
    while first < count:
        if kernel is None:
            rows = _upper_rows(first, left[first : first + ROWS], matrix, p)
        else:
            rows = kernel(first, max(ROOM, count), *arrays)
        length.append(rows[0])
        first += len(rows[0])
        start, filled = filled, filled + len(rows[1])
        for whole, piece in zip((indices, data), rows[1:], strict=True):
            whole.resize(filled, refcheck=False)  # where it is: pieces would be held twice
            whole[start:] = piece
    indptr = np.concatenate([[0], np.cumsum(np.concatenate(length))])
    return sparse.csr_array((data, indices, indptr), shape=(count, count))


def _arrays(matrix: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row pointers, columns and values, of the types that are compiled for."""
    indices = matrix.indices.astype(np.int32, copy=False)
    return matrix.indptr.astype(np.int64), indices, matrix.data


@compiled.standing_in()
def _upper_rows(
    first: int, left: Any, matrix: sparse.csr_array, p: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Entries in each of the rows from `first` on, their columns and values."""
    half = left @ matrix
    met = np.flatnonzero(np.bincount(half.indices, minlength=p.shape[0]))
    part = half[:, met] @ p[met]  # of the type of A: of P only what is met is converted
    row = np.arange(part.shape[0], dtype=np.int32).repeat(np.diff(part.indptr))
    upper = part.indices >= first + row
    length = np.bincount(row[upper], minlength=part.shape[0])
    return length, part.indices[upper], part.data[upper]


def _linear(
    lengths: Float[Tensor, "F e"], cells: Int[Tensor, "F corners"], count: int
) -> sparse.csr_array:
    """Linear elements on flat simplices."""
    shape = simplex(cells.shape[1] - 1, 1)
    flat = flat_metric(lengths)[:, None].expand(-1, len(shape.weights), -1)
    return summed(element_matrices(flat, shape), cells, count)


def flat_pair(mesh: CurvedMesh, count: int) -> sparse.csr_array:
    """K + iM of the coarse triangles: linear elements on a Delaunay triangulation of them, each half of its two copies.

    Their mass is lumped, to thirds of the triangles, as robust_laplacian's.
    """
    if mesh.cover is None:
        return sparse.csr_array((count, count), dtype=complex)
    faces, lengths, _ = mesh.cover
    element, g = simplex(2, 1), flat_metric(lengths)
    blocks = element_matrices(g[:, None].expand(-1, len(element.weights), -1), element)
    blocks.imag.zero_()
    blocks.imag[:, ::4] = area_element(g)[:, None] / 6
    return summed(blocks / 2, faces, count)


def _star_pair(points: Tensor, stars: Int[Tensor, "S 3"]) -> sparse.csr_array:
    """A third of the linear elements on local stars: each triangle is in those of its three corners."""
    ends = points[stars[:, [list(pair) for pair in subsets(2, 2)]]]
    lengths = (ends[:, :, 1] - ends[:, :, 0]).norm(dim=2)
    return _linear(mollified(lengths, stars), stars, len(points)) / 3


def positive_mass(
    p: Any,
    weights: Float[np.ndarray, " NX"],
    mesh: CurvedMesh,
    linear: sparse.csr_array,
) -> Float[np.ndarray, " N"]:
    """Pᵀw, w = M_FE 1: weights of the vertices that integrate to high order and sum to the area.

    Where one is below a tenth of that of linear elements, the rows of P that take from it are replaced by linear ones,
    until none is; that ends, since linear rows take nothing from anybody.
    """
    nodes, count, least = mesh.nodes, p.shape[1], SMALLEST * _row_sums(linear)
    mass = p.T @ weights
    if (mass >= least).all():
        return mass
    left, lowered = sparse.csr_array(p.T), np.zeros(p.shape[0], dtype=bool)
    while True:
        low: Any = left[np.flatnonzero(mass < least)]
        takes = (weights[low.indices] * low.data < 0) & (low.indices >= count)
        taking = np.unique(low.indices[takes & ~lowered[low.indices]])
        if len(taking) == 0:
            return mass
        lowered[taking] = True
        shares = nodes.shares.numpy()[taking - count] * weights[taking, None]
        mass -= p[taking].T @ weights[taking]
        np.add.at(mass, nodes.corners.numpy()[taking - count], shares)


def _row_sums(pair: Any) -> Float[np.ndarray, " N"]:
    """M1."""
    sums: Any = pair.sum(axis=1)
    return sums.imag.copy()


def _boundary_mass(points: Tensor, mesh: CurvedMesh, p: Any) -> Any:
    """∫ φ_i φ_j along the boundary, 1 at the end of a curve, lumped at coarse triangles; None for a closed shape."""
    nodes, shape = mesh.nodes, simplex(mesh.nodes.dim - 1, mesh.nodes.degree)
    cell, elements = nodes.boundary()
    if len(cell) == 0:
        return None
    coarse = mesh.coarse[cell]
    size = area_element(metric(mesh.places, elements[~coarse], shape))
    result = p.T @ (assemble_mass(size, elements[~coarse], shape, len(mesh.places)) @ p)
    if mesh.cover is not None:
        shares = boundary_shares(points, elements[coarse, :2], mesh.cover)
        result = result + sparse.diags_array(shares.numpy(), format="csr")
    return result


def stored(upper: Any, rim: Any = None, numbering: Numbering | None = None) -> SparsePair:
    """Of the upper triangles K + iM: exactly symmetric, rows of K sum to zero, as real parts on one pattern.

    From a numbering back to the user's, if there is one; `rim` is the mass of the boundary, whole.
    """
    upper = sparse.csr_array(upper)
    count = upper.shape[0]
    given = np.arange(count) if numbering is None else numbering.given.numpy()
    whole = compiled.kernel("mirrored") or _mirrored
    crow, col, values, diagonal = whole(*_arrays(upper), given)
    del upper
    values[0, diagonal] -= np.add.reduceat(values[0], crow[:-1])
    crow, col, values = (torch.from_numpy(part) for part in (crow, col, values))
    if rim is not None:
        line: Any = sparse.coo_array((rim + rim.T) / 2)
        i, j = (given[ends] for ends in line.coords)
        extra = torch.zeros_like(values[:1])
        place = torch.arange(count).repeat_interleave(crow.diff()) * count + col
        wanted = torch.from_numpy(i * count + j)
        extra[0, torch.searchsorted(place, wanted)] = torch.from_numpy(line.data)
        values = torch.cat([values, extra])
    return SparsePair(crow, col, values)


@compiled.standing_in()
def _mirrored(
    indptr: np.ndarray, indices: np.ndarray, data: np.ndarray, given: Int[np.ndarray, " N"]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The whole of a matrix that has one entry for each pair of rows, in other numbers, columns ascending.

    Row pointers, columns, (2, nnz) real and imaginary parts, and where the diagonal is.
    """
    count, given = len(given), given.astype(np.int32)
    row, col = given.repeat(np.diff(indptr)), given[indices]
    ends = np.maximum(row, col), np.minimum(row, col)
    lower: Any = sparse.coo_array((data, ends), shape=(count, count))
    lower.has_canonical_format = True  # but for its order, which the transposes bring about
    upper = sparse.csr_array(sparse.csr_array(lower).T)
    del lower, row, col, ends
    before = np.bincount(upper.indices, minlength=count) - 1  # of each row, left of the diagonal
    crow = np.concatenate([[0], np.cumsum(before + np.diff(upper.indptr))])
    free, diagonal = crow[:-1].copy(), crow[:-1] + before
    col, values = np.empty(crow[-1], dtype=np.int64), np.empty((2, crow[-1]))

    def put(part: Any, start: np.ndarray, shift: int) -> None:
        place = np.arange(len(part.data)) + (start - part.indptr[:-1]).repeat(np.diff(part.indptr))
        col[place] = part.indices + shift
        values[0, place], values[1, place] = part.data.real, part.data.imag

    for first in range(0, count, ROWS):
        part = upper[first : first + ROWS]
        mirrored = sparse.csr_array(part.T)
        put(part, diagonal[first : first + ROWS], 0)
        put(mirrored, free, first)
        free += np.diff(mirrored.indptr)
    return crow, col, values, diagonal
