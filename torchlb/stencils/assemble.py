"""From points to the rows of a sparse operator: every point takes the first stencil that passes.

The ladder of a point at order p (`method.md`, section 4): least-squares (or polyharmonic) stencils of degree p + 1
with K = 1.6, 2, …, 10 times as many points as polynomials; then the same at every odd order below; then positive
weights of order 1; then the fallback row. On a mesh that is better than order 1, which is tried there only if asked
for. How far down each point had to step is part of the result and never silent.
"""

from __future__ import annotations

from dataclasses import replace
from math import ceil

import torch
from jaxtyping import Float, Int
from torch import Tensor
from tqdm import tqdm

from torchlb.errors import StencilError
from torchlb.fits.polynomials import num_monomials
from torchlb.fits.rules import WEIGHT_RULES, typical_growth
from torchlb.fits.weights import Weights, least_squares_weights, positive_weights
from torchlb.geometry.candidates import Candidate, chunks, list_candidates, walk_ladder
from torchlb.geometry.frames import local_heights, local_offsets
from torchlb.stencils.acceptance import (
    DEGREE_OF_MISFIT,
    HOPELESS,
    MAX_DOMINANCE,
    MAX_DOMINANCE_AT_BOUNDARY,
    MAX_GROWTH,
    MAX_GROWTH_AT_BOUNDARY,
    MAX_GROWTH_OF_SPLINES,
    MAX_MISFIT,
    MAX_MISFIT_ON_MESH,
    MAX_RESIDUAL,
    MAX_SIZE_AT_BOUNDARY,
    MISFIT_OF_NORMALS,
    MISFIT_OF_WIDE,
    WIDE_ON_MESH,
    first_failure,
)
from torchlb.stencils.rows import Rows, matrix_rows, stencil_rows
from torchlb.stencils.shape import Shape

__all__ = ["Ladder", "build_stencil"]


