"""Rows of a sparse operator, with what is known of the stencil behind each."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["REASONS", "Rows"]

REASONS = (
    "requested order reached",
    "too few admissible neighbours",
    "rank below the number of polynomials",
    "moment equations not met",
    "weight of the centre not negative",
    "neighbours outweigh the centre",
    "growth beyond that of good stencils",
    "stepped down by the certificate",
    "points do not resolve the surface",
)
"""Why a row is below the requested order; its last failure there. `Rows.reason` counts in this list."""


@dataclass(frozen=True)
class Rows:
    """Consecutive rows of the operator in CSR, with what is known of each.

    Attributes
    ----------
    length : (B,), entries of each row.
    col : (nnz,), points, ascending within a row.
    laplacian : (nnz,), 1/ℓ².
    gradient : (nnz, d), 1/ℓ, in the frame of the row's point.
    hessian : (nnz, d(d+1)/2), 1/ℓ², ∂_a∂_b for a ≤ b at the origin of the tangent plane; zero in fallback rows.
    rung : (B,), place in the ladder; the number of rungs for a fallback row.
    order : (B,), order of accuracy p; 0 for a fallback row.
    growth : (B,), ρ² Σ|w|, the factor of the a-priori error bound.
    condition : (B,), of the scaled weighted Vandermonde matrix.
    dominance : (B,), Σ_{j≠i}|w_ij| / |w_ii|; 1 for an M-matrix row.
    reason : (B,), index into `REASONS`.
    """

    length: Int[Tensor, " B"]
    col: Int[Tensor, " nnz"]
    laplacian: Float[Tensor, " nnz"]
    gradient: Float[Tensor, "nnz d"]
    hessian: Float[Tensor, "nnz pairs"]
    rung: Int[Tensor, " B"]
    order: Int[Tensor, " B"]
    growth: Float[Tensor, " B"]
    condition: Float[Tensor, " B"]
    dominance: Float[Tensor, " B"]
    reason: Int[Tensor, " B"]

    @property
    def crow(self) -> Int[Tensor, " B_plus_1"]:
        """Row pointers."""
        return torch.cat([self.length.new_zeros(1), self.length.cumsum(0)])

    def __getitem__(self, rows: Tensor) -> Rows:
        """The given rows (a mask, or positions in any order)."""
        rows = rows.nonzero()[:, 0] if rows.dtype == torch.bool else rows
        length = self.length[rows]
        first = (self.length.cumsum(0) - self.length)[rows] - (length.cumsum(0) - length)
        entry = first.repeat_interleave(length) + torch.arange(int(length.sum()))
        return Rows(
            *(getattr(self, f.name)[entry if f.name in ENTRIES else rows] for f in fields(Rows))
        )

    @staticmethod
    def stack(blocks: Iterable[Rows]) -> Rows:
        """Blocks of rows one after the other."""
        blocks = list(blocks)
        return Rows(*(torch.cat([getattr(b, f.name) for b in blocks]) for f in fields(Rows)))


ENTRIES = {"col", "laplacian", "gradient", "hessian"}
"""The fields of `Rows` that have one value an entry; the others have one a row."""
