"""Validation of operators, and of functions on points: tensors of finite values."""

from __future__ import annotations

import torch
from torch import Tensor

from torchlb.errors import InputError, InputTypeError, first_few


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
            "operator without them"
        )
