"""Stored tensors as modules: records with a row for each point, and sparse matrices on one pattern.

The stored data of an operator consists of these two. `.to`, copies and `state_dict` come from `nn.Module`; a state of
any size loads into them, and they are joined to batches and split again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any, TypeVar

import torch
from jaxtyping import Float, Int, Shaped
from scipy import sparse
from torch import Tensor, nn
from torch.nn.functional import pad

from torchlb.linalg.checks import check_rows
from torchlb.linalg.sparse import csr_product, csr_tensor, to_scipy, transpose_pattern, values_on

Held = TypeVar("Held", bound="Tensors")


def starts(counts: Sequence[int]) -> list[int]:
    """Start of each of several consecutive blocks.

    >>> starts([3, 2, 4])
    [0, 3, 5]
    """
    return [0, *accumulate(counts)][: len(counts)]


def side_by_side(f: Tensor) -> Tensor:
    """The functions of f, (N,), (N, C) or (B, N, C), as columns: (N, 1), (N, C) or (N, B C).

    >>> side_by_side(torch.tensor([[[1.0], [2.0]], [[3.0], [4.0]]])).tolist()
    [[1.0, 3.0], [2.0, 4.0]]
    """
    if f.ndim == 1:
        return f[:, None]
    return f if f.ndim == 2 else f.transpose(0, 1).flatten(1)


def shaped_like(columns: Tensor, f: Tensor) -> Tensor:
    """Columns as functions of the shape of f, (N,), (N, C) or (B, N, C): the inverse of `side_by_side`."""
    if f.ndim == 1:
        return columns[:, 0]
    return columns if f.ndim == 2 else columns.unflatten(1, f.shape[::2]).transpose(0, 1)


class Tensors(nn.Module):
    """Plain buffers by name, which load a state of any size: they are data, not parameters."""

    def __init__(self, tensors: Mapping[str, Tensor], *, persistent: bool = True) -> None:
        super().__init__()
        for name, tensor in tensors.items():
            self.register_buffer(name, tensor, persistent=persistent)

    def __getattr__(self, name: str) -> Any:
        """Buffer or submodule, not by `nn.Module`, for whose buffers `torch.compile` makes a graph of every size."""
        for kind in ("_buffers", "_modules"):
            held = self.__dict__.get(kind, {})
            if name in held:
                return held[name]
        return super().__getattr__(name)

    def _alias(self: Held) -> Held:
        """A module of the same tensors, which is moved and cast by itself."""
        other = type(self).__new__(type(self))
        other.__dict__.update(self.__dict__)
        other._buffers = dict(self._buffers)
        other._modules = {
            name: module._alias() if isinstance(module, Tensors) else module
            for name, module in self._modules.items()
        }
        return other

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *given: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        for name, buffer in self._buffers.items():
            incoming = state_dict.get(prefix + name)
            if incoming is not None and buffer is not None:
                setattr(self, name, torch.empty_like(incoming, device=buffer.device))
        super()._load_from_state_dict(state_dict, prefix, *given)


def tensors_of(module: nn.Module) -> dict[str, Tensor]:
    """All buffers by name, including those of submodules and those that share memory."""
    return dict(module.named_buffers(remove_duplicate=False))


class Record(Tensors):
    """Tensors with a row for each point; those of a batch concatenate the rows of its shapes.

    >>> record = Record({"order": torch.tensor([3, 3, 0])})
    >>> [part.order.tolist() for part in record.split([2, 1])]
    [[3, 3], [0]]
    """

    @staticmethod
    def join(records: Sequence[Tensors]) -> Record:
        """Record of a batch."""
        names = tensors_of(records[0])
        return Record({n: torch.cat([tensors_of(each)[n] for each in records]) for n in names})

    def split(self, sizes: Sequence[int]) -> list[Record]:
        """Records of the shapes of a batch, with `sizes` points."""
        parts = {name: tensor.split(list(sizes)) for name, tensor in tensors_of(self).items()}
        # copies, which do not keep the batch alive
        return [Record({n: parts[n][s].clone() for n in parts}) for s in range(len(sizes))]


class Csr(Tensors):
    """Sparse matrices (N, N) on one CSR pattern with ascending columns, a channel of values, (c, nnz), for each.

    Those of a batch are block-diagonal. `order_t` sorts the entries by columns, and is None for symmetric matrices.

    >>> one = Csr(torch.tensor([0, 1]), torch.tensor([0]), torch.tensor([[2.0]]))
    >>> Csr.join([one, one]).col.tolist()
    [0, 1]
    """

    crow: Int[Tensor, " N_plus_1"]
    col: Int[Tensor, " nnz"]
    values: Float[Tensor, "c nnz"]
    crow_t: Int[Tensor, " N_plus_1"]
    col_t: Int[Tensor, " nnz"]
    order_t: Int[Tensor, " nnz"]

    def __init__(
        self,
        crow: Tensor | None = None,
        col: Tensor | None = None,
        values: Tensor | None = None,
        order_t: Tensor | None = None,
    ) -> None:
        crow = torch.zeros(1, dtype=torch.int64) if crow is None else crow
        col = crow[:0].clone() if col is None else col
        values = torch.zeros(2, 0) if values is None else values
        super().__init__({"crow": crow, "col": col, "values": values})
        self.symmetric = order_t is None
        if order_t is not None:
            self._transpose(order_t)

    @staticmethod
    def with_transpose(crow: Tensor, col: Tensor, values: Tensor) -> Csr:
        """Build matrices that are not symmetric."""
        return Csr(crow, col, values, transpose_pattern(crow, col, len(crow) - 1)[2])

    def _transpose(self, order_t: Tensor | None = None) -> None:
        pattern = transpose_pattern(self.crow, self.col, self.num_rows, order_t)
        for name, tensor in zip(("crow_t", "col_t", "order_t"), pattern, strict=True):
            self.register_buffer(name, tensor, persistent=False)

    @property
    def num_rows(self) -> int:
        """N; 0 where there are no matrices."""
        return self.crow.shape[0] - 1

    @property
    def row(self) -> Int[Tensor, " nnz"]:
        """The row of every entry."""
        count = torch.arange(self.num_rows, device=self.crow.device)
        return count.repeat_interleave(self.crow.diff(), output_size=self.col.shape[0])

    @property
    def pattern(self) -> list[Tensor]:
        """The pattern as `csr_product` takes it."""
        of_transpose = [] if self.symmetric else [self.crow_t, self.col_t, self.order_t]
        return [self.crow, self.col, *of_transpose]

    def tensor(self, channel: int) -> Tensor:
        """Matrix of a channel as a torch sparse CSR tensor that shares its memory."""
        return csr_tensor(self.crow, self.col, self.values[channel], self.num_rows)

    def to_scipy(self, channel: int) -> sparse.csr_array:
        """Matrix of a channel as a scipy CSR matrix on the CPU."""
        shape = self.num_rows, self.num_rows
        return to_scipy(self.crow, self.col, self.values[channel], shape)

    def product(
        self,
        channel: int,
        f: Shaped[Tensor, "*batch N C"] | Shaped[Tensor, " N"],
        *,
        transposed: bool = False,
        dtype: torch.dtype | None = None,
    ) -> Tensor:
        """Product of a matrix, or its transpose, with f: (N,), (N, C) or (B, N, C); types as in `csr_product`.

        The values are cast to `dtype` first, if it is given. Raises InputError for another shape.
        """
        check_rows(f, self.num_rows)
        values = self.values[channel] if dtype is None else self.values[channel].to(dtype)
        return shaped_like(csr_product(self.pattern, values, side_by_side(f), transposed), f)

    def beside(self, others: Sequence[Any], number: Any = None) -> Csr:
        """These symmetric matrices and scipy's others, whose rows have these numbers here, on their pattern."""
        place = self.crow.numpy(), self.col.numpy()
        extra = [torch.from_numpy(values_on(*place, other, number))[None] for other in others]
        return Csr(self.crow, self.col, torch.cat([self.values, *extra]))

    @staticmethod
    def join(records: Sequence[Csr]) -> Csr:
        """Block-diagonal matrices with the largest number of channels; missing ones are zero."""
        most = max(len(each.values) for each in records)
        first = starts([len(each.col) for each in records])
        rows = starts([each.num_rows for each in records])
        crows = [each.crow[1:] + start for each, start in zip(records, first, strict=True)]
        orders = [r.order_t + e for r, e in zip(records, first, strict=True) if not r.symmetric]
        return Csr(
            torch.cat([records[0].crow[:1], *crows]),
            torch.cat([each.col + start for each, start in zip(records, rows, strict=True)]),
            torch.cat([pad(r.values, (0, 0, 0, most - len(r.values))) for r in records], dim=1),
            torch.cat(orders) if orders else None,
        )

    def split(self, sizes: Sequence[int]) -> list[Csr]:
        """The diagonal blocks."""
        blocks = []
        ends = self.crow[[0, *accumulate(sizes)]].tolist()
        for start, size, first, last in zip(starts(sizes), sizes, ends, ends[1:], strict=False):
            crow, col = self.crow[start : start + size + 1] - first, self.col[first:last] - start
            order_t = None if self.symmetric else self.order_t[first:last] - first
            blocks.append(Csr(crow, col, self.values[:, first:last].clone(), order_t))
        return blocks

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *given: Any) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        super()._load_from_state_dict(state_dict, prefix, *given)
        if not self.symmetric:
            self._transpose()
