"""What torchlb raises and warns of. Bad input is an `InputError`; everything raised is a `TorchlbError`."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

__all__ = [
    "CacheWarning",
    "DerivativeError",
    "DiffusionError",
    "EigenbasisError",
    "InputError",
    "InputTypeError",
    "OperatorFileError",
    "StabilityError",
    "StabilityWarning",
    "StencilError",
    "TorchlbError",
    "as_given",
    "first_few",
    "renumbered",
    "warn",
]
HERE = str(Path(__file__).parent)


class TorchlbError(ValueError):
    """Base of all errors of torchlb; the message says what was expected, what came, where, and what to do."""


class InputError(TorchlbError):
    """Input that cannot work: shapes, types, values or options."""


class InputTypeError(InputError, TypeError):
    """An argument of another type than asked for, also a `TypeError`; the message says what makes the right one."""


class StencilError(InputError):
    """No acceptable stencil exists for some points; the message names them and the remedy."""


class StabilityError(TorchlbError):
    """Nothing can be said of stability: the operator is singular beyond its constants."""


class EigenbasisError(TorchlbError):
    """The eigenpairs cannot be had: no convergence, a growing mode, or a cut through a cluster."""


class DiffusionError(TorchlbError):
    """A flow cannot be computed by the method asked for; the message names one that can."""


class DerivativeError(TorchlbError, RuntimeError):
    """A second derivative of what is differentiable once, also a `RuntimeError`; the message says what to take."""


class OperatorFileError(TorchlbError):
    """A file that is no operator, or a damaged one; the message names it and says what to do."""


class StabilityWarning(UserWarning):
    """The certificate does not hold; the message names what remains."""


class CacheWarning(UserWarning):
    """A file of a cache was damaged, outdated, or could not be written; the message names it."""


_GIVEN: ContextVar[Any] = ContextVar("given", default=None)


@contextmanager
def renumbered(given: Any) -> Iterator[None]:
    """Within it messages name points by the numbers `given` to them by the user, (N,)."""
    token = _GIVEN.set(given)
    try:
        yield
    finally:
        _GIVEN.reset(token)


def as_given(index: Any) -> Any:
    """The user's numbers of points."""
    given = _GIVEN.get()
    return index if given is None else given[index]


def first_few(index: Any, limit: int = 8) -> str:
    """The smallest of an array of points, by the user's numbers, for a message."""
    names = sorted(as_given(index).tolist())[:limit]
    return ", ".join(map(str, names)) + (", …" if len(index) > limit else "")


def warn(message: str, category: type[Warning] = UserWarning) -> None:
    """Warn of the line outside torchlb from which the call came."""
    frame, level = sys._getframe(), 1
    while frame.f_back is not None and frame.f_code.co_filename.startswith(HERE):
        frame, level = frame.f_back, level + 1
    warnings.warn(message, category, stacklevel=level)
