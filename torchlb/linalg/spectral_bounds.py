"""Where the spectrum of a stable operator lies: an ellipse in the left half plane that touches 0."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy import sparse
from scipy.sparse.linalg import ArpackNoConvergence, eigs

__all__ = ["join_extents", "spectral_extent"]


def join_extents(extents: Sequence[tuple[float, float]]) -> tuple[float, float]:
    """Length R and half height b of an ellipse around −R/2 that holds those of the shapes; all touch 0.

    Near 0 an ellipse is a parabola of curvature R/2b², so that a longer one has to be higher too.

    >>> join_extents([(1.0, 0.1), (4.0, 0.0)])
    (4.0, 0.2)
    """
    radius = max(r for r, _ in extents)
    return radius, max(b * (radius / r) ** 0.5 for r, b in extents)


MARGIN = 1.02
"""On the spectral radius, which is known to a per cent."""
THINNEST, THICKEST, GROWTH = 0.02, 0.9, 1.25
"""Heights of the ellipse that are tried, in units of its half length."""
TRIAL_TERMS, LARGEST_VECTOR = 1000, 2.0


def spectral_extent(matrix: sparse.csr_array, mass: Float[np.ndarray, " N"]) -> tuple[float, float]:
    """(R, b): the spectrum of Δ lies in the ellipse of half axes R/2 and b around −R/2, 1/ℓ².

    R is the spectral radius. b is the smallest, up to a quarter, with which the vectors of the Chebyshev series stay
    bounded: that is what is needed, and imaginary parts alone do not tell, for the ellipse is thin near 0.
    """
    root = np.sqrt(mass)
    scaled = sparse.csr_array(sparse.diags_array(root) @ matrix @ sparse.diags_array(1 / root))
    radius = MARGIN * _spectral_radius(scaled)
    skew = sparse.csr_array(scaled - scaled.T)
    share = 0.0
    if skew.nnz and abs(skew).max() > 1e-6 * radius:
        share = THINNEST
        while share < THICKEST and not _stays_bounded(scaled, radius / 2, share):
            share = min(GROWTH * share, THICKEST)
    return radius, share * radius / 2


def _spectral_radius(matrix: sparse.csr_array) -> float:
    """Largest modulus of an eigenvalue, to a per cent; a bound (of Gershgorin) if it is not found."""
    size = len(matrix.indptr) - 1
    if size <= 400:
        return float(np.abs(np.linalg.eigvals(matrix.toarray())).max())
    start = np.random.default_rng(0).standard_normal(size)
    options: Any = {"which": "LM", "tol": 1e-3, "v0": start, "return_eigenvectors": False}
    try:
        return float(np.abs(eigs(matrix, 4, ncv=40, maxiter=60, **options)).max())
    except ArpackNoConvergence:
        return float(abs(matrix).sum(axis=1).max())


def _stays_bounded(matrix: sparse.csr_array, a: float, share: float) -> bool:
    """Whether r^{−k} T_k((L + a)/d) u does not grow from two random u, for the half axes a and a · share."""
    d, r = a * np.sqrt(1 - share**2), np.sqrt((1 + share) / (1 - share))
    before = np.random.default_rng(0).standard_normal((len(matrix.indptr) - 1, 2))
    limit = np.linalg.norm(before) * LARGEST_VECTOR
    v = (matrix @ before + a * before) / (d * r)
    for _ in range(TRIAL_TERMS):
        before, v = v, (matrix @ v + a * v) * (2 / (d * r)) - before / r**2
        if not np.linalg.norm(v) <= limit:
            return False
    return True
