r"""Null vector and definiteness of an operator too large to factor, by Krylov methods (`method.md`, section 5).

Both act on nearly symmetric matrices and share a preconditioner: a multigrid cycle B ≈ W⁻¹ for the M-matrix W of the
positive weights, which makes the number of iterations almost independent of that of the points.
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
"""Shift of W for the null vector, relative to each diagonal entry: 100 iterations instead of 1,000."""
RESTART = 50
"""Iterations between restarts, and after the first negative curvature, to separate negative directions."""


def prefers_krylov(size: int) -> bool:
    """Whether a matrix of `size` points is too large to be factored first."""
    return size > LARGEST_FACTORED


def krylov_or_factors(
    size: int, krylov: Callable[[], Result | None], factors: Callable[[], Result]
) -> Result:
    """Solve by sparse factors; beyond `LARGEST_FACTORED` points only if Krylov methods fail, with a warning."""
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
    """M-matrix of a symmetric matrix: its positive off-diagonal entries as weights, and a loss at each point.

    The loss is the excess of the diagonal entry over the weights of its row; negative values are rounding.
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
        """B: one symmetric V-cycle of smoothed-aggregation multigrid, the same in every run."""
        import pyamg

        hierarchy = pyamg.smoothed_aggregation_solver(
            sparse.csr_matrix(self.matrix),
            symmetry="symmetric",
            smooth=("jacobi", {"weighting": "local"}),
            improve_candidates=None,
            max_coarse=500,
            coarse_solver="cholesky",  # the default drops modes at 1e-15 of the largest
        )
        return hierarchy.aspreconditioner(cycle="V")

    def noise(self) -> Float[np.ndarray, " N"]:
        """Gaussian vector of covariance W, from one random number per edge and per loss."""
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
    """Density scaled to a mean of one over the area of each free component, which fixes its scale and sign."""
    total = np.where(free, np.bincount(component, area * density), np.bincount(component, area))
    return density * (np.bincount(component, area) / total)[component]


def backward_error(
    matrix: sparse.csr_array,
    vector: Float[np.ndarray, " N"],
    lost: Float[np.ndarray, " N"] | float = 0.0,
) -> float:
    """Componentwise backward error: the largest |Ax + lost| / |A||x| of all rows."""
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
    """Solve (AL)ᵀx = −lost, A the areas, by GMRES with B; None if that does not converge.

    On `free` components the scale of x is not fixed by `lost`, see `rescaled`.
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
    """Directions v with vᵀAv < 0 of a symmetric A; k = 0 if it has none, None if undecided.

    Conjugate gradients solve Ax = b, preconditioned by B, b Gaussian of covariance W ≈ B⁻¹. While every curvature is
    positive the residual is r(Â)b̂, Â = B^½AB^½ with the signs of A, b̂ = B^½b, and the polynomial r has r(0) = 1 and
    positive roots, the Ritz values. So |r(λ)| > 1 for λ < 0: the component of b̂ along a negative eigenvector never
    shrinks, and it is Gaussian of deviation about one. Where the residual falls to 1e-6 all the same, there is no such
    eigenvector, except with probability about 1e-6. Once a curvature is negative, `RESTART` iterations and a
    Rayleigh–Ritz step on all of them separate the directions.
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
    """Subtract from the vector its mean on each component where constants are null vectors of the matrix."""
    _, component = csgraph.connected_components(matrix, directed=False)
    loss, whole = (np.bincount(component, v) for v in (matrix.sum(axis=1), matrix.diagonal()))
    mean = np.bincount(component, vector) / np.bincount(component)
    return vector - np.where(loss <= ROOT_EPS * whole, mean, 0.0)[component]


def _conjugate_gradients(
    matrix: sparse.csr_array, inverse: LinearOperator, right: Float[np.ndarray, " N"]
) -> Iterator[tuple[np.ndarray, np.ndarray, float, float]]:
    """Yield z = B r, the direction p, pᵀAp, and the residual √(rᵀBr), NaN if B is not positive, at each iteration.

    Iterations continue past pᵀAp < 0, and end where pᵀAp = 0.
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
