"""Errors and warnings of torchlb. Bad input raises an `InputError`; every error is a `TorchlbError`."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import jaxtyping

HERE = str(Path(__file__).parent), str(Path(jaxtyping.__file__).parent)


class TorchlbError(ValueError):
    """Base of all errors of torchlb; messages say what was expected, what came, where, and what to do."""


class InputError(TorchlbError):
    """Input that cannot work: shapes, types, values or options."""


class InputTypeError(InputError, TypeError):
    """An argument of the wrong type, also a `TypeError`; the message says how to make one of the right type."""


class StencilError(InputError):
    """No acceptable stencil exists for some points; the message names them and the remedy."""


class StabilityError(TorchlbError):
    """Stability cannot be decided: the operator is singular beyond its constants."""


class EigenbasisError(TorchlbError):
    """The eigenpairs cannot be computed: no convergence, a growing mode, or a cut through a cluster."""


class DiffusionError(TorchlbError):
    """The flow cannot be computed by this method; the message names one that can."""


class DerivativeError(TorchlbError, RuntimeError):
    """A second derivative of what is differentiable once, also a `RuntimeError`; the message names a remedy."""


class OperatorFileError(TorchlbError):
    """A damaged file, or one that is no operator; the message names it and says what to do."""


class TorchlbWarning(UserWarning):
    """Base of all warnings of torchlb: ``warnings.simplefilter("error", torchlb.TorchlbWarning)`` raises them."""


class StabilityWarning(TorchlbWarning):
    """The certificate does not hold; the message names what remains."""


class CacheWarning(TorchlbWarning):
    """A cache file was damaged, outdated, or could not be written; the message names it."""


_GIVEN: ContextVar[Any] = ContextVar("given", default=None)


@contextmanager
def renumbered(given: Any) -> Iterator[None]:
    """Context in which messages name points by the user's numbers `given`, (N,)."""
    token = _GIVEN.set(given)
    try:
        yield
    finally:
        _GIVEN.reset(token)


def as_given(index: Any) -> Any:
    """User's numbers of the points in `index`."""
    given = _GIVEN.get()
    return index if given is None else given[index]


def first_few(index: Any, limit: int = 8) -> str:
    """Smallest of an array of points, in the user's numbers, for a message."""
    names = sorted(as_given(index).tolist())[:limit]
    return ", ".join(map(str, names)) + (", …" if len(index) > limit else "")


def shown(value: object, longest: int = 80) -> str:
    """A value for a message; its type where it has too many letters, as a tensor in the place of a number."""
    text = repr(value)
    return text if len(text) <= longest else f"a {type(value).__name__}"


def warn(
    message: str, category: type[Warning] = TorchlbWarning, *, once: set | None = None
) -> None:
    """Issue a warning at the line outside torchlb from which the call came; with `once` one kind once for each line."""
    frame, level = sys._getframe(), 1
    while frame.f_back is not None and frame.f_code.co_filename.startswith(HERE):
        frame, level = frame.f_back, level + 1
    kind = re.sub(r"\(.*?\)|\d", "", message)  # whatever the points and numbers
    place = frame.f_code.co_filename, frame.f_lineno, kind
    once = set() if once is None else once
    if place not in once:
        once.add(place)
        warnings.warn(message, category, stacklevel=level)
