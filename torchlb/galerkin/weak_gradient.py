"""The gradient of functions against tangent fields in the weak form, and its adjoint (`method.md`, section 15)."""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from torchlb.galerkin.assembly import area_element, flat_metric, spread, summed
from torchlb.galerkin.elements import simplex
from torchlb.galerkin.forms import Forms, times
from torchlb.geometry.vectors import at


class WeakGradient(NamedTuple):
    """The bilinear form ∫v·∇u of functions u and fields v on a surface, or ∫v·(ν × ∇u), for prolonged u and v.

    Its matrices are ∫φ_j (∇φ_i)_k for each component k in space, (NX, NX) on curved elements and (N, N) on flat cells.
    """

    prolongation: Any
    curved: list[Any]
    flat: list[Any]

    @classmethod
    def of(cls, forms: Forms, normals: Float[Tensor, "N 3"] | None = None) -> WeakGradient:
        """The form with ∇u, or, with normals ν at the vertices, ν × ∇u."""
        shape, slopes = simplex(2, 1), forms.slopes()
        share = 1.0 if forms.shares is None else forms.shares[:, None, None]
        lots = [(forms.nodes, forms.cells, forms.element, forms.metric, slopes[0], share)]
        for flat, x in zip(forms.flats, slopes[1:], strict=True):
            g = spread(flat_metric(flat.lengths), shape)
            lots.append((flat.cells, flat.cells, shape, g, spread(x, shape), flat.share))
        counts = forms.prolongation.shape[0], *[len(forms.points)] * len(forms.flats)
        found = []
        for (nodes, cells, element, g, x, part), count in zip(lots, counts, strict=True):
            entries = (
                part * element.weights[:, None] * _directions(g, x, cells, normals).movedim(2, 0)
            )
            products = torch.einsum("qia,qj->qaij", element.gradients, element.values).flatten(2)
            blocks = [entry.flatten(1) @ products.flatten(0, 1) for entry in entries]
            found.append([summed(block, nodes, count) for block in blocks])
        flat = [sum(each) for each in zip(*found[1:], strict=True)]
        return cls(forms.prolongation, found[0], flat)

    def divergence(self, v: Float[Tensor, "N n C"]) -> Float[Tensor, "N C"]:
        """∫v·∇φ_i of a field in space, differentiable in it."""
        inside = [
            times(d, times(self.prolongation, x))
            for d, x in zip(self.curved, v.unbind(1), strict=True)
        ]
        found = [times(self.prolongation.T, torch.stack(inside).sum(0))]
        found += [times(f, x) for f, x in zip(self.flat, v.unbind(1), strict=False)]
        return torch.stack(found).sum(0)

    def gradient(self, u: Float[Tensor, "N C"]) -> Float[Tensor, "N n C"]:
        """∫e_kφ_i·∇u, the adjoint of `divergence`, differentiable in u."""
        nodes = times(self.prolongation, u)
        found = [times(self.prolongation.T, times(d.T, nodes)) for d in self.curved]
        for k, f in enumerate(self.flat):
            found[k] = found[k] + times(f.T, u)
        return torch.stack(found, 1)


def _directions(
    g: Float[Tensor, "T Q 3"],
    slopes: Float[Tensor, "T Q n 2"],
    cells: Any,
    normals: Float[Tensor, "N 3"] | None,
) -> Float[Tensor, "T Q n 2"]:
    """√det G times the vectors d_a with ∇u = Σ_a d_a ∂_a u, or with ν × ∇u: the tangent vectors, turned or dual."""
    one, two = slopes.unbind(-1)
    if normals is None:
        xx, xy, yy = (entry[..., None] for entry in g.unbind(-1))
        dual = [yy * one - xy * two, xx * two - xy * one]
        return torch.stack(dual, -1) / area_element(g)[..., None, None]
    outer = at(normals, cells).sum(1)
    across = torch.linalg.cross(one, two, dim=-1).sum(1)
    side = (outer * across).sum(-1).sign()[:, None, None, None]
    return side * torch.stack([two, -one], -1)
