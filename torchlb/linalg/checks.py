"""Validation of operators, and of functions on points: tensors of finite values, or NumPy arrays in their place."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar, get_args

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from torchlb.errors import InputError, InputTypeError, first_few, shown

P = ParamSpec("P")
T = TypeVar("T")
DATA = {"f", "v", "coefficients", "sources"}


def takes_arrays(function: Callable[P, T]) -> Callable[P, T]:
    """Let a function take arrays of NumPy: if its data, a parameter in `DATA`, are one, so is what it returns.

    Arrays go to the device of the operator or basis; masked values become NaN. Results have no gradients.
    """
    names = list(inspect.signature(function).parameters)
    place = next(i for i, name in enumerate(names) if name in DATA)
    data_name = names[place]

    @wraps(function)
    def called(*args: P.args, **options: P.kwargs) -> T:
        data = args[place] if len(args) > place else options.get(data_name)
        if isinstance(data, np.ndarray):
            return _of_arrays(function, *args, **options)
        return function(*args, **options)

    return called


def _of_arrays(function: Any, *args: Any, **options: Any) -> Any:
    """The result as an array, with tensors in the place of the arrays that are given."""
    given = inspect.signature(function).bind(*args, **options).arguments
    mass = next((x.mass for x in given.values() if hasattr(x, "mass")), None)
    for name, x in given.items():
        if isinstance(x, np.ndarray):
            x = np.ma.filled(x, np.nan)
            x = torch.tensor(x.astype(x.dtype.newbyteorder("=")))
            given[name] = x.to(getattr(mass, "device", None))
    return function(**given).detach().cpu().numpy()


def check_tensor(f: object, what: str = "f") -> None:
    """Raise InputTypeError unless `f` is a tensor.

    >>> check_tensor([1.0])
    Traceback (most recent call last):
    torchlb.errors.InputTypeError: expected f as a tensor, got <class 'list'>; torch.as_tensor(f) makes one
    """
    if not isinstance(f, Tensor):
        raise InputTypeError(
            f"expected {what} as a tensor, got {type(f)}; torch.as_tensor({what}) makes one"
        )


def as_floats(x: Tensor, dtype: torch.dtype) -> Tensor:
    """x, integers and masks in the type.

    >>> as_floats(torch.tensor([True]), torch.float32)
    tensor([1.])
    """
    return x if x.is_floating_point() or x.is_complex() else x.to(dtype)


def check_rows(f: Tensor, count: int) -> None:
    """Raise InputError unless f is (N,), (N, C) or (B, N, C) with N = `count`, InputTypeError unless a tensor."""
    check_tensor(f)
    if f.ndim not in (1, 2, 3) or f.shape[max(f.ndim - 2, 0)] != count:
        raise InputError(
            f"expected f of shape (N,), (N, C) or (B, N, C) with N = {count}, got {tuple(f.shape)}"
        )


def check_operator(lb: object) -> None:
    """Raise InputTypeError unless `lb` is an operator; swapped arguments are the usual cause.

    >>> check_operator(torch.ones(3))  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    torchlb.errors.InputTypeError: expected an operator, got a Tensor in its place: functions take (lb, f), ...
    """
    if not hasattr(lb, "num_points"):
        raise InputTypeError(
            f"expected an operator, got a {type(lb).__name__} in its place: functions take (lb, f), layers (x, lb); "
            "several shapes are one operator, LaplaceBeltrami.batch(…), with features below each other, torch.cat(…)"
        )


def check_choice(name: str, value: object, choices: Any) -> None:
    """Raise InputError unless the value is one of a Literal."""
    if not isinstance(value, str) or value not in get_args(choices):
        raise InputError(f"{name}: expected one of {list(get_args(choices))}, got {shown(value)}")


def check_sources(sources: Any, count: int) -> Int[Tensor, " S"]:
    """Indices of points, from an index, several, or a mask; InputError for none, and for any out of range."""
    try:
        index = torch.as_tensor(sources)
    except (TypeError, ValueError, RuntimeError):
        index = torch.zeros(0)
    if index.dtype == torch.bool and index.shape == (count,):
        index = index.nonzero()
    index = index.reshape(-1)
    whole = index.dtype in (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)
    if len(index) == 0 or not whole or bool(((index < 0) | (index >= count)).any()):
        raise InputError(
            f"sources: expected numbers of points from 0 to {count - 1}, or a mask of them with at least one, got "
            f"{shown(sources)}"
        )
    return index.cpu().long()


def check_finite(f: Tensor, what: str = "f") -> None:
    """Raise InputError where f, (N,) or (…, N, C), is NaN or infinite, naming the points; not in compiled code.

    >>> check_finite(torch.tensor([0.0, torch.nan, torch.inf]))  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    torchlb.errors.InputError: f: expected finite values, got NaN or infinity at 2 of 3 points (1, 2); ...
    """
    if torch.compiler.is_compiling():
        return
    total = f.detach().sum().item()
    if total - total == 0:  # otherwise the sum may have overflowed
        return
    bad = (~f.isfinite()).nonzero()[:, max(f.ndim - 2, 0)].unique()
    if len(bad):
        raise InputError(
            f"{what}: expected finite values, got NaN or infinity at {len(bad)} of {f.shape[max(f.ndim - 2, 0)]} "
            f"points ({first_few(bad)}); give these points values, as torch.nan_to_num({what}) does, or build the "
            "operator without them (torchlb.submesh)"
        )
