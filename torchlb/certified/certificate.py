r"""The certificate of stability (`method.md`, section 5).

Let π be the left null vector, πᵀL = 0, one per connected component; with an outflow q of rows that sum to less than
zero, πᵀL = −q. If π > 0 and S = ½(ΠL + LᵀΠ) ≤ 0, then
d/dt |u|²_π = 2 uᵀSu ≤ 0 along u' = Lu: diffusion contracts in the norm of π, implicit schemes are stable at any step,
and Σ π_i u_i is conserved.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor

from torchlb.errors import StabilityError
from torchlb.linalg.factor import factorized
from torchlb.linalg.precision import ROOT_EPS, ROUNDING

CONSERVED = 1e-11
"""Largest relative imbalance of inflow and outflow at a point with which π counts as a null vector."""
SOLVES = 8
"""Steps of inverse iteration."""
DIRECTIONS = 50
"""Largest number of directions in which S is positive that are looked at in a round."""
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
    contracts, max_s, feed = False, np.nan, np.zeros((len(areas), 0))
    if smallest > 0 and error <= CONSERVED:
        contracts, max_s, feed = dissipation(matrix, mass)
    holds = smallest > ROOT_EPS and contracts
    return mass, Certificate(holds, smallest, max_s, components), feed


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
    feed = vectors * (weighted @ vectors)
    rayleigh = feed.sum(axis=0) / (size @ vectors**2)
    return len(negative) == 0, float(rayleigh.max(initial=0.0)), feed
