"""Differentiable products of sparse matrices, on plain tensors.

A sparse CSR tensor as a buffer breaks `deepcopy`, autocast and second derivatives, and its native backward is slow.
Here the matrix is `crow, col, values`, the transpose's pattern is computed once, and an operation of three kinds, whose
derivatives are each other, gives derivatives of any order in values and features. `torch.compile` and export see it as
a custom operation, which takes twice as long to call: that counts on a GPU, and for small shapes.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from functools import cache, partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Shaped
from scipy import sparse
from torch import Tensor
from torch.nn.functional import embedding_bag

from torchlb.errors import InputError


def transpose_pattern(
    crow: Int[Tensor, " rows_plus_1"],
    col: Int[Tensor, " nnz"],
    num_cols: int,
    order: Int[Tensor, " nnz"] | None = None,
) -> tuple[Int[Tensor, " cols_plus_1"], Int[Tensor, " nnz"], Int[Tensor, " nnz"]]:
    """Pattern of the transpose: (crow_t, col_t, order_t) with values_t = values[order_t]; `order` is order_t, if known.

    >>> crow, col = torch.tensor([0, 2, 3]), torch.tensor([0, 1, 1])
    >>> [part.tolist() for part in transpose_pattern(crow, col, 2)]
    [[0, 1, 3], [0, 0, 1], [0, 1, 2]]
    """
    order = torch.sort(col, stable=True).indices if order is None else order
    row = torch.repeat_interleave(torch.arange(len(crow) - 1, device=crow.device), crow.diff())
    count = torch.bincount(col, minlength=num_cols)
    crow_t = torch.cat([count.new_zeros(1), count.cumsum(0)])
    return crow_t.to(crow.dtype), row[order].to(col.dtype), order.to(col.dtype)


def csr_product(
    pattern: Sequence[Tensor],
    values: Float[Tensor, " nnz"],
    x: Shaped[Tensor, "M C"],
    transposed: bool = False,
) -> Float[Tensor, "K C"]:
    """Product A x of a CSR matrix, or Aᵀ x, differentiable any number of times in `values` and in `x`.

    The pattern is [crow, col, crow_t, col_t, order_t] of A and, from `transpose_pattern`, of its transpose, int32 or
    int64; [crow, col] for a symmetric A, with derivatives in x alone. The product is computed in the wider of the types
    of `values` and `x`, and at least in float32, also under autocast; the result has that type, or that of a
    half-precision x.

    >>> crow, col, values = torch.tensor([0, 2, 3]), torch.tensor([0, 1, 1]), torch.tensor([1.0, 2.0, 3.0])
    >>> pattern = [crow, col, *transpose_pattern(crow, col, 2)]
    >>> csr_product(pattern, values, torch.tensor([[1.0], [10.0]])).tolist()
    [[21.0], [30.0]]
    """
    if len(pattern) == 2:  # as if A were its own transpose, entry by entry
        pattern = *pattern, *pattern, torch.arange(len(pattern[1]), device=pattern[1].device)
    form: Any = _form_op if torch.compiler.is_compiling() else _Form.apply
    return form(*pattern, values, x, "transposed" if transposed else "product")


def compute_dtype(left: Tensor, right: Tensor) -> torch.dtype:
    """The wider of two types, at least float32.

    >>> compute_dtype(torch.ones(1).bfloat16(), torch.ones(1).half())
    torch.float32
    """
    wider = torch.promote_types(left.dtype, right.dtype)
    return torch.promote_types(wider, torch.float32)


def _result_dtype(values: Tensor, x: Tensor) -> torch.dtype:
    half = x.dtype in (torch.float16, torch.bfloat16)
    return x.dtype if half else compute_dtype(values, x)


@cache
def _hear_out_torch() -> None:
    """Create a first CSR tensor, to silence torch's one-time warning that these are in beta."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.sparse_csr_tensor([0, 1], [0], [1.0], (1, 1))


def csr_tensor(crow: Tensor, col: Tensor, values: Tensor, num_cols: int) -> Tensor:
    """A torch sparse CSR tensor that shares the memory of its parts."""
    _hear_out_torch()
    shape = (len(crow) - 1, num_cols)
    return torch.sparse_csr_tensor(crow, col, values, shape, check_invariants=False)


def multiply(
    crow: Int[Tensor, " rows_plus_1"],
    col: Int[Tensor, " nnz"],
    values: Float[Tensor, " nnz"],
    x: Float[Tensor, "cols C"],
) -> Float[Tensor, "rows C"]:
    """A x without derivatives, for operations that define their own; values and x of one type, at least float32."""
    x = x.contiguous()
    if x.device.type == "cpu" and x.dtype == torch.float32 and x.numel():
        # A row of the result is a weighted sum of rows of x; in float32 bags are twice as fast as MKL.
        return embedding_bag(
            col, x, crow, mode="sum", per_sample_weights=values, include_last_offset=True
        )
    with torch.autocast(x.device.type, enabled=False):
        return csr_tensor(crow, col, values, len(x)) @ x


def values_on(
    crow: np.ndarray, col: np.ndarray, matrix: Any, number: np.ndarray | None = None
) -> np.ndarray:
    """Values of a scipy matrix on a CSR pattern that has its entries, in rows and columns renumbered by `number`.

    >>> one = sparse.csr_array([[0.0, 2.0], [0.0, 0.0]])
    >>> values_on(np.array([0, 2, 3]), np.array([0, 1, 1]), one).tolist()
    [0.0, 2.0, 0.0]
    """
    entries: Any = sparse.coo_array(matrix)
    row, column = (x.astype(np.int64) if number is None else number[x] for x in entries.coords)
    count, values = len(crow) - 1, np.zeros(len(col))
    places = np.arange(count).repeat(np.diff(crow)) * count + col
    values[np.searchsorted(places, row * count + column)] = entries.data
    return values


