"""One polynomial a vertex, of functions and of the surface, over its initial frame (`method.md`, section 9)."""

from __future__ import annotations

from dataclasses import replace
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
IN_ROWS = 2
"""Place in `REASONS` of too few rows of neighbours."""
LEAST = 1.5
"""Neighbours per polynomial without which a fit is not tried."""


ROOM = 2**18
"""Fits in a pile, 0.7 GB at degree 4: pieces below 32 MB would stay with glibc, and scatter its memory."""


class Fits(NamedTuple):
    """Fits of one degree to as many points each.

    Attributes
    ----------
    vertices : (b,).
    degree : to which they are kept.
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

    def __init__(
        self, degree: int, size: int, room: int, like: Float[Tensor, "b M neighbors"]
    ) -> None:
        self.degree, self.filled = degree, 0
        self.vertices = torch.empty(room, dtype=torch.int64)
        self.points = torch.empty(room, size, dtype=torch.int64)
        self.coefficients = like.new_empty(room, *like.shape[1:])

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


class Graphs:
    """The surface near each vertex as a graph over its initial frame, by the fit of the highest degree that follows it.

    Attributes
    ----------
    degree : (N,), m of each fit; 0 where there is none.
    heights : (N, M − 1, n), ℓ: over the tangent plane, as vectors; zero beyond a fit's own monomials.
    radius : (N,), ℓ.
    reason : (N,), why the highest degree was not reached, a place in `REASONS`.
    """

    def __init__(self, balls: GraphBalls, degree: int) -> None:
        points, self.highest = balls.points, degree
        self.degree = torch.zeros(len(points), dtype=torch.int64)
        self.heights = points.new_zeros(
            len(points), num_monomials(balls.dim, degree) - 1, points.shape[1]
        )
        self.radius = points.new_ones(len(points))
        self.reason = torch.ones_like(self.degree)

    def take(
        self,
        vertices: Int[Tensor, " B"],
        fit: CenteredFit,
        heights: Float[Tensor, "B neighbors n"],
        regular: Bool[Tensor, " B"],
    ) -> Bool[Tensor, " B"]:
        """Keep the regular fits that follow the heights where there was none of their degree; and which do follow."""
        good = regular & (fit.misfit(heights) <= MAX_MISFIT.get(fit.degree, FAITHFUL))
        vacant = self.degree[vertices] < fit.degree
        if fit.degree == self.highest:
            reason = torch.where(good, 0, torch.where(regular, 3, IN_ROWS))
            self.reason[vertices] = torch.where(vacant, reason, self.reason[vertices])
        new = good & vacant
        kept, terms = vertices[new], fit.coefficients.shape[1]
        self.heights[kept, :terms] = fit.coefficients[new] @ heights[new]
        self.radius[kept], self.degree[kept] = fit.radius[new], fit.degree
        return good


class VertexFits:
    """Fits of functions at the vertices: the first of the degrees whose Lebesgue constant is bounded there.

    Of fits of degree 2 and 3 only the gradient is kept, for the cubic Hermite interpolant in the middles of edges:
    (u_a + u_b)/2 + (∂u_a − ∂u_b)/8, ∂ along the edge, which is the mean of u_a + ∇u_a·y half of the way there.

    Parameters
    ----------
    balls : neighbourhoods, and the frames that the fits are over.
    degrees : m, best first.
    surface_degree : the highest degree of the `surface`, which those of functions are the last resort for.

    Attributes
    ----------
    degrees : m, best first.
    surface : the graphs that the nodes stand on.
    frames : (N, n, d).
    degree : (N,), m of each fit; 0 where none passed, which leaves the vertex flat.
    reach : of the way to a node, where fits are asked.
    radius : (N,), ℓ.
    size : (N,), number of points of each fit, the vertex among them.
    """

    def __init__(
        self, balls: GraphBalls, degrees: tuple[int, ...], surface_degree: int = 0
    ) -> None:
        self._balls, self.degrees = balls, degrees
        self.surface = Graphs(balls, max(surface_degree, degrees[0]))
        self.frames = balls.frames
        self._jet, self.reach = (1, 0.5) if degrees[0] <= 3 else (degrees[0], 1.0)
        self.degree = torch.zeros(len(balls.points), dtype=torch.int64)
        self.radius = balls.points.new_ones(len(balls.points))
        self.size = torch.zeros_like(self.degree)
        self._tried = torch.zeros_like(self.degree)
        self._piles: dict[tuple[int, int], list[_Pile]] = {}

    def hand_over(self) -> list[Fits]:
        """The fits, those of one degree and size together; being large, they are not kept."""
        found = [pile.fits for piles in self._piles.values() for pile in piles]
        if not found and self.degree.any():
            raise RuntimeError("the fits were handed over before")
        self._piles.clear()
        return found

    def offer(
        self,
        vertices: Int[Tensor, " B"],
        index: Int[Tensor, "B K"],
        fit: CenteredFit,
        heights: Float[Tensor, "B neighbors n"],
    ) -> None:
        """Neighbourhoods that are there anyway: the nearest are tried first, by the same fit if it is that."""
        first = list_candidates(self._balls.dim, self.degrees)[0]
        if index.shape[1] < first.size:
            return
        self._tried[vertices] = 1
        if (fit.degree, index.shape[1]) == (first.degree, first.size):
            self._keep(vertices, index, fit, heights)
        else:
            self._try(vertices, index[:, : first.size], first.degree)

    def complete(self) -> VertexFits:
        """The same; vertices without a fit have tried the degrees, with more neighbours in turn, or with all of few."""
        for degree in self.degrees:
            sizes = list_candidates(self._balls.dim, [degree])
            for vertices in (self.degree == 0).nonzero()[:, 0].split(AT_ONCE):
                start = self._tried[vertices] if degree == self.degrees[0] else None
                search = Search(self._balls, vertices, sizes, start)
                for _, rows, index in search:
                    search.settle(rows[self._try(vertices[rows], index, degree)])
                vertices = vertices[self.degree[vertices] == 0]
                terms = num_monomials(self._balls.dim, degree) - 1
                least, few = 1 + ceil(LEAST * terms), sizes[0].size
                index, count = self._balls(vertices, few)
                some = (count >= least) & (count < few)
                keep = torch.arange(1, few) < count[some, None]
                self._try(vertices[some], index[some], degree, keep)
        del self._balls
        return self

    def _try(
        self,
        vertices: Int[Tensor, " B"],
        index: Int[Tensor, "B K"],
        degree: int,
        keep: Bool[Tensor, "B neighbors"] | None = None,
    ) -> Bool[Tensor, " B"]:
        """Make the fits of the degree, and keep those that pass; which do."""
        if len(vertices) == 0:
            return torch.zeros(0, dtype=torch.bool)
        balls = self._balls
        here, frame = balls.points[vertices, None], balls.frames[vertices]
        offset = balls.points[index[:, 1:]] - here
        coords = offset @ frame
        heights = offset - coords @ frame.mT
        if keep is not None:
            heights = heights * keep[..., None]
        return self._keep(vertices, index, centered_fit(coords, degree, keep), heights)

    def _keep(
        self,
        vertices: Int[Tensor, " B"],
        index: Int[Tensor, "B K"],
        fit: CenteredFit,
        heights: Float[Tensor, "B neighbors n"],
    ) -> Bool[Tensor, " B"]:
        """Keep the fits that pass; which do."""
        jet = min(fit.degree, self._jet)
        terms = num_monomials(self._balls.dim, jet) - 1
        kept = replace(
            fit,
            coefficients=fit.coefficients[:, :terms],
            values=fit.values[..., :terms],
            degree=jet,
        )
        regular = is_regular(kept, self._balls.middles(vertices))
        good = self.surface.take(vertices, fit, heights, regular)
        if good.any():
            found, size = vertices[good], index.shape[1]
            pile = self._pile((kept.degree, size), kept.coefficients[good])
            pile.add(found, index[good], kept.coefficients[good])
            self.degree[found], self.size[found] = fit.degree, size
            self.radius[found] = fit.radius[good]
        return good

    def _pile(self, kind: tuple[int, int], like: Float[Tensor, "b M neighbors"]) -> _Pile:
        """With room for as many as `like`."""
        piles = self._piles.setdefault(kind, [])
        if not piles or piles[-1].filled + len(like) > len(piles[-1].vertices):
            room = max(len(like), min(ROOM, int((self.degree == 0).sum())))
            piles.append(_Pile(*kind, room, like))
        return piles[-1]


def is_regular(fit: CenteredFit, middles: Float[Tensor, "B E d"]) -> Bool[Tensor, " B"]:
    """Whether the neighbours determine a fit, and well in the middles of the edges, ℓ: `MAX_LEBESGUE`."""
    return (fit.residual <= MAX_RESIDUAL) & (fit.lebesgue(middles) <= MAX_LEBESGUE)
