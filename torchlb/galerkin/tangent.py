"""Tangent fields on the elements (`method.md`, section 15): connection Laplacian, and gradients in the weak form.

A tangent field has the components c in the frames E of the vertices, and is the vector field Ec of space, prolonged
component by component. With the projector Π onto the tangent plane its covariant derivative is Π∇ũ, so that

    ∫κ|Π∇ũ|² = Σ_kl ∫κΠ_kl ∇ũ_k·∇ũ_l

is made of stiffness matrices of functions, with the conductivities κΠ_kl. It is symmetric and positive whatever the
fits are, in any codimension. At creases vectors are turned instead (`creases`). All else (mass, boundary, potential) is
that of functions, for every component in space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from torch import Tensor

from torchlb.galerkin.assembly import (
    ElementMatrices,
    Elements,
    area_element,
    conductance,
    gradient_products,
    spread,
    summed,
)
from torchlb.galerkin.forms import BilinearForm, Forms, times
from torchlb.galerkin.medium import orthonormal
from torchlb.galerkin.pair import Pattern
from torchlb.geometry.vectors import Frames, Points, at, dot
from torchlb.linalg.csr import Csr
from torchlb.linalg.precision import AT_ONCE
from torchlb.linalg.sparse import values_on


def in_space(forms: Sequence[BilinearForm], frames: Frames) -> list[BilinearForm]:
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


Part = tuple[int, int, bool]
"""One of the matrices of functions that the stiffness of tangent fields is made of, as (k, l, whether it is turning).

