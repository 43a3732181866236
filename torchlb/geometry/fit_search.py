"""Choice of the degree and the neighbours of every local fit (`method.md`, sections 4 and 9)."""

from __future__ import annotations

from collections.abc import Iterator
from math import ceil

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchlb.fits.polynomials import num_monomials
from torchlb.fits.rules import resolution
from torchlb.fits.weights import CenteredFit
from torchlb.geometry.candidates import Search, list_candidates
from torchlb.geometry.local_fits import FitPlan, LocalFits, Neighborhoods, slope_of
from torchlb.geometry.neighbors import GraphNeighborhoods
from torchlb.geometry.thresholds import CREASE, ROUGH, SLIGHT, WIDER
from torchlb.geometry.vectors import at
from torchlb.linalg.precision import AT_ONCE, NEGLIGIBLE

MAX_LEBESGUE = 10.0
"""Largest Lebesgue constant of a fit at the midpoints of the edges of its vertex; that of good fits is below 2."""
MAX_IN_SOLIDS = 4.0
"""The same of tetrahedra: the two layers of points of a curved wall, one cell thick, nearly satisfy a quadratic."""
REASONS = (
    "reached",
    "too few compatible neighbours",
    "neighbours too close to a line or conic",
    "points do not resolve the surface",
)
IN_ROWS = REASONS.index("neighbours too close to a line or conic")


class FitSearch:
    """Search for the first of the degrees q, q − 1, … whose fit of heights is regular, and likewise for functions.

    `frame_degree` is q, and 0 keeps the initial planes; `degrees` are those of the fits of functions, best first:
    without any there are neither such fits nor graphs. A user may have fixed the number of points of the fits of
    heights. `on_mesh` says whether triangles are given.
    """

    def __init__(
        self,
        neighborhoods: GraphNeighborhoods,
        frame_degree: int = 0,
        degrees: tuple[int, ...] = (),
        num_neighbors: int | None = None,
        *,
        on_mesh: bool = False,
    ) -> None:
        self.on_mesh = on_mesh and frame_degree > 1  # points do not follow planes
        count, self.neighborhoods, self.degrees = len(neighborhoods.points), neighborhoods, degrees
        self.candidates = list_candidates(
            neighborhoods.dim, range(frame_degree, 0, -1), num_neighbors=num_neighbors
        )
        self.highest = max(frame_degree, *degrees, 0) if degrees else 0
        self.jet, self.reach = (1, 0.5) if max(degrees, default=0) <= 3 else (degrees[0], 1.0)
        self.fits = LocalFits(neighborhoods.points, neighborhoods.frames, self.highest)
        self.order, self.degree, self.surface_degree, self.size, self.tried = torch.zeros(
            5, count, dtype=torch.int64
        )
        self.reason = torch.ones_like(self.order)
        self._surface: dict[tuple[int, int], list[tuple[Tensor, ...]]] = {}
        self._functions: dict[tuple[int, int], list[tuple[Tensor, ...]]] = {}

    def refine(self, centers: Int[Tensor, " B"]) -> None:
        """Find the tangent planes at `centers`, and try the same neighbourhoods for fits of functions.

        Each centre takes the first candidate whose fit is regular and tilted by less than 60°. On a mesh it keeps its
        initial plane where the points do not follow the fit as those of a stencil have to follow theirs.
        """
        middles, dim = self.neighborhoods.middles(centers), self.neighborhoods.dim
        search = Search(self.neighborhoods, centers, self.candidates)
        steepest = 1 / CREASE**2 - 1  # |∇H|² of a tilt of 60°, bounded by the Frobenius norm
        for number, rows, index in search:
            block = _block(self.candidates[number].degree, centers[rows], index)
            fit, heights, graph = self.fits.fitted(block)
            regular = is_regular(fit, middles[rows], block.degree)
            flat_enough = slope_of(fit, graph, dim).square().sum((1, 2)) <= steepest
            apart, passed = fit.apart(heights, graph), regular & flat_enough  # false for NaN
            if self.on_mesh:
                bound = resolution(dim, block.degree, on_mesh=True, normals=True)
                unresolved = regular & (fit.scatter(heights, apart, dim) > bound)
                search.settle(rows[unresolved])
                passed &= ~unresolved
            self.order[centers[rows[passed]]] = block.degree
            self._keep_surface(block._replace(frame=passed), fit, apart, graph, regular)
            if number == 0 and self.degrees:
                self._offer(block, fit, apart, graph)
            search.settle(rows[passed])

    def finish(self) -> tuple[FitPlan, LocalFits]:
        """The plan, and the fits that were made for it.

        Vertices still without a fit of functions try each degree with more and more neighbours, then with all if they
        are few.
        """
        dim = self.neighborhoods.dim
        for degree in self.degrees:
            sizes = list_candidates(dim, [degree])
            for vertices in (self.degree == 0).nonzero()[:, 0].split(AT_ONCE):
                start = self.tried[vertices] if degree == self.degrees[0] else None
                search = Search(self.neighborhoods, vertices, sizes, start)
                for _, rows, index in search:
                    search.settle(rows[self._try(_block(degree, vertices[rows], index))])
                vertices = vertices[self.degree[vertices] == 0]
                least, few = 1 + ceil(WIDER * (num_monomials(dim, degree) - 1)), sizes[0].size
                index, count = self.neighborhoods(vertices, few)
                some = (count >= least) & (count < few)
                keep = torch.arange(1, few) < count[some, None]
                self._try(_block(degree, vertices[some], index[some], keep))
        surface, functions = [], []
        for degree, block in _joined(self._surface):
            block[-1] &= self.surface_degree[block[0]] == degree  # of each, its best graph alone
            kept = block[-1] | block[-2]
            surface.append(Neighborhoods(degree, *(column[kept] for column in block)))
        for degree, (*block, coefficients) in _joined(self._functions):
            functions.append(Neighborhoods(degree, *block))
            self.fits.coefficients.append(coefficients)
        counts = self.order, self.surface_degree, self.degree, self.reason, self.size
        settings = self.highest, self.jet, self.reach
        return FitPlan(surface, functions, *counts, *settings), self.fits

    def _offer(self, block: Neighborhoods, fit: CenteredFit, apart: Tensor, graph: Tensor) -> None:
        """Try the nearest of these points for functions, by the same fit if it is the first candidate."""
        first = list_candidates(self.neighborhoods.dim, self.degrees)[0]
        size = block.points.shape[1]
        if size < first.size:
            return
        self.tried[block.vertices] = 1
        if (block.degree, size) == (first.degree, first.size):
            self._keep(block, fit, apart, graph)
        else:
            self._try(_block(first.degree, block.vertices, block.points[:, : first.size]))

    def _try(self, block: Neighborhoods) -> Bool[Tensor, " b"]:
        """Make fits of functions and keep those that pass; return which do."""
        fit, heights, graph = self.fits.fitted(block)
        return self._keep(block, fit, fit.apart(heights, graph), graph)

    def _keep(
        self, block: Neighborhoods, fit: CenteredFit, apart: Tensor, graph: Tensor
    ) -> Bool[Tensor, " b"]:
        """Keep the fits of functions that pass; return which do."""
        degree = min(block.degree, self.jet)
        terms = num_monomials(self.neighborhoods.dim, degree) - 1
        regular = is_regular(fit, self.neighborhoods.middles(block.vertices), degree)
        good = self._keep_surface(block, fit, apart, graph, regular)
        if good.any():
            found, size = block.vertices[good], block.points.shape[1]
            columns = *block._replace(points=block.points.int())[1:], fit.coefficients[:, :terms]
            rows = tuple(column[good] for column in columns)
            self._functions.setdefault((block.degree, size), []).append(rows)
            self.degree[found], self.size[found] = block.degree, size
            self.fits.radius[found] = fit.radius[good]
        return good

    def _keep_surface(
        self, block: Neighborhoods, fit: CenteredFit, apart: Tensor, graph: Tensor, regular: Tensor
    ) -> Bool[Tensor, " b"]:
        """Keep tangent planes, and graphs of a higher degree than before that follow the heights; return which do."""
        vertices, good, new = block.vertices, regular, block.surface
        if self.degrees:
            # quadratics are the last resort
            misfit = apart.amax(1) / fit.radius
            good = regular & (misfit <= (ROUGH if fit.degree == 2 else SLIGHT))
            vacant = self.surface_degree[vertices] < fit.degree
            if fit.degree == self.highest:
                reason = torch.where(good, 0, torch.where(regular, 3, IN_ROWS))
                self.reason[vertices] = torch.where(vacant, reason, self.reason[vertices])
            new = good & vacant
            self.surface_degree[vertices[new]] = fit.degree
        taken = block._replace(points=block.points.int(), surface=new)
        self.fits.take_surface(taken, fit, graph)
        rows = (block.frame | new).nonzero()[:, 0]
        if len(rows):
            kept = self._surface.setdefault((block.degree, block.points.shape[1]), [])
            kept.append(tuple(at(column, rows) for column in taken[1:]))
        return good


