"""Lagrange elements on the reference simplex of any dimension.

The corners of a cell are ascending, so that neighbours agree on the order of their shared nodes.
"""

from __future__ import annotations

from functools import cache
from itertools import combinations, product
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from scipy.special import roots_jacobi
from torch import Tensor
from torch.nn.functional import pad

from torchlb.fits.polynomials import monomial_derivatives, monomials
from torchlb.geometry.vectors import Points, at
from torchlb.linalg.devices import constant


class Element(NamedTuple):
    """Shape functions φ_i at the points of a Gauss rule that is exact up to degree 2r + 1.

    Its weights sum to the volume of the reference simplex, 1/d!. `values` are φ_i, `gradients` ∇φ_i in reference
    coordinates, the barycentric ones of all corners but the first.
    """

    weights: Float[Tensor, " Q"]
    values: Float[Tensor, "Q n"]
    gradients: Float[Tensor, "Q n d"]

    @property
    def dim(self) -> int:
        """Dimension d."""
        return self.gradients.shape[2]

    @property
    def is_linear(self) -> bool:
        """Whether the degree is 1."""
        return self.values.shape[1] == self.dim + 1


@cache
def subsets(dim: int, size: int) -> tuple[tuple[int, ...], ...]:
    """Corners of the sub-simplices with `size` corners of a d-simplex, in the order of their nodes.

    The edges of a triangle go round it.

    >>> subsets(2, 2)
    ((0, 1), (1, 2), (0, 2))
    """
    every = combinations(range(dim + 1), size)
    return tuple(sorted(every, key=lambda corners: (corners[-1] - corners[0], corners)))


def edge_lengths(points: Points, cells: Int[Tensor, "T corners"]) -> Float[Tensor, "T e"]:
    """Lengths of the edges of each cell, in the order of `subsets`, ℓ."""
    first, second = torch.tensor(subsets(cells.shape[1] - 1, 2)).T
    return (at(points, cells[:, second]) - at(points, cells[:, first])).norm(dim=2)


@constant
def inner(size: int, degree: int) -> Float[Tensor, "n size"]:
    """Barycentric coordinates of the nodes inside a simplex with `size` corners.

    >>> inner(2, 3).round(decimals=4).tolist()
    [[0.6667, 0.3333], [0.3333, 0.6667]]
    """
    rows = [
        [degree - sum(rest), *reversed(rest)]
        for rest in product(range(1, degree), repeat=size - 1)
        if sum(rest) < degree
    ]
    return torch.tensor(rows, dtype=torch.float64).view(-1, size) / degree


@constant
def lattice(dim: int, degree: int) -> Float[Tensor, "n corners"]:
    """Barycentric coordinates of all nodes: corners, then nodes inside each edge, inside each triangle, and so on.

    >>> lattice(2, 2)[3:].tolist()
    [[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]]
    """
    rows = [torch.eye(dim + 1, dtype=torch.float64)]
    for size in range(2, dim + 2):
        for corners in subsets(dim, size):
            part = torch.zeros(len(inner(size, degree)), dim + 1, dtype=torch.float64)
            part[:, list(corners)] = inner(size, degree)
            rows.append(part)
    return torch.cat(rows)


@constant
def facet_nodes(dim: int, degree: int) -> Int[Tensor, "facets n"]:
    """Indices into `lattice` of the nodes of each facet, in the order of the lattice of dimension d − 1.

    >>> facet_nodes(2, 2).tolist()
    [[0, 1, 3], [1, 2, 4], [0, 2, 5]]
    """
    nodes, own, places = lattice(dim, degree), lattice(dim - 1, degree), []
    for corners in subsets(dim, dim):
        embedded = torch.zeros(len(own), dim + 1, dtype=torch.float64)
        embedded[:, list(corners)] = own
        places.append((embedded[:, None] == nodes).all(2).nonzero()[:, 1])
    return torch.stack(places)


@constant
def simplex(dim: int, degree: int) -> Element:
    """Lagrange element of dimension d and degree r ≥ 1, with its nodes on `lattice`.

    The quadrature is the collapsed Gauss–Jacobi product rule with (r + 1)^d points; on triangles it is averaged over
    the three rotations, so that the order of the corners is irrelevant.
    """
    rules = [roots_jacobi(degree + 1, k, 0) for k in range(dim)]  # weight (1 − y)^k, y in [−1, 1]
    axes = [torch.from_numpy((1 + x) / 2) for x, _ in rules]
    factors = [torch.from_numpy(w / 2 ** (k + 1)) for k, (_, w) in enumerate(rules)]
    points, weights = torch.zeros(1, 0, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    for axis, factor in zip(axes, factors, strict=True):  # a cone over the simplex so far
        slices = (1 - axis)[:, None, None] * points
        apex = axis[:, None, None].expand(-1, len(points), 1)
        points = torch.cat([slices, apex], 2).flatten(0, 1)
        weights = torch.outer(factor, weights).flatten()
    if dim == 2:
        shares = torch.cat([1 - points.sum(1, keepdim=True), points], 1)
        points = torch.cat([shares.roll(corner, 1)[:, 1:] for corner in range(dim + 1)])
        weights = weights.repeat(dim + 1) / (dim + 1)
    nodes = lattice(dim, degree)[:, 1:]
    at_nodes, powers = (pad(monomials(x, degree), (1, 0), value=1.0) for x in (nodes, points))
    inverse = torch.linalg.inv(at_nodes)
    slopes = points.new_zeros(len(points), len(nodes), dim)
    if dim:
        slopes[:, 1:] = monomial_derivatives(points, degree)
    gradients = torch.einsum("qmd,mn->qnd", slopes, inverse)
    return Element(weights, powers @ inverse, gradients)
