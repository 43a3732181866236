"""Rows of a sparse operator, with a record of the stencil behind each."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.fits.rules import WEIGHT_RULES
from torchlb.fits.weights import Weights
from torchlb.geometry.numbering import Numbering
from torchlb.geometry.thresholds import SLIGHT
from torchlb.geometry.vectors import Frames, Points, at
from torchlb.linalg.precision import NEGLIGIBLE, ROOT_EPS


class Reason(IntEnum):
    """Why a row is below the requested order: the last test that it failed there; `text` says it in words."""

    text: str

    def __new__(cls, value: int, text: str) -> Reason:
        """Give the number a sentence."""
        reason = int.__new__(cls, value)
        reason._value_, reason.text = value, text
        return reason

    REACHED = 0, "requested order reached"
    FEW = 1, "too few compatible neighbours"
    MOMENTS = 2, "moment equations not met"
    UNRESOLVED = 3, "points do not resolve the surface"
    RATIO = 4, "neighbours outweigh the centre"
    GROWTH = 5, "growth beyond that of good stencils"
    STABILITY = 6, "lowered by the certificate"


@dataclass(frozen=True)
class Pattern:
    """Which columns consecutive rows of a sparse matrix have.

    `length`, (B,), counts the entries of each row; `col`, (nnz,), are ascending within a row.
    """

    length: Int[Tensor, " B"]
    col: Int[Tensor, " nnz"]

    @property
    def crow(self) -> Int[Tensor, " B_plus_1"]:
        """Row pointers."""
        return torch.cat([self.length.new_zeros(1), self.length.cumsum(0)])

    @property
    def row(self) -> Int[Tensor, " nnz"]:
        """Position of the row of each entry."""
        return torch.arange(len(self.length)).repeat_interleave(self.length)


@dataclass(frozen=True)
class Rows(Pattern):
    """Consecutive rows of the operator in CSR, with a record of each stencil.

    Entries have values `laplacian`, 1/ℓ², and `gradient`, 1/ℓ, in the frame of the row's point. Of each row there are:
    `candidate` and `rule`, indices into the list of candidates and into `WEIGHT_RULES`, or their lengths for a
    low-order row; its `order` of accuracy, 0 for a low-order row; its `growth` ρ² Σ|w|, the factor of the a-priori
    error bound; the `condition` number of the scaled weighted Vandermonde matrix; its `off_diagonal_ratio`
    Σ_{j≠i}|w_ij| / |w_ii|, 1 for an M-matrix row; `slope`, the degree of the gradient's fit where it has one of its
    own, else 0; and a `Reason`.
    """

    laplacian: Float[Tensor, " nnz"]
    gradient: Float[Tensor, "nnz d"]
    candidate: Int[Tensor, " B"]
    rule: Int[Tensor, " B"]
    order: Int[Tensor, " B"]
    growth: Float[Tensor, " B"]
    condition: Float[Tensor, " B"]
    off_diagonal_ratio: Float[Tensor, " B"]
    slope: Int[Tensor, " B"]
    reason: Int[Tensor, " B"]

    def __getitem__(self, rows: Tensor) -> Rows:
        """The given rows, by positions in any order."""
        length = self.length[rows]
        first = self.crow[rows] - (length.cumsum(0) - length)
        return self._taken(first.repeat_interleave(length) + torch.arange(int(length.sum())), rows)

    def _taken(self, entries: Int[Tensor, " e"], rows: Int[Tensor, " b"]) -> Rows:
        """The fields of these entries, and of these rows."""
        per_entry, names = {"col", "laplacian", "gradient"}, (f.name for f in fields(Rows))
        return Rows(*(getattr(self, n)[entries if n in per_entry else rows] for n in names))

    def with_gradient(
        self, local: Int[Tensor, " e"], index: Int[Tensor, " e"], gradient: Float[Tensor, "e d"]
    ) -> Rows:
        """Replace the gradient of the rows `local` by entries at the points `index`."""
        taken = torch.zeros_like(self.length, dtype=torch.bool).index_fill(0, local, True)
        old = torch.where(taken[self.row, None], 0.0, self.gradient)
        span = int(max(self.col.max(), index.max())) + 1
        key = torch.cat([self.row * span + self.col, local * span + index])
        key, place = key.unique(return_inverse=True)
        values = torch.zeros(len(key), 1 + old.shape[1], dtype=old.dtype)
        first, second = place.split([len(old), len(local)])
        values.index_add_(0, first, torch.cat([self.laplacian[:, None], old], 1))
        values[:, 1:].index_add_(0, second, gradient)
        length = torch.bincount(key // span, minlength=len(self.length))
        entries = {"col": key % span, "laplacian": values[:, 0], "gradient": values[:, 1:]}
        return replace(self, length=length, **entries)

    def restored(self, numbering: Numbering) -> Rows:
        """All rows, in the user's numbers."""
        col, entry = numbering.restored_pattern(self.crow, self.col)
        return replace(self._taken(entry, numbering.here), col=col)

    @staticmethod
    def stack(blocks: Iterable[Rows]) -> Rows:
        """Concatenate blocks of rows."""
        blocks = list(blocks)
        return Rows(*(torch.cat([getattr(b, f.name) for b in blocks]) for f in fields(Rows)))


@dataclass(frozen=True)
class RowsPlan(Pattern):
    """Plan of rows; attributes are those of `Rows`. Entries are `used` in the own fit of a low-order row's gradient."""

    candidate: Int[Tensor, " B"]
    slope: Int[Tensor, " B"]
    reason: Int[Tensor, " B"]
    used: Bool[Tensor, " nnz"]


