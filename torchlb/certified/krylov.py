r"""Null vector and sign of an operator too large to factor, by Krylov methods (`method.md`, section 5).

Both work on nearly symmetric matrices and lean on the same low-order matrix: the M-matrix W of the positive weights,
whose multigrid cycle B ≈ W⁻¹ makes their number of iterations almost independent of that of the points.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import TypeVar

import numpy as np
from jaxtyping import Bool, Float
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import LinearOperator, gmres

from torchlb.errors import warn
from torchlb.linalg.precision import (
    LARGEST_FACTORED,
    NEGLIGIBLE,
    ROOT_EPS,
    ROUNDING,
    ROUNDS,
    SINGLE,
    SMALL,
    STEPS,
)

Result = TypeVar("Result")
GROUND = 1e-4
"""Share of each diagonal entry that B is shifted by for the null vector: 100 iterations instead of 1,000."""
RESTART = 50
"""Iterations between restarts, and after the first negative curvature, to tell negative directions from each other."""


def prefers_krylov(size: int) -> bool:
    """Whether a matrix of so many points is too large to be factored first."""
    return size > LARGEST_FACTORED


def krylov_or_factors(
    size: int, krylov: Callable[[], Result | None], factors: Callable[[], Result]
) -> Result:
    """By sparse factors; beyond `LARGEST_FACTORED` points only if Krylov methods fail, which a warning says."""
    if prefers_krylov(size):
        found = krylov()
        if found is not None:
            return found
        warn(
            f"certificate: Krylov methods did not converge on {size} points, as where spacings change abruptly. Sparse "
            "factors take over, at many times the memory and time; certify=False does without"
        )
    return factors()


class LowOrder:
    """The M-matrix of a symmetric matrix: its positive entries as weights, and what is lost.

    Parameters
    ----------
    symmetric
        (N, N).
    loss
        Of each point, what the diagonal has beyond the weights of its row; negative numbers are rounding.
    """

    def __init__(self, symmetric: sparse.csr_array, loss: Float[np.ndarray, " N"]) -> None:
        upper = sparse.triu(symmetric, 1).tocoo()
        kept = upper.data > 0
        (row, col), weight = (index[kept] for index in upper.coords), upper.data[kept]
        self.size, self.row, self.col, self.weight = len(symmetric.diagonal()), row, col, weight
        diagonal = np.bincount(row, weight, self.size) + np.bincount(col, weight, self.size)
        own = np.abs(symmetric.diagonal())
        self.loss = np.maximum(loss, 0) + ROOT_EPS * np.where(own > 0, own, 1.0)
        both = (np.concatenate([row, col]), np.concatenate([col, row]))
        weights = sparse.csr_array((np.tile(weight, 2), both), shape=symmetric.shape)
        self.matrix = sparse.csr_array(sparse.diags_array(diagonal + self.loss) - weights)

    @cached_property
    def inverse(self) -> LinearOperator:
        """B: one symmetric V-cycle of multigrid by smoothed aggregation, the same in every run."""
        import pyamg

        hierarchy = pyamg.smoothed_aggregation_solver(
            sparse.csr_matrix(self.matrix),
            symmetry="symmetric",
            smooth=("jacobi", {"weighting": "local"}),
            improve_candidates=None,
            max_coarse=500,
            coarse_solver="cholesky",  # the default leaves out what is 1e-15 of the heaviest, and is blind to it
        )
        return hierarchy.aspreconditioner(cycle="V")

    def noise(self) -> Float[np.ndarray, " N"]:
        """A Gaussian vector of covariance W, one number for each edge and for each loss."""
        random = np.random.default_rng(0)
        edges = np.sqrt(self.weight) * random.standard_normal(len(self.weight))
        flow = np.bincount(self.row, edges, self.size) - np.bincount(self.col, edges, self.size)
        return flow + np.sqrt(self.loss) * random.standard_normal(self.size)


def rescaled(
    density: Float[np.ndarray, " N"],
    area: Float[np.ndarray, " N"],
    component: np.ndarray,
    free: Bool[np.ndarray, " C"],
) -> Float[np.ndarray, " N"]:
    """The density with a mean of one over the area of each free component, as 1 has: its own scale, its own sign."""
    total = np.where(free, np.bincount(component, area * density), np.bincount(component, area))
    return density * (np.bincount(component, area) / total)[component]


def backward_error(
    matrix: sparse.csr_array,
    vector: Float[np.ndarray, " N"],
    lost: Float[np.ndarray, " N"] | float = 0.0,
) -> float:
    """Componentwise backward error, the largest |Ax + lost| / |A||x| of a row: each is judged by its own scale."""
    terms = abs(matrix) @ np.abs(vector)
    left = np.abs(matrix @ vector + lost)
    return float(np.max(left / np.where(terms > 0, terms, 1.0)))


def null_density(
    matrix: sparse.csr_array,
    area: Float[np.ndarray, " N"],
    lost: Float[np.ndarray, " N"],
    component: np.ndarray,
    free: Bool[np.ndarray, " C"],
) -> Float[np.ndarray, " N"] | None:
    """x with (AL)ᵀx = −lost, A the areas, by GMRES with B; None if that does not converge.

    Parameters
    ----------
    matrix, area, lost
        L, the diagonal of A, the right-hand side.
    component
        Of each point.
    free
        Whether the scale of x on a component is, which `lost` does not fix there; see `rescaled`.
    """
    weighted = sparse.csr_array((sparse.diags_array(area) @ matrix).T)
    loss = -area * (matrix.sum(axis=1) + GROUND * matrix.diagonal())
    low = LowOrder(sparse.csr_array((weighted + weighted.T) / 2), loss)
    density = np.ones(len(area))
    for _ in range(ROUNDS):
        density = rescaled(density, area, component, free)
        residual = -lost - weighted @ density
        error = backward_error(weighted, density, lost)
        if error <= (SINGLE if density.min() < -SMALL else ROUNDING):
            return density
        if not np.isfinite(error):
            break
        wanted = max(NEGLIGIBLE, 0.01 * ROUNDING / error)
        step = gmres(weighted, residual, M=-low.inverse, rtol=wanted, restart=RESTART, maxiter=1)
        density = density + step[0]
    return None


def negative_directions(matrix: sparse.csr_array) -> Float[np.ndarray, "N k"] | None:
    """Directions v with vᵀAv < 0 of a symmetric A; k = 0 if it has none, None if that could not be told.

    Conjugate gradients on Ax = b, preconditioned by B, b Gaussian of covariance W ≈ B⁻¹. While every curvature is
    positive the residual is r(Â)b̂, Â = B^½AB^½ with the signs of A, b̂ = B^½b, and the polynomial r has r(0) = 1 and
    positive roots, the Ritz values. So |r(λ)| > 1 for λ < 0: the part of b̂ along a negative eigenvector never shrinks,
    and it is a Gaussian number of deviation about one. Where the residual falls to 1e-6 all the same, there is no such
    eigenvector, but for a chance of about 1e-6. Once a curvature is negative, `RESTART` iterations and a Rayleigh-Ritz
    step on all of them tell the directions from each other.
    """
    low = LowOrder(sparse.csr_array(-matrix), matrix.sum(axis=1))
    start = _without_constants(matrix, low.noise())
    basis: list[np.ndarray] = []
    negative, left, residual = None, RESTART, np.inf
    for z, p, curvature, residual in _conjugate_gradients(matrix, low.inverse, start):
        if not residual > NEGLIGIBLE or left == 0 or len(basis) == STEPS:
            break
        basis.append(z / residual)
        if negative is None and curvature < 0:
            negative = p
        left -= negative is not None
    if negative is None:
        return np.empty((low.size, 0)) if residual <= NEGLIGIBLE else None
    block = np.stack(basis, axis=1)
    values, vectors = np.linalg.eigh(block.T @ (matrix @ block))
    found = block @ vectors[:, values < 0]
    return found if found.shape[1] else negative[:, None]


def _without_constants(
    matrix: sparse.csr_array, vector: Float[np.ndarray, " N"]
) -> Float[np.ndarray, " N"]:
    """The vector less its mean on each component where constants are null vectors of the matrix."""
    _, component = csgraph.connected_components(matrix, directed=False)
    loss, whole = (np.bincount(component, v) for v in (matrix.sum(axis=1), matrix.diagonal()))
    mean = np.bincount(component, vector) / np.bincount(component)
    return vector - np.where(loss <= ROOT_EPS * whole, mean, 0.0)[component]


def _conjugate_gradients(
    matrix: sparse.csr_array, inverse: LinearOperator, right: Float[np.ndarray, " N"]
) -> Iterator[tuple[np.ndarray, np.ndarray, float, float]]:
    """Of each iteration z = B r, the direction p, pᵀAp, and the residual √(rᵀBr), NaN if B is not positive.

    It goes on past pᵀAp < 0, and ends where pᵀAp = 0.
    """
    r = right
    z = inverse.matvec(r)
    p, square = z, float(r @ z)
    while True:
        product = matrix @ p
        curvature = float(p @ product)
        yield z, p, curvature, math.sqrt(square) if square >= 0 else math.nan
        if curvature == 0:
            return
        r = r - square / curvature * product
        z = inverse.matvec(r)
        before, square = square, float(r @ z)
        p = z + square / before * p
