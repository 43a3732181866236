"""One polynomial a vertex, of functions and of the surface, over its initial frame (`method.md`, section 9)."""

from __future__ import annotations

from math import ceil

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.fits.polynomials import num_monomials
from torchlb.fits.rules import SIZE_FACTORS
from torchlb.fits.weights import CenteredFit, centered_fit
from torchlb.geometry.neighbors import AT_ONCE, GraphBalls

MAX_CONDITION = 1e5
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


class VertexFits:
    """Fits of the highest degree that passes at each vertex.

    A fit passes if its condition is bounded and its heights are followed. Those of the first degree come from
    `refine_frames`, which makes them anyway; `complete` makes the others, also of fewer points.

    Parameters
    ----------
    balls : neighbourhoods, and the frames that the fits are over.
    degrees : m, best first.

    Attributes
    ----------
    frames : (N, n, d).
    degree : (N,), m of each fit; 0 where none passed, which leaves the vertex flat.
    index : (N, K), its points, the vertex first; padded by the vertex.
    coefficients : (N, M − 1, K − 1), as in `CenteredFit`, zero beyond a fit's own points and monomials.
    heights : (N, M − 1, n), ℓ: of the surface over the tangent plane, as vectors.
    radius : (N,), ℓ.
    reason : (N,), why the first degree was not reached, a place in `REASONS`.
    """

    def __init__(self, balls: GraphBalls, degrees: tuple[int, ...]) -> None:
        points, self.frames, self.degrees = balls.points, balls.frames, degrees
        count, size = len(points), fit_size(2, degrees[0])
        terms = num_monomials(2, degrees[0]) - 1
        self.degree = torch.zeros(count, dtype=torch.int64)
        self.index = torch.arange(count)[:, None].repeat(1, size)
        self.coefficients = points.new_zeros(count, terms, size - 1)
        self.heights = points.new_zeros(count, terms, points.shape[1])
        self.radius = points.new_ones(count)
        self.reason = torch.ones(count, dtype=torch.int64)

    def take(
        self,
        centers: Int[Tensor, " B"],
        index: Int[Tensor, "B K"],
        fit: CenteredFit,
        heights: Float[Tensor, "B neighbors n"],
        degree: int | None = None,
    ) -> None:
        """Keep those of the fits that pass, of the first degree by default."""
        degree = degree or self.degrees[0]
        regular = fit.condition <= MAX_CONDITION
        good = regular & (fit.misfit(heights) <= MAX_MISFIT.get(degree, FAITHFUL))
        if degree == self.degrees[0]:
            self.reason[centers] = torch.where(good, 0, torch.where(regular, 3, 2))
        kept, terms, size = centers[good], fit.coefficients.shape[1], index.shape[1]
        self.degree[kept] = degree
        self.index[kept, :size] = index[good]
        self.coefficients[kept, :terms, : size - 1] = fit.coefficients[good]
        self.heights[kept, :terms] = (fit.coefficients @ heights)[good]
        self.radius[kept] = fit.radius[good]

    def complete(self, balls: GraphBalls) -> VertexFits:
        """The same; the vertices without a fit have tried the degrees in turn."""
        for degree in self.degrees:
            size, terms = fit_size(2, degree), num_monomials(2, degree) - 1
            for centers in (self.degree == 0).nonzero()[:, 0].split(AT_ONCE):
                index, count = balls(centers, size)
                enough = count - 1 >= LEAST * terms
                centers, index, count = centers[enough], index[enough], count[enough]
                if len(centers) == 0:
                    continue
                keep = torch.arange(1, size) < count[:, None]
                offset = balls.points[index[:, 1:]] - balls.points[centers, None]
                frame = balls.frames[centers]
                coords = offset @ frame
                heights = (offset - coords @ frame.mT) * keep[..., None]
                self.take(centers, index, centered_fit(coords, degree, keep), heights, degree)
        return self


def fit_size(dim: int, degree: int) -> int:
    """Points of a fit, the centre among them: those of the first candidate.

    >>> [fit_size(2, m) for m in (2, 4, 6)]
    [10, 24, 45]
    """
    return ceil(SIZE_FACTORS["least_squares"][0] * num_monomials(dim, degree) - 1e-9)
