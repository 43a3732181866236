"""From a shape to the rows of a sparse operator: every point takes the first candidate that passes.

The candidates of a point at order p (`method.md`, section 4): stencils of degree p + 1, then of every even degree
below, with K = 1.6, 2, …, 10 times as many points as polynomials; then the low-order row. On a mesh the low-order row
is better than degree 2, which is tried there only at order 1. The candidate of each point, and the reason for no better
one, are part of the result.
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
from torchlb.fits.rules import SIZE_FACTORS, WEIGHT_RULES, reference, resolution
from torchlb.fits.weights import Weights, least_squares_weights
from torchlb.geometry.candidates import Candidate, Search, list_candidates
from torchlb.geometry.frames import local_heights, local_offsets
from torchlb.geometry.thresholds import FACTOR
from torchlb.linalg.precision import AT_ONCE, NEGLIGIBLE, rows_at_once
from torchlb.stencils.options import Options
from torchlb.stencils.rows import Reason, Rows, RowsPlan, matrix_rows, stencil_rows, tangent_weights
from torchlb.stencils.shape import Shape

RULES = list(WEIGHT_RULES)
GRADIENT_GROWTH = 30.0
"""Largest ρ Σ|w| of a first derivative beside a boundary; well-placed points have 5 to 15."""
Gradients = tuple[Int[Tensor, " b"], Int[Tensor, "b K"], Float[Tensor, "b K d"], int]
"""Gradients of some rows: (positions of the rows, points, weights in the frames, degree of the fit)."""


def stencil_candidates(
    dim: int, order: int, weights: str, num_neighbors: int | None, *, on_mesh: bool
) -> list[Candidate]:
    """Candidates for a row of order p: degree p + 1, then the even degrees below; least squares after other `weights`.

    On evenly spread points rows of even order are no better than rows of the odd order below.

    >>> [c.degree for c in stencil_candidates(2, 5, "least_squares", 60, on_mesh=False)]
    [6, 4, 2]
    """
    degrees = [order + 1, *range(order // 2 * 2, 3 if on_mesh else 1, -2)]
    rules = list(dict.fromkeys([weights, "least_squares"]))
    return list_candidates(dim, degrees, rules, num_neighbors)


class Stencils:
    """Rows of a shape, each by the first of its candidates that passes.

    The first candidates have the order p ≥ 1, and all of them `num_neighbors` points, if that is given, instead of
    `SIZE_FACTORS`.
    """

    def __init__(self, shape: Shape, options: Options) -> None:
        self.shape, self.order, self.projection = shape, options.order, options.projection
        self.num_neighbors, self.placed = options.num_neighbors, (shape.points, shape.frames)
        self.dim = shape.frames.shape[-1]
        given = self.order, options.weights, self.num_neighbors
        self.candidates = stencil_candidates(self.dim, *given, on_mesh=shape.on_mesh)
        share, boundary = shape.condition.share, shape.boundary
        self.share = None if share is None or boundary is None else share * boundary.folds

    def rows(self, centers: Int[Tensor, " B"], start: Int[Tensor, " B"] | None = None) -> Rows:
        """Rows of `centers`, each by the first candidate (from `start` on) that passes, else the low-order row."""
        blocks, left = [], torch.ones(len(centers), dtype=torch.bool)
        reason = torch.full_like(centers, Reason.FEW)  # until something is tried
        assert self.shape.neighborhoods is not None
        search = Search(self.shape.neighborhoods, centers, self.candidates, start)
        for number, tried, index in search:
            candidate, touching = self.candidates[number], self._touching(index)
            weights = self._weights(index, candidate, touching)
            failure, rejected = self.judge(weights, candidate, touching)
            if candidate.degree == self.order + 1:
                reason[tried] = failure
            passed = failure == 0
            search.reject_degree(tried[rejected], number)
            search.settle(tried[passed])
            left[tried[passed]] = False
            block = self._stencil_rows(index[passed], weights[passed], number, touching[passed])
            blocks.append((tried[passed], block))
        if left.any():
            low, why = centers[left], reason[left]
            fitted = ((why == Reason.RATIO) | (why == Reason.GROWTH)).nonzero()[:, 0]
            rows = self._low_order_rows(low, self._gradients(low, fitted))
            bad = low[~rows.off_diagonal_ratio.isfinite()]
            if len(bad):
                raise StencilError(
                    f"{len(bad)} points have neither a stencil after {len(self.candidates)} tries nor a low-order row: "
                    f"{first_few(bad)}. Nothing compatible lies around them; remove them, or merge them with their "
                    "neighbours"
                )
            blocks.append((left.nonzero()[:, 0], rows))
        rows = self._finished(centers, blocks)
        return replace(rows, reason=torch.where(rows.order < self.order, reason, rows.reason))

    def plan(self, rows: Rows) -> RowsPlan:
        """Plan of all rows."""
        own = (rows.candidate == len(self.candidates)) & (rows.slope > 0)
        used = own.repeat_interleave(rows.length) & (rows.gradient != 0).any(1)
        kinds = rows.candidate, rows.slope, rows.reason
        return RowsPlan(rows.length, rows.col.int(), *kinds, used)

    def evaluated(self, plan: RowsPlan) -> Rows:
        """Evaluate the planned rows of all points."""
        every, blocks = torch.arange(len(plan.length)), []
        for number, candidate in enumerate(self.candidates):
            rows = every[plan.candidate == number]
            entry = candidate.size * num_monomials(self.dim, candidate.degree)
            for centers in rows.split(rows_at_once(entry)) if len(rows) else ():
                places = plan.crow[centers, None] + torch.arange(candidate.size)
                index = _own_first(plan.col[places].long(), centers)
                touching, slope = self._touching(index), plan.slope[centers]
                weights = self._weights(index, candidate, touching, slope)
                blocks.append((centers, self._stencil_rows(index, weights, number, touching)))
        low = every[plan.candidate == len(self.candidates)]
        if len(low):
            blocks.append((low, self._low_order_rows(low, self._planned_gradients(low, plan))))
        return replace(self._finished(every, blocks), reason=plan.reason)

    def _finished(
        self, centers: Int[Tensor, " B"], blocks: list[tuple[Int[Tensor, " _"], Rows]]
    ) -> Rows:
        """Rows of `centers`, from (positions, rows) in any order, with the effect of the boundary condition."""
        taken, parts = zip(*blocks, strict=True)
        rows, shape = Rows.stack(parts)[torch.cat(taken).argsort()], self.shape
        if shape.boundary is None:
            return rows
        return shape.condition.finish(shape, centers, rows)

    def _touching(self, index: Int[Tensor, "B K"]) -> Bool[Tensor, " B"]:
        """Whether stencils have boundary points."""
        if self.shape.boundary is None:
            return torch.zeros(len(index), dtype=torch.bool)
        return self.shape.boundary.mask[index].any(1)

    def judge(
        self, weights: Weights, candidate: Candidate, touching: Bool[Tensor, " B"]
    ) -> tuple[Int[Tensor, " B"], Bool[Tensor, " B"]]:
        """Return the first test that each stencil fails, a `Reason`, and whether to reject its whole degree."""
        inside = reference(self.dim, candidate.degree, candidate.rule)
        edge = reference(self.dim, candidate.degree, one_sided=True) if touching.any() else inside
        # at a boundary relative to the one-sided reference, or to the bound inside, since corners have more
        at_edge = FACTOR * max(edge.growth, FACTOR * inside.growth)
        max_growth = torch.where(touching, at_edge, FACTOR * inside.growth)
        max_ratio = FACTOR * torch.where(touching, edge.off_diagonal_ratio, 1.0)
        bound, loosest = self._resolved(candidate)
        center, others = weights.laplacian[:, 0], weights.laplacian[:, 1:].abs().sum(1)
        determined = weights.residual <= NEGLIGIBLE  # false for NaN
        failure = torch.zeros(len(center), dtype=torch.int64)
        for reason, passed in (
            (Reason.MOMENTS, determined),
            (Reason.UNRESOLVED, weights.height_residual <= bound),
            (Reason.RATIO, others <= -max_ratio * center),
            (Reason.GROWTH, weights.radius.square() * (others + center.abs()) <= max_growth),
        ):
            failure = torch.where((failure == 0) & ~passed, reason, failure)
        return failure, determined & (weights.height_residual > loosest)

    def _resolved(self, candidate: Candidate) -> tuple[float, float]:
        """Bounds on the height residual: for this candidate, and for every candidate of its degree.

        On a mesh the bound shrinks with the number of points beyond 3 per polynomial: a fit to folds does not improve
        over more of them. On a cloud, noise may shrink by the ratio of the widest stencil to the first; a size fixed by
        the user cannot widen.
        """
        kind = {"on_mesh": self.shape.on_mesh, "normals": self.projection == "normal"}
        bound = resolution(self.dim, candidate.degree, **kind)
        if self.shape.on_mesh:
            return bound * FACTOR / max(candidate.factor, FACTOR), bound
        factors = SIZE_FACTORS["least_squares"]
        widest = bound * (factors[-1] / factors[0]) ** (1 / self.dim)
        return (bound if candidate.factor else widest), widest

    def _weights(
        self, index: Tensor, candidate: Candidate, touching: Tensor, slope: Tensor | None = None
    ) -> Weights:
        """Weights of a batch, where it is `touching` with boundary data, if the condition has some.

        For planned rows, gradients beside data have the degree `slope`, and height residuals are not computed.
        """
        data = touching & (self.share is not None)
        if not data.any():
            return self._free_weights(index, candidate, slope is None)
        own = None if slope is None else slope[data]
        beside = self._weights_with_data(index[data], candidate, own)
        if data.all():
            return beside
        free = self._free_weights(index[~data], candidate, slope is None)
        order = torch.cat([x.nonzero()[:, 0] for x in (data, ~data)]).argsort()
        return Weights.stack([beside, free])[order]

    def _free_weights(
        self, index: Int[Tensor, "B K"], candidate: Candidate, judged: bool = True
    ) -> Weights:
        """Weights without boundary data, with residuals of heights if they are to be `judged`."""
        coords = local_offsets(*self.placed, index, self.projection)
        heights = self._heights(index, coords) if judged else None
        return WEIGHT_RULES[candidate.rule](coords, candidate.degree, heights=heights)

    def _weights_with_data(
        self, index: Int[Tensor, "B K"], candidate: Candidate, slope: Int[Tensor, " B"] | None
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
        weights = least_squares_weights(coords, degree, flux, share[index])
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

    def _stencil_rows(
        self, index: Int[Tensor, "B K"], weights: Weights, number: int, touching: Bool[Tensor, " B"]
    ) -> Rows:
        """Rows of stencils of the candidate `number`."""
        candidate = self.candidates[number]
        rule = torch.full_like(index[:, 0], RULES.index(candidate.rule))
        rule[touching & (self.share is not None)] = RULES.index("least_squares")
        return stencil_rows(*self.placed, index, weights, number, candidate.degree - 1, rule)

    def _low_order_rows(self, centers: Int[Tensor, " B"], gradients: Iterable[Gradients]) -> Rows:
        """Low-order rows, some of them with the gradients of fits."""
        rows = matrix_rows(*self.shape.low_order.rows(centers), *self.placed, centers)
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

    def _gradients(
        self, centers: Int[Tensor, " B"], fitted: Int[Tensor, " b"]
    ) -> Iterator[Gradients]:
        """Yield first derivatives of the highest acceptable degree where only Δ has no stencil, as at a boundary.

        At degree 1 the low-order row is as good.
        """
        degrees = range(self.order + 1, 1, -1)
        candidates = list_candidates(self.dim, degrees, num_neighbors=self.num_neighbors)
        candidates = [c for c in candidates if c.factor <= FACTOR]
        assert self.shape.neighborhoods is not None
        search = Search(self.shape.neighborhoods, centers[fitted], candidates)
        for number, tried, index in search:
            weights, candidate = self._free_weights(index, candidates[number]), candidates[number]
            bound, _ = self._resolved(candidate)
            passed = _good_slope(weights) & (weights.height_residual <= bound)
            search.settle(tried[passed])
            if passed.any():
                index = index[passed]
                gradient = tangent_weights(*self.placed, index, weights.gradient[passed])
                yield fitted[tried[passed]], index, gradient, candidate.degree

    def _planned_gradients(self, centers: Int[Tensor, " B"], plan: RowsPlan) -> Iterator[Gradients]:
        """Yield the planned gradients of low-order rows."""
        row, col, slope = plan.row[plan.used], plan.col[plan.used].long(), plan.slope[centers]
        size = torch.bincount(row, minlength=len(plan.length))[centers]
        for degree, count in torch.stack([slope, size], 1)[slope > 0].unique(dim=0).tolist():
            local = ((slope == degree) & (size == count)).nonzero()[:, 0]
            index = col[torch.isin(row, centers[local])].view(-1, count)
            index = _own_first(index, centers[local])
            weights = self._free_weights(index, Candidate(degree, count, RULES[0]), judged=False)
            yield local, index, tangent_weights(*self.placed, index, weights.gradient), degree


def _good_slope(weights: Weights) -> Bool[Tensor, " B"]:
    """Whether the points determine first derivatives, with bounded growth."""
    growth = weights.radius * weights.gradient.abs().sum(1).amax(1)
    return (weights.residual <= NEGLIGIBLE) & (growth <= GRADIENT_GROWTH)


def _own_first(index: Int[Tensor, "B K"], centers: Int[Tensor, " B"]) -> Int[Tensor, "B K"]:
    """Columns of each row, reordered to begin with its own point."""
    others = index != centers[:, None]
    return index.gather(1, others.byte().argsort(dim=1, stable=True))


def assemble(stencils: Stencils, *, progress: bool = True) -> Rows:
    """Rows of all points, in chunks.

    Memory beyond the result is about 0.1 GB for any N (`precision.BYTES`); the result takes 16 + 8 d bytes an entry.
    """
    parts = torch.arange(len(stencils.shape.points)).split(AT_ONCE)
    bar = tqdm(parts, "stencils", delay=2, disable=not progress, leave=False)
    return Rows.stack(stencils.rows(centers) for centers in bar)
