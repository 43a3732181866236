"""One polynomial a vertex, of functions and of the surface, over its initial frame (`method.md`, section 9)."""

from __future__ import annotations

from math import ceil
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.fits.polynomials import num_monomials
from torchlb.fits.weights import MAX_RESIDUAL, CenteredFit, centered_fit
from torchlb.geometry.candidates import Search, list_candidates
from torchlb.geometry.neighbors import AT_ONCE, GraphBalls

MAX_LEBESGUE = 10.0
"""Of a fit in the middles of the edges of its point; where neighbours lie well around it has less than 2."""
MAX_MISFIT = {2: 0.3}
"""Of the heights of a quadratic, which is the last resort; all others have to follow them to `FAITHFUL`."""
FAITHFUL = 0.05
REASONS = (
    "reached",
    "too few admissible neighbours",
    "neighbours too close to a line or conic",
    "points do not resolve the surface",
)
LEAST = 1.5
"""Neighbours per polynomial without which a fit is not tried."""


ROOM = 2**18
"""Fits in a pile, 0.7 GB at degree 4: pieces below 32 MB would stay with glibc, and scatter its memory."""


class Fits(NamedTuple):
    """Fits of one degree to as many points each.

    Attributes
    ----------
    vertices : (b,).
    degree : m.
    points : (b, K), the vertex first; padded by the vertex, whose coefficients are then zero.
    coefficients : (b, M − 1, K − 1), as in `CenteredFit`.
    """

    vertices: Int[Tensor, " b"]
    degree: int
    points: Int[Tensor, "b K"]
    coefficients: Float[Tensor, "b M neighbors"]


class _Pile:
    """Room for fits of one degree and size, of which only what is filled takes memory.

    In large pieces: thousands of arrays that stay, between those that come and go, would scatter the memory.
    """

    def __init__(self, degree: int, room: int, size: int, terms: int, like: Tensor) -> None:
        self.degree, self.filled = degree, 0
        self.vertices = torch.empty(room, dtype=torch.int64)
        self.points = torch.empty(room, size, dtype=torch.int64)
        self.coefficients = like.new_empty(room, terms, size - 1)

    def add(
        self,
        vertices: Int[Tensor, " b"],
        points: Int[Tensor, "b K"],
        coefficients: Float[Tensor, "b M neighbors"],
    ) -> None:
        """Fill the next places."""
        part = slice(self.filled, self.filled + len(vertices))
        self.vertices[part], self.points[part] = vertices, points
        self.coefficients[part] = coefficients
        self.filled = part.stop

    @property
    def fits(self) -> Fits:
        """What is there."""
        n = self.filled
        return Fits(self.vertices[:n], self.degree, self.points[:n], self.coefficients[:n])


