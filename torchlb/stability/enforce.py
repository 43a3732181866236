"""Rows lower their order until the certificate holds (`method.md`, section 5)."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor
from tqdm import tqdm

from torchlb.errors import StabilityWarning
from torchlb.linalg.krylov import prefers_krylov
from torchlb.linalg.sparse import to_scipy
from torchlb.stability.certificate import FEED_SHARE, Certificate, check_certificate
from torchlb.stencils.assemble import Ladder
from torchlb.stencils.rows import Reason, Rows

__all__ = ["certify"]
MARGIN = 0.02
"""A point whose π is below this share of its area asks the rows around it to step down while they can."""
MAX_ROUNDS = 80
PATIENCE = 20
"""Rounds after which rows step down to the bottom at once; twice as many beyond `krylov.LARGEST_FACTORED` points."""
SINGLE_STEPS = 4
"""Times that a row steps down by one candidate; from then on its way doubles with every second time."""
WEIGHT_SHARE = 0.1


def certify(
    ladder: Ladder, rows: Rows, areas: Float[Tensor, " N"], *, progress: bool = True
) -> tuple[Rows, Float[Tensor, " N"], Certificate]:
    """Step rows down their ladders until the certificate holds.

    Returns
    -------
    rows : the operator that it holds for.
    mass : π, (N,), ℓ^d.
    certificate : what was reached; a `StabilityWarning` is issued if it does not hold.
    """
    count = len(areas)
    first = rows.candidate.clone()
    steps = torch.zeros(count, dtype=torch.int64)
    rounds, bottom = 0, len(ladder.candidates)
    patience = 2 * PATIENCE if prefers_krylov(count) else PATIENCE
    with tqdm(desc="certificate", delay=2, disable=not progress, leave=False) as bar:
        while True:
            bar.update()
            matrix = to_scipy(rows.crow, rows.col, rows.laplacian, (count, count))
            free = rows.candidate < bottom
            astray = _into_sinks(matrix)
            astray = astray[free[astray]]
            if len(astray) > 0 and rounds < MAX_ROUNDS:
                rounds += 1
                rows = _step_down(ladder, rows, astray, torch.full_like(astray, bottom))
                continue
            stepped = int((rows.candidate > first).sum())
            mass, result, feed = check_certificate(matrix, areas, rounds, stepped)
            bar.set_postfix_str(f"min π {result.min_pi:.2g}, {stepped} rows down", refresh=False)
            blamed = _responsible(matrix, mass / areas, feed, free)
            movable = blamed[free[blamed]]
            reach = 0
            while len(movable) == 0 and not result.holds and reach < len(blamed):
                reach = len(blamed)
                blamed = _around(matrix, blamed)
                movable = blamed[free[blamed]]
            if len(movable) == 0 or rounds == MAX_ROUNDS:
                break
            rounds += 1
            steps[movable] += 1
            way = _way_down(steps[movable]) if rounds <= patience else bottom
            rows = _step_down(ladder, rows, movable, first[movable] + way)
    if not result.holds:
        _warn(result, mass / areas, feed)
    return rows, mass, result


def _into_sinks(matrix: sparse.csr_array) -> Int[Tensor, " J"]:
    """Rows that refer to a sink: to a few points that refer to each other alone.

    What flows in never leaves, so all of π is there, and nothing can be told from its zeros elsewhere. The largest
    class of points that refer to each other, on a connected component, is none.
    """
    matrix = sparse.csr_array(matrix, copy=True)
    matrix.eliminate_zeros()
    _, component = csgraph.connected_components(matrix, directed=False)
    count, label = csgraph.connected_components(matrix, connection="strong")
    if count == component.max() + 1:
        return torch.empty(0, dtype=torch.int64)
    row, col = sparse.coo_array(matrix).coords
    leaving = label[row] != label[col]
    sink = np.ones(count, dtype=bool)
    sink[label[row[leaving]]] = False
    by_size = np.bincount(label)[label].argsort(kind="stable")
    largest = np.zeros(component.max() + 1, dtype=np.int64)
    largest[component[by_size]] = label[by_size]  # the last one written stays
    sink[largest] = False
    return torch.from_numpy(np.unique(row[leaving & sink[label[col]]]).astype(np.int64))


def _responsible(
    matrix: sparse.csr_array,
    density: Float[Tensor, " N"],
    feed: Float[Tensor, "N k"],
    free: Bool[Tensor, " N"],
) -> Int[Tensor, " J"]:
    """Rows to step down.

    Where π is small: the rows with a negative weight into the point, unless slight, and its own if π is positive, as
    π_i |L_ii| is what flows in, or if those are at the bottom. Also the points of its row if that is at the bottom
    already, since they may leave it out of theirs, as on both sides of a crease. Where S fails: the rows that feed its
    positive eigenvalues.
    """
    blamed = (feed > FEED_SHARE * feed.amax(0)).any(1) if feed.shape[1] else density.isnan()
    small = (density <= MARGIN).numpy()
    if small.any():
        starved = np.flatnonzero(small)
        columns = sparse.coo_array(sparse.csc_array(matrix)[:, starved])
        row, col = columns.coords
        inflow = np.where(row == starved[col], 0.0, columns.data)
        worst = np.zeros(len(starved))
        np.minimum.at(worst, col, inflow)
        heavy = (inflow < WEIGHT_SHARE * worst[col]) & (inflow < 0)
        blamed[torch.from_numpy(row[heavy].astype(np.int64))] = True
        alone = not (blamed & free).any()
        blamed |= torch.from_numpy(small) & ((density > 0) | alone)
        at_bottom = starved[~free.numpy()[starved]]
        blamed[torch.from_numpy(np.unique(matrix[at_bottom].indices).astype(np.int64))] = True
    return blamed.nonzero()[:, 0]


def _around(matrix: sparse.csr_array, rows: Int[Tensor, " J"]) -> Int[Tensor, " K"]:
    """Rows that share an entry with the given ones, where those are at the bottom: they are symmetric only together."""
    inward = sparse.csc_array(matrix)[:, rows.numpy()].indices
    joined = np.concatenate([matrix[rows.numpy()].indices, inward])
    return torch.from_numpy(np.unique(joined).astype(np.int64))


def _way_down(steps: Int[Tensor, " J"]) -> Int[Tensor, " J"]:
    """Rungs below the first that a row starts from when it is blamed for the steps-th time.

    >>> _way_down(torch.arange(13)).tolist()
    [0, 1, 2, 3, 4, 6, 8, 12, 16, 23, 32, 46, 64]
    """
    doubled = SINGLE_STEPS * 2 ** ((steps - SINGLE_STEPS) / 2)
    return torch.where(steps <= SINGLE_STEPS, steps, doubled.ceil().long())


def _step_down(ladder: Ladder, rows: Rows, movable: Tensor, start: Tensor) -> Rows:
    """Rebuild the given rows from candidate `start` on, one candidate lower at least."""
    start = torch.maximum(rows.candidate[movable] + 1, start).clamp_max(len(ladder.candidates))
    rebuilt = ladder.rows(movable, start)
    top = ladder.candidates[0].degree - 1
    reason = torch.where(rebuilt.order < top, Reason.STABILITY, 0)
    kept = rebuilt.hessian[:, : rows.hessian.shape[1]]
    rebuilt = replace(rebuilt, reason=reason, hessian=kept)
    place = torch.arange(len(rows.candidate))
    place[movable] = len(rows.candidate) + torch.arange(len(movable))
    return Rows.stack([rows, rebuilt])[place]


def _warn(result: Certificate, density: Float[Tensor, " N"], feed: Float[Tensor, "N k"]) -> None:
    order = feed.amax(1).argsort(descending=True) if feed.shape[1] else density.argsort()
    names = ", ".join(map(str, order[:8].tolist()))
    warnings.warn(
        f"{result}; the worst points: {names}. Lower `order`, or repair the surface there.",
        StabilityWarning,
        stacklevel=4,
    )
