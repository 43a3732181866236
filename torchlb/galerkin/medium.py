"""Media: the conductivity A, density ρ and potential c of −div(A∇u) + cu = λρu (`method.md`, section 14)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from math import log
from typing import Any, Literal, NamedTuple

import torch
from jaxtyping import Bool, Float, Int, Shaped
from scipy import sparse
from torch import Tensor

from torchlb.geometry.thresholds import FACTOR
from torchlb.geometry.vectors import dot
from torchlb.linalg.once import once_differentiable
from torchlb.linalg.precision import ROOT_EPS, TINY

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
    """Where a conductivity on the faces jumps, by more than `FACTOR`: `at` vertices whose cells differ.

    The cells have logarithms `logs`, of every entry of a tensor.
    """

    at: Bool[Tensor, " N"]
    cells: Int[Tensor, "T corners"]
    logs: Float[Tensor, "T c"]

    @classmethod
    def of(cls, cells: Int[Tensor, "T corners"], logs: Float[Tensor, "T c"], count: int) -> Jumps:
        """The jumps at so many vertices.

        >>> logs = torch.tensor([[0.0], [0.0], [7.0]])
        >>> jumps = Jumps.of(torch.tensor([[0, 1], [1, 2], [2, 3]]), logs, 4)
        >>> jumps.at
        tensor([False, False,  True, False])
        >>> jumps.inside(torch.tensor([0, 0, 0, 1, 1, 1]), torch.tensor([0, 1, 2, 1, 2, 3]), 2)
        tensor([False,  True])
        """
        corners = cells.shape[1]
        every = logs.repeat_interleave(corners, 0)
        return cls(_differ(cells.flatten(), every, count), cells, logs)

    def reached(
        self, groups: Int[Tensor, " e"], vertices: Int[Tensor, " e"], count: int
    ) -> Bool[Tensor, " G"]:
        """Whether each of so many groups of vertices has one where the conductivity jumps."""
        return self.at.new_zeros(count).index_fill(0, groups[self.at[vertices]], True)

    def inside(
        self, groups: Int[Tensor, " e"], vertices: Int[Tensor, " e"], count: int
    ) -> Bool[Tensor, " G"]:
        """Whether it jumps between cells of one group of vertices, for each of so many.

        These are cells with all corners in the group, and those with one there at which it does not jump.
        """
        some = self.reached(groups, vertices, count)[groups]
        (size, corners), points, ends = self.cells.shape, len(self.at), self.cells.flatten()
        cell = torch.arange(len(ends), device=ends.device) // corners
        enough = torch.where(self.at[ends], 1, corners)
        own = _matrix(torch.ones_like(ends[:1]), groups[some], vertices[some], (count, points))
        own.data[:] = 1  # points stand twice where there are few
        met = sparse.coo_array(own @ _matrix(enough, ends, cell, (points, size)))
        within = met.data >= corners
        group, cell = (torch.from_numpy(x[within]).to(ends) for x in met.coords)
        return _differ(group, self.logs[cell], count)


def _matrix(values: Tensor, row: Tensor, col: Tensor, shape: tuple[int, int]) -> Any:
    entries = values.expand_as(row).cpu().numpy(), (row.cpu().numpy(), col.cpu().numpy())
    return sparse.csr_array(entries, shape=shape)


def _differ(groups: Tensor, logs: Float[Tensor, "e c"], count: int) -> Bool[Tensor, " G"]:
    """Whether logarithms in one group differ by more than that of `FACTOR`, and rounding."""
    signed = torch.cat([logs, -logs], 1)
    most = signed.new_full((count, signed.shape[1]), -torch.inf)
    most = most.scatter_reduce(0, groups[:, None].expand_as(signed), signed, "amax")
    high, low = most.chunk(2, 1)
    return (high + low).amax(1) > log(FACTOR) + ROOT_EPS


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
