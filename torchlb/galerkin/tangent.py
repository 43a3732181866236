"""Tangent fields on the elements: the connection Laplacian by matrices of functions (`method.md`, section 15).

A tangent field has the components c in the frames E of the vertices, and is the vector field Ec of space, prolonged
component by component. With the projector Π onto the tangent plane its covariant derivative is Π∇ũ, so that

    ∫κ|Π∇ũ|² = Σ_kl ∫κΠ_kl ∇ũ_k·∇ũ_l

is made of stiffness matrices of functions, with the conductivities κΠ_kl. It is symmetric and positive whatever the
fits are, in any codimension. All else (mass, boundary, potential) is that of functions, for every component in space.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations, combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.galerkin.assembly import (
    conductance,
    flat_metric,
    gradient_products,
    spread,
    summed,
    upper_congruence,
)
from torchlb.galerkin.bilinear import BilinearForm
from torchlb.galerkin.elements import Element, simplex
from torchlb.galerkin.forms import Forms, cell_mean
from torchlb.galerkin.medium import orthonormal
from torchlb.galerkin.pair import Pattern
from torchlb.geometry.vectors import at
from torchlb.linalg.csr import Csr
from torchlb.linalg.sparse import on_one_pattern, values_on


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
    kinds = ("covariant", "turning") if hodge else ("covariant",)
    parts = [part for kind in kinds for part in _parts(forms, conductivity, kind)]
    columns = zip(zip(*parts, strict=True), others, strict=True)
    return [_framed(list(own), frames, other) for own, other in columns if other is not None]


class _Lot(NamedTuple):
    """Elements with the entries of a matrix of functions for each k and l at their Gauss points.

    Attributes
    ----------
    slopes, products
        (T, Q, S), (Q, S, n_times_n): what the element matrices are sums over Q and S of, without k and l.
    directions
        (T, Q, n, n), the factor for k and l.
    nodes
        (T, nodes).
    """

    slopes: Float[Tensor, "T Q S"]
    products: Float[Tensor, "Q S n_times_n"]
    directions: Float[Tensor, "T Q n n"]
    nodes: Int[Tensor, "T nodes"]

    @classmethod
    def of(
        cls, kind: str, nodes: Tensor, g: Tensor, element: Element, kappa: Tensor | None, e: Tensor
    ) -> _Lot:
        """Elements with the metric g, conductivity κ, and orthonormal tangent vectors e."""
        if kind == "covariant":
            slopes, directions = conductance(g, kappa), e @ e.mT
            products = gradient_products(element)
        else:
            slopes = torch.ones_like(g[..., :1]) if kappa is None else kappa[..., None]
            directions = e[..., :1] @ e[..., 1:].mT
            directions = directions - directions.mT
            one, two = element.gradients.unbind(-1)
            cross = one[:, :, None] * two[:, None]
            products = (cross - cross.mT).flatten(1)[:, None]
        return cls(element.weights[:, None] * slopes, products, directions, nodes)

    def assembled(self, k: int, m: int, count: int, share: Any) -> sparse.csr_array:
        """The matrix of functions for k and m; `share` is the fraction of each element that counts."""
        entries = (share * self.slopes * self.directions[..., k, m, None]).flatten(1)
        return summed(entries @ self.products.flatten(0, 1), self.nodes, count)


def _parts(forms: Forms, conductivity: Any, kind: str) -> list[tuple[Any, Any]]:
    """Upper triangles of the matrices of functions, k ≤ l row by row, and of P1 elements.

    "covariant", ∫κΠ_kl ∇φ_i·∇φ_j, are those of the connection Laplacian. Hodge's ∫κ(div u)² + κ(curl u)² has "turning"
    ones beside it, ∫κω_kl det(∇φ_i, ∇φ_j) for k < l, where ω = e₁e₂ᵀ − e₂e₁ᵀ: they are antisymmetric both in i and j
    and in k and l.
    """
    kappa: list[Any] = [None] * (1 + len(forms.flats)) if conductivity is None else conductivity
    tangents, corners = forms.tangents(), simplex(forms.element.dim, 1)
    curved = _Lot.of(
        kind, forms.nodes, forms.metric, forms.element, forms.on_curved(kappa[0]), tangents[0]
    )
    mean = None if kappa[0] is None else cell_mean(kappa[0], forms.element)
    own = forms.cells, forms.lengths, mean, orthonormal(cell_mean(tangents[0], forms.element))
    beside = zip(forms.flats, kappa[1:], tangents[1:], strict=True)
    lots = []
    for cells, lengths, a, e in [own, *((f.cells, f.lengths, *rest) for f, *rest in beside)]:
        a = forms.on_flat(a, cells, lengths)
        a = None if a is None else spread(a, corners)
        g = spread(flat_metric(lengths), corners)
        lots.append(_Lot.of(kind, cells, g, corners, a, spread(e, corners)))
    share = 1.0 if forms.shares is None else forms.shares[:, None, None]
    shares, count, found = [share, *(f.share for f in forms.flats)], len(forms.points), []
    for k, m in combinations_with_replacement(range(forms.points.shape[1]), 2):
        if kind == "turning" and k == m:
            continue
        triangles = [
            sparse.triu(lot.assembled(k, m, count, part), format="csr")
            for lot, part in zip(lots, shares, strict=True)
        ]
        elements = curved.assembled(k, m, forms.prolongation.shape[0], share)
        whole, flat = upper_congruence(forms.prolongation, elements), sum(triangles[1:])
        found.append((whole + flat, triangles[0] + flat))
    return found


def _framed(parts: list[Any], frames: Float[Tensor, "N n d"], others: Csr) -> Csr:
    """Σ_kl E_kᵀ S_kl E_l of upper triangles of S_kl, as in `_parts`, with Σ_k E_kᵀ A E_k of the other channels A."""
    count, n, dim = frames.shape
    pairs = [(k, m, 1) for k, m in combinations_with_replacement(range(n), 2)]
    if len(parts) > len(pairs):
        pairs += [(k, m, -1) for k, m in combinations(range(n), 2)]
    rest = [others.to_scipy(channel) for channel in range(1, len(others.values))]
    upper, values = _on_one_pattern([*parts, *(sparse.triu(a, format="csr") for a in rest)])
    row = np.arange(count).repeat(np.diff(upper.indptr))
    left, right = (at(frames, torch.from_numpy(x).long()) for x in (row, upper.indices))
    blocks = values.new_zeros(1 + len(rest), len(row), dim, dim)
    for value, (k, m, sign) in zip(values, pairs, strict=False):
        product = left[:, k, :, None] * right[:, m, None, :]
        if k != m:
            product += sign * left[:, m, :, None] * right[:, k, None, :]
        blocks[0] += value[:, None, None] * product
    blocks[1:] = values[len(pairs) :, :, None, None] * (left.mT @ right)
    diagonal = torch.from_numpy(np.flatnonzero(row == upper.indices))
    own = blocks[:, diagonal]
    blocks[:, diagonal] = (own + own.mT) / 2  # symmetric but for rounding
    pattern = Pattern.of(upper)
    blocks = blocks[:, torch.from_numpy(pattern.order).long()]
    below = pattern.col < torch.arange(count).repeat_interleave(pattern.crow.diff())
    return _by_rows(pattern.crow, pattern.col, torch.where(below[:, None, None], blocks.mT, blocks))


def _on_one_pattern(matrices: list[Any]) -> tuple[Any, Float[Tensor, "c nnz"]]:
    """A pattern that has the entries of all matrices, and their values on it."""
    if all(on_one_pattern(matrices[0], other) for other in matrices):
        return matrices[0], torch.from_numpy(np.stack([m.data.astype(float) for m in matrices]))
    joint: Any = sparse.csr_array(sum(abs(matrix) for matrix in matrices))
    joint.sort_indices()
    values = [values_on(joint.indptr, joint.indices, matrix) for matrix in matrices]
    return joint, torch.from_numpy(np.stack(values))


def _by_rows(crow: Tensor, col: Tensor, blocks: Float[Tensor, "c nnz d d"]) -> Csr:
    """Matrices of d × d blocks as CSR."""
    dim, uses = blocks.shape[-1], crow.diff()
    within, start = torch.arange(dim), crow[:-1].repeat_interleave(uses)
    first = dim**2 * start + dim * (torch.arange(len(col)) - start)
    step = dim * uses.repeat_interleave(uses)
    place = (first[:, None, None] + step[:, None, None] * within[:, None] + within).flatten()
    values, columns = torch.empty_like(blocks).flatten(1), torch.empty_like(place)
    values[:, place] = blocks.flatten(1)
    columns[place] = (dim * col[:, None, None] + within).expand(-1, dim, -1).flatten()
    rows = torch.cat([crow[:1], (dim * uses).repeat_interleave(dim).cumsum(0)])
    return Csr(rows, columns, values)
