"""The sparse product that layers differentiate through, on plain tensors.

A sparse CSR tensor as a buffer breaks `deepcopy`, autocast and second derivatives, and its native backward is slow.
Here the matrix is `crow, col, values`, the transpose's pattern is computed once, and two custom operations, each the
derivative of the other, give first and second derivatives in everything, under `torch.compile` and export.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy import sparse
from torch import Tensor

__all__ = ["from_scipy", "matmul", "to_scipy", "transpose_pattern"]

ENTRIES_AT_ONCE = 2**26
"""Bound on entries times columns that the gradient in the values gathers at a time."""


def transpose_pattern(
    crow: Int[Tensor, " rows_plus_1"], col: Int[Tensor, " nnz"], num_cols: int
) -> tuple[Int[Tensor, " cols_plus_1"], Int[Tensor, " nnz"], Int[Tensor, " nnz"]]:
    """Pattern of the transpose: (crow_t, col_t, order_t) with values_t = values[order_t].

    >>> crow, col = torch.tensor([0, 2, 3]), torch.tensor([0, 1, 1])
    >>> [part.tolist() for part in transpose_pattern(crow, col, 2)]
    [[0, 1, 3], [0, 0, 1], [0, 1, 2]]
    """
    order = torch.sort(col, stable=True).indices
    row = torch.repeat_interleave(torch.arange(len(crow) - 1, device=crow.device), crow.diff())
    count = torch.bincount(col, minlength=num_cols)
    crow_t = torch.cat([count.new_zeros(1), count.cumsum(0)])
    return crow_t.to(crow.dtype), row[order].to(col.dtype), order.to(col.dtype)


def matmul(
    crow: Int[Tensor, " rows_plus_1"],
    col: Int[Tensor, " nnz"],
    values: Float[Tensor, " nnz"],
    pattern_t: tuple[Tensor, Tensor, Tensor],
    x: Float[Tensor, "cols C"],
) -> Float[Tensor, "rows C"]:
    """Product A x of a CSR matrix, differentiable any number of times in `values` and in `x`.

    Parameters
    ----------
    crow, col, values : A.
    pattern_t : of its transpose, from `transpose_pattern`.
    x : dense. Half precision is computed in float32 and returned as it came; otherwise the result has the wider of the
        types of `values` and `x`.
    """
    return _product(crow, col, *pattern_t, values, x, False)


def _compute_dtype(values: Tensor, x: Tensor) -> torch.dtype:
    wider = torch.promote_types(values.dtype, x.dtype)
    return torch.promote_types(wider, torch.float32)


def _result_dtype(values: Tensor, x: Tensor) -> torch.dtype:
    return x.dtype if x.dtype.itemsize < 4 else _compute_dtype(values, x)


@torch.library.custom_op("torchlb::csr_product", mutates_args=())
def _product(
    crow: Tensor,
    col: Tensor,
    crow_t: Tensor,
    col_t: Tensor,
    order_t: Tensor,
    values: Tensor,
    x: Tensor,
    transposed: bool,
) -> Tensor:
    """A x, or Aᵀ x."""
    dtype = _compute_dtype(values, x)
    values, dense = values.to(dtype), x.to(dtype).contiguous()
    if transposed:
        crow, col, values = crow_t, col_t, values[order_t]
    shape = (len(crow) - 1, len(x))
    with torch.autocast(x.device.type, enabled=False):
        matrix = torch.sparse_csr_tensor(crow, col, values, shape, check_invariants=False)
        return (matrix @ dense).to(_result_dtype(values, x))


@_product.register_fake
def _(
    crow: Tensor,
    col: Tensor,
    crow_t: Tensor,
    col_t: Tensor,
    order_t: Tensor,
    values: Tensor,
    x: Tensor,
    transposed: bool,
) -> Tensor:
    num_rows = (crow_t if transposed else crow).shape[0] - 1
    return x.new_empty(num_rows, x.shape[1], dtype=_result_dtype(values, x))


@torch.library.custom_op("torchlb::csr_values_gradient", mutates_args=())
def _values_gradient(
    crow: Tensor,
    col: Tensor,
    crow_t: Tensor,
    col_t: Tensor,
    order_t: Tensor,
    left: Tensor,
    right: Tensor,
) -> Tensor:
    """Σ_c left[row, c] right[col, c] at every entry of the pattern."""
    row = torch.repeat_interleave(torch.arange(len(crow) - 1, device=crow.device), crow.diff())
    dtype = _compute_dtype(left, right)
    result = torch.empty(len(col), dtype=dtype, device=left.device)
    step = max(1, ENTRIES_AT_ONCE // max(1, left.shape[1]))
    for start in range(0, len(col), step):
        part = slice(start, start + step)
        result[part] = (left[row[part]].to(dtype) * right[col[part]].to(dtype)).sum(1)
    return result


@_values_gradient.register_fake
def _(
    crow: Tensor,
    col: Tensor,
    crow_t: Tensor,
    col_t: Tensor,
    order_t: Tensor,
    left: Tensor,
    right: Tensor,
) -> Tensor:
    return left.new_empty(col.shape[0], dtype=_compute_dtype(left, right))


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    tensors = [value for value in inputs if isinstance(value, Tensor)]
    ctx.save_for_backward(*tensors)
    ctx.transposed = inputs[-1]


def _product_backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
    *pattern, values, x = ctx.saved_tensors
    grad_values = grad_x = None
    if ctx.needs_input_grad[5]:
        left, right = (x, grad) if ctx.transposed else (grad, x)
        grad_values = _values_gradient(*pattern, left, right).to(values.dtype)
    if ctx.needs_input_grad[6]:
        grad_x = _product(*pattern, values, grad, not ctx.transposed).to(x.dtype)
    return *(None,) * 5, grad_values, grad_x, None


def _values_gradient_backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
    *pattern, left, right = ctx.saved_tensors
    grad_left = grad_right = None
    if ctx.needs_input_grad[5]:
        grad_left = _product(*pattern, grad, right, False).to(left.dtype)
    if ctx.needs_input_grad[6]:
        grad_right = _product(*pattern, grad, left, True).to(right.dtype)
    return *(None,) * 5, grad_left, grad_right


_product.register_autograd(_product_backward, setup_context=_save)
_values_gradient.register_autograd(_values_gradient_backward, setup_context=_save)


def to_scipy(
    crow: Int[Tensor, " rows_plus_1"],
    col: Int[Tensor, " nnz"],
    values: Float[Tensor, " nnz"],
    shape: tuple[int, int],
) -> sparse.csr_array:
    """As a scipy CSR matrix on the CPU, without a copy where there is none needed."""
    data, indices, indptr = (t.detach().cpu().numpy() for t in (values, col, crow))
    return sparse.csr_array((data, indices, indptr), shape=shape)


def from_scipy(matrix: Any) -> tuple[Tensor, Tensor, Tensor]:
    """(crow, col, values) of a scipy matrix: columns ascending, duplicates summed, int64 indices.

    >>> from_scipy(sparse.eye_array(2))[1].tolist()
    [0, 1]
    """
    matrix = sparse.csr_array(matrix, copy=True)
    matrix.sum_duplicates()
    crow, col = (
        torch.from_numpy(part.astype(np.int64)) for part in (matrix.indptr, matrix.indices)
    )
    return crow, col, torch.from_numpy(matrix.data)