def to_tangent_vectors(
    jacobian: Float[Tensor, "B d n"], frames: Float[Tensor, "B n d"]
) -> Float[Tensor, "B d d"]:
    """EᵀJ⁺, which maps derivatives along the coordinates of a fit to the components of the gradient in the frame E.

    With weights G of these derivatives, the rows of J = Gx are tangent vectors of the surface fitted to the points x,
    and ∇f = Jᵀ(JJᵀ)⁻¹Gf = J⁺Gf on it. The gradient of the coordinates is Eᵀ times a projector, thus of norm 1 at most,
    however steep the fit is over the frame. Where the frame is tangent to it, to `SLIGHT`, G is kept, and ∇ is exact
    for functions that are linear in the tangent plane.

    >>> steep = torch.tensor([[[1.0, 2.0]]])
    >>> to_tangent_vectors(steep, torch.tensor([[[1.0], [0.0]]])).round(decimals=4).tolist()
    [[[0.2]]]
    """
    turn = torch.eye(jacobian.shape[1], dtype=jacobian.dtype).repeat(len(jacobian), 1, 1)
    tilted = (jacobian @ jacobian.mT - turn).abs().amax((1, 2)) > SLIGHT
    # Singular values are those of [1, slope], at least 1, and 0 across a line that holds all points.
    inverse = torch.linalg.pinv(jacobian[tilted], atol=NEGLIGIBLE, rtol=0.0)
    turn[tilted] = frames[tilted].mT @ inverse
    return turn


def tangent_weights(
    points: Points, frames: Frames, index: Int[Tensor, "B K"], gradient: Float[Tensor, "B K d"]
) -> Float[Tensor, "B K d"]:
    """Weights of ∇ in the frames, from those of derivatives along coordinates; `index` has the centre first."""
    offset = at(points, index) - at(points, index[:, 0])[:, None]
    turn = to_tangent_vectors(gradient.mT @ offset, at(frames, index[:, 0]))
    return gradient @ turn.mT


def stencil_rows(
    points: Points,
    frames: Frames,
    index: Int[Tensor, "B K"],
    weights: Weights,
    candidate: int,
    order: int,
    rule: Int[Tensor, " B"],
) -> Rows:
    """Convert a batch of stencils of one candidate, derivatives along coordinates, to rows with ascending columns."""
    batch, size = index.shape
    col, place = index.sort(dim=1)
    laplacian, gradient = weights.laplacian, weights.gradient
    gradient = tangent_weights(points, frames, index, gradient)
    center, total = laplacian[:, 0].abs(), laplacian.abs().sum(1)
    return Rows(
        length=torch.full((batch,), size),
        col=col.flatten(),
        laplacian=laplacian.take_along_dim(place, dim=1).flatten(),
        gradient=gradient.take_along_dim(place[..., None], dim=1).flatten(0, 1),
        candidate=torch.full((batch,), candidate),
        rule=rule,
        order=torch.full((batch,), order),
        growth=weights.radius.square() * total,
        condition=weights.condition,
        off_diagonal_ratio=(total - center) / center,
        slope=weights.slope,
        reason=torch.zeros(batch, dtype=torch.int64),
    )


def matrix_rows(
    length: Int[Tensor, " B"],
    col: Int[Tensor, " nnz"],
    laplacian: Float[Tensor, " nnz"],
    beside: Bool[Tensor, " nnz"],
    points: Points,
    frames: Frames,
    centers: Int[Tensor, " B"],
) -> Rows:
    """Rows of a given strong-form matrix, with the least-squares gradient over the points `beside` the row's own.

    Where these lie on a line, the derivative across it is zero. For steep rows see `to_tangent_vectors`.
    """
    local = Pattern(length, col).row
    offset = points[col] - points[centers[local]]
    coords = torch.einsum("en,end->ed", offset, frames[centers[local]]) * beside[:, None]

    def summed(values: Tensor) -> Tensor:
        return values.new_zeros(len(centers), *values.shape[1:]).index_add_(0, local, values)

    size = summed(coords.square().sum(-1)).sqrt()
    size = size.clamp_min(torch.finfo(size.dtype).tiny ** 0.5)[:, None]
    coords = coords / size[local]
    moment = summed(coords[:, :, None] * coords[:, None, :])
    inverse = torch.linalg.pinv(moment, rtol=ROOT_EPS, hermitian=True) / size[..., None]
    jacobian = inverse @ summed(coords[:, :, None] * offset[:, None, :])
    inverse = to_tangent_vectors(jacobian, frames[centers]) @ inverse
    gradient = torch.einsum("ecd,ed->ec", inverse[local], coords)
    on_diagonal = col == centers[local]
    gradient = gradient - on_diagonal[:, None] * summed(gradient)[local]
    total = summed(laplacian.abs())
    center = summed(laplacian.abs() * on_diagonal)
    radius = torch.zeros_like(total).scatter_reduce_(0, local, offset.norm(dim=-1), "amax")
    return Rows(
        length=length,
        col=col,
        laplacian=laplacian,
        gradient=gradient,
        candidate=torch.zeros_like(length),
        rule=torch.full_like(length, len(WEIGHT_RULES)),
        order=torch.zeros_like(length),
        growth=radius.square() * total,
        condition=torch.full_like(total, torch.nan),
        off_diagonal_ratio=(total - center) / center,
        slope=torch.zeros_like(length),
        reason=torch.zeros_like(length),
    )
