"""From points to the rows of a sparse operator: every point takes the first stencil that passes (`method.md`, 4).

The ladder of a point at order p: least-squares (or polyharmonic) stencils of degree p + 1 with K = 1.6, 2, …, 10 times as
many points as polynomials; then the same at p − 1, …, 1; then positive weights of order 1; then the fallback row. How far down each point
had to step is part of the result and never silent.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from tqdm import tqdm

from torchlb.geometry import Geometry
from torchlb.ladder import Rung, chunks, ladder_rungs, walk_ladder
from torchlb.neighbors import GraphBalls
from torchlb.polynomials import num_monomials
from torchlb.rows import Rows
from torchlb.tangent import local_offsets
from torchlb.weights import WEIGHT_RULES, Weights, typical_growth

__all__ = ["Ladder", "StencilError", "build_stencil"]

MAX_DOMINANCE = 3.0
MAX_GROWTH = 3.0
MAX_RESIDUAL = 1e-10


class StencilError(ValueError):
    """No acceptable stencil exists for some points; the message names them and the remedy."""


class Ladder:
    """All that decides a row, ready to build any of them, at any rung and below.

    Parameters
    ----------
    geometry : points, frames, graph and fallback rows.
    order : p ≥ 1 of the first rungs.
    projection, weights : keys of `PROJECTIONS` and `WEIGHT_RULES`.
    num_neighbors : K of every rung, instead of `SIZE_FACTORS`.
    """

    def __init__(
        self,
        geometry: Geometry,
        order: int,
        *,
        projection: str = "tangent",
        weights: str = "least_squares",
        num_neighbors: int | None = None,
    ) -> None:
        self.points, self.frames = geometry.points, geometry.frames
        self.fallback = geometry.fallback
        self.balls = GraphBalls(geometry.points, geometry.graph, geometry.frames)
        self.projection = projection
        dim = self.frames.shape[-1]
        rules = [weights] if weights == "least_squares" else [weights, "least_squares"]
        self.rungs = ladder_rungs(dim, range(order + 1, 1, -1), rules, num_neighbors)
        self.rungs += ladder_rungs(dim, [2], ["positive"], num_neighbors)

    def rows(self, centers: Int[Tensor, " B"], start: Int[Tensor, " B"] | None = None) -> Rows:
        """Rows of `centers`, each at the first rung (from `start` on) that passes.

        Raises StencilError where a point passes nowhere and there is no fallback.
        """
        blocks, taken = [], []
        reason = torch.ones(len(centers), dtype=torch.int64)  # until something is tried: too few
        place = torch.empty(len(self.points), dtype=torch.int64)
        place[centers] = torch.arange(len(centers))
        top = self.rungs[0].degree

        def attempt(rows: Tensor, index: Tensor, rung: Rung) -> tuple[Tensor, Rows]:
            weights = self._weights(rows, index, rung)
            failure = _failure(weights, rung.degree)
            if rung.degree == top and rung.rule != "positive":
                reason[place[rows]] = failure
            return failure == 0, _stencil_rows(index, weights, rung.degree)

        for number, rows, block in walk_ladder(self.balls, centers, self.rungs, attempt, start):
            block.rung[:] = number
            blocks.append(block)
            taken.append(rows)
        left = torch.ones(len(centers), dtype=torch.bool)
        left[torch.cat([*taken, torch.empty(0, dtype=torch.int64)])] = False
        if left.any():
            last_resort = self._least_bad_rows if self.fallback is None else self._fallback_rows
            blocks.append(last_resort(centers[left]))
            taken.append(left.nonzero()[:, 0])
        rows = Rows.stack(blocks)[torch.cat(taken).argsort()]
        return replace(rows, reason=torch.where(rows.order < top - 1, reason, rows.reason))

    def _weights(self, centers: Tensor, index: Tensor, rung: Rung) -> Weights:
        coords = local_offsets(self.points, self.frames, centers, index[:, 1:], self.projection)
        return WEIGHT_RULES[rung.rule](coords, rung.degree)

    def _fallback_rows(self, centers: Int[Tensor, " B"]) -> Rows:
        """M-matrix rows for Δ, and the first-order least-squares gradient of the nearest admissible neighbours."""
        assert self.fallback is not None
        index, _ = self.balls(centers, 2 * num_monomials(self.frames.shape[-1], 1) + 1)
        coords = local_offsets(self.points, self.frames, centers, index, "tangent")
        radius = coords.norm(dim=-1).amax(-1).clamp_min(torch.finfo(coords.dtype).tiny)
        # Where all neighbours lie on a line the pseudo-inverse leaves the other derivative zero.
        slopes = torch.linalg.pinv(coords / radius[:, None, None]).mT / radius[:, None, None]
        slopes[:, 0] -= slopes.sum(1)
        matrix = self.fallback[centers.numpy()].tocoo()
        local = torch.arange(len(centers)).repeat_interleave(index.shape[1])
        return _merged_rows(
            torch.cat([torch.from_numpy(matrix.coords[0].astype(np.int64)), local]),
            torch.cat([torch.from_numpy(matrix.coords[1].astype(np.int64)), index.reshape(-1)]),
            torch.cat([torch.from_numpy(matrix.data), slopes.new_zeros(len(local))]),
            torch.cat([slopes.new_zeros(matrix.nnz, slopes.shape[2]), slopes.flatten(0, 1)]),
            radius,
            len(self.rungs),
        )

    def _least_bad_rows(self, centers: Int[Tensor, " B"]) -> Rows:
        """Where there is no fallback: the lowest order and the most points whose moments hold, stable or not."""

        def attempt(rows: Tensor, index: Tensor, rung: Rung) -> tuple[Tensor, Rows]:
            weights = self._weights(rows, index, rung)
            failure = _failure(weights, rung.degree)
            block = replace(_stencil_rows(index, weights, rung.degree), reason=failure)
            return (failure == 0) | (failure > 3), block

        upward = self.rungs[::-1]
        blocks, taken = [], []
        for number, rows, block in walk_ladder(self.balls, centers, upward, attempt):
            block.rung[:] = len(self.rungs) - 1 - number
            blocks.append(block)
            taken.append(rows)
        if sum(len(rows) for rows in taken) < len(centers):
            found = torch.zeros(len(centers), dtype=torch.bool)
            found[torch.cat([*taken, torch.empty(0, dtype=torch.int64)])] = True
            raise StencilError(self._complaint(centers[~found]))
        return Rows.stack(blocks)[torch.cat(taken).argsort()]

    def _complaint(self, centers: Int[Tensor, " B"]) -> str:
        rung = min(self.rungs)
        index, count = self.balls(centers[:1], rung.size)
        needed = num_monomials(self.frames.shape[-1], rung.degree) - 1
        rank = needed - int(self._weights(centers[:1], index, rung).deficit[0])
        names = ", ".join(map(str, centers[:8].tolist())) + (", …" if len(centers) > 8 else "")
        return (
            f"point {int(centers[0])}: rank {rank} of {needed} at degree {rung.degree} after "
            f"{len(self.rungs)} sizes, with {int(count[0]) - 1} admissible neighbours nearby; "
            f"{len(centers)} points have no stencil ({names}) and there are no fallback rows in "
            f"{self.points.shape[1]} dimensions. Add points there, lower `order`, or pass `normals`"
        )


def _failure(weights: Weights, degree: int) -> Int[Tensor, " B"]:
    """Which of the local tests a stencil fails first, as an index into `REASONS`; 0 if none."""
    laplacian = weights.laplacian
    center, others = laplacian[:, 0], laplacian[:, 1:].abs().sum(1)
    typical = typical_growth(weights.gradient.shape[-1], degree)
    failure = torch.zeros(len(center), dtype=torch.int64)
    for code, passed in (
        (2, weights.deficit == 0),
        (3, weights.residual <= MAX_RESIDUAL),  # false for NaN
        (4, center < 0),
        (5, others <= MAX_DOMINANCE * center.abs()),
        (6, weights.radius.square() * (others + center.abs()) <= MAX_GROWTH * typical),
    ):
        failure = torch.where((failure == 0) & ~passed, code, failure)
    return failure


def _stencil_rows(index: Int[Tensor, "B K"], weights: Weights, degree: int) -> Rows:
    """A batch of stencils of one size as rows, columns ascending."""
    batch, size = index.shape
    col, order = index.sort(dim=1)
    laplacian = weights.laplacian
    center, total = laplacian[:, 0].abs(), laplacian.abs().sum(1)

    def entries(values: Tensor) -> Tensor:
        return values.take_along_dim(order[..., None], dim=1).flatten(0, 1)

    return Rows(
        length=torch.full((batch,), size),
        col=col.flatten(),
        laplacian=laplacian.take_along_dim(order, dim=1).flatten(),
        gradient=entries(weights.gradient),
        hessian=entries(weights.hessian),
        rung=torch.zeros(batch, dtype=torch.int64),
        order=torch.full((batch,), degree - 1),
        growth=weights.radius.square() * total,
        condition=weights.condition,
        dominance=(total - center) / center,
        reason=torch.zeros(batch, dtype=torch.int64),
    )


def _merged_rows(
    local: Int[Tensor, " E"],
    col: Int[Tensor, " E"],
    laplacian: Float[Tensor, " E"],
    gradient: Float[Tensor, "E d"],
    radius: Float[Tensor, " B"],
    rung: int,
) -> Rows:
    """Fallback rows from entries in any order, those of one place summed."""
    batch, dim = len(radius), gradient.shape[1]
    stride = int(col.max()) + 1
    key, place = torch.unique(local * stride + col, return_inverse=True)
    row = key // stride

    def summed(values: Tensor) -> Tensor:
        return values.new_zeros(len(key), *values.shape[1:]).index_add_(0, place, values)

    laplacian = summed(laplacian)
    total = radius.new_zeros(batch).index_add_(0, row, laplacian.abs())
    return Rows(
        length=torch.bincount(row, minlength=batch),
        col=key % stride,
        laplacian=laplacian,
        gradient=summed(gradient),
        hessian=gradient.new_zeros(len(key), dim * (dim + 1) // 2),
        rung=torch.full((batch,), rung),
        order=torch.zeros(batch, dtype=torch.int64),
        growth=radius.square() * total,
        condition=torch.full_like(radius, torch.nan),
        dominance=torch.ones_like(radius),
        reason=torch.zeros(batch, dtype=torch.int64),
    )


def build_stencil(ladder: Ladder, *, hessian: bool = False, progress: bool = True) -> Rows:
    """Rows of all points, in chunks; the second derivatives are kept only if asked for.

    Memory beyond the result: about 1 GB whatever N (`ladder.CHUNK_BYTES`). The result takes 16 + 8 d bytes an entry.
    """
    blocks = []
    parts = chunks(len(ladder.points), ladder.rungs, ladder.frames.shape[-1])
    for centers in tqdm(parts, "stencils", delay=2, disable=not progress, leave=False):
        rows = ladder.rows(centers)
        blocks.append(rows if hessian else replace(rows, hessian=rows.hessian[:, :0]))
    return Rows.stack(blocks)
