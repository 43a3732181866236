"""The ladder of candidate neighbourhoods of a point, best first, and the walk down it (`method.md`, section 4)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from math import ceil
from typing import Any, NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from torchlb.fits.polynomials import num_monomials
from torchlb.geometry.neighbors import GraphBalls

__all__ = ["CHUNK_BYTES", "SIZE_FACTORS", "Candidate", "chunks", "list_candidates", "walk_ladder"]

SIZE_FACTORS = {
    "least_squares": (1.6, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0, 10.0),
    "polyharmonic": (2.0, 2.5, 3.0),
    "positive": (1.6, 2.5, 4.0, 7.0, 10.0),
}
"""Points of a stencil per polynomial, by the rule for its weights, in the order in which they are tried."""

CHUNK_BYTES = 2**28
"""Bound on one array of a chunk of points: about four of them live at once."""


class Candidate(NamedTuple):
    """A candidate neighbourhood and what to do with it.

    Attributes
    ----------
    degree : of the polynomials.
    size : number of points K, the centre included.
    rule : for the weights, a key of `WEIGHT_RULES`.
    """

    degree: int
    size: int
    rule: str


def list_candidates(
    dim: int,
    degrees: Sequence[int],
    rules: Sequence[str] = ("least_squares",),
    num_neighbors: int | None = None,
) -> list[Candidate]:
    """Candidates, best first: for each degree every rule, for each rule every size. `num_neighbors` fixes the size.

    >>> [rung.size for rung in list_candidates(2, [2])]
    [10, 12, 15, 18, 24, 30, 42, 60]
    >>> list_candidates(2, [3, 2], num_neighbors=20)[1]
    Candidate(degree=2, size=20, rule='least_squares')
    """
    rungs = []
    for degree in degrees:
        count = num_monomials(dim, degree)
        for rule in rules:
            sizes = [ceil(factor * count - 1e-9) for factor in SIZE_FACTORS[rule]]
            fixed = sizes if num_neighbors is None else [num_neighbors]
            rungs += [Candidate(degree, size, rule) for size in fixed]
    return rungs


def chunks(num_points: int, rungs: Sequence[Candidate], dim: int) -> tuple[Int[Tensor, " B"], ...]:
    """Consecutive centres, so many at a time that one (B, K, M) array stays below `CHUNK_BYTES`."""
    size = max(rung.size for rung in rungs)
    columns = num_monomials(dim, rungs[0].degree)
    return torch.arange(num_points).split(max(64, CHUNK_BYTES // (8 * size * columns)))


def walk_ladder(
    balls: GraphBalls,
    centers: Int[Tensor, " B"],
    rungs: Sequence[Candidate],
    attempt: Callable[[Tensor, Tensor, Candidate], tuple[Tensor, Any]],
    start: Int[Tensor, " B"] | None = None,
) -> Iterator[tuple[int, Tensor, Any]]:
    """Let every centre take the first rung that passes.

    `attempt(centers, index, rung)` tries the neighbourhoods `index` (b, K) and returns (passed (b,), result), where
    `result[mask]` selects rows. Yields (rung number, rows of `centers` that took it, their result); rows that never
    appear passed nowhere. `start` keeps a row off the rungs before its own.
    """
    pending = torch.arange(len(centers))
    start = torch.zeros_like(pending) if start is None else start
    held = 0  # size of the balls at hand: small ones first, since most rows take an early rung
    index = count = torch.empty(0)
    for number, rung in enumerate(rungs):
        eligible = start[pending] <= number
        if not eligible.any():
            continue
        if rung.size > held:
            held = rung.size if held == 0 else max(r.size for r in rungs if r.size <= 2 * rung.size)
            index, count = balls(centers[pending], held)
        tried = eligible & (count >= rung.size)
        if not tried.any():
            continue
        passed, result = attempt(centers[pending[tried]], index[tried, : rung.size], rung)
        if passed.any():
            yield number, pending[tried][passed], result[passed]
        left = ~tried
        left[tried] = ~passed
        pending, index, count = pending[left], index[left], count[left]
