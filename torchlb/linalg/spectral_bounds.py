"""Where the spectrum of a stable operator lies: an interval, or an ellipse in the left half plane, that touches 0."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import sparse

TERMS, GROWN = 500, 4.0
"""Length of a trial, and the growth that ends it. Eigenvalues outside by 2 % of b grow that much in two trials."""
THINNEST, THICKEST, WIDER = 0.02, 0.9, 1.2
"""Shares b/a of the ellipses that are tried, and the factor between two of them at least."""
MARGIN, MARGIN_OF_HEIGHT = 1.02, 1.1
"""On R and on b, so that series longer than a trial stay bounded, too."""
PRODUCTS, FLOOR = 20, 1e-6
"""Products with |K| towards its first eigenvector, which bring its bound to within 25 %; least share of an entry."""


class Bounds(NamedTuple):
    """The spectrum lies in the ellipse around −radius/2 of half length radius/2 and half height `height`, in 1/ℓ².

    `height` is None where no ellipse holds it, as on an operator that is not stable; `radius` is then Gershgorin's.
    """

    radius: float
    height: float | None


def join_bounds(bounds: Sequence[Bounds]) -> Bounds:
    """Of a block-diagonal operator, from those of its blocks; all the ellipses touch 0.

    Near 0 an ellipse is a parabola of curvature R/2b², so that a longer one has to be higher too.

    >>> join_bounds([Bounds(1.0, 0.1), Bounds(4.0, 0.0)])
    Bounds(radius=4.0, height=0.2)
    """
    radius = max(each.radius for each in bounds)
    heights = [b and b * (radius / r) ** 0.5 for r, b in bounds]
    known = [b for b in heights if b is not None]
    return Bounds(radius, max(known) if len(known) == len(heights) else None)


def interval_bounds(stiffness: sparse.csr_array, mass: Float[np.ndarray, " N"]) -> Bounds:
    """Of −D⁻¹K, K positive semidefinite and D the diagonal mass: R = max_i (|K|x)_i / (D x)_i bounds it for any x > 0.

    So say Collatz and Wielandt of |K|, whose spectral radius is not below that of K.

    >>> path = sparse.csr_array([[1.0, -1.0], [-1.0, 1.0]])
    >>> interval_bounds(path, np.ones(2))
    Bounds(radius=2.0, height=0.0)
    """
    size, x, radius = abs(stiffness), np.ones(len(mass)), np.inf
    for _ in range(PRODUCTS):
        y = size @ x / mass
        radius = min(radius, float((y / x).max(initial=0.0)))
        x = np.sqrt(x) * np.sqrt(y)  # the mean keeps it from turning in circles
        x = np.maximum(x / (x.max(initial=0.0) or 1.0), FLOOR)
    return Bounds(radius, 0.0)


def spectral_bounds(matrix: sparse.csr_array, mass: Float[np.ndarray, " N"]) -> Bounds:
    """The smallest ellipse, to about a fifth in b, in which the vectors of the Chebyshev series stay bounded.

    That is what the series needs, and imaginary parts alone do not tell, for the ellipse is thin near 0. Where vectors
    grow they turn to the eigenvectors outside: these say how long and how high the next ellipse has to be, and the
    next trial starts from them, so that a handful of trials finds it, as short as power iteration at first.
    """
    scale = float(abs(matrix.diagonal()).max(initial=0.0))
    radius = MARGIN * scale
    if radius == 0 or not (mass > 0).all():
        return Bounds(float(abs(matrix).sum(axis=1).max(initial=0.0)), None if radius else 0.0)
    root = np.sqrt(mass)
    scaled = sparse.csr_array(sparse.diags_array(root) @ matrix @ sparse.diags_array(1 / root))
    skew = abs(scaled - scaled.T)
    share = THINNEST if skew.nnz and skew.max() > 1e-6 * scale else 0.0
    random = np.random.default_rng(0)
    start = random.standard_normal(len(mass))
    while share < THICKEST:
        grown = _grown(scaled, radius / 2, share, start)
        if grown is None:
            return Bounds(radius, MARGIN_OF_HEIGHT * share * radius / 2)
        basis = np.linalg.qr(grown)[0]
        found = np.linalg.eigvals(basis.T @ (scaled @ basis))
        longer = max(radius, MARGIN * float(np.abs(found).max()))
        if longer < 1.01 * radius:
            across = 1 - (1 + 2 * found.real / longer) ** 2
            needed = np.abs(found.imag) / (longer / 2 * np.sqrt(np.maximum(across, 1e-12)))
            share = max(
                THINNEST, WIDER * share, 1.05 * float(needed.max(where=across > 0, initial=0.0))
            )
        radius = longer
        start = grown[:, 1] / np.linalg.norm(grown[:, 1])
        start += random.standard_normal(len(mass)) / len(mass) ** 0.5
    return Bounds(float(abs(scaled).sum(axis=1).max()), None)


def _grown(
    matrix: sparse.csr_array, a: float, share: float, start: Float[np.ndarray, " N"]
) -> Float[np.ndarray, "N 2"] | None:
    """The last two r^{−k} T_k((L + a)/d) u, for the half axes a and a · share, once they have grown; None if never."""
    d, r = a * np.sqrt(1 - share**2), np.sqrt((1 + share) / (1 - share))
    doubled = matrix * (2 / (d * r))
    shift, damping = 2 * a / (d * r), r**-2
    before, v = start, (doubled @ start + shift * start) / 2
    limit = GROWN * np.linalg.norm(start)
    for _ in range(TERMS):
        if not np.linalg.norm(v) <= limit:
            return np.stack([before, v], axis=1)
        before, v = v, doubled @ v + (shift * v - damping * before)
    return None
