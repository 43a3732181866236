r"""The certificate of stability, and the walk down the ladder until it holds (`method.md`, section 5).

Let π be the left null vector, πᵀL = 0, one per connected component. If π > 0 and S = ½(ΠL + LᵀΠ) ≤ 0, then
d/dt |u|²_π = 2 uᵀSu ≤ 0 along u' = Lu: diffusion contracts in the norm of π, implicit schemes are stable at any step,
and Σ π_i u_i is conserved. Rows that stand in the way take the next rung of their ladder, until it holds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from torch import Tensor

from torchlb.linalg.factor import factorized
from torchlb.linalg.krylov import negative_directions, prefers_krylov
from torchlb.stability.null_vector import CONSERVED, left_null_vector

__all__ = ["Certificate", "check_certificate"]
STRICTNESS = 1e-12
"""S passes if it is negative up to this share of the size of each of its rows; a hundred times their rounding."""
POSITIVE = 1e-10
"""Share of its area that π must reach at every point; what is below has no inflow but rounding."""
MAX_VECTORS = 128
FEED_SHARE = 0.2
PEAK = 0.02
"""Share of the largest feed of a direction from which on a row can be a peak of its own."""


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


def dissipation(
    matrix: sparse.csr_array, mass: Float[Tensor, " N"]
) -> tuple[float, Float[Tensor, "N k"]]:
    """How far S is from S ≤ 0, in units of the size of its rows, and what feeds it.

    A = εD − S, D the diagonal of the absolute sums of the terms in each row of S, is positive iff A = LDLᵀ has no
    negative pivot (Sylvester's law of inertia). So each point is judged by its own scale, which may be 1e6 times
    finer here than there. Each negative pivot d_j brings its own proof, v = L^{-T} e_j with vᵀAv = d_j < 0: what is
    already eliminated relaxes around j, so v lives where S fails. It is A^{-1} applied to d_j times column j of the
    factor, one solve. Row i feeds vᵀSv > 0 by π_i v_i (Lv)_i, which sums to it.

    Beyond `krylov.LARGEST_FACTORED` points the v are those that conjugate gradients come upon.

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
    vectors = negative_directions(shifted) if prefers_krylov(len(size)) else None
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


def raised_peaks(
    feed: Float[np.ndarray, "N k"], matrix: sparse.csr_array, share: float
) -> Float[np.ndarray, "N k"]:
    """The feed, every place where a direction fails made as high as its worst.

    On many points a direction is a sum of many local ones, by chance with different weights. Row i belongs to a peak if
    its feed is at least `share` of the largest in row and column i of the matrix, and the sum there is positive.
    """
    joined = sparse.csr_array(abs(matrix) + abs(matrix).T)
    joined.data[:] = 1.0
    raised = feed.copy()
    for column, own in zip(raised.T, feed.T, strict=True):
        positive = np.maximum(own, 0)
        around = np.maximum.reduceat(positive[joined.indices], joined.indptr[:-1])
        worst = own.max()
        peak = (own > PEAK * worst) & (own >= share * around) & (joined @ own > 0)
        column[peak] = worst
    return raised
