"""Curvatures of a surface in R³ from the derivative of its normals."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchlb.errors import InputError
from torchlb.linalg.sparse import csr_product


class Curvatures:
    """Curvatures of a surface in R³ at its points, positive where it bends away from its normals, as a sphere does.

    All are differentiable in the points. Directions are so where the principal curvatures differ.

    Attributes
    ----------
    shape_operator
        (N, 2, 2), 1/ℓ, symmetric: the derivative of the normal along the frames, in the frames.
    frames
        (N, 3, 2), orthonormal tangent vectors in columns.
    """

    def __init__(
        self, shape_operator: Float[Tensor, "N 2 2"], frames: Float[Tensor, "N 3 2"]
    ) -> None:
        self.shape_operator, self._frames = shape_operator, frames

    @property
    def k1(self) -> Float[Tensor, " N"]:
        """The larger principal curvature, κ₁ ≥ κ₂, 1/ℓ."""
        return torch.linalg.eigvalsh(self.shape_operator)[:, 1]

    @property
    def k2(self) -> Float[Tensor, " N"]:
        """The smaller principal curvature, κ₂, 1/ℓ."""
        return torch.linalg.eigvalsh(self.shape_operator)[:, 0]

    @property
    def directions(self) -> Float[Tensor, "N 3 2"]:
        """Unit tangent vectors of space of κ₁ and κ₂, up to their sign; any where both are equal."""
        return self._frames @ torch.linalg.eigh(self.shape_operator).eigenvectors.flip(2)

    @property
    def mean(self) -> Float[Tensor, " N"]:
        """H = (κ₁ + κ₂)/2, 1/ℓ; the mean-curvature vector Δx is −2H times the normal."""
        return self.shape_operator.diagonal(dim1=1, dim2=2).sum(1) / 2

    @property
    def gaussian(self) -> Float[Tensor, " N"]:
        """K = κ₁κ₂, 1/ℓ², whatever the side of the normals."""
        return torch.linalg.det(self.shape_operator)

    @property
    def curvedness(self) -> Float[Tensor, " N"]:
        """√((κ₁² + κ₂²)/2), 1/ℓ (Koenderink and van Doorn 1992)."""
        return (self.shape_operator.square().sum((1, 2)) / 2).sqrt()

    @property
    def shape_index(self) -> Float[Tensor, " N"]:
        """(2/π) atan((κ₁ + κ₂)/(κ₁ − κ₂)): 1 on spheres, 1/2 on cylinders, 0 on saddles, −1 on cups."""
        return 2 / torch.pi * torch.atan2(self.k1 + self.k2, self.k1 - self.k2)

    def __repr__(self) -> str:
        least, most = float(self.k2.min()), float(self.k1.max())
        return f"Curvatures({len(self.shape_operator)} points, from {least:.4g} to {most:.4g})"


def curvatures_of(lb: Any) -> Curvatures:
    """The curvatures of an operator's surface, by its rows of ∇ applied to its normals.

    A neighbour's normal is taken on the side of that of the row, so that surfaces without sides have curvatures.
    """
    check_surface(lb, "curvatures")
    stencil, normals = lb.stencil, lb.normals
    opposed = (normals[stencil.row] * normals[stencil.col]).sum(1) < 0
    sign = torch.where(opposed, -1.0, 1.0).to(normals.dtype)
    slopes = [
        csr_product(stencil.pattern, values * sign, normals, False) for values in stencil.values[1:]
    ]
    own = lb.frames.mT @ torch.stack(slopes, 2)
    return Curvatures((own + own.mT) / 2, lb.frames)


def turned_frames(lb: Any) -> Float[Tensor, "N 3 2"]:
    """The frames of a surface in R³ after a quarter turn about the normals, ν × E."""
    check_surface(lb, "a curl or a quarter turn")
    return torch.linalg.cross(lb.normals[:, :, None].expand_as(lb.frames), lb.frames, dim=1)


def check_surface(lb: Any, what: str) -> None:
    """Raise InputError unless the operator is of a surface in R³ with normals."""
    if lb.points.shape[1:] != (3,) or lb.dim != 2 or not len(lb.normals):
        raise InputError(
            f"{what}: expected a surface in R³ with normals, got one of dimension {lb.dim} in R^{lb.points.shape[1]}"
        )
