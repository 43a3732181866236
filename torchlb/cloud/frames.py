"""Tangent frames and normals of a cloud."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from torchlb.fits.polynomials import monomials
from torchlb.fits.weights import window
from torchlb.geometry.compatibility import admissible_neighbors, planes_of
from torchlb.geometry.frames import complete_frames
from torchlb.geometry.vectors import dot
from torchlb.linalg.precision import AT_ONCE, ROUNDING, TINY


def cloud_frames(
    points: Float[Tensor, "N n"], candidates: Int[Tensor, "N K"], dim: int, rounds: int = 3
) -> Float[Tensor, "N n d"]:
    """Initial frames of a cloud: distance-weighted principal components of the nearer half of the candidates.

    Each further round takes the nearest candidates that are compatible by the frames before, so that the other side of
    a thin sheet drops out. The error is O(h) on a smooth surface.
    """
    planes = None
    frames = torch.empty(0)
    for _ in range(rounds):
        parts = candidates.split(AT_ONCE)
        frames = torch.cat([_principal_directions(points, part, planes, dim) for part in parts])
        planes = planes_of(frames)
    return frames


def _principal_directions(
    points: Float[Tensor, "N n"],
    index: Int[Tensor, "B K"],
    planes: Float[Tensor, "N n d"] | Float[Tensor, "N n"] | None,
    dim: int,
) -> Float[Tensor, "B n d"]:
    """Leading eigenvectors of the weighted covariance of the nearer half of the compatible points.

    All points count where the compatible ones are too few for a plane, as at a corner whose neighbours stand across it.
    """
    offset = points[index] - points[index[:, :1]]
    distance = offset.norm(dim=-1)
    good = torch.ones_like(index, dtype=torch.bool)
    if planes is not None:
        good = admissible_neighbors(points, planes, index)
        good |= good.sum(1, keepdim=True) <= dim
    near = good & (good.cumsum(1) <= (index.shape[1] + 1) // 2)
    reach = (distance * near).amax(1, keepdim=True).clamp_min(torch.finfo(distance.dtype).tiny)
    weight = window((distance / reach).clamp_max(1.1)) * near
    weight = weight / weight.sum(1, keepdim=True)
    centered = offset - (weight[..., None] * offset).sum(1, keepdim=True)
    covariance = centered.mT @ (weight[..., None] * centered)
    return torch.linalg.eigh(covariance).eigenvectors[..., -dim:]


def refined_normals(
    points: Float[Tensor, "N 3"],
    normals: Float[Tensor, "N 3"],
    candidates: Int[Tensor, "N K"],
    centers: Int[Tensor, " B"] | None = None,
    rounds: int = 1,
) -> Float[Tensor, "N 3"]:
    """Unit normals, at `centers` from quadratics through compatible candidates, with error O(h²); not oriented.

    The quadratics need not pass through the point itself, which lessens the effect of noise on the slope.
    """
    centers = torch.arange(len(points)) if centers is None else centers
    parts = centers.split(AT_ONCE)
    for _ in range(rounds):
        found = [_slopes_removed(points, normals, candidates[part]) for part in parts]
        normals = normals.index_put((centers,), torch.cat(found))
    return normals


def _slopes_removed(
    points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], index: Int[Tensor, "B K"]
) -> Float[Tensor, "B 3"]:
    """Normals at the first point of each row, turned by the slope of a quadratic through its neighbours."""
    own = normals[index[:, 0]]
    frames = complete_frames(own)
    offset = points[index] - points[index[:, :1]]
    distance = offset.norm(dim=-1)
    good = admissible_neighbors(points, normals, index)
    good[:, 0] = True
    reach = (distance * good).amax(1, keepdim=True).clamp_min(TINY)
    weight = window((distance / reach).clamp_max(1.1)) * good
    terms = monomials(offset @ frames / reach[..., None], 2).mT
    terms = torch.cat([torch.ones_like(terms[:, :1]), terms], 1) * weight[:, None]
    heights = weight * dot(offset, own[:, None]) / reach
    square = terms @ terms.mT
    trace = square.diagonal(dim1=-2, dim2=-1).sum(-1)
    square += ROUNDING * trace[:, None, None] * torch.eye(6, dtype=points.dtype)
    slope = torch.linalg.solve(square, terms @ heights[..., None])[:, 1:3]
    sound = (good.sum(1) > 7) & (slope[..., 0].norm(dim=1) < 1)
    return torch.where(sound[:, None], normalize(own - (frames @ slope)[..., 0]), own)
