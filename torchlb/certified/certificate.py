r"""The certificate of stability, and the widening and order reduction of rows until it holds (`method.md`, section 5).

Let π be the left null vector, πᵀL = 0, one per connected component; with an outflow q of rows that sum to less than
zero, πᵀL = −q. If π > 0 and S = ½(ΠL + LᵀΠ) ≤ 0, then
d/dt |u|²_π = 2 uᵀSu ≤ 0 along u' = Lu: diffusion contracts in the norm of π, implicit schemes are stable at any step,
and Σ π_i u_i is conserved.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor
from tqdm import tqdm

from torchlb.errors import StabilityError, StabilityWarning, as_given, warn
from torchlb.linalg.factor import factorized
from torchlb.linalg.precision import LOW, ROOT_EPS, ROUNDING
from torchlb.linalg.sparse import to_scipy
from torchlb.stencils.rows import Reason, Rows

CONSERVED = 1e-11
"""Largest relative imbalance of inflow and outflow at a point with which π counts as a null vector."""
SOLVES = 8
"""Steps of inverse iteration."""
DIRECTIONS = 50
"""Largest number of directions in which S is positive that are looked at in a round."""
MARGIN = 0.02
"""Fraction of a point's area below which its weight π is small, so that rows around it are marked."""
MOST_ROUNDS = 80
"""Largest number of rounds; then the operator is left as it is, with a warning."""
Lower = Callable[[Int[Tensor, " J"], Int[Tensor, " J"]], Rows]
SINGULAR = (
    "certificate: the operator is singular beyond its constants; is `dim` the dimension of the manifold? "
    "Pass the right one, or certify=False to look at the raw operator"
)


@dataclass(frozen=True)
class Certificate:
    """Proof of stability of one operator: π > 0 and S ≤ 0.

    Attributes
    ----------
    holds
        Whether ‖e^{tL}‖_π ≤ 1 for all t ≥ 0.
    min_pi
        Smallest π_i in units of the point's area; positive if the certificate holds.
    max_s
        Lower bound of the largest eigenvalue of D^{-1/2} S D^{-1/2}, D the size of each row; 0.0 if none is positive
        beyond rounding. NaN if π is not positive or not a null vector, where S is meaningless.
    components
        Number of connected components, each with its own π.
    rounds
        Number of rounds of widening and lowering.
    lowered
        Number of rows below the order at which they first passed.
    widened
        Number of rows of the same order with more points or another rule of weights.
    """

    holds: bool
    min_pi: float
    max_s: float
    components: int
    rounds: int = 0
    lowered: int = 0
    widened: int = 0

    def __str__(self) -> str:
        """One line."""
        verdict = "holds" if self.holds else f"does NOT hold, max S = {self.max_s:.1e} of its size"
        pieces = f", {self.components} components" if self.components > 1 else ""
        return (
            f"certificate {verdict}: min π = {self.min_pi:.3g} of the area; "
            f"{self.rounds} rounds, {self.widened} rows widened, {self.lowered} lowered{pieces}"
        )


def check_certificate(
    matrix: sparse.csr_array, areas: Float[Tensor, " N"], *, outflow: bool = False
) -> tuple[Float[Tensor, " N"], Certificate, Float[np.ndarray, "N k"]]:
    """Return π, the certificate, and the contribution of each row of L to every vᵀSv > 0 that violates it.

    With `outflow` rows may have L1 < 0, as beside a Dirichlet boundary.
    """
    q = shared_outflow(matrix, areas) if outflow else np.zeros(len(areas))
    mass, components, error = left_null_vector(matrix, areas, q)
    smallest = float((mass / areas).min())
    contracts, max_s, indicator = False, np.nan, np.zeros((len(areas), 0))
    if smallest > 0 and error <= CONSERVED:
        contracts, max_s, indicator = dissipation(matrix, mass)
    holds = smallest > ROOT_EPS and contracts
    return mass, Certificate(holds, smallest, max_s, components), indicator


