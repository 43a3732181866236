"""Sums and products of sparse matrices on a device, where torch's take the place of compiled loops.

A matrix is a tuple (crow, col, values) in CSR, with values (nnz, c) of c matrices on one pattern.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.linalg.csr import Csr
from torchlb.linalg.sparse import csr_tensor, transpose_pattern

Matrix = tuple[Int[Tensor, " rows_plus_1"], Int[Tensor, " nnz"], Float[Tensor, "nnz c"]]
Entries = tuple[Int[Tensor, " e"], Int[Tensor, " e"], Float[Tensor, "e c"]]
"""Rows, columns and values."""


def entries_of(nodes: Int[Tensor, "T n"], blocks: Float[Tensor, "T n_times_n c"]) -> Entries:
    """Entries of element matrices, flattened row by row."""
    size = nodes.shape[1]
    row, col = nodes.repeat_interleave(size, 1), nodes.repeat(1, size)
    return row.flatten(), col.flatten(), blocks.flatten(0, 1)


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
    size = len(p[0]) - 1
    crow, col, order = transpose_pattern(p[0], p[1], count)
    values = p[2][:, 0]
    left, right = csr_tensor(crow, col, values[order], size), csr_tensor(*p[:2], values, count)
    found = []
    for values in a[2].T:
        whole = left @ csr_tensor(*a[:2], values.contiguous(), size) @ right
        row = torch.arange(count).repeat_interleave(whole.crow_indices().diff())
        entries = row, whole.col_indices(), whole.values()[:, None]
        found.append(summed_entries([entries], (count, count)))
    crow, col, _ = found[0]
    values = torch.cat([part[2] for part in found], 1)
    return crow, col, (values + values[transpose_pattern(crow, col, count)[2]]) / 2


def without_row_sums(matrix: Matrix) -> Csr:
    """The matrices, the first of them with the diagonal that makes its rows sum to zero."""
    found = Csr(*matrix[:2], matrix[2].T.contiguous())
    sums = torch.zeros_like(matrix[0][1:], dtype=matrix[2].dtype)
    sums = sums.index_add(0, found.row, found.values[0])
    found.values[0] -= torch.where(found.row == found.col, sums[found.row], 0.0)
    return found
