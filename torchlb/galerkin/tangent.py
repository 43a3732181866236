"""Tangent fields on the elements: the connection Laplacian by matrices of functions (`method.md`, section 15).

A tangent field has the components c in the frames E of the vertices, and is the vector field Ec of space, prolonged
component by component. With the projector Π onto the tangent plane its covariant derivative is Π∇ũ, so that

    ∫κ|Π∇ũ|² = Σ_kl ∫κΠ_kl ∇ũ_k·∇ũ_l

is made of stiffness matrices of functions, with the conductivities κΠ_kl. It is symmetric and positive whatever the
fits are, in any codimension. All else (mass, boundary, potential) is that of functions, for every component in space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.galerkin.assembly import (
    ElementMatrices,
    conductance,
    flat_metric,
    gradient_products,
    spread,
)
from torchlb.galerkin.bilinear import BilinearForm
from torchlb.galerkin.elements import Element, simplex
from torchlb.galerkin.forms import Forms, cell_mean
from torchlb.galerkin.medium import orthonormal
from torchlb.galerkin.pair import Pattern
from torchlb.geometry.vectors import at, dot
from torchlb.linalg.csr import Csr
from torchlb.linalg.sparse import values_on


def in_space(forms: Sequence[BilinearForm], frames: Float[Tensor, "N n d"]) -> list[BilinearForm]:
    """Forms of the components (N d, C) of tangent fields as forms of functions, differentiable in the frames."""
    known: dict[int, tuple[Tensor, ...]] = {}
    for f in (f for form in forms for f in (form.w, form.u)):
        if id(f) not in known:
            local = f.view(*frames.shape[::2], -1)
            known[id(f)] = torch.einsum("ind,idc->inc", frames, local).unbind(1)
    found = []
    for name, w, u, c, _ in forms:
        for k, one in enumerate(known[id(w)]):
            for m, two in enumerate(known[id(u)]):
                if name == "stiffness":
                    found.append(BilinearForm(name, one, two, c, (k, m)))
                elif k == m:
                    found.append(BilinearForm(name, one, two, c))
    return found


class _Part(NamedTuple):
    """One of the matrices of functions that the stiffness of tangent fields is made of.

    It is S_kl = ∫κΠ_kl ∇φ_i·∇φ_j; if `turning`, ∫κω_kl det(∇φ_i, ∇φ_j) with ω = e₁e₂ᵀ − e₂e₁ᵀ, which Hodge's
    ∫κ(div u)² + κ(curl u)² has besides. The latter is antisymmetric both in i and j and in k and l.
    """

    k: int
    m: int
    turning: bool


def tangent_matrices(
    forms: Forms,
    conductivity: list[Tensor] | None,
    frames: Float[Tensor, "N n d"],
    others: tuple[Csr, Csr | None],
    *,
    hodge: bool = False,
) -> list[Csr]:
    """Matrices of tangent fields, and those of P1 elements if there are others than these.

    Their channels are the stiffness, of Hodge's Laplacian if asked for, and all but the first channel of `others`,
    which are of functions.
    """
    axes = range(frames.shape[1])
    parts = [_Part(k, m, False) for k, m in combinations_with_replacement(axes, 2)]
    parts += [_Part(k, m, True) for k, m in combinations(axes, 2)] if hodge else []
    curved, linear, *flats = _elements(forms, conductivity)
    same: Any = sparse.eye_array(len(forms.points), format="csr")
    found = []
    for p, own, other in zip((forms.prolongation, same), (curved, linear), others, strict=True):
        if other is not None:
            upper, values = _assembled(forms, p, [own, *flats], parts)
            found.append(_framed(upper, values, forms.given, frames, other))
    return found


@dataclass(frozen=True)
class _Elements:
    """Elements of functions, orthonormal tangent vectors at their Gauss points, and the share of each that counts."""

    nodes: Int[Tensor, "T nodes"]
    metric: Float[Tensor, "T Q S"]
    element: Element
    conductivity: Tensor | None
    tangents: Float[Tensor, "T Q n d"]
    share: Any

    @cached_property
    def covariant(self) -> tuple[Float[Tensor, "T Q S"], Float[Tensor, "Q S n_times_n"]]:
        """The element matrices of S_kl are sums of products of these, and of Π_kl."""
        slopes = conductance(self.metric, self.conductivity)
        return self.share * self.element.weights[:, None] * slopes, gradient_products(self.element)

    @cached_property
    def turning(self) -> tuple[Float[Tensor, "T Q 1"], Float[Tensor, "Q 1 n_times_n"]]:
        """The same with ω_kl."""
        kappa = self.conductivity
        kappa = torch.ones_like(self.metric[..., 0]) if kappa is None else kappa
        one, two = self.element.gradients.unbind(-1)
        cross = one[:, :, None] * two[:, None]
        slopes = self.share * (self.element.weights * kappa)[..., None]
        return slopes, (cross - cross.mT).flatten(1)[:, None]

    def blocks(self, part: _Part) -> Float[Tensor, "T n_times_n"]:
        """Element matrices of a part."""
        one, two = self.tangents[..., part.k, :], self.tangents[..., part.m, :]
        direction, (slopes, products) = dot(one, two), self.covariant
        if part.turning:
            direction = one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0]
            slopes, products = self.turning
        return (direction[..., None] * slopes).flatten(1) @ products.flatten(0, 1)


def _elements(forms: Forms, conductivity: list[Tensor] | None) -> list[_Elements]:
    """The curved elements, those of P1 in their place, and every lot of flat cells."""
    kappa: list[Any] = [None] * (1 + len(forms.flats)) if conductivity is None else conductivity
    tangents, corners = forms.tangents(), simplex(forms.element.dim, 1)
    share = 1.0 if forms.shares is None else forms.shares[:, None, None]
    mean = None if kappa[0] is None else cell_mean(kappa[0], forms.element)
    flat = orthonormal(cell_mean(tangents[0], forms.element))
    lots = [(forms.cells, forms.lengths, share, mean, flat)]
    lots += [
        (flat.cells, flat.lengths, flat.share, a, e)
        for flat, a, e in zip(forms.flats, kappa[1:], tangents[1:], strict=True)
    ]
    a = forms.on_curved(kappa[0])
    found = [_Elements(forms.nodes, forms.metric, forms.element, a, tangents[0], share)]
    for cells, lengths, part, a, e in lots:
        a = forms.on_flat(a, cells, lengths)
        a = None if a is None else spread(a, corners)
        g = spread(flat_metric(lengths), corners)
        found.append(_Elements(cells, g, corners, a, spread(e, corners), part))
    return found


def _assembled(
    forms: Forms, p: Any, lots: list[_Elements], parts: list[_Part]
) -> tuple[Any, Float[Tensor, "n n upper"]]:
    """Upper triangles on one pattern, the last of them, and S for all k and l; two are computed at a time."""
    values, upper = [], None
    for pair in zip(parts[::2], [*parts[1::2], parts[-1]], strict=False):
        upper = forms.upper(
            p,
            [
                ElementMatrices(lot.nodes, torch.complex(*(lot.blocks(part) for part in pair)))
                for lot in lots
            ],
        )
        both = torch.from_numpy(upper.data)
        values += [both.real, both.imag]
    size = forms.points.shape[1]
    found = values[0].new_zeros(size, size, len(values[0]))
    for (k, m, turning), value in zip(parts, values, strict=False):
        found[k, m] += value
        if k != m:
            found[m, k] += -value if turning else value
    return upper, found


def _framed(
    upper: Any,
    stiffness: Float[Tensor, "n n upper"],
    given: Int[Tensor, " N"],
    frames: Float[Tensor, "N n d"],
    others: Csr,
) -> Csr:
    """Σ_kl E_kᵀ S_kl E_l of the upper triangles of S_kl, with Σ_k E_kᵀ A E_k of the other channels A."""
    count, _, dim = frames.shape
    pattern, ends = Pattern.of(upper, given), torch.from_numpy(upper.indices).long()
    starts = torch.arange(count).repeat_interleave(torch.from_numpy(np.diff(upper.indptr)))
    left, right = (frames.permute(1, 2, 0)[..., given[x]] for x in (starts, ends))  # (n, d, upper)
    terms = [torch.einsum("kmu,mbu->kbu", stiffness, right), right]
    whole, inner = (torch.einsum("kau,kbu->uab", left, term) for term in terms)
    own = whole[starts == ends]
    whole[starts == ends] = (own + own.mT) / 2  # symmetric but for rounding
    crow, col, order = pattern.crow, pattern.col, torch.from_numpy(pattern.order).long()
    turned = given[starts][order] != torch.arange(count).repeat_interleave(crow.diff())
    whole, inner = (at(torch.cat([x, x.mT]), order + len(x) * turned) for x in (whole, inner))
    place = crow.numpy(), col.numpy()
    parts = [whole]
    for channel in range(1, len(others.values)):
        value = torch.from_numpy(values_on(*place, others.to_scipy(channel)))
        parts.append(value[:, None, None] * inner)
    found: Any = [
        sparse.bsr_array((part.numpy(), *place[::-1]), shape=2 * (dim * count,)).tocsr()
        for part in parts
    ]
    values = torch.from_numpy(np.stack([each.data for each in found]))
    rows, columns = (torch.from_numpy(x).long() for x in (found[0].indptr, found[0].indices))
    return Csr(rows, columns, values)
