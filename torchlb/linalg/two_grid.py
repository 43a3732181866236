"""A two-grid cycle, smoothing before and after a coarse solve, as a preconditioner."""

from __future__ import annotations

from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn.functional import pad

from torchlb.linalg.conjugate_gradients import Linear
from torchlb.linalg.precision import SMALL

Matrix = tuple[Tensor, Tensor, Tensor]  # crow, col, values
LOWEST = 0.25
"""Lower end of the smoothed part of the spectrum of D⁻¹A; the quarter below is left to the coarse solve."""
SIZE = 2 * (1 + LOWEST) ** 2 - (1 - LOWEST) ** 2
FIRST, SECOND = 8 * (1 + LOWEST) / SIZE, -8 / SIZE
"""Coefficients a, b of the smoother D⁻¹(a + b AD⁻¹): 1 − x(a + bx) is T₂ on the smoothed part, scaled to 1 at x = 0."""


def two_grid(product: Linear, sums: Float[Tensor, "N _"], coarse: Linear) -> Linear:
    """Approximate inverse of a symmetric A ≥ 0, itself symmetric and definite, for right-hand sides (N, C) in float32.

    The smoother is a Chebyshev polynomial of degree 2 over the upper three quarters of the spectrum of D⁻¹A, D the
    absolute row sums or more, which bound it by one. Right-hand sides should be scaled to about one.

    `product` may approximate A on rough functions, the solve `coarse` on smooth ones. `sums` is D, (N, 1), or (N, C)
    for columns with matrices of their own; rows of zeros are skipped.

    >>> diagonal = torch.tensor([[2.0], [4.0]])
    >>> cycle = two_grid(lambda x: diagonal * x, diagonal, torch.zeros_like)
    >>> cycle(diagonal).T.round(decimals=2)
    tensor([[0.95, 0.95]])
    """
    return partial(_cycle, product, torch.where(sums > 0, 1 / sums, 0.0), coarse)


def _cycle(product: Linear, scale: Tensor, coarse: Linear, r: Tensor) -> Tensor:
    x = _smoothed(product, scale, r)
    x += coarse(product(x).neg_().add_(r))
    return x.add_(_smoothed(product, scale, product(x).neg_().add_(r)))


def _smoothed(product: Linear, scale: Tensor, r: Tensor) -> Tensor:
    """D⁻¹(a + b AD⁻¹)r."""
    p = scale * r
    q = product(p).mul_(scale)
    return p.mul_(FIRST).add_(q, alpha=SECOND)


def without_small_entries(
    crow: Int[Tensor, " N_plus_1"], col: Int[Tensor, " nnz"], values: Float[Tensor, " nnz"]
) -> Matrix:
    """Drop the entries of a symmetric matrix below a thousandth of √(d_i d_j), d the absolute row sums; in float32.

    They are added to the diagonal, which preserves row sums. Four of ten entries of a stiffness matrix remain.

    >>> crow, col = torch.tensor([0, 2, 4]), torch.tensor([0, 1, 0, 1])
    >>> without_small_entries(crow, col, torch.tensor([1.0, 1e-4, 1e-4, 1.0]))[1:]
    (tensor([0, 1], dtype=torch.int32), tensor([1.0001, 1.0001]))
    """
    values, col, count = values.float(), col.int(), crow.diff()
    row = torch.arange(len(count), dtype=col.dtype, device=col.device).repeat_interleave(count)
    root = (SMALL * absolute_row_sums(crow, values)[:, 0]).sqrt()
    diagonal = row == col
    kept = (values.abs() >= root.repeat_interleave(count) * root.index_select(0, col)) | diagonal
    rest = torch.segment_reduce(torch.where(kept, 0.0, values), "sum", offsets=crow.long())
    places, ends = kept.nonzero()[:, 0], pad(kept.cumsum(0, dtype=torch.int32), (1, 0))
    col, values, diagonal = (part.index_select(0, places) for part in (col, values, diagonal))
    own = diagonal.nonzero()[:, 0]
    values[own] += rest[col[own]]
    return ends[crow], col, values


def absolute_row_sums(
    crow: Int[Tensor, " rows_plus_1"], values: Float[Tensor, " nnz"]
) -> Float[Tensor, "rows 1"]:
    """Σ_j |a_ij| of a CSR matrix.

    >>> absolute_row_sums(torch.tensor([0, 2, 2]), torch.tensor([1.0, -2.0])).T
    tensor([[3., 0.]])
    """
    return torch.segment_reduce(values.abs(), "sum", offsets=crow.long())[:, None]
