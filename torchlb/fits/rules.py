"""Rules for weights by name, least squares and polyharmonic splines; sizes and reference figures of good stencils."""

from __future__ import annotations

from functools import lru_cache
from math import ceil, gamma, pi
from typing import Literal, NamedTuple

import torch
from torch.nn.functional import pad

from torchlb.fits.polynomials import functionals, monomials, num_monomials
from torchlb.fits.weights import Coords, Heights, Weights, centered_fit, least_squares_weights

WeightsName = Literal["least_squares", "polyharmonic"]
SIZE_FACTORS = {
    "least_squares": (1.6, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0),
    "polyharmonic": (2.0, 2.5, 3.0),
}
"""Points of a stencil per polynomial, by the rule for its weights, in the order in which they are tried."""
RESOLVED_ON_MESH, RESOLVED_ON_CLOUD = 1.8, 4.1
"""Largest scatter of heights about a fit times the growth g∞, which turns it into an error of Δ. The bound is lower on
a mesh, whose triangles follow a surface that its points do not resolve better than a fit."""
RESOLVING_DEGREE = 4
"""Degree up to which the bound stays constant: the scatter about a low degree does not justify the next fits."""


def polyharmonic_weights(coords: Coords, degree: int, heights: Heights | None = None) -> Weights:
    r"""Derivatives of the interpolant by the spline :math:`|y|^{2m+3}` plus polynomials of degree m.

    On Deserno's sphere with 2,022 nodes errors are smaller than by least squares, 10 times at p = 3, 80 times at p = 5
    (`method.md`, section 2). Arguments and result are those of `least_squares_weights`; m ≥ 2.
    """
    exponent = 2 * degree + 3
    fit, (batch, _, dim) = centered_fit(coords, degree), coords.shape
    scaled, wanted = coords / fit.radius[:, None, None], functionals(dim, degree).to(coords)
    nodes = pad(scaled, (0, 0, 1, 0))
    # Distances from differences: |a|² − 2ab + |b|² would lose half the digits.
    kernel = (nodes[:, :, None] - nodes[:, None]).square().sum(-1).pow(exponent / 2)
    polynomials = pad(monomials(nodes, degree), (1, 0), value=1.0)
    num_points, num_polynomials = polynomials.shape[1:]
    lower = pad(polynomials.mT, (0, num_polynomials))
    matrix = torch.cat([torch.cat([kernel, polynomials], dim=2), lower], dim=1)
    exact = pad(wanted, (0, 0, 1, 0)).expand(batch, -1, -1)
    # derivatives at y = 0 of |y − y_j|^s: −s r^{s−2} y, and Δ, s (s + d − 2) r^{s−2}
    power = exponent * nodes.norm(dim=-1, keepdim=True) ** (exponent - 2)
    slopes = torch.cat([-power * nodes, (exponent + dim - 2) * power], dim=-1)
    right = torch.cat([slopes, exact], dim=1)
    factors, pivots, _ = torch.linalg.lu_factor_ex(matrix)
    weights = torch.linalg.lu_solve(factors, pivots, right)[:, :num_points]
    moments = fit.values.mT @ weights[:, 1:]
    # Points that nearly coincide have weights of any size, which cancel up to rounding.
    rounding = torch.finfo(weights.dtype).eps * weights.abs().sum(1).amax(1)
    violation = (moments - wanted).abs().amax((1, 2)) + rounding
    return fit.weights(weights, violation / wanted.abs().max(), dim, heights)


WEIGHT_RULES = {"least_squares": least_squares_weights, "polyharmonic": polyharmonic_weights}
"""The rules for the weights of a stencil, the values of the option `weights`."""


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


def resolution(dim: int, degree: int, *, on_mesh: bool, normals: bool) -> float:
    """Largest scatter of heights about a fit (`CenteredFit.scatter`) of a surface that its points resolve.

    On a mesh it is half as large if the `normals` of the fit count.
    """
    growth = max(reference(dim, m).growth for m in (degree, RESOLVING_DEGREE))
    return (RESOLVED_ON_MESH / (1 + normals) if on_mesh else RESOLVED_ON_CLOUD) / growth