def _block(
    degree: int, vertices: Tensor, points: Tensor, keep: Tensor | None = None
) -> Neighborhoods:
    """Neighbourhoods with no flag set; without `keep` all points count."""
    keep = torch.ones_like(points[:, 1:], dtype=torch.bool) if keep is None else keep
    none = torch.zeros(2, len(vertices), dtype=torch.bool)
    return Neighborhoods(degree, vertices, points, keep, *none)


def _joined(
    blocks: dict[tuple[int, int], list[tuple[Tensor, ...]]],
) -> Iterator[tuple[int, list[Tensor]]]:
    """Yield the joined columns of the blocks of one degree and size, with the degree, and let go of these blocks."""
    while blocks:
        degree, _ = key = next(iter(blocks))
        yield degree, [torch.cat(column) for column in zip(*blocks.pop(key), strict=True)]


def is_regular(fit: CenteredFit, middles: Tensor, degree: int) -> Bool[Tensor, " B"]:
    """Whether a fit's slope is exact, and its Lebesgue constant up to `degree` small at edge midpoints (B, E, d), ℓ.

    Points on two lines, but for rounding, leave a term free that vanishes at all of them: its coefficients are large.
    """
    exact = fit.residual(middles.shape[2]) <= NEGLIGIBLE
    exact &= fit.coefficients.abs().amax((1, 2)) <= 1 / NEGLIGIBLE
    most = MAX_IN_SOLIDS if middles.shape[2] == 3 else MAX_LEBESGUE
    return exact & (fit.lebesgue(middles, degree) <= most)
