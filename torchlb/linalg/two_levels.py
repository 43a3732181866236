"""A cycle of two levels, smoothing around a coarse solve, as a preconditioner."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.linalg.sparse import multiply

Linear = Callable[[Tensor], Tensor]

FIRST, SECOND = 160 / 41, -128 / 41
"""Of the smoother D⁻¹(a + b AD⁻¹): with x in the spectrum of D⁻¹A, 1 − x(a + bx) is T₂((5 − 8x)/3) / T₂(5/3)."""


def two_levels(
    crow: Int[Tensor, " rows_plus_1"],
    col: Int[Tensor, " nnz"],
    values: Float[Tensor, " nnz"],
    coarse: Linear,
) -> tuple[Linear, Linear]:
    """An approximate inverse of a symmetric A, itself symmetric and definite, and the product with A.

    Smoothing is by Chebyshev polynomials of degree 2 over the upper three quarters of the spectrum of D⁻¹A, D the
    absolute row sums, whose own bound is one. All is in float32, which costs a preconditioner nothing; scale what it
    is given to about one.

    Parameters
    ----------
    crow, col, values : A, positive semidefinite; rows of zeros are left alone.
    coarse : of an (N, C) in float32, a solve with what is near A on smooth functions.

    >>> crow, col, values = torch.tensor([0, 1, 2]), torch.tensor([0, 1]), torch.tensor([2.0, 4.0])
    >>> cycle, product = two_levels(crow, col, values, torch.zeros_like)
    >>> cycle(product(torch.ones(2, 1))).T.round(decimals=2)
    tensor([[0.95, 0.95]])
    """
    values = values.detach().float()
    sums = torch.segment_reduce(values.abs(), "sum", offsets=crow.long())
    crow, col = crow.int(), col.int()
    scale = torch.where(sums > 0, 1 / sums, 0.0)[:, None]

    def product(x: Tensor) -> Tensor:
        return multiply(crow, col, values, x)

    def smooth(r: Tensor) -> Tensor:
        p = scale * r
        q = product(p).mul_(scale)
        return p.mul_(FIRST).add_(q, alpha=SECOND)

    def left(r: Tensor, x: Tensor) -> Tensor:
        return product(x).neg_().add_(r)

    def cycle(r: Tensor) -> Tensor:
        x = smooth(r)
        x += coarse(left(r, x))
        return x.add_(smooth(left(r, x)))

    return cycle, product
