"""π with πᵀL = 0: by sparse factors, or by Krylov methods where those would be too large."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor

from torchlb.errors import StencilError
from torchlb.linalg.factor import factorized
from torchlb.linalg.krylov import imbalance, null_density, prefers_krylov, rescaled

__all__ = ["LOSS", "left_null_vector"]

LOSS = 1e-9
"""A row whose sum is above this share of its size loses heat; all others sum to zero up to rounding."""
CONSERVED = 1e-11
"""π is a null vector if what flows in and out of each point agrees to this share."""
SHIFT, SOLVES = 1e-9, 8
"""Share of each diagonal entry that inverse iteration is shifted by, and its number of steps."""


def left_null_vector(
    matrix: sparse.csr_array, areas: Float[Tensor, " N"]
) -> tuple[Float[Tensor, " N"], np.ndarray, float]:
    """π with πᵀL = 0, scaled on each component to the sum of the areas there.

    Inverse iteration with the LU of (AL)ᵀ, A the areas, each diagonal entry shifted by its own share. Beyond
    `krylov.LARGEST_FACTORED` points GMRES with multigrid of the low-order part. On a component with rows that lose heat
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
    if prefers_krylov(len(area)):
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
