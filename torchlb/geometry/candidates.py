"""Candidate neighbourhoods of a point, best first, and the search through them (`method.md`, section 4)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product
from math import ceil
from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from torchlb.fits.polynomials import num_monomials
from torchlb.fits.rules import SIZE_FACTORS
from torchlb.geometry.neighbors import GraphNeighborhoods
from torchlb.linalg.precision import rows_at_once


class Candidate(NamedTuple):
    """Degree of polynomials, size K of a neighbourhood with its centre, and rule of the weights, of `WEIGHT_RULES`.

    The factor is that of `SIZE_FACTORS`, points per polynomial; 0 where the user has fixed the size.
    """

    degree: int
    size: int
    rule: str
    factor: float = 0.0


def list_candidates(
    dim: int,
    degrees: Sequence[int],
    rules: Sequence[str] = ("least_squares",),
    num_neighbors: int | None = None,
) -> list[Candidate]:
    """Candidates, best first: for each degree every rule, for each rule every size, unless `num_neighbors` fixes it.

    >>> [candidate.size for candidate in list_candidates(2, [2])]
    [10, 12, 15, 18, 24, 30, 42, 60]
    >>> list_candidates(2, [3, 2], num_neighbors=20)[1]
    Candidate(degree=2, size=20, rule='least_squares', factor=0.0)
    """
    found = []
    for degree, rule in product(degrees, rules):
        count, factors = num_monomials(dim, degree), SIZE_FACTORS[rule]
        sizes = [(ceil(factor * count - 1e-9), factor) for factor in factors]
        sizes = sizes if num_neighbors is None else [(num_neighbors, 0.0)]
        found += [Candidate(degree, size, rule, factor) for size, factor in sizes]
    return found


def stencil_candidates(
    dim: int, order: int, weights: str, num_neighbors: int | None, *, on_mesh: bool, triangles: bool
) -> list[Candidate]:
    """Candidates for a row of order p: degree p + 1, then the even degrees below, then positive weights of order 1.

    On evenly spread points rows of even order are no better than rows of the odd order below. Rows of order 1 are no
    better than the triangles of a mesh, and positive ones no better than those of a surface through a cloud: there they
    are tried only if asked for. Least squares follow any other `weights`.
    """
    rules = list(dict.fromkeys([weights, "least_squares"]))
    lowest = 4 if on_mesh else 2
    degrees = [order + 1, *range(order // 2 * 2, lowest - 1, -2)]
    positive = [2] if order == 1 or not triangles else []
    return [
        *list_candidates(dim, degrees, rules, num_neighbors),
        *list_candidates(dim, positive, ["positive"], num_neighbors),
    ]


class Search:
    """Search in which every centre tries the candidates in turn until one is accepted.

    Iteration yields (number of the candidate, rows of `centers` that try it, their neighbourhoods (b, K)), in chunks
    whose (b, K, M) arrays stay below `BYTES`. Rows are to be settled, or turned away from further candidates, before
    the next chunk. Each begins with its candidate `start`, by default the very first.
    """

    def __init__(
        self,
        neighborhoods: GraphNeighborhoods,
        centers: Int[Tensor, " B"],
        candidates: Sequence[Candidate],
        start: Int[Tensor, " B"] | None = None,
    ) -> None:
        self.neighborhoods, self.centers, self.candidates = neighborhoods, centers, candidates
        self._next = torch.zeros_like(centers) if start is None else start.clone()

    def settle(self, rows: Int[Tensor, " b"]) -> None:
        """Mark these rows as done."""
        self._next[rows] = len(self.candidates)

    def reject_degree(self, rows: Int[Tensor, " b"], number: int) -> None:
        """Let these rows go on with the first candidate of a lower degree than that of candidate `number`."""
        degree = self.candidates[number].degree
        self._next[rows] = sum(other.degree >= degree for other in self.candidates)

    def __iter__(self) -> Iterator[tuple[int, Int[Tensor, " b"], Int[Tensor, "b K"]]]:
        """Yield the candidates that some rows can try; neighbourhoods start small, since most rows settle early."""
        pending, dim = torch.arange(len(self.centers)), self.neighborhoods.frames.shape[-1]
        held, index, count = 0, torch.empty(0), torch.empty(0)
        for number, candidate in enumerate(self.candidates):
            left = self._next[pending] < len(self.candidates)
            if not left.all():
                pending = pending[left]
                index, count = (index[left], count[left]) if held else (index, count)
            eligible = self._next[pending] <= number
            if not eligible.any():
                continue
            if candidate.size > held:
                within = [c.size for c in self.candidates if c.size <= 2 * candidate.size]
                held = candidate.size if held == 0 else max(within)
                index, count = self.neighborhoods(self.centers[pending], held)
            tried = (eligible & (count >= candidate.size)).nonzero()[:, 0]
            entry = candidate.size * num_monomials(dim, candidate.degree)
            for piece in tried.split(rows_at_once(entry)):
                if len(piece):
                    yield number, pending[piece], index[piece, : candidate.size]
