"""Block Lanczos for the smallest eigenpairs of a symmetric pencil K u = λ M u (`method.md`, section 10)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy import linalg, sparse

from torchlb.errors import EigenbasisError
from torchlb.linalg.factor import Factor
from torchlb.linalg.precision import LOW, ROUNDS, SMALL

BLOCK = 16
"""Block size, the largest multiplicity that is surely found; 8 to 32 take about the same time."""
CHECK = 2
"""Blocks between two checks of the residuals."""

Inverse = Callable[[Float[np.ndarray, "N C"]], Float[np.ndarray, "N C"]]
Pairs = tuple[Float[np.ndarray, " k"], Float[np.ndarray, "N k"]]


class ShiftTooLarge(Exception):
    """The shift is far above the requested eigenvalues, the largest of which is at most `bound`."""

    def __init__(self, bound: float) -> None:
        super().__init__(f"eigenvalues up to {bound:.3g}")
        self.bound = bound


def inverse(matrix: sparse.csr_array) -> Inverse:
    """Product with A⁻¹, by a Cholesky factor."""
    factor = Factor(sparse.csr_array(matrix))
    return lambda b: factor.solve(torch.from_numpy(b)).numpy()


def lanczos_of_pair(
    stiffness: sparse.csr_array,
    mass_matrix: sparse.csr_array,
    k: int,
    shift: float,
    **settings: Any,
) -> tuple[Inverse, Pairs]:
    """Product with (K + shift M)⁻¹, and the eigenpairs by `lanczos`; the shift is lowered where necessary.

    Eigenvalues of a shape as narrow as a ribbon are those of a curve, far below the inverse of its area. The shift is
    lowered to them there, but not below the rounding of K.
    """
    rounding = float(np.finfo(float).eps) * float(stiffness.diagonal().max())
    least = rounding / float(mass_matrix.diagonal().max())
    while True:
        solve = inverse(sparse.csr_array(stiffness + shift * mass_matrix))
        try:
            return solve, lanczos(solve, mass_matrix, k, shift=shift, least=least, **settings)
        except ShiftTooLarge as error:
            shift = error.bound


def lanczos(
    solve: Inverse,
    mass_matrix: sparse.csr_array,
    k: int,
    *,
    shift: float,
    tolerance: float,
    more: int = 0,
    null: Float[np.ndarray, " N"] | None = None,
    least: float = np.inf,
) -> Pairs:
    """The k smallest eigenpairs except `null`, ascending and M-orthonormal, and `more` less accurate ones.

    The Krylov space of (K + shift M)⁻¹M, a product `solve` and M, from fixed pseudo-random vectors is orthogonalised in
    full, without restarts. The shift, in the unit of λ, is small and positive; `least` is the smallest one worth trying
    instead. The tolerance bounds the residuals in the M-norm, relative to 1/(λ + shift); the error of eigenvalues is
    about its square.

    Raises ShiftTooLarge if `LOW` times the shift serves better and `least` allows it; EigenbasisError if N vectors do
    not suffice, or `ROUNDS` times those requested.
    """
    size, count, first = len(mass_matrix.diagonal()), k + more, int(null is not None)
    generator, kind = np.random.default_rng(0), np.float32 if tolerance > SMALL else np.float64
    basis, dual = (np.empty((min(4 * count + 4 * BLOCK, size), size)) for _ in range(2))  # V, MV
    if null is not None:
        basis[0], dual[0] = null, mass_matrix @ null
    h, end, look = np.zeros((first, first)), first, first + 2 * count
    z = generator.standard_normal((BLOCK, size))
    while end + BLOCK <= min(size, ROUNDS * (count + BLOCK)):
        coupling = _orthogonalise(z, basis[:end], dual[:end], 1 if tolerance > SMALL else 2)
        h[:, max(end - BLOCK, first) : end] = coupling.T if end > first else 0.0
        try:
            z, mz, r = _orthonormal(z, mass_matrix)
        except np.linalg.LinAlgError:  # the space is invariant: go on from new vectors
            z = generator.standard_normal((BLOCK, size))
            _orthogonalise(z, basis[:end], dual[:end], 2)
            (z, mz, _), r = _orthonormal(z, mass_matrix), np.zeros((BLOCK, BLOCK))
        if end >= look:
            theta, y = linalg.eigh(np.triu(h[first:, first:]), lower=False)
            theta, y = theta[: -count - 1 : -1], y[:, : -count - 1 : -1]
            if (bound := max(1 / theta[k - 1] - shift, least)) < LOW * shift:
                raise ShiftTooLarge(bound)
            if (np.linalg.norm(r @ y[-BLOCK:, :k], axis=0) <= tolerance * theta[:k]).all():
                found = basis[first:end].astype(kind, copy=False), y.astype(kind, copy=False)
                return 1 / theta - shift, found[0].T @ found[1]
            look = end + CHECK * BLOCK
        if end + BLOCK > len(basis):
            basis, dual = (np.concatenate([x, np.empty_like(x)]) for x in (basis, dual))
        basis[end : end + BLOCK], dual[end : end + BLOCK] = z, mz
        h, end = np.pad(h, (0, BLOCK)), end + BLOCK
        z = np.ascontiguousarray(solve(np.ascontiguousarray(mz.T)).T)
    raise EigenbasisError(
        f"eigenbasis: block Lanczos did not find {k} pairs of {size} points to {tolerance:.1g}; ask for fewer, or "
        "for a medium of less contrast"
    )


def _orthogonalise(z: np.ndarray, basis: np.ndarray, dual: np.ndarray, passes: int) -> np.ndarray:
    """Orthogonalise the rows of z against the basis, in place; return the coefficients."""
    total = np.zeros((len(z), len(basis)))
    for _ in range(passes):
        coefficients = z @ dual.T
        z -= coefficients @ basis
        total += coefficients
    return total


def _orthonormal(
    z: np.ndarray, mass_matrix: sparse.csr_array
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """M-orthonormal rows, their products with M, and R with z = Rᵀ × rows; LinAlgError if z is dependent."""
    mz = np.ascontiguousarray((mass_matrix @ np.ascontiguousarray(z.T)).T)
    lower = np.linalg.cholesky(z @ mz.T)
    back = linalg.inv(lower)
    return back @ z, back @ mz, lower.T