def _form(*inputs: Any) -> Tensor:
    """A b or Aᵀ b, where A has the values a, or `_values` of a and b; from a pattern, a, b and the kind."""
    crow, col, crow_t, col_t, order_t, a, b, kind = inputs
    dtype, result_dtype = compute_dtype(a, b), _result_dtype(a, b)
    if kind == "values":
        return _values(crow, col, a.to(dtype), b.to(dtype))
    if kind == "transposed":
        crow, col, a = crow_t, col_t, a.index_select(0, order_t)
    return multiply(crow, col, a.to(dtype), b.to(dtype)).to(result_dtype)


def _values(crow: Tensor, col: Tensor, left: Tensor, right: Tensor) -> Tensor:
    """Σ_c left[row, c] right[col, c] at every entry (row, col), without storing the (nnz, C) terms."""
    matrix = csr_tensor(crow, col, left.new_zeros(len(col)), len(right))
    with torch.autocast(left.device.type, enabled=False):
        return torch.sparse.sampled_addmm(matrix, left, right.T).values()


DERIVATIVES = {
    "product": {"a": ("values", "gb"), "b": ("transposed", "ag")},
    "transposed": {"a": ("values", "bg"), "b": ("product", "ag")},
    "values": {"a": ("product", "gb"), "b": ("transposed", "ga")},
}
"""The gradients of each kind in a and in b, of which kind they are, and of which two of a, b and the cotangent g."""


def _save(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
    ctx.save_for_backward(*inputs[:7])
    ctx.save_for_forward(*inputs[:7])
    ctx.kind = inputs[7]


def _backward(ctx: Any, grad: Tensor, form: Any) -> Any:
    *pattern, a, b = ctx.saved_tensors
    given, found = {"a": a, "b": b, "g": grad}, []
    for needed, name in zip(ctx.needs_input_grad[5:7], "ab", strict=True):
        kind, parts = DERIVATIVES[ctx.kind][name]
        gradient = form(*pattern, *(given[part] for part in parts), kind) if needed else None
        found.append(gradient if gradient is None else gradient.to(given[name].dtype))
    return *(None,) * 5, *found, None


class _Form(torch.autograd.Function):
    """`_form` in eager mode, also under the transforms of `torch.func`."""

    forward = staticmethod(_form)  # pyright: ignore[reportIncompatibleMethodOverride]
    setup_context = staticmethod(_save)  # pyright: ignore[reportIncompatibleMethodOverride]

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return _backward(ctx, grad, _Form.apply)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        *pattern, a, b = ctx.saved_tensors
        pairs = (a, tangents[6]), (tangents[5], b)
        parts: Any = [
            _Form.apply(*pattern, *pair, ctx.kind)
            for pair in pairs
            if not any(part is None for part in pair)
        ]
        return sum(parts[1:], parts[0])

    @staticmethod
    def vmap(info: Any, in_dims: Any, *inputs: Any) -> tuple[Tensor, int]:  # pyright: ignore[reportIncompatibleMethodOverride]
        *rest, x, kind = inputs
        if kind == "values" or any(place is not None for place in in_dims[:6]):
            raise InputError("vmap: over functions, (B, N, C), not over matrices; use a batch")
        x = x.movedim(in_dims[6], 1)  # (N, B, C)
        result: Any = _Form.apply(*rest, x.flatten(1), kind)
        return result.unflatten(1, x.shape[1:]), 1


_form_op = torch.library.custom_op(
    "torchlb::csr_form",
    _form,
    mutates_args=(),
    schema="(Tensor crow, Tensor col, Tensor crow_t, Tensor col_t, Tensor order_t, Tensor a, Tensor b, str kind)"
    " -> Tensor",
)
_form_op.register_autograd(partial(_backward, form=_form_op), setup_context=_save)


@_form_op.register_fake
def _(*inputs: Any) -> Tensor:
    crow, col, crow_t, _, _, a, b, kind = inputs
    if kind == "values":
        return a.new_empty(col.shape[0], dtype=compute_dtype(a, b))
    num_rows = (crow_t if kind == "transposed" else crow).shape[0] - 1
    return b.new_empty(num_rows, b.shape[1], dtype=_result_dtype(a, b))


def to_scipy(
    crow: Int[Tensor, " rows_plus_1"],
    col: Int[Tensor, " nnz"],
    values: Float[Tensor, " nnz"],
    shape: tuple[int, int],
) -> sparse.csr_array:
    """Convert to a scipy CSR matrix on the CPU, without needless copies; half precision becomes float32."""
    values = values.float() if values.dtype.itemsize < 4 else values
    data, indices, indptr = (t.detach().cpu().numpy() for t in (values, col, crow))
    return sparse.csr_array((data, indices, indptr), shape=shape)


def from_scipy(matrix: Any) -> tuple[Tensor, Tensor, Tensor]:
    """(crow, col, values) of a scipy matrix: columns ascending, duplicates summed, int64 indices.

    >>> from_scipy(sparse.eye_array(2))[1].tolist()
    [0, 1]
    """
    matrix = sparse.csr_array(matrix, copy=True)
    matrix.sum_duplicates()
    crow, col, values = on_device(matrix, torch.device("cpu"))
    return crow.long(), col.long(), values


def on_device(matrix: sparse.csr_array, device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """(crow, col, values) of a scipy CSR matrix on a device; on the CPU in the same memory."""
    parts = matrix.indptr, matrix.indices, matrix.data
    crow, col, values = (torch.from_numpy(part).to(device) for part in parts)
    return crow, col, values
