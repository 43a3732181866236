"""Left null vector π, πᵀL = −q, q the outflow: by sparse factors, or by Krylov methods for large matrices."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor

from torchlb.certified.krylov import backward_error, krylov_or_factors, null_density, rescaled
from torchlb.errors import StabilityError
from torchlb.linalg.factor import factorized
from torchlb.linalg.precision import ROOT_EPS

CONSERVED = 1e-11
"""Largest relative imbalance of inflow and outflow at a point with which π counts as a null vector."""
SOLVES = 8
"""Steps of inverse iteration."""


def left_null_vector(
    matrix: sparse.csr_array,
    areas: Float[Tensor, " N"],
    outflow: Float[np.ndarray, " N"] | None = None,
) -> tuple[Float[Tensor, " N"], np.ndarray, float]:
    """Left null vector π of L, πᵀL = −q, scaled on each component to the sum of the areas there.

    Inverse iteration uses the LU of (AL)ᵀ, A the areas, with a relative shift of each diagonal entry; beyond
    `krylov.LARGEST_FACTORED` points it is GMRES with multigrid of the low-order part. q ≥ 0 is the `outflow` of the
    points where L1 < 0, from `shared_outflow`, ℓ^{d−2}; None where L1 = 0.

    Returns π, the component of each point, and the componentwise backward error of π, of which rounding leaves at most
    `CONSERVED`. Raises StabilityError if there is no such π, as L is singular beyond its constants.
    """
    area = areas.numpy()
    lost = np.zeros(len(area)) if outflow is None else outflow
    count, component = csgraph.connected_components(matrix, directed=True, connection="weak")
    free = np.bincount(component, lost, minlength=count) == 0
    problem = (matrix, area, lost, component, free)
    density = krylov_or_factors(
        len(area), lambda: null_density(*problem), lambda: _factored_density(*problem)
    )
    if not np.isfinite(density).all():
        raise StabilityError(SINGULAR)
    error = backward_error(sparse.csr_array(matrix.T), area * density, lost)
    density = rescaled(density, area, component, np.ones_like(free))
    return torch.from_numpy(area * density), component, error


SINGULAR = (
    "certificate: the operator is singular beyond its constants; is `dim` the dimension of the manifold? "
    "Pass the right one, or certify=False to look at the raw operator"
)


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


def _factored_density(
    matrix: sparse.csr_array,
    area: Float[np.ndarray, " N"],
    lost: Float[np.ndarray, " N"],
    component: np.ndarray,
    free: Bool[np.ndarray, " C"],
) -> Float[np.ndarray, " N"]:
    """Solve the problem of `null_density` by inverse iteration."""
    weighted = sparse.diags_array(area) @ matrix
    diagonal = np.abs(weighted.diagonal())
    shift = ROOT_EPS * np.where(diagonal > 0, diagonal, 1.0)
    try:
        lu = factorized(sparse.csc_array((weighted - sparse.diags_array(shift)).T), 1e-2)
    except RuntimeError as error:
        raise StabilityError(SINGULAR) from error
    density = np.ones(len(area))
    for _ in range(SOLVES):
        density = -lu.solve(lost + shift * density)
        density = rescaled(density, area, component, free)
    return density
