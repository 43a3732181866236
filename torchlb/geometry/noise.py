"""Whether a cloud is noisy, and where its surface lies then (`method.md`, section 12)."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.fits.polynomials import monomial_columns, num_monomials
from torchlb.geometry.admission import admissible_neighbors
from torchlb.geometry.frames import complete_frames
from torchlb.geometry.neighbors import AT_ONCE
from torchlb.geometry.vectors import dot

SMOOTH = 4.0
"""From this F on what quadratics miss is taken for shape: of clean clouds F is 15 and more, of pure noise it is 1."""
SAMPLE = 2000
"""Points by which a cloud is judged."""
ROUNDING = 1e-6
"""Residuals below this share of a neighbourhood's radius are none."""
RIDGE = 1e-12


def denoised(
    points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], candidates: Int[Tensor, "N K"]
) -> tuple[Float[Tensor, "N 3"], float]:
    """Where the surface is, and how far the points are from it, root mean square, ℓ; the points and 0 if it is clean.

    A smooth surface that quadratics do not follow is followed by quartics: F, the variance that the quartic terms take
    out over that which they leave, is large. Noise has as much in every term. Noisy points move along their normals
    onto the quadratics through their neighbourhoods.
    """
    size = candidates.shape[1]
    if size < num_monomials(2, 4) + 3:
        return points, 0.0
    some = torch.arange(0, len(points), -(-len(points) // SAMPLE))
    radius, counts, two, _ = _residuals(points, normals, candidates, some, 2)
    _, _, four, _ = _residuals(points, normals, candidates, some, 4)
    free = counts - num_monomials(2, 2), counts - num_monomials(2, 4)
    use = (free[1] > 2) & (two > free[0] * (ROUNDING * radius) ** 2)
    if use.double().mean() < 0.5:
        return points, 0.0
    ratio = (two - four) / (free[0] - free[1]) / (four / free[1])
    if ratio[use].median() > SMOOTH:
        return points, 0.0
    moved, squares = points.clone(), []
    for part in torch.arange(len(points)).split(AT_ONCE):
        _, counts, left, offset = _residuals(points, normals, candidates, part, 2)
        known = counts > num_monomials(2, 2) + 2
        moved[part] += torch.where(known, offset, 0.0)[:, None] * normals[part]
        squares.append((left / (counts - num_monomials(2, 2)))[known])
    return moved, float(torch.cat(squares).median().sqrt())


def _residuals(
    points: Float[Tensor, "N 3"],
    normals: Float[Tensor, "N 3"],
    candidates: Int[Tensor, "N K"],
    centers: Int[Tensor, " B"],
    degree: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Radius, number of admissible neighbours, sum of squares that polynomials through them leave, height at 0."""
    index = candidates[centers]
    offset, frames = points[index] - points[centers, None], complete_frames(normals[centers])
    good = admissible_neighbors(points, normals, index)
    good[:, 0] = True
    radius = (offset.norm(dim=-1) * good).amax(1)
    heights = dot(offset, normals[centers, None]) * good
    scale = radius.clamp_min(torch.finfo(radius.dtype).tiny)[:, None, None]
    terms = monomial_columns(offset @ frames / scale, degree).mT
    terms = torch.cat([torch.ones_like(terms[:, :1]), terms], 1) * good[:, None]
    square = terms @ terms.mT
    square += RIDGE * good.sum(1)[:, None, None] * torch.eye(square.shape[-1]).to(square)
    coefficients = torch.linalg.solve(square, terms @ heights[..., None])
    left = heights - (terms.mT @ coefficients)[..., 0]
    return radius, good.sum(1), left.square().sum(1), coefficients[:, 0, 0]
