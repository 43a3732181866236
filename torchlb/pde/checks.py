"""Checks of the input of solves, flows and layers: shapes, types and names."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from torchlb.errors import InputError, InputTypeError
from torchlb.linalg.checks import as_floats, check_finite, check_operator, check_tensor
from torchlb.operator.pair_methods import PairMethods, check_pair

P = ParamSpec("P")
T = TypeVar("T")


def check_shape(x: Tensor, lb: PairMethods) -> None:
    """Raise InputError unless x is (N, C) or (B, N, C) with the N of the operator, InputTypeError unless a tensor."""
    check_operator(lb)
    check_tensor(x)
    if x.ndim not in (2, 3) or x.shape[-2] != lb.num_points:
        raise InputError(
            f"expected features of shape (N, C) or (B, N, C) with N = {lb.num_points}, got {tuple(x.shape)}"
        )


def as_columns(f: Tensor, lb: PairMethods) -> Tensor:
    """A user's f of shape (N,), (N, C) or (B, N, C) as (N, C) or (B, N, C); integers and masks in the operator's type.

    Errors as for `check_shape`, and InputError for complex numbers, NaN and infinity, and without a weak pair.
    """
    x = f[:, None] if isinstance(f, Tensor) and f.ndim == 1 else f
    check_shape(x, lb)
    check_pair(lb)
    if x.is_complex():
        raise InputError(f"expected real f, got {x.dtype}; torch.view_as_real(f) makes channels")
    check_finite(x)
    return as_floats(x, lb.dtype)


def as_times(t: float | Tensor, x: Tensor, dtype: torch.dtype) -> Tensor:
    """Times for the channels of x, (C,); InputError unless one or C are given, finite and at least 0.

    >>> as_times(0.5, torch.ones(4, 2), torch.float32)
    tensor([0.5000, 0.5000])
    """
    try:
        time = torch.as_tensor(t, dtype=dtype, device=x.device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputTypeError(f"t: expected a number or numbers, got {t!r}") from error
    if time.shape not in ((), (1,), x.shape[-1:]):
        raise InputError(
            f"t: expected one time or one for each of {x.shape[-1]} channels, got {tuple(time.shape)}"
        )
    if not torch.compiler.is_compiling() and not bool(((time >= 0) & time.isfinite()).all()):
        raise InputError(f"t: expected finite times of at least 0, got {time.detach().cpu()}")
    return time.expand(x.shape[-1])


def uncompiled(function: Callable[P, T]) -> Callable[P, T]:
    """`torch.compiler.disable`, deferred until something is compiled: importing the compiler takes over a second."""

    @wraps(function)
    def called(*args: P.args, **options: P.kwargs) -> T:
        if torch.compiler.is_compiling():
            disabled: Any = torch.compiler.disable(function)
            return disabled(*args, **options)
        return function(*args, **options)

    return called
