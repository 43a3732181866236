"""Rules for weights by name, sizes of their stencils, and reference figures of good stencils."""

from __future__ import annotations

from functools import lru_cache
from math import ceil, gamma, pi
from typing import Literal, NamedTuple

import torch

from torchlb.fits.polyharmonic import polyharmonic_weights
from torchlb.fits.polynomials import num_monomials
from torchlb.fits.weights import least_squares_weights, positive_weights

WeightsName = Literal["least_squares", "polyharmonic"]
WEIGHT_RULES = {
    "least_squares": least_squares_weights,
    "polyharmonic": polyharmonic_weights,
    "positive": positive_weights,
}
"""The rules for the weights of a stencil; the first two are the values of the option `weights`."""

SIZE_FACTORS = {
    "least_squares": (1.6, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0),
    "polyharmonic": (2.0, 2.5, 3.0),
    "positive": (1.6, 2.5, 4.0, 7.0, 10.0),
}
"""Points of a stencil per polynomial, by the rule for its weights, in the order in which they are tried."""


class Reference(NamedTuple):
    """Figures of a good stencil: the growth ρ² Σ|w|, and the ratio Σ_{j≠i}|w_j| / |w_i|."""

    growth: float
    off_diagonal_ratio: float


@lru_cache(maxsize=256)
def reference(
    dim: int, degree: int, rule: str = "least_squares", one_sided: bool = False
) -> Reference:
    """Figures of the widest stencil of a rule on a cubic lattice, close to those of its other evenly spaced stencils.

    A one-sided stencil is centred on a flat boundary whose Neumann data it uses.

    >>> [round(reference(2, m).growth) for m in (2, 4, 6, 8)]
    [23, 59, 110, 180]
    >>> [round(reference(2, m, one_sided=True).growth) for m in (2, 4, 6, 8)]
    [23, 173, 761, 2367]
    """
    count = ceil(SIZE_FACTORS[rule][-1] * num_monomials(dim, degree))
    # A ball of `count` points of Zᵈ (twice as many where half of them are cut off), to whole shells.
    volume = pi ** (dim / 2) / gamma(dim / 2 + 1)
    reach = ceil(((1 + one_sided) * count / volume) ** (1 / dim)) + 1
    axis = torch.arange(-reach, reach + 1, dtype=torch.float64)
    nodes = torch.cartesian_prod(*[axis] * dim).view(-1, dim)
    nodes = nodes[nodes[:, 0] <= 0] if one_sided else nodes
    square = nodes.square().sum(1)
    nodes = nodes[(square <= square.sort().values[count - 1]) & (square > 0)]
    options = {}
    if one_sided:
        options["flux"] = torch.zeros(1, len(nodes) + 1, dim, dtype=torch.float64)
        options["flux"][0, :, 0] = torch.cat([torch.ones(1), (nodes[:, 0] == 0).double()])
    weights = WEIGHT_RULES[rule](nodes[None], degree, **options)
    center, others = weights.laplacian[0, 0].abs(), weights.laplacian[0, 1:].abs().sum()
    growth = weights.radius[0].square() * (center + others)
    return Reference(float(growth), float(others / center))
