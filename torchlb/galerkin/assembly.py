"""Stiffness and mass of finite elements from the metric at their Gauss points."""

from __future__ import annotations

import torch
from jaxtyping import Complex, Float, Int, Shaped
from scipy import sparse
from torch import Tensor

from torchlb.galerkin.elements import Element

CHUNK = 2**14
"""Elements at a time: some 100 MB."""


def metric(
    places: Float[Tensor, "NX D"], elements: Int[Tensor, "T n"], shape: Element
) -> Float[Tensor, "T Q 3"]:
    """G = JᵀJ at the Gauss points of elements with nodes at `places`, as (g_ξξ, g_ξη, g_ηη), ℓ²."""
    slopes = torch.cat([*shape.gradients.unbind(-1)]).T.contiguous()  # (n, 2Q)
    xx = xy = yy = places.new_zeros(())
    for coordinate in places.T:
        x, y = (coordinate[elements] @ slopes).chunk(2, 1)
        xx, xy, yy = xx + x * x, xy + x * y, yy + y * y
    return torch.stack([xx, xy, yy], -1)


def flat_metric(lengths: Float[Tensor, "T 3"]) -> Float[Tensor, "T 3"]:
    """The same of flat triangles from the lengths of their edges, in the order of `EDGES`, ℓ.

    >>> flat_metric(torch.tensor([[1.0, 2.0**0.5, 1.0]])).round(decimals=6).abs().tolist()
    [[1.0, 0.0, 1.0]]
    """
    a, b, c = lengths.square().unbind(-1)
    return torch.stack([a, (a + c - b) / 2, c], dim=-1)


def area_element(g: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """√det G, ℓ²; zero where rounding makes the determinant negative."""
    return (g[..., 0] * g[..., 2] - g[..., 1].square()).clamp_min(0).sqrt()


def element_matrices(
    g: Float[Tensor, "T Q 3"], shape: Element, conductivity: Float[Tensor, "T Q"] | None = None
) -> Complex[Tensor, "T n_times_n"]:
    """K + iM of each element, both symmetric: ∫ κ∇φ_i·∇φ_j, without a unit, and ∫ φ_i φ_j, ℓ²; κ = 1 unless given.

    Two real matrices on one pattern, so that they are summed, and later multiplied, at once.
    """
    x, y = shape.gradients.unbind(-1)  # (Q, n)
    cross = x[:, :, None] * y[:, None, :]
    products = [y[:, :, None] * y[:, None], -(cross + cross.mT), x[:, :, None] * x[:, None]]
    gradients = torch.stack(products, 1).flatten(0, 1).flatten(1)
    squares = _squares(shape)
    blocks = torch.empty(len(g), squares.shape[1], dtype=torch.complex128)
    for first in range(0, len(g), CHUNK):
        part = slice(first, first + CHUNK)
        root = area_element(g[part])
        adjugate = shape.weights[:, None] * g[part] / root[..., None]
        if conductivity is not None:
            adjugate = conductivity[part, :, None] * adjugate
        stiffness = adjugate.flatten(1) @ gradients
        blocks[part] = torch.complex(stiffness, (shape.weights * root) @ squares)
    return blocks


def assemble_mass(
    size: Float[Tensor, "T Q"], nodes: Int[Tensor, "T n"], shape: Element, num_nodes: int
) -> sparse.csr_array:
    """∫ φ_i φ_j over elements whose area or length element at the Gauss points is `size`."""
    return summed((shape.weights * size) @ _squares(shape), nodes, num_nodes)


def _squares(shape: Element) -> Float[Tensor, "Q n_times_n"]:
    return (shape.values[:, :, None] * shape.values[:, None, :]).flatten(1)


def summed(
    blocks: Shaped[Tensor, "T n_times_n"], nodes: Int[Tensor, "T n"], num_nodes: int
) -> sparse.csr_array:
    """The matrix of all elements from the matrix of each, rows by rows."""
    size, nodes = nodes.shape[1], nodes.int()
    row, col = nodes.repeat_interleave(size, dim=1).flatten(), nodes.repeat(1, size).flatten()
    where = row.numpy(), col.numpy()
    return sparse.csr_array((blocks.flatten().numpy(), where), shape=(num_nodes, num_nodes))
