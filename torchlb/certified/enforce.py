"""Widening and order reduction of rows until the certificate holds: solve, estimate, mark, lower.

Each round solves for π and for directions in which S > 0 (`certificate`), marks the responsible rows, and moves each of
them to a later one of its candidates (`method.md`, section 5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor
from tqdm import tqdm

from torchlb.certified.certificate import Certificate, check_certificate
from torchlb.errors import StabilityWarning, as_given, warn
from torchlb.linalg.precision import LOW
from torchlb.linalg.sparse import to_scipy
from torchlb.stencils.rows import Reason, Rows

MARGIN = 0.02
"""Fraction of a point's area below which its weight π is small, so that rows around it are marked."""
MOST_ROUNDS = 80
"""Largest number of rounds; then the operator is left as it is, with a warning."""
Lower = Callable[[Int[Tensor, " J"], Int[Tensor, " J"]], Rows]


def certify(
    rows: Rows,
    areas: Float[Tensor, " N"],
    lower: Lower,
    bottom: int,
    *,
    outflow: bool = False,
    progress: bool = True,
) -> tuple[Rows, Float[Tensor, " N"], Certificate]:
    """Widen rows, or lower their order, until the certificate holds.

    Each row is by the first of its candidates that passed; `lower` maps points and first candidates to rows by the
    first candidate from there on that passes. `bottom` is the number of candidates, the `Rows.candidate` of low-order
    rows, which cannot be lowered further. With `outflow` rows may have L1 < 0, as beside a Dirichlet boundary.

    Returns the rows, the mass π, (N,), ℓ^d, and the certificate; a `StabilityWarning` is issued if it does not hold.
    """
    first, count, rounds = rows, len(areas), 0
    with tqdm(desc="certificate", delay=2, disable=None if progress else True, leave=False) as bar:
        while True:
            bar.update()
            matrix = to_scipy(rows.crow, rows.col, rows.laplacian, (count, count))
            mass, result, feed = check_certificate(matrix, areas, outflow=outflow)
            free = rows.candidate < bottom
            marked = _marked(matrix, mass / areas, feed, free, spread=not result.holds)
            if not marked.any() or rounds == MOST_ROUNDS:
                break
            rounds, rows = rounds + 1, _lowered(rows, first, marked, lower)
            bar.set_postfix_str(f"{int(marked.sum())} rows marked", refresh=False)
    below = rows.order < first.order
    widened = (rows.candidate > first.candidate) & ~below
    counts = {"lowered": int(below.sum()), "widened": int(widened.sum()), "rounds": rounds}
    result = replace(result, **counts)
    if not result.holds:
        worst = (mass / areas).argsort() if feed.shape[1] == 0 else (-feed.max(1)).argsort()
        names = ", ".join(map(str, as_given(worst[:8]).tolist()))
        stopped = ", where rounds end" if rounds == MOST_ROUNDS else ""
        warn(
            f"{result}{stopped}; the worst points: {names}. Lower `order`, or repair the surface there.",
            StabilityWarning,
        )
    return rows, mass, result


def _marked(
    matrix: sparse.csr_array,
    density: Float[Tensor, " N"],
    feed: Float[np.ndarray, "N k"],
    free: Bool[Tensor, " N"],
    *,
    spread: bool,
) -> Bool[Tensor, " N"]:
    """Rows to widen or lower: those that make π small, or contribute most to a direction v with vᵀSv > 0.

    With `spread`, neighbours are marked too until one is free, since low-order rows are symmetric only together.
    """
    joined = sparse.csr_array(abs(matrix) + abs(matrix).T)
    joined.data[:] = 1.0
    marked = _around_small_weights(matrix, density.numpy(), free.numpy())
    marked |= (feed > LOW * feed.max(axis=0)).any(axis=1)
    while spread and not (marked & free.numpy()).any():
        wider = joined @ marked > 0
        if (wider == marked).all():
            break
        marked = wider
    return torch.from_numpy(marked) & free


def _around_small_weights(
    matrix: sparse.csr_array, density: Float[np.ndarray, " N"], free: Bool[np.ndarray, " N"]
) -> Bool[np.ndarray, " N"]:
    """Rows to mark for the points of small π.

    For each such point these are the rows with a considerable negative weight on it, as π_i |L_ii| = Σ_{j≠i} π_j L_ji;
    and, if its own is a low-order row, the rows of the points in it, which may not refer back, as across a crease.
    """
    small = np.flatnonzero(density <= MARGIN)
    columns = sparse.coo_array(sparse.csc_array(matrix)[:, small])
    row, col = columns.coords
    inflow = np.where(row == small[col], 0.0, columns.data)
    worst = np.zeros(len(small))
    np.minimum.at(worst, col, inflow)
    marked = np.zeros(len(density), dtype=bool)
    marked[row[(inflow < LOW * worst[col]) & (inflow < 0)]] = True
    marked[matrix[small[~free[small]]].indices] = True
    return marked


def _lowered(rows: Rows, first: Rows, marked: Bool[Tensor, " N"], lower: Lower) -> Rows:
    """Rebuild the marked rows from the candidate after their present one on."""
    index = marked.nonzero()[:, 0]
    rebuilt = lower(index, rows.candidate[index] + 1)
    reason = torch.where(rebuilt.order < first.order[index], Reason.STABILITY, first.reason[index])
    place = torch.arange(len(first.order))
    place[index] = len(place) + torch.arange(len(index))
    return Rows.stack([rows, replace(rebuilt, reason=reason)])[place]