It is S_kl = ∫κΠ_kl ∇φ_i·∇φ_j; if turning, ∫κω_kl det(∇φ_i, ∇φ_j) with ω = e₁e₂ᵀ − e₂e₁ᵀ, which Hodge's
∫κ(div u)² + κ(curl u)² has besides. The latter is antisymmetric both in i and j and in k and l.
"""


def tangent_matrices(
    forms: Forms,
    conductivity: list[Tensor] | None,
    frames: Frames,
    others: Sequence[Csr],
    *,
    hodge: bool = False,
) -> list[Csr]:
    """Matrices of tangent fields, and those of P1 elements if there are others than these.

    Their channels are the stiffness, of Hodge's Laplacian if asked for, and all but the first channel of `others`,
    which are of functions.
    """
    axes = range(frames.shape[1])
    parts = [(k, m, False) for k, m in combinations_with_replacement(axes, 2)]
    parts += [(k, m, True) for k, m in combinations(axes, 2)] if hodge else []
    tangents, found = forms.tangents(), []
    kinds = [(forms.prolongation, forms.lots, tangents, conductivity)]
    if len(others) > 1:
        same, shape = sparse.eye_array(len(forms.given), format="csr"), forms.linear.element
        flat = orthonormal(forms.flattened(tangents)[0][:, 0])
        lots, tangents = [forms.linear, *forms.lots[1:]], [spread(flat, shape), *tangents[1:]]
        kinds.append((same, lots, tangents, conductivity and forms.flattened(conductivity)))
    for (p, lots, tangents, kappa), other in zip(kinds, others, strict=True):
        elements = [
            _Elements(lot, lot.conductivity(a, forms.places), e)
            for lot, a, e in zip(lots, kappa or [None] * len(lots), tangents, strict=True)
        ]
        upper, values = _assembled(forms, p, elements, parts)
        matrix = _framed(upper, values, forms.given, frames, other)
        for x in (x for x in elements if x.lot.turns is not None):
            own = values_on(matrix.crow.numpy(), matrix.col.numpy(), x.turned(frames, hodge=hodge))
            matrix.values[0] += torch.from_numpy(own)
        found.append(matrix)
    return found


@dataclass(frozen=True)
class _Elements:
    """Elements of functions, a conductivity, and orthonormal tangent vectors at their Gauss points."""

    lot: Elements
    conductivity: Tensor | None
    tangents: Float[Tensor, "T Q n d"]

    @cached_property
    def covariant(self) -> tuple[Float[Tensor, "T Q S"], Float[Tensor, "Q S n_times_n"]]:
        """The element matrices of S_kl are sums of products of these, and of Π_kl."""
        shape, slopes = self.lot.element, conductance(self.lot.metric, self.conductivity)
        return self.lot.shared(shape.weights[:, None] * slopes), gradient_products(shape)

    @cached_property
    def turning(self) -> tuple[Float[Tensor, "T Q 1"], Float[Tensor, "Q 1 n_times_n"]]:
        """The same with ω_kl."""
        shape, kappa = self.lot.element, self.conductivity
        kappa = torch.ones_like(self.lot.metric[..., 0]) if kappa is None else kappa
        one, two = shape.gradients.unbind(-1)
        cross = one[:, :, None] * two[:, None]
        slopes = self.lot.shared((shape.weights * kappa)[..., None])
        return slopes, (cross - cross.mT).flatten(1)[:, None]

    def blocks(self, k: int, m: int, turning: bool) -> Float[Tensor, "T n_times_n"]:
        """Element matrices of a `Part`; zero for elements with turned vectors, see `turned`."""
        if self.lot.turns is not None:
            return self.lot.metric.new_zeros(len(self.lot.nodes), self.lot.nodes.shape[1] ** 2)
        one, two = self.tangents[..., k, :], self.tangents[..., m, :]
        direction, (slopes, products) = dot(one, two), self.covariant
        if turning:
            direction = one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0]
            slopes, products = self.turning
        return (direction[..., None] * slopes).flatten(1) @ products.flatten(0, 1)

    def turned(self, frames: Frames, *, hodge: bool) -> sparse.csr_array:
        """The stiffness (N d, N d) of elements at whose corners vectors are turned into their plane."""
        nodes, turns = self.lot.nodes, self.lot.turns
        assert turns is not None
        q, dim = turns @ at(frames, nodes), frames.shape[2]
        kinds, total = [(q, self.covariant)], torch.zeros((), dtype=q.dtype)
        if hodge:
            cross = torch.stack([q[..., 1, :], -q[..., 0, :]], -2)  # the quarter turn of ω
            kinds.append((cross, self.turning))
        for other, (slopes, products) in kinds:
            inner = torch.einsum("tika,tjkb->tiajb", q, other)
            blocks = slopes.flatten(1) @ products.flatten(0, 1)
            total = total + blocks.view(-1, *2 * (nodes.shape[1], 1)) * inner
        rows = (dim * nodes[..., None] + torch.arange(dim)).flatten(1)
        whole = summed(total.flatten(1), rows, dim * len(frames))
        return (whole + whole.T) / 2  # symmetric but for rounding


def _assembled(
    forms: Forms, p: Any, elements: list[_Elements], parts: list[Part]
) -> tuple[Any, Float[Tensor, "n n upper"]]:
    """Upper triangles on one pattern, the last of them, and S for all k and l; two are computed at a time."""
    values, upper = [], None
    for pair in zip(parts[::2], [*parts[1::2], parts[-1]], strict=False):
        blocks = [torch.complex(*(x.blocks(*part) for part in pair)) for x in elements]
        lots = (x.lot.nodes for x in elements)
        upper = forms.upper(p, list(map(ElementMatrices, lots, blocks)))
        both = torch.from_numpy(upper.data)
        values += [both.real, both.imag]
    size = forms.places.shape[1]
    found = values[0].new_zeros(size, size, len(values[0]))
    for (k, m, turning), value in zip(parts, values, strict=False):
        found[k, m] += value
        if k != m:
            found[m, k] += -value if turning else value
    return upper, found


def _framed(
    upper: Any, stiffness: Float[Tensor, "n n upper"], given: Tensor, frames: Frames, others: Csr
) -> Csr:
    """Σ_kl E_kᵀ S_kl E_l of the upper triangles of S_kl, with Σ_k E_kᵀ A E_k of the other channels A."""
    count, _, dim = frames.shape
    pattern, ends = Pattern.of(upper, given), torch.from_numpy(upper.indices).long()
    starts = torch.arange(count).repeat_interleave(torch.from_numpy(np.diff(upper.indptr)))
    frames = frames[given]
    whole, inner = (frames.new_empty(len(ends), dim, dim) for _ in range(2))
    for part in torch.arange(len(ends)).split(AT_ONCE):
        left, right = (at(frames, x[part]) for x in (starts, ends))
        inner[part] = left.mT @ right
        whole[part] = left.mT @ (stiffness[..., part].permute(2, 0, 1) @ right)
    own = whole[starts == ends]
    whole[starts == ends] = (own + own.mT) / 2  # symmetric but for rounding
    crow, col, order = pattern.crow, pattern.col, torch.from_numpy(pattern.order).long()
    turned = given[starts][order] != torch.arange(count).repeat_interleave(crow.diff())
    whole, inner = (at(torch.cat([x, x.mT]), order + len(x) * turned) for x in (whole, inner))
    # where the d rows of each block stand when the rows of a block row are written one after the other
    start, length = (x.repeat_interleave(crow.diff()) for x in (crow[:-1], crow.diff()))
    first = (dim - 1) * start + torch.arange(len(col))
    place = (first[:, None] + torch.arange(dim) * length[:, None]).view(-1)
    values = inner.new_empty(len(others.values), len(place), dim)
    for channel in range(len(values)):
        if channel:
            value = values_on(crow.numpy(), col.numpy(), others.to_scipy(channel))
            whole = torch.from_numpy(value)[:, None, None] * inner
        values[channel, place] = whole.view(-1, dim)
    columns = col.new_empty(len(place), dim)
    columns[place] = (dim * col[:, None] + torch.arange(dim)).repeat_interleave(dim, 0)
    rows = torch.cat([crow[:1], (dim * crow.diff()).repeat_interleave(dim).cumsum(0)])
    return Csr(rows, columns.view(-1), values.flatten(1))


class WeakGradient(NamedTuple):
    """The bilinear form ∫v·∇u of functions u and fields v on a surface, or ∫v·(ν × ∇u), for prolonged u and v.

    Its matrices, (NX, NX), are ∫φ_j (∇φ_i)_k for each component k in space.
    """

    prolongation: Any
    matrices: list[Any]

    @classmethod
    def of(cls, forms: Forms, normals: Float[Tensor, "N 3"] | None = None) -> WeakGradient:
        """The form with ∇u, or, with normals ν at the vertices, ν × ∇u."""
        found = []
        for lot in forms.lots:
            shape, slopes = lot.element, lot.slopes(forms.places)
            directions = _directions(lot.metric, slopes, lot.nodes[:, :3], normals)
            entries = lot.shared(shape.weights[:, None, None] * directions).unbind(2)
            products = torch.einsum("qia,qj->qaij", shape.gradients, shape.values).flatten(2)
            blocks = [entry.flatten(1) @ products.flatten(0, 1) for entry in entries]
            found.append([summed(block, lot.nodes, len(forms.places)) for block in blocks])
        return cls(forms.prolongation, [sum(each) for each in zip(*found, strict=True)])

    def divergence(self, v: Float[Tensor, "N n C"]) -> Float[Tensor, "N C"]:
        """∫v·∇φ_i of a field in space, differentiable in it."""
        nodes = (times(self.prolongation, x) for x in v.unbind(1))
        inside = [times(d, x) for d, x in zip(self.matrices, nodes, strict=True)]
        return times(self.prolongation.T, torch.stack(inside).sum(0))

    def gradient(self, u: Float[Tensor, "N C"]) -> Float[Tensor, "N n C"]:
        """∫e_kφ_i·∇u, the adjoint of `divergence`, differentiable in u."""
        nodes = times(self.prolongation, u)
        found = [times(self.prolongation.T, times(d.T, nodes)) for d in self.matrices]
        return torch.stack(found, 1)


def _directions(
    g: Tensor, slopes: Float[Tensor, "T Q n 2"], cells: Any, normals: Points | None
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
