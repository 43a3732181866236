"""The rules for weights by name, and the growth that good stencils have."""

from __future__ import annotations

from functools import lru_cache

import torch

from torchlb.fits.polyharmonic import polyharmonic_weights
from torchlb.fits.polynomials import num_monomials
from torchlb.fits.weights import least_squares_weights, positive_weights

__all__ = ["WEIGHT_RULES", "typical_growth"]


@lru_cache(maxsize=64)
def typical_growth(dim: int, degree: int) -> float:
    """Growth ρ² Σ|w| of a stencil with very many evenly spread neighbours: what good stencils of any size have.

    >>> [round(typical_growth(2, m)) for m in (2, 4, 6, 8)]
    [23, 59, 110, 179]
    """
    cube = 2 * torch.quasirandom.SobolEngine(dim).draw(2**14).double() - 1
    ball = cube[cube.norm(dim=1) <= 1][1 : 20 * num_monomials(dim, degree)]
    weights = least_squares_weights(ball[None], degree)
    return float(weights.radius[0] ** 2 * weights.laplacian.abs().sum())


WEIGHT_RULES = {
    "least_squares": least_squares_weights,
    "polyharmonic": polyharmonic_weights,
    "positive": positive_weights,
}
"""The rules for the weights of a rung; the first two are the values of the option `weights`."""