def left_null_vector(
    matrix: sparse.csr_array, areas: Float[Tensor, " N"], outflow: Float[np.ndarray, " N"]
) -> tuple[Float[Tensor, " N"], int, float]:
    """π with πᵀL = −q, q ≥ 0 the outflow, ℓ^{d−2}, scaled on each component to the sum of the areas there.

    Inverse iteration uses the LU of (AL)ᵀ, A the areas, with a relative shift of each diagonal entry. Returns π, the
    number of components, and the largest |πᵀL + q| of all points relative to its terms, of which rounding leaves at
    most `CONSERVED`. Raises StabilityError if there is no such π, as L is singular beyond its constants.
    """
    area = areas.numpy()
    count, component = csgraph.connected_components(matrix, directed=True, connection="weak")

    def total(values: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
        return np.bincount(component, values, minlength=count)[component]

    closed, whole = total(outflow) == 0, total(area)
    weighted = sparse.csc_array((sparse.diags_array(area) @ matrix).T)
    diagonal = np.abs(weighted.diagonal())
    shift = ROOT_EPS * np.where(diagonal > 0, diagonal, 1.0)
    try:
        lu = factorized(sparse.csc_array(weighted - sparse.diags_array(shift)), 1e-2)
    except RuntimeError as error:
        raise StabilityError(SINGULAR) from error
    density = np.ones(len(area))
    for _ in range(SOLVES):
        density = -lu.solve(outflow + shift * density)
        density *= np.where(closed, whole / total(area * density), 1.0)
    if not np.isfinite(density).all():
        raise StabilityError(SINGULAR)
    terms = abs(weighted) @ np.abs(density)
    error = np.abs(weighted @ density + outflow) / np.where(terms > 0, terms, 1.0)
    density *= whole / total(area * density)
    return torch.from_numpy(area * density), count, float(error.max())


def shared_outflow(matrix: sparse.csr_array, areas: Float[Tensor, " N"]) -> Float[np.ndarray, " N"]:
    """Outflow of the rows of non-zero sum, each shared equally among those of them that it has an entry with.

    Where almost nothing flows out of a row, π would almost vanish, and rows would be lowered for it.
    """
    total = matrix.sum(axis=1)
    rows = np.flatnonzero(np.abs(total) > ROOT_EPS * abs(matrix).sum(axis=1))
    own = np.maximum(-areas.numpy() * total, 0)[rows]
    joined = matrix[rows][:, rows].astype(bool)
    joined = sparse.csr_array((joined + joined.T).astype(float))
    shared = np.zeros(len(areas))
    shared[rows] = joined @ (own / np.maximum(joined.sum(axis=1), 1))
    return shared


def dissipation(
    matrix: sparse.csr_array, mass: Float[Tensor, " N"]
) -> tuple[bool, float, Float[np.ndarray, "N k"]]:
    """Test S ≤ 0, with the largest violation relative to the size of its rows, and the rows that contribute.

    A = εD − S, D the diagonal of the absolute sums of the terms in each row of S, is positive iff A = LDLᵀ has no
    negative pivot (Sylvester's law of inertia). Each point is thus judged by its own scale, which may vary by a factor
    of 1e6. Each negative pivot d_j has a witness v = L^{-T} e_j with vᵀAv = d_j < 0: eliminated points relax around j,
    so v is localised where S fails. It is A^{-1} applied to d_j times column j of the factor, one solve. Row i
    contributes π_i v_i (Lv)_i to vᵀSv > 0. The violation is the largest vᵀSv / vᵀDv, a lower bound of the largest
    eigenvalue; it is 0.0, and k = 0, if there is no v.
    """
    weighted = sparse.csr_array(sparse.diags_array(mass.numpy()) @ matrix)
    symmetric = (weighted + weighted.T) / 2
    size = (abs(weighted).sum(axis=0) + abs(weighted).sum(axis=1)) / 2
    size = np.where(size > 0, size, 1.0)
    lu = factorized(sparse.csc_array(ROUNDING * sparse.diags_array(size) - symmetric), 0.0)
    pivots = lu.U.diagonal()
    negative = np.flatnonzero(pivots < 0)[:DIRECTIONS]
    columns = (lu.L[:, negative] * pivots[negative]).toarray()
    vectors = lu.solve(columns[lu.perm_r])
    indicator = vectors * (weighted @ vectors)
    rayleigh = indicator.sum(axis=0) / (size @ vectors**2)
    return len(negative) == 0, float(rayleigh.max(initial=0.0)), indicator


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
            mass, result, indicator = check_certificate(matrix, areas, outflow=outflow)
            free = (rows.candidate < bottom).numpy()
            marked = _marked(matrix, mass / areas, indicator, free, not result.holds)
            if not marked.any() or rounds == MOST_ROUNDS:
                break
            rounds, rows = rounds + 1, _lowered(rows, first, marked, lower)
            bar.set_postfix_str(f"{int(marked.sum())} rows marked", refresh=False)
    below = rows.order < first.order
    widened = (rows.candidate > first.candidate) & ~below
    counts = {"lowered": int(below.sum()), "widened": int(widened.sum()), "rounds": rounds}
    result = replace(result, **counts)
    if not result.holds:
        worst = (-indicator.max(1) if indicator.shape[1] else mass / areas).argsort()
        names = ", ".join(map(str, as_given(worst[:8]).tolist()))
        stopped = ", where rounds end" if rounds == MOST_ROUNDS else ""
        warn(
            f"{result}{stopped}; the worst points: {names}. Lower `order`, or repair the surface there.",
            StabilityWarning,
        )
    return rows, mass, result


def _marked(
    matrix: sparse.csr_array, density: Tensor, indicator: np.ndarray, free: np.ndarray, spread: bool
) -> Bool[Tensor, " N"]:
    """Rows to widen or lower: those that make π small, or contribute most to a direction v with vᵀSv > 0.

    A small π_i is due to the rows with a considerable negative weight on the point, as π_i |L_ii| = Σ_{j≠i} π_j L_ji;
    and, if its own is a low-order row, to those of the points in it, which may not refer back, as across a crease. With
    `spread`, neighbours are marked too until one is free, since low-order rows are symmetric only together.
    """
    small = np.flatnonzero(density.numpy() <= MARGIN)
    columns = sparse.coo_array(sparse.csc_array(matrix)[:, small])
    row, col = columns.coords
    inflow, worst = np.where(row == small[col], 0.0, columns.data), np.zeros(len(small))
    np.minimum.at(worst, col, inflow)
    marked = (indicator > LOW * indicator.max(axis=0)).any(axis=1)
    marked[row[inflow < LOW * worst[col]]] = True
    marked[matrix[small[~free[small]]].indices] = True
    joined = abs(matrix) + abs(matrix).T
    while spread and not (marked & free).any():
        wider = joined @ marked > 0
        if (wider == marked).all():
            break
        marked = wider
    return torch.from_numpy(marked & free)


def _lowered(rows: Rows, first: Rows, marked: Bool[Tensor, " N"], lower: Lower) -> Rows:
    """Rebuild the marked rows from the candidate after their present one on."""
    index = marked.nonzero()[:, 0]
    rebuilt = lower(index, rows.candidate[index] + 1)
    reason = torch.where(rebuilt.order < first.order[index], Reason.STABILITY, first.reason[index])
    place = torch.arange(len(first.order))
    place[index] = len(place) + torch.arange(len(index))
    return Rows.stack([rows, replace(rebuilt, reason=reason)])[place]
