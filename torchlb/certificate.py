r"""The certificate of stability, and the walk down the ladder until it holds (`method.md`, section 5).

Let π be the left null vector, πᵀL = 0, one per connected component. If π > 0 and S = ½(ΠL + LᵀΠ) ≤ 0, then
d/dt |u|²_π = 2 uᵀSu ≤ 0 along u' = Lu: diffusion contracts in the norm of π, implicit schemes are stable at any step,
and Σ π_i u_i is conserved. Rows that stand in the way take the next rung of their ladder, until it holds.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor
from tqdm import tqdm

from torchlb.iterative import (
    imbalance,
    negative_directions,
    null_density,
    raised_peaks,
    rescaled,
)
from torchlb.rows import REASONS, Rows
from torchlb.sparse import to_scipy
from torchlb.stencil import Ladder, StencilError

__all__ = [
    "LOSS",
    "Certificate",
    "StabilityWarning",
    "certify",
    "check_certificate",
    "factorized",
    "left_null_vector",
]

LOSS = 1e-9
"""A row whose sum is above this share of its size loses heat; all others sum to zero up to rounding."""
MARGIN = 0.02
"""A point whose π is below this share of its area asks the rows around it to step down while they can."""
STRICTNESS = 1e-12
"""S passes if it is negative up to this share of the size of each of its rows; a hundred times their rounding."""
CONSERVED = 1e-11
"""π is a null vector if what flows in and out of each point agrees to this share."""
SHIFT, SOLVES = 1e-9, 8
"""Share of each diagonal entry that inverse iteration is shifted by, and its number of steps."""
POSITIVE = 1e-10
"""Share of its area that π must reach at every point; what is below has no inflow but rounding."""
MAX_ROUNDS = 80
PATIENCE = 20
"""Rounds after which rows step down to the bottom at once; twice as many beyond `LARGEST_FACTORED` points."""
SINGLE_STEPS = 4
"""Times that a row steps down by one rung; from then on its way doubles with every second time."""
LARGEST_FACTORED = 100_000
"""Beyond this many points Krylov methods come before the sparse factors, whose memory grows faster than the points."""
MAX_VECTORS = 128
FEED_SHARE = 0.2
WEIGHT_SHARE = 0.1
STEPPED_DOWN = REASONS.index("stepped down by the certificate")


class StabilityWarning(UserWarning):
    """The certificate does not hold; the message names what remains."""


@dataclass(frozen=True)
class Certificate:
    """Proof of stability of one operator: π > 0 and S ≤ 0.

    Attributes
    ----------
    holds : whether ‖e^{tL}‖_π ≤ 1 for all t ≥ 0.
    min_pi : smallest π_i in units of the point's area; positive if the certificate holds.
    max_s : lower bound of the largest eigenvalue of D^{-1/2} S D^{-1/2}, D the size of each row; 0.0 if there is no
        positive one, beyond rounding. NaN if π is not positive or no null vector, where S means nothing.
    rounds : of stepping down that it took.
    stepped_down : number of rows below the rung that they passed on their own.
    components : number of connected components, each with its own π.
    """

    holds: bool
    min_pi: float
    max_s: float
    rounds: int
    stepped_down: int
    components: int

    def __str__(self) -> str:
        """One line."""
        verdict = "holds" if self.holds else "does NOT hold"
        return (
            f"certificate {verdict}: min π = {self.min_pi:.3g} of the area, max S = {self.max_s:.1e} of its size, "
            f"{self.rounds} rounds, {self.stepped_down} rows stepped down, {self.components} components"
        )


def factorized(matrix: sparse.csc_array, threshold: float) -> SuperLU:
    """Sparse LU with an ordering for nearly symmetric patterns, several times faster here than the default."""
    return splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=threshold,
        options={"SymmetricMode": True},
    )


def left_null_vector(
    matrix: sparse.csr_array, areas: Float[Tensor, " N"]
) -> tuple[Float[Tensor, " N"], np.ndarray, float]:
    """π with πᵀL = 0, scaled on each component to the sum of the areas there.

    Inverse iteration with the LU of (AL)ᵀ, A the areas, each diagonal entry shifted by its own share. Beyond
    `LARGEST_FACTORED` points GMRES with multigrid of the low-order part. On a component with rows that lose heat
    (L1 < 0, next to a Dirichlet boundary) π solves πᵀL = −q instead, q from `_shared`, and has the sum of the areas.

    Returns
    -------
    mass : π.
    component : of each point.
    error : largest imbalance of a point, see `imbalance`; `CONSERVED` is what rounding may leave.
    """
    area = areas.numpy()
    count, component = csgraph.connected_components(matrix, directed=True, connection="weak")
    loss = -matrix.sum(axis=1)
    losing = np.abs(loss) > LOSS * abs(matrix).sum(axis=1)
    lossless = np.bincount(component, losing, minlength=count) == 0
    lost = _shared(np.maximum(area * loss, 0), matrix, losing)
    density = None
    if len(area) > LARGEST_FACTORED:
        density = null_density(matrix, area, lost, component, lossless)
    if density is None:
        density = _factored_density(matrix, area, lost, component, lossless)
    error = imbalance(sparse.csr_array(matrix.T), area * density, lost)
    density = rescaled(density, area, component, ~lossless)
    return torch.from_numpy(area * density), component, error


def _shared(
    heat: Float[np.ndarray, " N"], matrix: sparse.csr_array, losing: Bool[np.ndarray, " N"]
) -> Float[np.ndarray, " N"]:
    """The heat of each losing row, in equal parts to those of them that it shares an entry with; none of the others.

    Where a row loses next to nothing π would be next to nothing, and rows would step down for it.
    """
    rows = np.flatnonzero(losing)
    joined = matrix[rows][:, rows].astype(bool)
    joined = sparse.csr_array((joined + joined.T).astype(float))
    shared = np.zeros_like(heat)
    shared[rows] = joined @ (heat[rows] / np.maximum(joined.sum(axis=1), 1))
    return shared


def _factored_density(
    matrix: sparse.csr_array,
    area: Float[np.ndarray, " N"],
    lost: Float[np.ndarray, " N"],
    component: np.ndarray,
    free: Bool[np.ndarray, " C"],
) -> Float[np.ndarray, " N"]:
    """What `null_density` finds, by inverse iteration."""
    weighted = sparse.diags_array(area) @ matrix
    diagonal = np.abs(weighted.diagonal())
    shift = SHIFT * np.where(diagonal > 0, diagonal, 1.0)
    try:
        lu = factorized(sparse.csc_array((weighted - sparse.diags_array(shift)).T), 1e-2)
    except RuntimeError as error:
        raise StencilError(
            "certificate: the operator is singular beyond its constants; is `dim` the dimension of the manifold? "
            "Pass the right one, or certify=False to look at the raw operator"
        ) from error
    density = np.ones(len(area))
    for _ in range(SOLVES):
        density = -lu.solve(lost + shift * density)
        density = rescaled(density, area, component, free)
    return density


def dissipation(
    matrix: sparse.csr_array, mass: Float[Tensor, " N"]
) -> tuple[float, Float[Tensor, "N k"]]:
    """How far S is from S ≤ 0, in units of the size of its rows, and what feeds it.

    A = εD − S, D the diagonal of the absolute sums of the terms in each row of S, is positive iff A = LDLᵀ has no
    negative pivot (Sylvester's law of inertia). So each point is judged by its own scale, which may be 1e6 times
    finer here than there. Each negative pivot d_j brings its own proof, v = L^{-T} e_j with vᵀAv = d_j < 0: what is
    already eliminated relaxes around j, so v lives where S fails. It is A^{-1} applied to d_j times column j of the
    factor, one solve. Row i feeds vᵀSv > 0 by π_i v_i (Lv)_i, which sums to it.

    Beyond `LARGEST_FACTORED` points the v are those that conjugate gradients come upon.

    Returns
    -------
    max_s : largest vᵀSv / vᵀDv, a lower bound of the largest eigenvalue; 0.0 if there is no v.
    feed : (N, k), the shares of the rows in each vᵀSv; k = 0 if there is none.
    """
    weighted = sparse.csr_array(sparse.diags_array(mass.numpy()) @ matrix)
    symmetric = (weighted + weighted.T) / 2
    size = (abs(weighted).sum(axis=0) + abs(weighted).sum(axis=1)) / 2
    size = np.where(size > 0, size, 1.0)
    shifted = sparse.csr_array(STRICTNESS * sparse.diags_array(size) - symmetric)
    vectors = negative_directions(shifted) if len(size) > LARGEST_FACTORED else None
    localized = vectors is None
    if vectors is None:
        vectors = _negative_pivots(shifted)
    if vectors.shape[1] == 0:
        return 0.0, torch.zeros(len(size), 0)
    feed = vectors * (weighted @ vectors)
    rayleigh = feed.sum(axis=0) / (size @ vectors**2)
    if not localized:
        feed = raised_peaks(feed, matrix, FEED_SHARE)
    return float(rayleigh.max()), torch.from_numpy(feed)


def _negative_pivots(matrix: sparse.csr_array) -> Float[np.ndarray, "N k"]:
    """For each negative pivot of the symmetric A = LDLᵀ, at most `MAX_VECTORS`, v = L^{-T}e_j."""
    lu = factorized(sparse.csc_array(matrix), 0.0)
    pivots = lu.U.diagonal()
    negative = np.flatnonzero(pivots < 0)[:MAX_VECTORS]
    if len(negative) == 0:
        return np.empty((len(pivots), 0))
    columns = (lu.L[:, negative] * pivots[negative]).toarray()
    return lu.solve(columns[lu.perm_r])


def check_certificate(
    matrix: sparse.csr_array, areas: Float[Tensor, " N"], rounds: int = 0, stepped: int = 0
) -> tuple[Float[Tensor, " N"], Certificate, Float[Tensor, "N k"]]:
    """π, the certificate as it stands, and the rows' shares in the positive eigenvalues of S."""
    mass, component, error = left_null_vector(matrix, areas)
    smallest = float((mass / areas).min())
    max_s, feed = np.nan, torch.zeros(len(areas), 0)
    if smallest > 0 and error <= CONSERVED:
        max_s, feed = dissipation(matrix, mass)
    holds = smallest > POSITIVE and max_s == 0
    result = Certificate(holds, smallest, max_s, rounds, stepped, int(component.max()) + 1)
    return mass, result, feed


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
    first = rows.rung.clone()
    steps = torch.zeros(count, dtype=torch.int64)
    rounds, bottom = 0, len(ladder.rungs)
    patience = PATIENCE if count <= LARGEST_FACTORED else 2 * PATIENCE
    with tqdm(desc="certificate", delay=2, disable=not progress, leave=False) as bar:
        while True:
            bar.update()
            matrix = to_scipy(rows.crow, rows.col, rows.laplacian, (count, count))
            free = rows.rung < bottom
            astray = _into_sinks(matrix)
            astray = astray[free[astray]]
            if len(astray) > 0 and rounds < MAX_ROUNDS:
                rounds += 1
                rows = _step_down(ladder, rows, astray, torch.full_like(astray, bottom))
                continue
            stepped = int((rows.rung > first).sum())
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
    """Rebuild the given rows from rung `start` on, one rung lower at least."""
    start = torch.maximum(rows.rung[movable] + 1, start).clamp_max(len(ladder.rungs))
    rebuilt = ladder.rows(movable, start)
    top = ladder.rungs[0].degree - 1
    reason = torch.where(rebuilt.order < top, STEPPED_DOWN, 0)
    kept = rebuilt.hessian[:, : rows.hessian.shape[1]]
    rebuilt = replace(rebuilt, reason=reason, hessian=kept)
    place = torch.arange(len(rows.rung))
    place[movable] = len(rows.rung) + torch.arange(len(movable))
    return Rows.stack([rows, rebuilt])[place]


def _warn(result: Certificate, density: Float[Tensor, " N"], feed: Float[Tensor, "N k"]) -> None:
    order = feed.amax(1).argsort(descending=True) if feed.shape[1] else density.argsort()
    names = ", ".join(map(str, order[:8].tolist()))
    warnings.warn(
        f"{result}; the worst points: {names}. Lower `order`, or repair the surface there.",
        StabilityWarning,
        stacklevel=4,
    )
