"""Weights of polyharmonic splines (PHS) with polynomials (`method.md`, section 2)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor

from torchlb.fits.least_squares import left_inverse
from torchlb.fits.polynomials import functionals, monomials
from torchlb.fits.weights import Weights, finish, height_residual, scaled_system


def polyharmonic_weights(
    coords: Float[Tensor, "B neighbors d"],
    degree: int,
    heights: Float[Tensor, "B neighbors n"] | None = None,
) -> Weights:
    r"""Derivatives of the interpolant by the spline :math:`|y|^{2m+3}` plus polynomials of degree m.

    On Deserno's sphere with 2,022 nodes errors are smaller than by least squares, 10 times at p = 3, 80 times at p = 5
    (`method.md`, section 2). Arguments and result are those of `least_squares_weights`; m ≥ 2.
    """
    exponent = 2 * degree + 3
    radius, scaled, values, root = scaled_system(coords, degree)
    batch, _, dim = coords.shape
    wanted = functionals(dim, degree).to(coords)
    coefficients, condition = left_inverse(values, root)

    nodes = torch.cat([scaled.new_zeros(batch, 1, dim), scaled], dim=1)
    # Distances from differences: |a|² − 2ab + |b|² would lose half the digits.
    kernel = (nodes[:, :, None] - nodes[:, None]).square().sum(-1).pow(exponent / 2)
    polynomials = torch.cat([torch.ones_like(nodes[..., :1]), monomials(nodes, degree)], dim=-1)
    num_points, num_polynomials = polynomials.shape[1:]
    zero = kernel.new_zeros(batch, num_polynomials, num_polynomials)
    upper = torch.cat([kernel, polynomials], dim=2)
    matrix = torch.cat([upper, torch.cat([polynomials.mT, zero], dim=2)], dim=1)
    exact = torch.cat([wanted.new_zeros(1, dim + 1), wanted]).expand(batch, -1, -1)
    right = torch.cat([_kernel_derivatives(nodes, exponent), exact], dim=1)
    factors, pivots, _ = torch.linalg.lu_factor_ex(matrix)
    weights = torch.linalg.lu_solve(factors, pivots, right)[:, :num_points]
    moments = values.mT @ weights[:, 1:]
    # Points that nearly coincide have weights of any size, which cancel up to rounding.
    rounding = torch.finfo(weights.dtype).eps * weights.abs().sum(1).amax(1)
    violation = (moments - wanted).abs().amax((1, 2)) + rounding
    residual = violation / wanted.abs().max()
    left = torch.zeros_like(radius)
    if heights is not None:
        left = height_residual(values, coefficients, root, coords, heights)
    return finish(weights, residual, radius, condition, left, dim)


def _kernel_derivatives(nodes: Float[Tensor, "B K d"], s: int) -> Float[Tensor, "B K F"]:
    """First derivatives, then Δ, at y = 0 of |y − y_j|^s: −s r^{s−2} y and s (s + d − 2) r^{s−2}."""
    power = s * nodes.norm(dim=-1, keepdim=True) ** (s - 2)
    return torch.cat([-power * nodes, (s + nodes.shape[-1] - 2) * power], dim=-1)
