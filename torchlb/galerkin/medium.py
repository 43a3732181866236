"""div κ∇ on the elements of a weak pair: its stiffness, and derivatives in κ (`method.md`, section 10)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.galerkin.assembly import (
    CHUNK,
    area_element,
    cofactors,
    element_matrices,
    flat_metric,
    summed,
)
from torchlb.galerkin.boundary import boundary_nodes
from torchlb.galerkin.curving import curve
from torchlb.galerkin.elements import Element, lattice, simplex, subsets
from torchlb.galerkin.nodes import lagrange_nodes
from torchlb.galerkin.pair import upper_product
from torchlb.galerkin.prolongation import prolongation
from torchlb.geometry.numbering import Numbering
from torchlb.geometry.vertex_fits import VertexFits
from torchlb.linalg.once import once_differentiable


@dataclass(frozen=True)
class Medium:
    """The elements of a weak pair, kept so that stiffnesses for many conductivities cost an assembly each.

    Attributes
    ----------
    faces : (T, d + 1), simplices.
    lengths : (T, e), of their edges, ℓ, in the order of `subsets`.
    prolongation : P, (N + X, N), from the vertices to the nodes.
    nodes : (T, n), of each element.
    metric : (T, Q, S), at its Gauss points.
    element : its shape functions there.
    shares : (T, F), how much of each face of the mesh is in an element; rows sum to one, or to a half where two copies
        of a triangle stand for it.
    """

    faces: Int[Tensor, "T corners"]
    lengths: Float[Tensor, "T e"]
    prolongation: Any
    nodes: Int[Tensor, "T n"]
    metric: Float[Tensor, "T Q S"]
    element: Element
    shares: Any

    @classmethod
    def curved(
        cls,
        points: Float[Tensor, "N n"],
        faces: Int[Tensor, "F corners"],
        fits: VertexFits,
        degree: int,
        held: Bool[Tensor, " N"] | None = None,
    ) -> Medium:
        """That of `mesh_pair` with elements of degree r ≥ 2; those of the cover have linear nodes of their own."""
        nodes = lagrange_nodes(faces, len(points), degree)
        boundary = boundary_nodes(points, nodes, fits.degrees, held)
        mesh, metric = curve(points, fits, nodes, boundary, held)
        p: Any = prolongation(points, fits, mesh)
        element, cover = simplex(nodes.dim, degree), mesh.cover
        same: Any = sparse.eye_array(len(faces), format="csr")
        if cover is None:
            return cls(nodes.cells, mesh.lengths, p, nodes.elements, metric, element, same)
        fit, within = ~mesh.coarse, lattice(2, degree)[3:]
        own = torch.arange(len(cover.faces) * len(within)).view(-1, len(within))
        weights = within.repeat(len(cover.faces), 1).flatten().numpy()
        where = own.flatten().repeat_interleave(3), cover.faces.repeat_interleave(len(within), 0)
        where = where[0].numpy(), where[1].flatten().numpy()
        linear = sparse.csr_array((weights, where), shape=(own.numel(), len(points)))
        flat = flat_metric(cover.lengths)[:, None].expand(-1, len(element.weights), -1)
        shares = same[fit.numpy()], cover.mixed() @ same[mesh.coarse.numpy()] / 2
        return cls(
            torch.cat([nodes.cells[fit], cover.faces]),
            torch.cat([mesh.lengths[fit], cover.lengths]),
            sparse.csr_array(sparse.vstack([p, linear])),
            torch.cat([nodes.elements[fit], torch.cat([cover.faces, p.shape[0] + own], 1)]),
            torch.cat([metric[fit], flat]),
            element,
            sparse.csr_array(sparse.vstack(shares)),
        )

    @property
    def num_faces(self) -> int:
        """F, of the mesh."""
        return self.shares.shape[1]

    @classmethod
    def linear(cls, points: Float[Tensor, "N n"], faces: Int[Tensor, "F corners"]) -> Medium:
        """That of linear elements, whose stiffness for κ = 1 is the cotangent's."""
        ends = points[faces[:, [list(pair) for pair in subsets(2, 2)]]]
        lengths = (ends[:, :, 1] - ends[:, :, 0]).norm(dim=2)
        element = simplex(2, 1)
        metric = flat_metric(lengths)[:, None].expand(-1, len(element.weights), 3)
        same: Any = sparse.eye_array(len(points), format="csr")
        shares: Any = sparse.eye_array(len(faces), format="csr")
        return cls(faces, lengths, same, faces, metric, element, shares)

    def restored(self, numbering: Numbering, order: Int[Tensor, " G"], num_faces: int) -> Medium:
        """With the user's numbers of the points and of so many faces, `order` those of the faces here."""
        given = numbering.given
        p, shares = (
            sparse.csr_array((m.data, of.numpy()[m.indices], m.indptr), shape=(m.shape[0], size))
            for m, of, size in (
                (self.prolongation, given, len(given)),
                (self.shares, order, num_faces),
            )
        )
        return replace(self, faces=given[self.faces], prolongation=p, shares=shares)

    def at_gauss_points(self, conductivity: Tensor) -> Float[Tensor, "T Q"]:
        """κ there, differentiable: of the vertices (N,), whose logarithm is prolonged, or of each face, if F ≠ N.

        So it is positive, and of high order where the fits are. Half of it on each of two copies of a triangle.
        """
        if len(conductivity) != self.prolongation.shape[1]:
            of_element = _prolonged(conductivity, self.shares)
            return of_element[:, None].expand(-1, len(self.element.weights))
        at_nodes = _prolonged(conductivity.log(), self.prolongation)
        copies = torch.from_numpy(self.shares.sum(axis=1))[:, None]
        return copies * (at_nodes[self.nodes] @ self.element.values.T).exp()

    def stiffness(self, conductivity: Float[Tensor, "T Q"]) -> sparse.csr_array:
        """Upper triangle of PᵀK_FE(κ)P, which is positive semidefinite for every κ > 0; its rows sum to zero."""
        p = self.prolongation
        blocks = element_matrices(self.metric, self.element, conductivity)
        elements = summed(blocks.real, self.nodes, p.shape[0])
        return upper_product(p, elements)

    def coarse_stiffness(self, conductivity: Float[Tensor, "T Q"]) -> sparse.csr_array:
        """K₁(κ) of linear elements on flat triangles, with the mean of κ on each: it preconditions."""
        shape, share = (
            simplex(self.element.dim, 1),
            self.element.weights / self.element.weights.sum(),
        )
        mean = (conductivity @ share)[:, None].expand(-1, len(shape.weights))
        metric = flat_metric(self.lengths)[:, None].expand(-1, len(shape.weights), -1)
        blocks = element_matrices(metric, shape, mean).real
        return summed(blocks, self.faces, self.prolongation.shape[1])

    def sensitivity(self, w: Float[Tensor, "N C"], u: Float[Tensor, "N C"]) -> Float[Tensor, "T Q"]:
        """∂/∂κ of Σ_c w_cᵀK(κ)u_c at the Gauss points: weights times ∇w·∇u."""
        at_nodes = [torch.from_numpy(self.prolongation @ x.numpy()) for x in (w, u)]
        found = []
        for part in torch.arange(len(self.nodes)).split(max(CHUNK // w.shape[1], 1)):
            g, nodes = self.metric[part], self.nodes[part]
            one, two = (
                torch.einsum("qnd,tnc->dtqc", self.element.gradients, x[nodes]) for x in at_nodes
            )
            pairs = combinations_with_replacement(range(self.element.dim), 2)
            products = [
                one[a] * two[b] if a == b else one[a] * two[b] + one[b] * two[a] for a, b in pairs
            ]
            parts = zip(cofactors(g).unbind(-1), products, strict=True)
            total = sum(m * x.sum(-1) for m, x in parts)
            found.append(self.element.weights * total / area_element(g))
        return torch.cat(found)


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
