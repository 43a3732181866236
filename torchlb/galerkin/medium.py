"""Media: the conductivity A, density ρ and potential c of −div(A∇u) + cu = λρu (`method.md`, section 14)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from math import log
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from torchlb.geometry.thresholds import FACTOR
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


class Jumps(NamedTuple):
    """Where a conductivity on the faces jumps: `at` the vertices whose faces differ by more than `FACTOR`.

    `extremes` are the largest logarithms at the faces of each vertex, for a tensor of each entry, and the largest of
    their negatives.
    """

    at: Bool[Tensor, " N"]
    extremes: Float[Tensor, "N c"]

    @classmethod
    def of(cls, vertices: Int[Tensor, " e"], logs: Float[Tensor, "e c"], count: int) -> Jumps:
        """The jumps at so many vertices, from the logarithms at the corners of all faces.

        >>> logs = torch.tensor([0.0, 0.0, 7.0, 7.0])[:, None]
        >>> jumps = Jumps.of(torch.tensor([0, 1, 1, 2]), logs, 3)
        >>> jumps.at
        tensor([False,  True, False])
        >>> jumps.between(torch.tensor([0, 0, 1, 1, 1]), torch.tensor([0, 1, 0, 1, 2]), 2)
        tensor([False,  True])
        """
        found = _extremes(vertices, torch.cat([logs, -logs], 1), count)
        return cls(_differ(found), found)

    def between(
        self, groups: Int[Tensor, " e"], vertices: Int[Tensor, " e"], count: int
    ) -> Bool[Tensor, " G"]:
        """Whether each of so many groups of vertices has some on both sides of a jump."""
        on = self.at[vertices]
        near = self.at.new_zeros(count).index_fill(0, groups[on], True)
        return near & _differ(_extremes(groups[~on], self.extremes[vertices[~on]], count))


def _extremes(groups: Tensor, values: Tensor, count: int) -> Float[Tensor, "G c"]:
    """Largest values of each group, −∞ of an empty one."""
    found = values.new_full((count, values.shape[1]), -torch.inf)
    return found.scatter_reduce(0, groups[:, None].expand_as(values), values, "amax")


def _differ(extremes: Float[Tensor, "G c"]) -> Bool[Tensor, " G"]:
    """Whether the logarithms of each group, whose extremes these are, differ by more than that of `FACTOR`."""
    high, low = extremes.chunk(2, 1)
    return (high + low).amax(1) > log(FACTOR)


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
