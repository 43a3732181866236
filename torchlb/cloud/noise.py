"""Noise of a cloud: its detection, and denoising by local quadratics (`method.md`, section 12)."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from torchlb.fits.polynomials import monomials, num_monomials
from torchlb.geometry.compatibility import admissible_neighbors
from torchlb.geometry.frames import complete_frames
from torchlb.linalg.precision import AT_ONCE, LOW, NEGLIGIBLE, ROUNDING

SMOOTH = 4.0
"""F from which on the residual of quadratics is taken for shape: 6 and more of clean clouds, 1.5 to 4 with noise of a
twentieth of the spacing, 1 of pure noise."""
SAMPLE = 2000
"""Number of points by which a cloud is judged."""
PATCH = 40
"""Number of points around each whose heights are tested for two layers."""
UNIMODAL = 1.6
"""Kurtosis of the residuals of quadratics below which they form two layers: 1 for two values, at least 9/5 for a
symmetric unimodal distribution, 3 for a normal one."""


def denoised(
    points: Float[Tensor, "N n"],
    planes: Float[Tensor, "N n"] | Float[Tensor, "N n d"],
    candidates: Int[Tensor, "N K"],
) -> tuple[Float[Tensor, "N n"], float]:
    """(points on the shape; root mean square distance of the cloud from it, ℓ); the points and 0 if it is clean.

    Quartics follow a smooth shape where quadratics do not: F, the variance removed by the quartic terms over that which
    remains, is large. Noise has as much in every term. Noisy points move onto the quadratics through their
    neighbourhoods, along the normals of a surface or orthogonally to tangent frames.
    """
    dim = points.shape[1] - 1 if planes.ndim == 2 else planes.shape[2]
    size, terms = candidates.shape[1], [num_monomials(dim, degree) for degree in (2, 4)]
    if size < terms[1] + 3:
        return points, 0.0
    some = torch.arange(0, len(points), -(-len(points) // SAMPLE))
    radius, counts, two, _ = _residuals(points, planes, candidates, some, 2)
    _, _, four, _ = _residuals(points, planes, candidates, some, 4)
    free = counts - terms[0], counts - terms[1]
    use = (free[1] > 2) & (two > free[0] * (NEGLIGIBLE * radius) ** 2)
    if use.double().mean() < 0.5:
        return points, 0.0
    ratio = (two - four) / (free[0] - free[1]) / (four / free[1])
    if ratio[use].median() > SMOOTH:
        return points, 0.0
    moved, squares = points.clone(), []
    for part in torch.arange(len(points)).split(AT_ONCE):
        _, counts, left, offset = _residuals(points, planes, candidates, part, 2)
        known = counts > terms[0] + 2
        moved[part] += torch.where(known[:, None], offset, 0.0)
        squares.append((left / (counts - terms[0]))[known])
    return moved, float(torch.cat(squares).median().sqrt())


def in_two_layers(points: Float[np.ndarray, "N 3"]) -> tuple[Int[np.ndarray, " M"], int]:
    """(sampled points around which points lie in two layers, a spacing apart or closer; size of the sample).

    Noise makes heights over the surface unimodal, most frequent in the middle; of two layers the middle is the rarest,
    which shows in the kurtosis of the residuals of local quadratics. Clouds of fewer than 2 `PATCH` points are not
    tested.
    """
    some = np.arange(0, len(points), -(-len(points) // SAMPLE))
    if len(points) < 2 * PATCH:
        return some[:0], len(some)
    distance, index = (np.asarray(part) for part in KDTree(points).query(points[some], k=PATCH))
    offset = points[index] - points[index].mean(1, keepdims=True)
    axes = np.linalg.eigh(offset.transpose(0, 2, 1) @ offset)[1]
    height, v, u = np.moveaxis(offset @ axes / distance[:, -1:, None], -1, 0)
    basis = np.linalg.qr(np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], -1))[0]
    height -= (basis @ (basis.transpose(0, 2, 1) @ height[..., None]))[..., 0]
    square = np.square(height).mean(1)
    layered = (height**4).mean(1) < UNIMODAL * square**2
    return some[layered & (square > LOW**2 * np.pi / PATCH)], len(some)


def _residuals(
    points: Float[Tensor, "N n"],
    planes: Float[Tensor, "N n"] | Float[Tensor, "N n d"],
    candidates: Int[Tensor, "N K"],
    centers: Int[Tensor, " B"],
    degree: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """(radius; number of compatible neighbours; sum of squared residuals of polynomials; their offset at 0)."""
    index = candidates[centers]
    offset = points[index] - points[centers, None]
    good = admissible_neighbors(points, planes, index)
    good[:, 0] = True
    radius = (offset.norm(dim=-1) * good).amax(1)
    frames = complete_frames(planes[centers]) if planes.ndim == 2 else planes[centers]
    coords = offset @ frames
    heights = (offset - coords @ frames.mT) * good[..., None]
    scale = radius.clamp_min(torch.finfo(radius.dtype).tiny)[:, None, None]
    terms = monomials(coords / scale, degree).mT
    terms = torch.cat([torch.ones_like(terms[:, :1]), terms], 1) * good[:, None]
    square = terms @ terms.mT
    square += ROUNDING * good.sum(1)[:, None, None] * torch.eye(square.shape[-1]).to(square)
    coefficients = torch.linalg.solve(square, terms @ heights)
    left = heights - terms.mT @ coefficients
    return radius, good.sum(1), left.square().sum((1, 2)), coefficients[:, 0]
