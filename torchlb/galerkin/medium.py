"""Media: the conductivity A, density ρ and potential c of −div(A∇u) + cu = λρu (`method.md`, section 14)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchlb.geometry.vectors import dot
from torchlb.linalg.once import once_differentiable
from torchlb.linalg.precision import TINY

FieldName = Literal["conductivity", "density", "potential"]
Map = Callable[[Tensor], Tensor]


class Field(NamedTuple):
    """A field of a medium at the vertices or on the faces: numbers, or symmetric positive space tensors, (…, n, n).

    It is `positive`, or merely nowhere negative.
    """

    values: Shaped[Tensor, "count ..."]
    on_faces: bool
    positive: bool

    @property
    def transforms(self) -> tuple[Map, Map]:
        """What is prolonged of the values, and its inverse, which makes the result as positive as the field is.

        >>> log, exp = Field(torch.eye(2)[None], on_faces=False, positive=True).transforms
        >>> exp(log(torch.tensor([[2.0, 1.0], [1.0, 2.0]]))).round(decimals=4).tolist()
        [[2.0, 1.0], [1.0, 2.0]]
        """
        if self.values.ndim == 3:
            return partial(_spectral, "log"), partial(_spectral, "exp")
        if self.positive:
            return torch.log, torch.exp
        return torch.clone, lambda x: x.clamp_min(0.0)


Medium = Mapping[str, Field]
"""Fields by their `FieldName`; a conductivity or density that is left out is 1, a potential 0."""


class _SpectralFunction(torch.autograd.Function):
    """f(A) = Q f(Λ) Qᵀ, "log" or "exp", of symmetric matrices, differentiable once.

    The derivative is that of Daleckii and Krein (1965), by divided differences of f; equal eigenvalues do no harm.
    """

    @staticmethod
    def forward(ctx: Any, name: str, matrix: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        values, vectors = torch.linalg.eigh(matrix)
        images = getattr(torch, name)(values)
        ctx.save_for_backward(values, vectors, images)
        ctx.name = name
        return (vectors * images[..., None, :]) @ vectors.mT

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        values, vectors, images = ctx.saved_tensors
        logs, powers = (images, values) if ctx.name == "log" else (values, images)
        half = (logs[..., :, None] - logs[..., None, :]) / 2
        mean = (powers[..., :, None] * powers[..., None, :]).sqrt()
        # (eᵃ − eᵇ)/(a − b) = √(eᵃeᵇ) sinh(h)/h for h = (a − b)/2
        slope = mean * torch.where(half == 0, 1.0, half.sinh() / half)
        slope = 1 / slope if ctx.name == "log" else slope
        inside = vectors.mT @ ((g + g.mT) / 2) @ vectors
        return None, vectors @ (slope * inside) @ vectors.mT


_spectral: Any = _SpectralFunction.apply


def orthonormal(slopes: Float[Tensor, "*batch n d"]) -> Float[Tensor, "*batch n d"]:
    """Orthonormal vectors of the same span, by Gram and Schmidt; zero for a vector that is zero."""
    unit: list[Tensor] = []
    for x in slopes.unbind(-1):
        for _ in range(2):  # the second time takes off what rounding leaves
            for e in unit:
                x = x - dot(x, e)[..., None] * e
        unit.append(x / dot(x, x).clamp_min(TINY).sqrt()[..., None])
    return torch.stack(unit, -1)
