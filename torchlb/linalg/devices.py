"""Work on a device: new tensors there, constants made once for each, and nested data moved."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields, is_dataclass, replace
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

Inputs = ParamSpec("Inputs")
Result = TypeVar("Result")


def moved(data: Result, device: torch.device, known: dict[int, Any] | None = None) -> Result:
    """Data with all tensors on the device: a tensor, tuples, lists and dictionaries, dataclasses of them.

    Tensors that stand in it twice are moved once; `known` has those moved so far, by `id`.

    >>> moved({"one": [torch.ones(1)]}, torch.device("meta"))["one"][0].device
    device(type='meta')
    """
    found: Any = data
    known = {} if known is None else known
    if isinstance(data, Tensor):
        found = known[id(data)] = known.get(id(data), data.to(device))
    elif isinstance(data, dict):
        found = {key: moved(value, device, known) for key, value in data.items()}
    elif isinstance(data, list):
        found = [moved(value, device, known) for value in data]
    elif isinstance(data, tuple):
        parts = [moved(value, device, known) for value in data]
        found = type(data)(*parts) if hasattr(data, "_fields") else tuple(parts)
    elif is_dataclass(data):
        parts = {f.name: getattr(data, f.name) for f in fields(data) if f.init}
        found = replace(data, **moved(parts, device, known))  # pyright: ignore[reportArgumentType]
    return found


def default(device: torch.device) -> AbstractContextManager[Any]:
    """Context in which new tensors are on the device; torch's own costs a tenth of small operations, also where it is.

    >>> with default(torch.device("meta")):
    ...     torch.zeros(1).device
    device(type='meta')
    """
    return nullcontext() if device == torch.get_default_device() else device


def constant(function: Callable[Inputs, Result]) -> Callable[Inputs, Result]:
    """Cache tensors that follow from numbers, once for each default device."""

    @cache
    def made(device: torch.device, *inputs: Any) -> Any:
        with torch.device("cpu"):
            return moved(function(*inputs), device)  # pyright: ignore[reportCallIssue]

    @wraps(function)
    def on_default_device(*inputs: Any) -> Any:
        return made(torch.get_default_device(), *inputs)

    return on_default_device  # pyright: ignore[reportReturnType]