class Ladder:
    """All that decides a row, ready to build any of them, at any rung and below.

    Parameters
    ----------
    shape : points, frames, neighbourhoods, boundary and low-order rows.
    order : p ≥ 1 of the first rungs.
    projection, weights : keys of `PROJECTIONS` and `WEIGHT_RULES`.
    num_neighbors : K of every rung, instead of `SIZE_FACTORS`.
    """

    def __init__(
        self,
        shape: Shape,
        order: int,
        *,
        projection: str = "tangent",
        weights: str = "least_squares",
        num_neighbors: int | None = None,
    ) -> None:
        self.shape, self.points, self.frames = shape, shape.points, shape.frames
        self.boundary, self.balls, self.on_mesh = shape.boundary, shape.balls, shape.on_mesh
        self.projection, self.fixed_size = projection, num_neighbors is not None
        dim = self.frames.shape[-1]
        rules = [weights] if weights == "least_squares" else [weights, "least_squares"]
        # Rows of an even order are no better on evenly spread points than those of the odd order below, and rows of
        # order 1 no better on a mesh than its triangles.
        lowest = 4 if self.on_mesh else 2
        degrees = [order + 1, *range(order // 2 * 2, lowest - 1, -2)]
        self.candidates = list_candidates(dim, degrees, rules, num_neighbors)
        if order == 1 or not self.on_mesh:
            self.candidates += list_candidates(dim, [2], ["positive"], num_neighbors)

    def rows(self, centers: Int[Tensor, " B"], start: Int[Tensor, " B"] | None = None) -> Rows:
        """Rows of `centers`, each at the first rung (from `start` on) that passes, else the fallback row."""
        blocks, taken = [], []
        reason = torch.ones(len(centers), dtype=torch.int64)  # until something is tried: too few
        place = torch.empty(len(self.points), dtype=torch.int64)
        place[centers] = torch.arange(len(centers))
        start = torch.zeros_like(centers) if start is None else start.clone()
        top = self.candidates[0].degree
        lower = [
            sum(other.degree >= rung.degree for other in self.candidates)
            for rung in self.candidates
        ]

        def attempt(rows: Tensor, index: Tensor, rung: Candidate) -> tuple[Tensor, Rows]:
            weights = self._weights(rows, index, rung)
            max_misfit, hopeless = self._misfits(rung)
            failure = first_failure(weights, *self._limits(index, rung), max_misfit)
            if rung.degree == top and rung.rule != "positive":
                reason[place[rows]] = failure
            unresolved = rows[weights.misfit > hopeless]
            start[place[unresolved]] = lower[self.candidates.index(rung)]
            return failure == 0, stencil_rows(index, weights, rung.degree, rung.rule)

        for number, rows, block in walk_ladder(
            self.balls, centers, self.candidates, attempt, start
        ):
            block.candidate[:] = number
            blocks.append(block)
            taken.append(rows)
        left = torch.ones(len(centers), dtype=torch.bool)
        left[torch.cat([*taken, torch.empty(0, dtype=torch.int64)])] = False
        if left.any():
            blocks.append(self._fallback_rows(centers[left]))
            taken.append(left.nonzero()[:, 0])
        rows = Rows.stack(blocks)[torch.cat(taken).argsort()]
        if self.boundary is not None:
            rows = self.shape.condition.finish(self.points, self.boundary, centers, rows)
        return replace(rows, reason=torch.where(rows.order < top - 1, reason, rows.reason))

    def _weights(self, centers: Tensor, index: Tensor, rung: Candidate) -> Weights:
        """Weights of a batch; stencils that hold boundary points use the Neumann data there, if they have some."""
        touching = torch.zeros(len(centers), dtype=torch.bool)
        if self.boundary is not None and self.shape.condition.share is not None:
            touching = self.boundary.mask[index].any(1)
        parts = []
        if not touching.all():
            own, around = centers[~touching], index[~touching]
            coords = local_offsets(self.points, self.frames, own, around[:, 1:], self.projection)
            heights = self._heights(own, around, coords)
            parts.append(WEIGHT_RULES[rung.rule](coords, rung.degree, heights=heights))
        if touching.any():
            parts.append(self._neumann_weights(centers[touching], index[touching], rung))
        order = torch.cat([(~touching).nonzero()[:, 0], touching.nonzero()[:, 0]]).argsort()
        return Weights.stack(parts)[order]

    def _heights(self, centers: Tensor, index: Tensor, coords: Tensor) -> Float[Tensor, "B K n"]:
        """What a polynomial must follow: heights over the points of the plane that the coordinates name, on a mesh.

        So the note's coordinates are tested too, which need normals that folds do not have. On a cloud there is nothing
        better to fall to: heights straight over the plane.
        """
        neighbors = index[:, 1:]
        if not self.on_mesh and self.projection != "tangent":
            coords = local_offsets(self.points, self.frames, centers, neighbors, "tangent")
        return local_heights(self.points, self.frames, centers, neighbors, coords)

    def _widened(self, rung: Candidate, factor: float) -> bool:
        """Whether the ladder, not the user, has come to more than `factor` points per polynomial."""
        size = ceil(factor * num_monomials(self.frames.shape[-1], rung.degree))
        return rung.size > size and not self.fixed_size

    def _misfits(self, rung: Candidate) -> tuple[float, float]:
        """Bounds on the misfit: of this rung, and of all rungs of its degree."""
        if not self.on_mesh:
            hopeless = MAX_MISFIT * HOPELESS
            return (hopeless if self.fixed_size else MAX_MISFIT), hopeless
        dim = self.frames.shape[-1]
        growth = typical_growth(dim, DEGREE_OF_MISFIT) / typical_growth(dim, rung.degree)
        straight = rung.degree == 2 or self.projection == "tangent"
        bound = MAX_MISFIT_ON_MESH * min(1.0, growth) * (1.0 if straight else MISFIT_OF_NORMALS)
        return bound * (MISFIT_OF_WIDE if self._widened(rung, WIDE_ON_MESH) else 1.0), bound

    def _limits(
        self, index: Tensor, rung: Candidate
    ) -> tuple[Float[Tensor, " B"], Float[Tensor, " B"]]:
        """Bounds on growth and dominance; none passes where points of the boundary make a wide stencil lopsided."""
        dim = self.frames.shape[-1]
        largest = MAX_GROWTH_OF_SPLINES if rung.rule == "polyharmonic" else MAX_GROWTH
        growth = torch.full((len(index),), largest, dtype=self.points.dtype)
        dominance = torch.full_like(growth, MAX_DOMINANCE)
        if self.boundary is not None:
            touching = self.boundary.mask[index].any(1)
            refused = rung.degree > 2 and self._widened(rung, MAX_SIZE_AT_BOUNDARY)
            growth[touching] = 0.0 if refused else MAX_GROWTH_AT_BOUNDARY
            dominance[touching] = MAX_DOMINANCE_AT_BOUNDARY
        return growth * typical_growth(dim, rung.degree), dominance

    def _neumann_weights(self, centers: Tensor, index: Tensor, rung: Candidate) -> Weights:
        """Second derivatives that use ∂_ν f = 0; first derivatives that do not, since they serve any f.

        By straight projection, where the derivative along a conormal is its component in the plane. Splines have no
        such form; least squares stands in for them.
        """
        assert self.boundary is not None
        coords = local_offsets(self.points, self.frames, centers, index[:, 1:], "tangent")
        flux = self.boundary.conormals[index] @ self.frames[centers]
        rule = positive_weights if rung.rule == "positive" else least_squares_weights
        weights = rule(coords, rung.degree, flux=flux)
        heights = self._heights(centers, index, coords)
        free = least_squares_weights(coords, rung.degree, heights=heights)
        usable = (free.residual <= MAX_RESIDUAL)[:, None, None]
        gradient = torch.where(usable, free.gradient, weights.gradient)
        return replace(weights, gradient=gradient, misfit=free.misfit)

    def _fallback_rows(self, centers: Int[Tensor, " B"]) -> Rows:
        assert self.shape.low_order is not None
        matrix = self.shape.low_order.rows(centers)
        rows = matrix_rows(matrix, self.points, self.frames, centers)
        rows.candidate[:] = len(self.candidates)
        bad = centers[~rows.off_diagonal_ratio.isfinite()]
        if len(bad):
            names = ", ".join(map(str, bad[:8].tolist())) + (", …" if len(bad) > 8 else "")
            raise StencilError(
                f"{len(bad)} points have neither a stencil after {len(self.candidates)} tries nor a fallback row: "
                f"{names}. Nothing admissible lies around them; remove them, or merge them with their neighbours"
            )
        return rows


def build_stencil(ladder: Ladder, *, hessian: bool = False, progress: bool = True) -> Rows:
    """Rows of all points, in chunks; the second derivatives are kept only if asked for.

    Memory beyond the result: about 1 GB whatever N (`ladder.CHUNK_BYTES`). The result takes 16 + 8 d bytes an entry.
    """
    blocks = []
    parts = chunks(len(ladder.points), ladder.candidates, ladder.frames.shape[-1])
    for centers in tqdm(parts, "stencils", delay=2, disable=not progress, leave=False):
        rows = ladder.rows(centers)
        blocks.append(rows if hessian else replace(rows, hessian=rows.hessian[:, :0]))
    return Rows.stack(blocks)
