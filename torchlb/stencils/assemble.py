"""From a shape to the rows of a sparse operator: every point takes the first candidate that passes.

The candidates of a point at order p (`method.md`, section 4): least-squares (or polyharmonic) stencils of degree p + 1
with K = 1.6, 2, …, 10 times as many points as polynomials; then the same at every odd order below; then positive
weights of order 1; then the low-order row. On a mesh the low-order row is better than order 1, which is tried there
only on request. The candidate of each point, and the reason for no better one, are part of the result.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from tqdm import tqdm

from torchlb.errors import StencilError, first_few
from torchlb.fits.polynomials import num_monomials
from torchlb.fits.rules import WEIGHT_RULES
from torchlb.fits.weights import Weights, least_squares_weights, positive_weights
from torchlb.geometry.candidates import Candidate, Search, list_candidates, stencil_candidates
from torchlb.geometry.frames import local_heights, local_offsets
from torchlb.geometry.thresholds import FACTOR
from torchlb.linalg.precision import AT_ONCE, NEGLIGIBLE, rows_at_once
from torchlb.stencils.acceptance import Acceptance
from torchlb.stencils.low_order import MeshLowOrder
from torchlb.stencils.rows import (
    Reason,
    Rows,
    RowsPlan,
    matrix_rows,
    stencil_rows,
    tangent_weights,
)
from torchlb.stencils.shape import Shape

RULES = list(WEIGHT_RULES)
GRADIENT_GROWTH = 30.0
"""Largest ρ Σ|w| of a first derivative beside a boundary; well-placed points have 5 to 15."""
Gradients = tuple[Int[Tensor, " b"], Int[Tensor, "b K"], Float[Tensor, "b K d"], int]
"""Gradients of some rows: (positions of the rows, points, weights in the frames, degree of the fit)."""


class Stencils:
    """Rows of a shape, each by the first of its candidates that passes.

    The first candidates have the order p ≥ 1, and all of them `num_neighbors` points, if that is given, instead of
    `SIZE_FACTORS`. The projection is one of `PROJECTIONS`, the rule for the weights one of `WEIGHT_RULES`.
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
        dim, on_mesh = shape.frames.shape[-1], shape.on_mesh
        self.shape, self.order, self.projection = shape, order, projection
        self.num_neighbors, self.placed = num_neighbors, (shape.points, shape.frames)
        triangles = isinstance(shape.low_order, MeshLowOrder)
        self.candidates = stencil_candidates(
            dim, order, weights, num_neighbors, on_mesh=on_mesh, triangles=triangles
        )
        self.acceptance = Acceptance(dim, on_mesh, projection)
        share, boundary = shape.condition.share, shape.boundary
        self.share = None if share is None or boundary is None else share * boundary.folds

    def rows(self, centers: Int[Tensor, " B"], start: Int[Tensor, " B"] | None = None) -> Rows:
        """Rows of `centers`, each by the first candidate (from `start` on) that passes, else the low-order row."""
        blocks, taken = [], []
        reason = torch.full_like(centers, Reason.FEW)  # until something is tried
        assert self.shape.neighborhoods is not None
        search = Search(self.shape.neighborhoods, centers, self.candidates, start)
        for number, tried, index in search:
            candidate = self.candidates[number]
            holds = self._holds_boundary(index)
            if candidate.degree > 2 and candidate.factor > FACTOR:  # too wide beside a boundary
                tried, index, holds = tried[~holds], index[~holds], holds[~holds]
                if len(tried) == 0:
                    continue
            with_data = holds & (self.share is not None)
            weights = self._weights(index, candidate, with_data)
            failure, rejected = self.acceptance.judge(weights, candidate, holds)
            if candidate.degree == self.order + 1 and candidate.rule != "positive":
                reason[tried] = failure
            passed = failure == 0
            search.reject_degree(tried[rejected], number)
            search.settle(tried[passed])
            splines = candidate.rule == "polyharmonic"
            rule = torch.full_like(tried, RULES.index(candidate.rule))
            rule[with_data & splines] = RULES.index("least_squares")
            parts = index[passed], weights[passed], number, candidate.degree - 1, rule[passed]
            blocks.append(stencil_rows(*self.placed, *parts))
            taken.append(tried[passed])
        left = torch.ones(len(centers), dtype=torch.bool)
        left[torch.cat([*taken, torch.empty(0, dtype=torch.int64)])] = False
        if left.any():
            low, why = centers[left], reason[left]
            fitted = ((why == Reason.RATIO) | (why == Reason.GROWTH)).nonzero()[:, 0]
            blocks.append(self._low_order_rows(low, self._gradients(low, fitted)))
            taken.append(left.nonzero()[:, 0])
            self._check(low, blocks[-1])
        rows = self._finished(centers, blocks, taken)
        return replace(rows, reason=torch.where(rows.order < self.order, reason, rows.reason))

    def _finished(
        self, centers: Int[Tensor, " B"], blocks: list[Rows], taken: list[Int[Tensor, " _"]]
    ) -> Rows:
        """Rows of `centers`, from blocks at the positions `taken`, with the effect of the boundary condition."""
        rows, shape = Rows.stack(blocks)[torch.cat(taken).argsort()], self.shape
        if shape.boundary is None:
            return rows
        return shape.condition.finish(shape.points, shape.areas, shape.boundary, centers, rows)

    def _holds_boundary(self, index: Int[Tensor, "B K"]) -> Bool[Tensor, " B"]:
        if self.shape.boundary is None:
            return torch.zeros(len(index), dtype=torch.bool)
        return self.shape.boundary.mask[index].any(1)

    def plan(self, rows: Rows) -> RowsPlan:
        """Plan of all rows."""
        row = torch.arange(len(rows.length)).repeat_interleave(rows.length)
        own = (rows.candidate == len(self.candidates)) & (rows.slope > 0)
        slope = (rows.gradient != 0).any(1)
        # Dirichlet's condition removes weights of Δ; beside Neumann data ∇ is fitted to all points.
        weights = slope if self.share is None else rows.laplacian != 0
        positive = rows.rule == RULES.index("positive")
        used = (~positive[row] | weights) & (~own[row] | slope)
        kinds = rows.candidate, rows.rule, rows.slope, rows.reason
        return RowsPlan(rows.length, rows.col.int(), *kinds, used)

    def evaluated(self, plan: RowsPlan) -> Rows:
        """Evaluate the planned rows of all points."""
        every, blocks, taken = torch.arange(len(plan.length)), [], []
        start = plan.length.cumsum(0) - plan.length
        for number, candidate in enumerate(self.candidates):
            rows = every[plan.candidate == number]
            entry = candidate.size * num_monomials(self.shape.frames.shape[2], candidate.degree)
            for centers in rows.split(rows_at_once(entry)) if len(rows) else ():
                places = start[centers, None] + torch.arange(int(plan.length[centers[0]]))
                places = places.gather(1, _own_first(plan.col[places], centers))
                index, used = plan.col[places].long(), plan.used[places][:, 1:]
                with_data = self._holds_boundary(index) & (self.share is not None)
                keep, slope = None if used.all() else used, plan.slope[centers]
                weights = self._weights(index, candidate, with_data, keep, slope)
                parts = index, weights, number, candidate.degree - 1, plan.rule[centers]
                blocks.append(stencil_rows(*self.placed, *parts))
                taken.append(centers)
        low = every[plan.candidate == len(self.candidates)]
        if len(low):
            blocks.append(self._low_order_rows(low, self._planned_gradients(low, plan)))
            taken.append(low)
        rows = self._finished(every, blocks, taken)
        rows = rows.on_pattern(plan) if len(low) else rows
        return replace(rows, reason=plan.reason)

    def _weights(
        self,
        index: Int[Tensor, "B K"],
        candidate: Candidate,
        with_data: Bool[Tensor, " B"],
        keep: Bool[Tensor, "B neighbors"] | None = None,
        slope: Int[Tensor, " B"] | None = None,
    ) -> Weights:
        """Weights of a batch, with boundary data where `with_data` is set.

        For planned rows, positive weights are restricted to the neighbours `keep`, gradients beside data have the
        degree `slope`, and height residuals are not computed.
        """
        parts, order = [], []
        for data, rows in ((False, ~with_data), (True, with_data)):
            if rows.any():
                options = [None if x is None else x[rows] for x in (keep, slope)]
                fit = self._weights_with_data if data else self._free_weights
                parts.append(fit(index[rows], candidate, *options))
                order.append(rows.nonzero()[:, 0])
        return Weights.stack(parts)[torch.cat(order).argsort()] if len(parts) > 1 else parts[0]

    def _free_weights(
        self,
        index: Int[Tensor, "B K"],
        candidate: Candidate,
        keep: Bool[Tensor, "B neighbors"] | None = None,
        slope: Int[Tensor, " B"] | None = None,
    ) -> Weights:
        coords = local_offsets(*self.placed, index, self.projection)
        heights = self._heights(index, coords) if slope is None else None
        if keep is not None:
            return least_squares_weights(coords, candidate.degree, keep, heights=heights)
        return WEIGHT_RULES[candidate.rule](coords, candidate.degree, heights=heights)

    def _weights_with_data(
        self,
        index: Int[Tensor, "B K"],
        candidate: Candidate,
        keep: Bool[Tensor, "B neighbors"] | None = None,
        slope: Int[Tensor, " B"] | None = None,
    ) -> Weights:
        """Δ by a fit with the boundary data; first derivatives by one without, valid for every f.

        Coordinates are by tangential projection, in which the conormal derivative is a component in the plane. Splines
        have no such form and are replaced by least squares. A few rows of points along the boundary may not suffice
        without the data: first derivatives are of the highest degree that the points determine.
        """
        boundary, share, degree = self.shape.boundary, self.share, candidate.degree
        assert boundary is not None
        assert share is not None
        coords = local_offsets(*self.placed, index, "tangent")
        flux = boundary.conormals[index] @ self.shape.frames[index[:, 0]]
        if candidate.rule == "positive" and keep is None:
            weights = positive_weights(coords, degree, flux=flux, share=share[index])
        else:
            weights = least_squares_weights(coords, degree, keep, flux, share[index])
        heights = self._heights(index, coords) if slope is None else None
        free = part = least_squares_weights(coords, degree, heights=heights)
        gradient, left = free.gradient.clone(), torch.arange(len(index))
        settled = torch.zeros_like(left) if slope is None else slope
        for lower in range(degree - 1, 0, -1):
            if slope is None and len(left):
                left = left[~_good_slope(part)]
                settled[left] = lower
            elif slope is not None:
                left = (slope == lower).nonzero()[:, 0]
            if len(left):
                part = least_squares_weights(coords[left], lower)
                gradient[left] = part.gradient
        found = {"gradient": gradient, "slope": settled}
        return replace(weights, height_residual=free.height_residual, **found)

    def _heights(self, index: Tensor, coords: Tensor) -> Float[Tensor, "B K n"]:
        """Heights that a fit has to follow; on a mesh, over the points of the plane with the given coordinates.

        This also tests coordinates along normals, which need normals that folds do not have. A cloud has no better rows
        to fall back to, so there the heights are those of the tangential projection.
        """
        if not self.shape.on_mesh and self.projection != "tangent":
            coords = local_offsets(*self.placed, index, "tangent")
        return local_heights(*self.placed, index, coords)

    def _low_order_rows(self, centers: Int[Tensor, " B"], gradients: Iterable[Gradients]) -> Rows:
        """Low-order rows, some of them with the gradients of fits."""
        assert self.shape.low_order is not None
        matrix = self.shape.low_order.rows(centers)
        rows = matrix_rows(matrix, *self.placed, centers)
        if self.shape.points.requires_grad:
            row = centers.repeat_interleave(rows.length)
            rows = replace(rows, laplacian=self.shape.low_order.entries(row, rows.col))
        rows = replace(rows, candidate=torch.full_like(centers, len(self.candidates)))
        found = list(gradients)
        if not found:
            return rows
        for local, _, _, degree in found:
            rows.slope[local] = degree
        local = [local.repeat_interleave(index.shape[1]) for local, index, *_ in found]
        index = torch.cat([index.flatten() for _, index, *_ in found])
        gradient = torch.cat([gradient.flatten(0, 1) for *_, gradient, _ in found])
        return rows.with_gradient(torch.cat(local), index, gradient)

    def _check(self, centers: Int[Tensor, " B"], rows: Rows) -> None:
        """Raise StencilError for low-order rows without a centre."""
        bad = centers[~rows.off_diagonal_ratio.isfinite()]
        if len(bad):
            raise StencilError(
                f"{len(bad)} points have neither a stencil after {len(self.candidates)} tries nor a low-order row: "
                f"{first_few(bad)}. Nothing compatible lies around them; remove them, or merge them with their "
                "neighbours"
            )

    def _gradients(
        self, centers: Int[Tensor, " B"], fitted: Int[Tensor, " b"]
    ) -> Iterator[Gradients]:
        """Yield first derivatives of the highest acceptable degree where only Δ has no stencil, as at a boundary.

        At degree 1 the low-order row is as good.
        """
        dim, degrees = self.shape.frames.shape[-1], range(self.order + 1, 1, -1)
        candidates = list_candidates(dim, degrees, num_neighbors=self.num_neighbors)
        candidates = [c for c in candidates if c.factor <= FACTOR]
        assert self.shape.neighborhoods is not None
        search = Search(self.shape.neighborhoods, centers[fitted], candidates)
        for number, tried, index in search:
            weights, candidate = self._free_weights(index, candidates[number]), candidates[number]
            bound, _ = self.acceptance.resolved(candidate)
            passed = _good_slope(weights) & (weights.height_residual <= bound)
            search.settle(tried[passed])
            if passed.any():
                index = index[passed]
                gradient = tangent_weights(*self.placed, index, weights.gradient[passed])
                yield fitted[tried[passed]], index, gradient, candidate.degree

    def _planned_gradients(self, centers: Int[Tensor, " B"], plan: RowsPlan) -> Iterator[Gradients]:
        """Yield the planned gradients of low-order rows."""
        length = plan.length[centers]
        start = (plan.length.cumsum(0) - plan.length)[centers]
        row = torch.arange(len(centers)).repeat_interleave(length)
        entry = start[row] + torch.arange(len(row)) - (length.cumsum(0) - length)[row]
        entry, row = entry[plan.used[entry]], row[plan.used[entry]]
        size, slope = torch.bincount(row, minlength=len(centers)), plan.slope[centers]
        for degree, count in torch.stack([slope, size], 1)[slope > 0].unique(dim=0).tolist():
            local = ((slope == degree) & (size == count)).nonzero()[:, 0]
            index = plan.col[entry[torch.isin(row, local)]].long().view(-1, count)
            index = index.gather(1, _own_first(index, centers[local]))
            weights = self._free_weights(index, Candidate(degree, count, RULES[0]))
            yield local, index, tangent_weights(*self.placed, index, weights.gradient), degree


def _good_slope(weights: Weights) -> Bool[Tensor, " B"]:
    """Whether the points determine first derivatives, with bounded growth."""
    growth = weights.radius * weights.gradient.abs().sum(1).amax(1)
    return (weights.residual <= NEGLIGIBLE) & (growth <= GRADIENT_GROWTH)


def assemble(stencils: Stencils, *, progress: bool = True) -> Rows:
    """Rows of all points, in chunks.

    Memory beyond the result is about 0.1 GB for any N (`precision.BYTES`); the result takes 16 + 8 d bytes an entry.
    """
    shape = stencils.shape
    parts = torch.arange(len(shape.points)).split(AT_ONCE)
    bar = tqdm(parts, "stencils", delay=2, disable=not progress, leave=False)
    return Rows.stack(stencils.rows(centers) for centers in bar)


def _own_first(index: Int[Tensor, "B K"], centers: Int[Tensor, " B"]) -> Int[Tensor, "B K"]:
    """Columns of each row, reordered to begin with its own point."""
    return (index == centers[:, None]).byte().argsort(dim=1, descending=True, stable=True)
