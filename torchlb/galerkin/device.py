"""Sums and products of sparse matrices on a device, where torch's take the place of compiled loops.

A matrix is a tuple (crow, col, values) in CSR, with values (nnz, c) of c matrices on one pattern.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.linalg.csr import Csr
from torchlb.linalg.precision import BYTES
from torchlb.linalg.sparse import csr_tensor, transpose_pattern

Matrix = tuple[Int[Tensor, " _"], Int[Tensor, " _"], Float[Tensor, "_ _"]]
Entries = tuple[Int[Tensor, " _"], Int[Tensor, " _"], Float[Tensor, "_ _"]]
"""Rows, columns and values, (e, c)."""


def summed_entries(parts: Iterable[Entries], shape: tuple[int, int]) -> Matrix:
    """The sum of entries, with ascending columns.

    >>> one = torch.tensor([0, 0]), torch.tensor([1, 1]), torch.tensor([[2.0], [3.0]])
    >>> [part.tolist() for part in summed_entries([one], (2, 2))]
    [[0, 1, 1], [1], [[5.0]]]
    """
    row, col, values = (torch.cat(column) for column in zip(*parts, strict=True))
    key, place = (row * shape[1] + col).unique(return_inverse=True)
    total = values.new_zeros(len(key), values.shape[1]).index_add(0, place, values)
    uses = torch.bincount(key // shape[1], minlength=shape[0])
    return torch.cat([uses.new_zeros(1), uses.cumsum(0)]), key % shape[1], total


def congruence(p: Matrix, a: Matrix, count: int) -> Matrix:
    """PᵀAP of symmetric matrices, symmetric to the last digit; P has `count` columns."""
    crow, col, order = transpose_pattern(p[0], p[1], count)
    left = crow, col, p[2][order]
    found = []
    for values in a[2].T:
        half = product(left, (*a[:2], values[:, None]), len(p[0]) - 1)
        found.append(product(half, p, count))
    crow, col, _ = found[0]
    values = torch.cat([part[2] for part in found], 1)
    return crow, col, (values + values[transpose_pattern(crow, col, count)[2]]) / 2


def product(a: Matrix, b: Matrix, count: int) -> Matrix:
    """AB of single matrices; B has `count` columns.

    Rows of A are multiplied by some 10⁸ terms at once: CUDA takes room for all of them, and counts them in 32 bits.
    """
    crow, col, values = a
    terms = torch.cat([crow.new_zeros(1), b[0].diff()[col].cumsum(0)])[crow]
    _, rows = torch.unique_consecutive(terms[:-1] // (8 * BYTES), return_counts=True)
    right, parts = csr_tensor(b[0].int(), b[1].int(), b[2][:, 0].contiguous(), count), []
    for first, last in pairwise([0, *rows.cumsum(0).tolist()]):
        own = crow[first : last + 1]
        some = slice(*own[[0, -1]].tolist())
        left = (own - own[0]).int(), col[some].int(), values[some, 0].contiguous()
        part = csr_tensor(*left, len(b[0]) - 1) @ right
        row = torch.arange(first, last).repeat_interleave(part.crow_indices().diff())
        parts.append((row, part.col_indices().long(), part.values()[:, None]))
    return summed_entries(parts, (len(crow) - 1, count))


def without_row_sums(matrix: Matrix) -> Csr:
    """The matrices, the first of them with the diagonal that makes its rows sum to zero."""
    found = Csr(*matrix[:2], matrix[2].T.contiguous())
    sums = torch.zeros_like(matrix[0][1:], dtype=matrix[2].dtype)
    sums = sums.index_add(0, found.row, found.values[0])
    found.values[0] -= torch.where(found.row == found.col, sums[found.row], 0.0)
    return found
