"""Compatibility of neighbours: which may enter a point's stencil (`method.md`, section 4)."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.geometry.thresholds import CREASE, HALF_CREASE
from torchlb.geometry.vectors import Frames, Near, Points, at, dot
from torchlb.linalg.precision import AT_ONCE


def planes_of(frames: Frames) -> Frames | Points:
    """Tangent planes as `compatible` takes them: unit normals of a surface in R³, else the frames."""
    return torch.linalg.cross(*frames.unbind(-1)) if frames.shape[1:] == (3, 2) else frames


def plucker_coordinates(frames: Frames) -> Float[Tensor, "N minors"]:
    """Minors of the frames, whose inner products are det(E_kᵀE_i); for a surface in R³ its normals."""
    planes, (n, dim) = planes_of(frames), frames.shape[1:]
    if planes.ndim == 2:
        return planes
    return torch.linalg.det(frames[:, torch.combinations(torch.arange(n), dim)])


def compatible(
    points: Points, planes: Frames | Points, centers: Int[Tensor, " P"], others: Int[Tensor, " P"]
) -> Bool[Tensor, " P"]:
    """Whether `others[j]` may enter the stencil of `centers[j]`.

    Tangent planes of compatible points are less than 60° apart (|det(E_kᵀE_i)| ≥ 0.5, the product of the cosines of
    the principal angles), and the height of the neighbour over the centre's plane is at most 0.5 of its distance.
    `planes` are frames E, or the unit normals of a surface in R³, for which det(E_kᵀE_i) = n_k·n_i takes less time.
    Orientation is irrelevant.
    """
    found = []
    for one, other in zip(centers.split(AT_ONCE), others.split(AT_ONCE), strict=True):
        offset = at(points, other) - at(points, one)
        total = dot(offset, offset)
        mine, theirs = at(planes, one), at(planes, other)
        if planes.ndim == 3:
            flat = torch.einsum("pn,pnd->pd", offset, mine)
            height = total - dot(flat, flat)
            cosine = torch.linalg.det(theirs.mT @ mine).abs()
        else:
            height = dot(offset, mine).square()
            cosine = dot(theirs, mine).abs()
        found.append((height <= HALF_CREASE**2 * total) & (cosine >= CREASE))
    return torch.cat(found)


def compatible_neighbors(
    points: Points, planes: Frames | Points, index: Int[Tensor, "B K"]
) -> Bool[Tensor, "B K"]:
    """Which points of each row are compatible with its first, see `compatible`."""
    centers = index[:, 0].repeat_interleave(index.shape[1])
    return compatible(points, planes, centers, index.flatten()).view(index.shape)


def mutually_compatible(
    points: Points, planes: Frames | Points, candidates: Near
) -> tuple[Int[Tensor, " P"], Int[Tensor, " P"], Bool[Tensor, "N others"]]:
    """Pairs (i, j) of each point with its candidates, row by row, and which of them are compatible both ways."""
    others = candidates[:, 1:]
    i, j = torch.arange(len(points)).repeat_interleave(others.shape[1]), others.reshape(-1)
    good = compatible(points, planes, i, j) & compatible(points, planes, j, i)
    return i, j, good.view(others.shape)


def thin_sides(points: Points, oriented: Points, candidates: Near) -> Points:
    """Oriented normals in and next to thin places, zero elsewhere.

    Points are on different sides if their normals have a negative product. A place is thin where a near point stands
    above or below the tangent plane and yet has nearly the same one. Elsewhere a shape may be one-sided.
    """
    i, j, good = mutually_compatible(points, oriented, candidates)
    refused = ~good.view(-1)
    both = torch.stack([i[refused], j[refused]])
    alike = dot(at(oriented, both[0]), at(oriented, both[1])).abs() >= CREASE
    thin = torch.zeros(len(points), dtype=torch.bool)
    thin[both[:, alike]] = True
    beside = thin[i] | thin[j]
    thin[i[beside]] = thin[j[beside]] = True
    return oriented * thin[:, None]
