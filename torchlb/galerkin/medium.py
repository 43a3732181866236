"""div κ∇ on the elements of a weak pair: its stiffness, and derivatives in κ (`method.md`, section 10)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.galerkin.assembly import CHUNK, area_element, element_matrices, flat_metric, summed
from torchlb.galerkin.curving import curve
from torchlb.galerkin.elements import Element, triangle
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
    faces : (F, 3), of the mesh.
    lengths : (F, 3), of its edges, ℓ, in the order of `EDGES`.
    prolongation : P, (N + X, N), from the vertices to the nodes.
    nodes : (F, n), of each element.
    metric : (F, Q, 3), at its Gauss points.
    element : its shape functions there.
    """

    faces: Int[Tensor, "F 3"]
    lengths: Float[Tensor, "F 3"]
    prolongation: Any
    nodes: Int[Tensor, "F n"]
    metric: Float[Tensor, "F Q 3"]
    element: Element

    @classmethod
    def curved(
        cls, points: Float[Tensor, "N n"], faces: Int[Tensor, "F 3"], fits: VertexFits, degree: int
    ) -> Medium:
        """That of `mesh_pair` with elements of degree r ≥ 2."""
        mesh, metric = curve(points, fits, lagrange_nodes(faces, len(points), degree))
        p = prolongation(points, fits, mesh)
        return cls(faces, mesh.lengths, p, mesh.nodes.elements, metric, triangle(degree))

    @classmethod
    def linear(cls, points: Float[Tensor, "N n"], faces: Int[Tensor, "F 3"]) -> Medium:
        """That of linear elements, whose stiffness for κ = 1 is the cotangent's."""
        lengths = (points[faces[:, [1, 2, 0]]] - points[faces]).norm(dim=2)
        element = triangle(1)
        metric = flat_metric(lengths)[:, None].expand(-1, len(element.weights), 3)
        same: Any = sparse.eye_array(len(points), format="csr")
        return cls(faces, lengths, same, faces, metric, element)

    def restored(self, numbering: Numbering, order: Int[Tensor, " F"]) -> Medium:
        """With the user's numbers of the points, and their order of the faces."""
        back, p, given = order.argsort(), self.prolongation, numbering.given.numpy()
        p = sparse.csr_array((p.data, given[p.indices], p.indptr), shape=p.shape)
        faces = numbering.given[self.faces[back]]
        lengths, nodes, metric = (t[back] for t in (self.lengths, self.nodes, self.metric))
        return Medium(faces, lengths, p, nodes, metric, self.element)

    def at_gauss_points(self, conductivity: Tensor) -> Float[Tensor, "F Q"]:
        """κ there, differentiable: of the vertices (N,), whose logarithm is prolonged, or of each face, if F ≠ N.

        So it is positive, and of high order where the fits are.
        """
        if len(conductivity) != self.prolongation.shape[1]:
            return conductivity[:, None].expand(-1, len(self.element.weights))
        at_nodes = _prolonged(conductivity.log(), self.prolongation)
        return (at_nodes[self.nodes] @ self.element.values.T).exp()

    def stiffness(self, conductivity: Float[Tensor, "F Q"]) -> sparse.csr_array:
        """Upper triangle of PᵀK_FE(κ)P, which is positive semidefinite for every κ > 0; its rows sum to zero."""
        p = self.prolongation
        blocks = element_matrices(self.metric, self.element, conductivity)
        elements = summed(blocks.real, self.nodes, p.shape[0])
        return upper_product(p, elements)

    def coarse_stiffness(self, conductivity: Float[Tensor, "F Q"]) -> sparse.csr_array:
        """K₁(κ) of linear elements on flat triangles, with the mean of κ on each: it preconditions."""
        shape, share = triangle(1), self.element.weights / self.element.weights.sum()
        mean = (conductivity @ share)[:, None].expand(-1, len(shape.weights))
        metric = flat_metric(self.lengths)[:, None].expand(-1, len(shape.weights), 3)
        blocks = element_matrices(metric, shape, mean).real
        return summed(blocks, self.faces, self.prolongation.shape[1])

    def sensitivity(self, w: Float[Tensor, "N C"], u: Float[Tensor, "N C"]) -> Float[Tensor, "F Q"]:
        """∂/∂κ of Σ_c w_cᵀK(κ)u_c at the Gauss points: weights times ∇w·∇u."""
        at_nodes = [torch.from_numpy(self.prolongation @ x.numpy()) for x in (w, u)]
        found = []
        for part in torch.arange(len(self.nodes)).split(max(CHUNK // w.shape[1], 1)):
            g, nodes = self.metric[part], self.nodes[part]
            (a, b), (c, d) = (
                torch.einsum("qnd,tnc->dtqc", self.element.gradients, x[nodes]) for x in at_nodes
            )
            products = [b * d, -(a * d + b * c), a * c]
            total = sum(m * x.sum(-1) for m, x in zip(g.unbind(-1), products, strict=True))
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
