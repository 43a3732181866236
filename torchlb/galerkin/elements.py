"""Lagrange elements on the reference triangle and the reference segment."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.special import roots_jacobi
from torch import Tensor

from torchlb.fits.polynomials import monomial_derivatives, monomials

EDGES = ((0, 1), (1, 2), (2, 0))
"""Corners of the edges of a triangle, in the order of their nodes."""


class Element(NamedTuple):
    """Shape functions φ_i at the points of a Gauss rule that is exact up to degree 2r + 1.

    Attributes
    ----------
    weights : (Q,), their sum is the size of the reference simplex, ½ or 1.
    values : (Q, n), φ_i.
    gradients : (Q, n, d), in the reference coordinates: the barycentrics of the corners after the first.
    """

    weights: Float[Tensor, " Q"]
    values: Float[Tensor, "Q n"]
    gradients: Float[Tensor, "Q n d"]


@cache
def lattice(degree: int) -> Float[Tensor, "n 3"]:
    """Barycentrics of the nodes: the corners, those of each edge from its first corner on, those inside.

    >>> lattice(2)[3:].tolist()
    [[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]]
    """
    unit = torch.eye(3, dtype=torch.float64)
    steps = torch.arange(1, degree, dtype=torch.float64)[:, None] / degree
    edges = [(1 - steps) * unit[i] + steps * unit[j] for i, j in EDGES]
    inside = [
        [(degree - i - j) / degree, i / degree, j / degree]
        for j in range(1, degree)
        for i in range(1, degree - j)
    ]
    return torch.cat([unit, *edges, torch.tensor(inside, dtype=torch.float64).view(-1, 3)])


@cache
def triangle(degree: int) -> Element:
    """The element of degree r ≥ 1 with its nodes on `lattice`.

    Its rule is the collapsed product rule of (r + 1)² points, turned to each corner, so that their order is irrelevant.
    """
    x, wx = np.polynomial.legendre.leggauss(degree + 1)
    y, wy = roots_jacobi(
        degree + 1, 1, 0
    )  # weight 1 − y, the width of the triangle at η = (1 + y)/2
    x, y = np.meshgrid((1 + x) / 2, (1 + y) / 2, indexing="ij")
    points = torch.from_numpy(np.stack([x * (1 - y), y], axis=-1).reshape(-1, 2))
    shares = torch.cat([1 - points.sum(1, keepdim=True), points], 1)
    points = torch.cat([shares.roll(corner, 1)[:, 1:] for corner in range(3)])
    weights = torch.from_numpy(np.outer(wx, wy).reshape(-1) / 24).repeat(3)
    return _element(points, weights, lattice(degree)[:, 1:], degree)


@cache
def segment(degree: int) -> Element:
    """The element of degree r ≥ 1 on [0, 1]; its nodes are the two ends, then those between, in order."""
    x, wx = np.polynomial.legendre.leggauss(degree + 1)
    points = torch.from_numpy((1 + x) / 2)[:, None]
    steps = torch.arange(1, degree, dtype=torch.float64) / degree
    nodes = torch.cat([torch.tensor([0.0, 1.0], dtype=torch.float64), steps])[:, None]
    return _element(points, torch.from_numpy(wx / 2), nodes, degree)


def _element(points: Tensor, weights: Tensor, nodes: Tensor, degree: int) -> Element:
    inverse = torch.linalg.inv(_powers(nodes, degree))
    slopes = monomial_derivatives(points, degree)
    slopes = torch.cat([torch.zeros_like(slopes[:, :1]), slopes], dim=1)
    gradients = torch.einsum("qmd,mn->qnd", slopes, inverse)
    return Element(weights, _powers(points, degree) @ inverse, gradients)


def _powers(points: Float[Tensor, "Q d"], degree: int) -> Float[Tensor, "Q M"]:
    return torch.cat([torch.ones_like(points[:, :1]), monomials(points, degree)], dim=1)