class VertexFits:
    """Fits of the highest degree that passes at each vertex.

    A fit passes if its Lebesgue constant is bounded and the heights are followed. Those of the first degree come from
    `refine_frames`, which makes them anyway; `complete` makes the others, also of fewer points.

    Parameters
    ----------
    balls : neighbourhoods, and the frames that the fits are over.
    degrees : m, best first.

    Attributes
    ----------
    frames : (N, n, d).
    degree : (N,), m of each fit; 0 where none passed, which leaves the vertex flat.
    heights : (N, M − 1, n), ℓ: of the surface over the tangent plane, as vectors; zero beyond a fit's own monomials.
    radius : (N,), ℓ.
    size : (N,), number of points of each fit, the vertex among them.
    reason : (N,), why the first degree was not reached, a place in `REASONS`.
    """

    def __init__(self, balls: GraphBalls, degrees: tuple[int, ...]) -> None:
        points, self.frames, self.degrees = balls.points, balls.frames, degrees
        count, terms = len(points), num_monomials(2, degrees[0]) - 1
        self.degree = torch.zeros(count, dtype=torch.int64)
        self.heights = points.new_zeros(count, terms, points.shape[1])
        self.radius = points.new_ones(count)
        self.size = torch.zeros_like(self.degree)
        self.reason = torch.ones_like(self.degree)
        self._piles: dict[tuple[int, int], list[_Pile]] = {}

    def hand_over(self) -> list[Fits]:
        """The fits, those of one degree and size together; being large, they are not kept."""
        found = [pile.fits for piles in self._piles.values() for pile in piles]
        if not found and self.degree.any():
            raise RuntimeError("the fits were handed over before")
        self._piles.clear()
        return found

    def take(
        self,
        vertices: Int[Tensor, " B"],
        index: Int[Tensor, "B K"],
        fit: CenteredFit,
        heights: Float[Tensor, "B neighbors n"],
        regular: Bool[Tensor, " B"],
    ) -> None:
        """Keep those of the regular fits that follow the heights, for vertices that have none yet."""
        degree, terms = fit.degree, fit.coefficients.shape[1]
        if degree not in self.degrees:
            return
        good = regular & (fit.misfit(heights) <= MAX_MISFIT.get(degree, FAITHFUL))
        vacant = self.degree[vertices] == 0
        if degree == self.degrees[0]:
            reason = torch.where(good, 0, torch.where(regular, 3, 2))
            self.reason[vertices] = torch.where(vacant, reason, self.reason[vertices])
        good &= vacant
        if not good.any():
            return
        kept, coefficients, kind = vertices[good], fit.coefficients[good], (degree, index.shape[1])
        piles = self._piles.setdefault(kind, [])
        if not piles or piles[-1].filled + len(kept) > len(piles[-1].vertices):
            room = max(len(kept), min(ROOM, int((self.degree == 0).sum())))
            piles.append(_Pile(degree, room, index.shape[1], terms, coefficients))
        piles[-1].add(kept, index[good], coefficients)
        self.degree[kept], self.size[kept] = kind
        self.heights[kept, :terms] = coefficients @ heights[good]
        self.radius[kept] = fit.radius[good]

    def complete(self, balls: GraphBalls) -> VertexFits:
        """The same; the vertices without a fit have tried the degrees in turn."""
        for degree in self.degrees:
            sizes = list_candidates(2, [degree])
            left = self.degree == 0
            if degree == self.degrees[0]:
                left &= self.reason == 1
            for vertices in left.nonzero()[:, 0].split(AT_ONCE):
                search = Search(balls, vertices, sizes)
                for _, rows, index in search:
                    self._try(balls, vertices[rows], index, degree)
                    search.settle(rows[self.degree[vertices[rows]] > 0])
                least, few = 1 + ceil(LEAST * (num_monomials(2, degree) - 1)), sizes[0].size
                vertices = vertices[self.degree[vertices] == 0]
                index, count = balls(vertices, few)
                some = (count >= least) & (count < few)
                keep = torch.arange(1, few) < count[some, None]
                self._try(balls, vertices[some], index[some], degree, keep)
        return self

    def _try(
        self,
        balls: GraphBalls,
        vertices: Int[Tensor, " B"],
        index: Int[Tensor, "B K"],
        degree: int,
        keep: Bool[Tensor, "B neighbors"] | None = None,
    ) -> None:
        if len(vertices) == 0:
            return
        here, frame = balls.points[vertices, None], balls.frames[vertices]
        offset = balls.points[index[:, 1:]] - here
        coords = offset @ frame
        heights = offset - coords @ frame.mT
        if keep is not None:
            heights = heights * keep[..., None]
        fit = centered_fit(coords, degree, keep)
        middles = (balls.points[balls.longest[vertices]] - here) @ frame / 2
        self.take(vertices, index, fit, heights, is_regular(fit, middles))


def is_regular(fit: CenteredFit, middles: Float[Tensor, "B E d"]) -> Bool[Tensor, " B"]:
    """Whether the neighbours determine a fit, and well in the middles of the edges, ℓ: `MAX_LEBESGUE`."""
    return (fit.residual <= MAX_RESIDUAL) & (fit.lebesgue(middles) <= MAX_LEBESGUE)


def fit_size(dim: int, degree: int) -> int:
    """Points of a fit, the centre among them: those of the first candidate.

    >>> [fit_size(2, m) for m in (2, 4, 6)]
    [10, 24, 45]
    """
    return list_candidates(dim, [degree])[0].size
