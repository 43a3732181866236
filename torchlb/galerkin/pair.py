"""The weak pair of a mesh: K = PᵀK_FE P and M = PᵀM_FE P, and the positive mass (`method.md`, section 9)."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor
from torch.nn.functional import pad

from torchlb.galerkin.assembly import assemble, assemble_mass, flat_metric
from torchlb.galerkin.curving import CurvedMesh, Surface, curve, mollified
from torchlb.galerkin.elements import segment, triangle
from torchlb.galerkin.nodes import lagrange_nodes
from torchlb.galerkin.prolongation import prolongation
from torchlb.geometry.frames import normals_of_frames, vertex_normals
from torchlb.geometry.vertex_fits import VertexFits

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


ELEMENTS = {1: (2, (2,)), 2: (2, (2,)), 3: (2, (4, 2)), 4: (3, (4, 2)), 5: (4, (6, 4, 2))}
"""Degree r of the elements, and degrees m of the fits, best first, by the order p; above 5 as for 5."""


def mesh_pair(
    points: Float[Tensor, "N n"],
    faces: Int[Tensor, "F 3"],
    fits: VertexFits,
    degree: int,
    stars: Int[Tensor, "S 3"] | None = None,
) -> WeakPair:
    """The pair of a mesh in the plane or in space, from the fits of its vertices, with elements of degree r.

    A third of the flat triangles `stars` is added.
    """
    return weak_pair(fitted_surface(points, faces, fits), faces, degree, stars)


def fitted_surface(
    points: Float[Tensor, "N n"], faces: Int[Tensor, "F 3"], fits: VertexFits
) -> Surface:
    """A mesh in the plane or in space with the fits of its vertices, in space."""
    if points.shape[1] == 2:
        points, fits = pad(points, (0, 1)), copy(fits)
        fits.frames, fits.heights = pad(fits.frames, (0, 0, 0, 1)), pad(fits.heights, (0, 1))
    outward = vertex_normals(points, faces)
    normals = normals_of_frames(fits.frames)
    normals = normals * (normals * outward).sum(1, keepdim=True).sign()
    return Surface(points, fits.frames, normals, fits)


def weak_pair(
    surface: Surface,
    faces: Int[Tensor, "F 3"],
    degree: int,
    stars: Int[Tensor, "S 3"] | None = None,
) -> WeakPair:
    """The pair of a mesh with elements of degree r; r = 1 is the cotangent's, with its full mass.

    Symmetric, K1 = 0, K ≥ 0, M > 0 whatever the fits are: rows of P sum to one, and it has full column rank.
    """
    count = len(surface.points)
    mesh = curve(surface, lagrange_nodes(faces, count, max(degree, 2)))
    linear = _linear(mesh.lengths, faces, count)
    if degree == 1:
        return WeakPair(stored(linear), mass=torch.from_numpy(_row_sums(linear)))
    shape, nodes = triangle(degree), mesh.nodes
    p = prolongation(surface, mesh)
    elements = assemble(mesh.metric, nodes.elements, shape, len(mesh.places))
    pair = sparse.csr_array(p.T) @ (elements @ p)
    mass = positive_mass(p, _row_sums(elements), mesh, linear)
    if stars is not None and len(stars):
        extra = _star_pair(surface.points, stars)
        pair, linear, mass = pair + extra, linear + extra, mass + _row_sums(extra)
    rim = None if len(mesh.rim) == 0 else p.T @ (_rim_mass(mesh) @ p)
    ends = nodes.edges.flatten()
    edges = [torch.bincount(e, minlength=count) for e in (ends, nodes.edges[mesh.curved].flatten())]
    return WeakPair(
        stored(pair, rim),
        stored(linear),
        torch.from_numpy(mass),
        torch.stack([surface.fits.degree, surface.fits.reason, *edges]),
    )


def _linear(lengths: Tensor, faces: Tensor, count: int) -> sparse.csr_array:
    """Linear elements on flat triangles."""
    flat = flat_metric(lengths)[:, None]
    return assemble(flat.expand(-1, len(triangle(1).weights), 3), faces, triangle(1), count)


def _star_pair(points: Tensor, stars: Int[Tensor, "S 3"]) -> sparse.csr_array:
    """A third of the linear elements on local stars: each triangle is in those of its three corners."""
    lengths = (points[stars[:, [1, 2, 0]]] - points[stars]).norm(dim=2)
    return _linear(mollified(lengths), stars, len(points)) / 3


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
    nodes, count = mesh.nodes, p.shape[1]
    least = SMALLEST * _row_sums(linear)
    shares = (np.repeat(np.arange(len(nodes.shares)), 3) + count, nodes.corners.numpy().ravel())
    straight = sparse.csr_array((nodes.shares.numpy().ravel(), shares), shape=p.shape)
    entries = sparse.coo_array(p)
    row, col = entries.coords
    given = weights[row] * entries.data
    lowered = np.zeros(p.shape[0], dtype=bool)
    while True:
        kept = np.where(lowered, 0.0, weights)
        mass = p.T @ kept + straight.T @ (weights - kept)
        taking = (mass < least)[col] & (given < 0) & (row >= count) & ~lowered[row]
        if not taking.any():
            return mass
        lowered[row[taking]] = True


def _row_sums(pair: Any) -> Float[np.ndarray, " N"]:
    """M1."""
    sums: Any = pair.sum(axis=1)
    return sums.imag.copy()


def _rim_mass(mesh: CurvedMesh) -> sparse.csr_array:
    """∫ φ_i φ_j along the boundary."""
    nodes, shape = mesh.nodes, segment(mesh.nodes.degree)
    on_edge = nodes.degree - 1
    first = len(mesh.places) - len(nodes.shares)
    between = first + mesh.rim[:, None] * on_edge + torch.arange(on_edge)
    elements = torch.cat([nodes.edges[mesh.rim], between], 1)
    speed = torch.einsum("qnd,gnc->gqc", shape.gradients, mesh.places[elements]).norm(dim=2)
    return assemble_mass(speed, elements, shape, len(mesh.places))


def stored(pair: Any, rim: Any = None) -> SparsePair:
    """Exactly symmetric, with rows of K that sum to zero, as real parts on one pattern."""
    other: Any = sparse.csr_array(sparse.csr_array(pair).T)  # sorted as it comes
    pair = sparse.csr_array(other.T)
    values = np.empty((2, len(pair.data)))
    for to, mine, theirs in zip(
        values, (pair.data.real, pair.data.imag), (other.data.real, other.data.imag), strict=True
    ):
        np.multiply(mine + theirs, 0.5, out=to)
    count = len(pair.indptr) - 1
    row = np.arange(count, dtype=np.int32).repeat(np.diff(pair.indptr))
    values[0, row == pair.indices] -= np.bincount(row, values[0], count)
    values = torch.from_numpy(values)
    crow, col = (torch.from_numpy(part.astype(np.int64)) for part in (pair.indptr, pair.indices))
    if rim is not None:
        line: Any = sparse.coo_array((rim + rim.T) / 2)
        i, j = (torch.from_numpy(part.astype(np.int64)) for part in line.coords)
        extra = torch.zeros_like(values[:1])
        keys = torch.from_numpy(row.astype(np.int64)) * count + col
        extra[0, torch.searchsorted(keys, i * count + j)] = torch.from_numpy(line.data)
        values = torch.cat([values, extra])
    return SparsePair(crow, col, values)
