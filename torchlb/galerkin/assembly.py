"""Stiffness and mass of finite elements from the metric at their Gauss points, in every dimension d = 1, 2, 3.

A symmetric (d, d) matrix is stored as its upper triangle, row by row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Complex, Float, Int, Shaped
from scipy import sparse
from torch import Tensor

from torchlb.galerkin.elements import Element, simplex, subsets
from torchlb.geometry.vectors import at
from torchlb.linalg.once import computed_again
from torchlb.linalg.precision import AT_ONCE, rows_at_once


def metric(
    places: Float[Tensor, "NX D"], elements: Int[Tensor, "T n"], shape: Element
) -> Float[Tensor, "T Q S"]:
    """Upper triangle of the metric G = JᵀJ, ℓ², at the Gauss points of elements with nodes at `places`."""
    dim = shape.dim
    if dim == 0:
        return places.new_zeros(len(elements), len(shape.weights), 0)
    slopes = torch.cat([*shape.gradients.unbind(-1)]).T.contiguous()  # (n, d Q)
    entries = places.new_zeros(dim * (dim + 1) // 2, len(elements), len(shape.weights))
    for coordinate in places.T:
        along = (coordinate[elements] @ slopes).chunk(dim, 1)
        pairs = combinations_with_replacement(along, 2)
        for number, (x, y) in enumerate(pairs):
            entries[number] += x * y
    return entries.movedim(0, -1)


def flat_metric(lengths: Float[Tensor, "T e"]) -> Float[Tensor, "T S"]:
    """Metric of flat simplices, ℓ², from their edge lengths, ℓ, in the order of `subsets`.

    >>> flat_metric(torch.tensor([[1.0, 2.0**0.5, 1.0]])).round(decimals=6).abs().tolist()
    [[1.0, 0.0, 1.0]]
    """
    dim = {1: 1, 3: 2, 6: 3}[lengths.shape[-1]]
    square = dict(zip(subsets(dim, 2), lengths.square().unbind(-1), strict=True))
    entries = [
        square[0, a] if a == b else (square[0, a] + square[0, b] - square[a, b]) / 2
        for a in range(1, dim + 1)
        for b in range(a, dim + 1)
    ]
    return torch.stack(entries, dim=-1)


def cofactors(g: Float[Tensor, "*batch S"]) -> Float[Tensor, "*batch S"]:
    """Upper triangle of the adjugate det(G) G⁻¹.

    >>> cofactors(torch.tensor([2.0, 0.5, 3.0])).tolist()
    [3.0, -0.5, 2.0]
    """
    if g.shape[-1] == 1:
        return torch.ones_like(g)
    if g.shape[-1] == 3:
        xx, xy, yy = g.unbind(-1)
        return torch.stack([yy, -xy, xx], -1)
    xx, xy, xz, yy, yz, zz = g.unbind(-1)
    first = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    others = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
    return torch.stack([*first, *others], -1)


def area_element(g: Float[Tensor, "*batch S"]) -> Float[Tensor, "*batch"]:
    """Volume element √det G, ℓ^d; zero where rounding makes the determinant negative."""
    if g.shape[-1] == 0:
        return g.new_ones(g.shape[:-1])
    if g.shape[-1] == 3:
        return (g[..., 0] * g[..., 2] - g[..., 1].square()).clamp_min(0).sqrt()
    return (g[..., :3] * cofactors(g)[..., :3]).sum(-1).clamp_min(0).sqrt()


def conductance(
    g: Float[Tensor, "*batch S"], conductivity: Tensor | None = None
) -> Float[Tensor, "*batch S"]:
    """Upper triangle of √det(G) A, for ∫A∇u·∇w in reference coordinates.

    The conductivity is a number κ (…), A = κG⁻¹, or a tensor in these coordinates, (…, S), as `in_cells` has it.

    >>> conductance(torch.tensor([4.0]), torch.tensor(8.0)).tolist(), conductance(torch.tensor([4.0])).tolist()
    ([4.0], [0.5])
    """
    root = area_element(g)
    if conductivity is not None and conductivity.ndim == g.ndim:
        return root[..., None] * conductivity
    scale = 1 / root if conductivity is None else conductivity / root
    return cofactors(g) * scale[..., None]


def in_cells(
    a: Float[Tensor, "*batch n n"], edges: Float[Tensor, "*batch n d"], g: Float[Tensor, "*batch S"]
) -> Float[Tensor, "*batch S"]:
    """Upper triangle of a space tensor in reference coordinates, R⁻¹(QᵀAQ)R⁻ᵀ with G = RᵀR.

    Q are orthonormal vectors along the edges of a cell, or its partial derivatives, whose lengths G may not have.
    """
    q, r = torch.linalg.qr(edges)
    q = torch.where(r.diagonal(dim1=-2, dim2=-1)[..., None, :] < 0, -q, q)
    places = {1: [[0]], 3: [[0, 1], [1, 2]], 6: [[0, 1, 2], [1, 3, 4], [2, 4, 5]]}
    root = torch.linalg.cholesky_ex(g[..., places[g.shape[-1]]], upper=True).L
    others, r = root.diagonal(dim1=-2, dim2=-1)[..., :-1].prod(-1), root.clone()
    # rounded as for numbers: needles have hardly any area
    r[..., -1, -1] = area_element(g) / others
    one = torch.eye(r.shape[-1], dtype=r.dtype).expand_as(r)
    inverse = torch.linalg.solve_triangular(r, one, upper=True)
    row, col = torch.triu_indices(*r.shape[-2:])
    return (inverse @ (q.mT @ a @ q) @ inverse.mT)[..., row, col]


def gradient_products(shape: Element) -> Float[Tensor, "Q S n_times_n"]:
    """∂_a φ_i ∂_b φ_j at the Gauss points for a = b, and its sum with a and b exchanged for a < b."""
    products = []
    for x, y in combinations_with_replacement(shape.gradients.unbind(-1), 2):
        cross = x[:, :, None] * y[:, None, :]
        products.append(cross if x is y else cross + cross.mT)
    return torch.stack(products, 1).flatten(2)


def squares(shape: Element) -> Float[Tensor, "Q n_times_n"]:
    """φ_i φ_j at the Gauss points."""
    return (shape.values[:, :, None] * shape.values[:, None, :]).flatten(1)


def spread(x: Tensor, shape: Element) -> Tensor:
    """A value for each cell, (T, …), at its Gauss points, (T, Q, …)."""
    return x[:, None].expand(-1, len(shape.weights), *x.shape[1:])


def entries_of(
    nodes: Int[Tensor, "T n"], blocks: Shaped[Tensor, "T n_times_n c"]
) -> tuple[Int[Tensor, " e"], Int[Tensor, " e"], Shaped[Tensor, "e c"]]:
    """Rows, columns and values of element matrices, flattened row by row."""
    size = nodes.shape[1]
    row, col = nodes.repeat_interleave(size, 1), nodes.repeat(1, size)
    return row.flatten(), col.flatten(), blocks.flatten(0, 1)


def summed(
    blocks: Shaped[Tensor, "T n_times_n"], nodes: Int[Tensor, "T n"], num_nodes: int
) -> sparse.csr_array:
    """Assemble element matrices, each flattened row by row, into one sparse matrix."""
    row, col, values = (part.numpy() for part in entries_of(nodes.int(), blocks[..., None]))
    result = sparse.csr_array((values[:, 0], (row, col)), shape=(num_nodes, num_nodes))
    result.data, result.indices = result.data.copy(), result.indices.copy()  # without duplicates
    return result


class ElementMatrices(NamedTuple):
    """Nodes of elements, (T, n), and their stiffness and mass as complex matrices K + iM, row by row, (T, n²)."""

    nodes: Int[Tensor, "T n"]
    blocks: Complex[Tensor, "T n_times_n"]

    def row_sums(self, count: int) -> Float[Tensor, " count"]:
        """M1 of the assembled matrix of `count` nodes."""
        shares = self.blocks.imag.unflatten(1, 2 * self.nodes.shape[1:]).sum(2).flatten()
        return shares.new_zeros(count).index_add_(0, self.nodes.flatten(), shares)


@dataclass(frozen=True)
class Elements:
    """Elements of the cells of a complex, curved ones, or flat ones of degree 1, with their nodes and metric, ℓ².

    A field of a medium has values at their Gauss points, (T, Q, …), of flat elements all equal; one left out is 1. Of
    each element the fraction `share` is integrated, a number or (T,). `mix`, (T, F), has the share of each face of the
    mesh in an element, None where elements are beside the faces. With factors `lumped` for the points, the mass is in
    equal shares at the corners, times these. Of tangent fields `turns` take the vector at each corner into the plane of
    the cell, see `torchlb.galerkin.creases`; None where fields are prolonged as vectors of space.
    """

    nodes: Int[Tensor, "T n"]
    metric: Float[Tensor, "T Q S"]
    element: Element
    share: Any = 1.0
    mix: Any = None
    lumped: Float[Tensor, " N"] | None = None
    turns: Float[Tensor, "T corners d space"] | None = None

    @classmethod
    def flat(
        cls, cells: Int[Tensor, "T corners"], lengths: Float[Tensor, "T e"], **others: Any
    ) -> Elements:
        """Linear elements on flat cells with these edge lengths, ℓ."""
        shape = simplex(cells.shape[1] - 1, 1)
        return cls(cells, spread(flat_metric(lengths), shape), shape, **others)

    def slopes(self, places: Float[Tensor, "NX n"]) -> Float[Tensor, "T Q n d"]:
        """Derivatives of the position in reference coordinates at the Gauss points."""
        return torch.einsum("tnk,qnd->tqkd", at(places, self.nodes), self.element.gradients)

    def conductivity(self, a: Tensor | None, places: Float[Tensor, "NX n"]) -> Tensor | None:
        """A conductivity as `conductance` takes it; the plane of a cell is that of its nodes, whatever the metric."""
        if a is None or a.ndim == 2:
            return a
        slopes = self.slopes(places)
        if self.element.is_linear:
            return spread(in_cells(a[:, 0], slopes[:, 0], self.metric[:, 0]), self.element)
        return in_cells(a, slopes, self.metric)

    def shared(self, x: Tensor) -> Tensor:
        """Values of the elements, (T, …), times the fractions of these that are integrated."""
        share = torch.as_tensor(self.share, dtype=torch.float64)
        return share.view(-1, *[1] * (x.ndim - 1)) * x

    def matrices(
        self, conductivity: Tensor | None = None, density: Float[Tensor, "T Q"] | None = None
    ) -> ElementMatrices:
        """Their matrices: K = ∫ A∇φ_i·∇φ_j, ℓ^{d−2}, and M = ∫ ρφ_i φ_j, ℓ^d; A, as in `conductance`, and ρ are 1.

        Packed into one complex matrix they are assembled and multiplied together.
        """
        g, shape = self.metric, self.element
        gradients, masses = gradient_products(shape).flatten(0, 1), squares(shape)
        blocks = torch.empty(len(g), masses.shape[1], dtype=torch.complex128)
        for first in range(0, len(g), AT_ONCE):
            part = slice(first, first + AT_ONCE)
            kappa, rho = (None if x is None else x[part] for x in (conductivity, density))
            entries = shape.weights[:, None] * conductance(g[part], kappa)
            size = shape.weights * area_element(g[part])
            mass = (size if rho is None else rho * size) @ masses
            blocks[part] = torch.complex(entries.flatten(1) @ gradients, mass)
        if self.lumped is not None:
            corners, total = self.nodes.shape[1], blocks.imag.sum(1, keepdim=True)
            blocks.imag.zero_()
            blocks.imag[:, :: corners + 1] = self.lumped[self.nodes] * total / corners
        return ElementMatrices(self.nodes, self.shared(blocks))

    def outer(self, values: list[Tensor], c: Float[Tensor, " C"]) -> Float[Tensor, "T n_times_n"]:
        """Σ_k c_k w_k(i) u_k(j) for all pairs of nodes of each element, of two functions at the nodes."""
        one, two = values[0] * c, values[1]
        parts = self.nodes.split(rows_at_once(self.nodes.shape[1] * len(c)))
        return torch.cat([computed_again(_outer, one, two, part) for part in parts])

    def weighted_slopes(
        self, blocks: Float[Tensor, "T n_times_n"], conductivity: Tensor | None
    ) -> Float[Tensor, "T Q"]:
        """Quadrature weights times Σ_k c_k A∇w_k·∇u_k at the Gauss points, from `outer`."""
        entries = conductance(self.metric, conductivity).unbind(-1)
        crosses = gradient_products(self.element).unbind(1)
        total = [entry * (blocks @ cross.T) for entry, cross in zip(entries, crosses, strict=True)]
        return self.element.weights * torch.stack(total).sum(0)

    def weighted_products(
        self, blocks: Float[Tensor, "T n_times_n"], density: Tensor | None = None
    ) -> Float[Tensor, "T Q"]:
        """Quadrature weights times Σ_k c_k ρ w_k u_k at the Gauss points."""
        shape = self.element
        found = shape.weights * area_element(self.metric) * (blocks @ squares(shape).T)
        return found if density is None else density * found


def _outer(one: Tensor, two: Tensor, nodes: Tensor) -> Tensor:
    return (at(one, nodes) @ at(two, nodes).mT).flatten(1)


def upper_congruence(p: Any, lots: Sequence[ElementMatrices]) -> sparse.csr_array:
    """Upper triangle of PᵀAP, where A is the sum of lots of element matrices; its pattern has no regard to values."""
    from torchlb.linalg.kernels import congruence

    nodes = np.concatenate([lot.nodes.flatten().numpy() for lot in lots]).astype(np.uint32)
    sizes = np.concatenate([np.full(len(lot.nodes), lot.nodes.shape[1]) for lot in lots])
    size, first = (each.repeat(sizes) for each in (sizes, sizes.cumsum() - sizes))
    order, start = nodes.argsort(kind="stable"), size.cumsum() - size
    ends = np.bincount(nodes, minlength=p.shape[0]).cumsum()
    rows = np.concatenate([[0], ends]), first[order], start[order], size[order]
    elements = nodes, torch.cat([lot.blocks.flatten() for lot in lots]).numpy()
    left, unsigned, count = p.T.tocsr(), np.uint32, p.shape[1]  # unsigned indices are faster
    left, right = (
        (m.indptr.astype(np.int32), m.indices.astype(unsigned), m.data)
        for m in (left, left.T.tocsr())  # with ascending columns
    )
    room = [
        (np.empty(length, complex), np.empty(length, np.int32), np.empty(length, unsigned))
        for length in p.shape
    ]
    indptr, done = np.zeros(count + 1, np.int32), 0
    indices, data = np.empty(64 * count, unsigned), np.empty(64 * count, complex)
    while done < count:
        for _, seen, _ in room:
            seen.fill(-1)
        done = congruence(done, left, right, rows, elements, *room, (indptr, indices, data))
        length = int(indptr[done])
        if done < count:
            length = max(2 * len(indices), int(1.1 * length * count / max(done, 1)))
        for x in (indices, data):
            x.resize(length, refcheck=False)
    return sparse.csr_array((data, indices.view(np.int32), indptr), shape=(count, count))
