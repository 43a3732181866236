"""Kernels compiled by numba, each the same to the bit as what stands in for it (`decisions.md`, *Compiled kernels*).

`admissible`: who may enter a stencil. `best_manifold`: triangles for a cloud. `both_products`: those of a weak pair.
`components`: what hangs together, and which side is out. `delaunay`: tetrahedra of points. `edges`: those of triangles.
`graph_balls`: neighbourhoods of surfaces in R³ and of flat domains. `left_inverse`, `monomials`: local fits.
`mirrored`, `upper_product`: the weak pair from its elements. Numba keeps what it has compiled, which takes some seconds
once in an installation.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from time import perf_counter
from typing import Any

KERNELS = (
    "admissible",
    "best_manifold",
    "both_products",
    "components",
    "delaunay",
    "edges",
    "graph_balls",
    "left_inverse",
    "mirrored",
    "monomials",
    "upper_product",
)
PATIENCE = 0.25
"""Seconds that a process does, or would do, without kernels before it loads them, which takes twice as long."""

_spent = [0.0]


def kernel(name: str, seconds: float = 0.0) -> Any:
    """The function of that name; None without numba, and until a process has spent `PATIENCE` without.

    `seconds` are those that it would take without this time.
    """
    return _loaded(name) if _spent[0] + seconds >= PATIENCE else None


def prepare() -> bool:
    """Compile all of them now, for later processes; whether there is a numba that does."""
    return None not in [_loaded(name) for name in KERNELS]


@cache
def _loaded(name: str) -> Any:
    try:
        found = getattr(import_module(f"torchlb.compiled.{name}"), name)
    except (ImportError, RuntimeError):  # not there; no place to keep what is compiled
        return None
    return found if hasattr(found, "signatures") else None  # it was told not to compile


@contextmanager
def standing_in() -> Iterator[None]:
    """What a kernel would do: its time counts, once where one stands within another."""
    start, before = perf_counter(), _spent[0]
    yield
    _spent[0] = before + perf_counter() - start
