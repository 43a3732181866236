r"""Eigenpairs of a symmetric weak pair K u = λ M u (`method.md`, section 10).

Block Lanczos for the P1 pair (K₁, M₁), whose factor is 20 times sparser than that of K; Rayleigh–Ritz in (K, M); then
Jacobi–Davidson sweeps. A sweep corrects each eigenvector u by some conjugate-gradient steps for (K − λM)w = Ku − λMu on
the complement of the known vectors. Rayleigh–Ritz follows: first among all u − w, mostly enough, or among all u and w
where an error is large; in later sweeps among the u and the w that are needed. The steps, taken in float32, give only
directions, so that no digits are lost. Their preconditioner is a two-grid cycle, Chebyshev smoothing in K around a
solve with that factor.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import linalg, sparse
from scipy.sparse import csgraph
from torch import Tensor
from torch.nn.functional import pad

from torchlb.errors import EigenbasisError, warn
from torchlb.geometry.thresholds import FACTOR
from torchlb.linalg.conjugate_gradients import Linear
from torchlb.linalg.lanczos import BLOCK, lanczos_of_pair
from torchlb.linalg.precision import (
    DENSE,
    EPS,
    LARGEST_FACTORED,
    ROOT_EPS,
    ROUNDING,
    ROUNDS,
    SMALL,
    TINY,
)
from torchlb.linalg.sparse import multiply, on_device, on_one_pattern
from torchlb.linalg.two_grid import absolute_row_sums, two_grid, without_small_entries
from torchlb.spectral.components import constants
from torchlb.spectral.eigenbasis import Eigenbasis

SHARE = 9
"""If more than a ninth of the spectrum is wanted, a dense solve is as fast."""
SHIFT = 10.0
"""Shift of the factor times the size of a component: about half of its first eigenvalue, were it a disk."""
START = 0.003
"""Relative residual of the eigenpairs of the P1 pair, whose distance from (K, M) is of that order."""
LONGEST = 24
"""Maximal number of conjugate-gradient steps in a sweep."""
ASTRAY = 0.5
"""Estimated error above which a sweep takes one step only, and the first one keeps the old vectors beside the new."""
SAFETY = 4.0
"""Factor on the estimated errors, which are too small where K is softer than its preconditioner."""


Sparse = sparse.csr_array
Pair = tuple[Sparse, Sparse]
Blocks = tuple[Tensor, ...]  # U, KU, MU


class _Part(NamedTuple):
    """One component, without its fixed points."""

    points: np.ndarray
    stiffness: Sparse
    mass_matrix: Sparse
    linear: Pair | None  # K₁, M₁
    conserving: bool  # constants have the eigenvalue 0


def pencil_eigenbasis(
    stiffness: Sparse,
    mass_matrix: Sparse,
    mass: Float[Tensor, " N"],
    k: int,
    *,
    dim: int = 2,
    linear: Pair | None = None,
    fixed: Bool[np.ndarray, " N"] | None = None,
    losing: Bool[np.ndarray, " N"] | None = None,
    tolerance: float | None = None,
) -> Eigenbasis:
    """The min(k, N) smallest eigenpairs of K u = λ M u, and more where a group of equal nonzero ones would be split.

    Parameters
    ----------
    stiffness, mass_matrix, mass
        K, positive semidefinite, M, positive definite, (N, N), and the diagonal mass, in float64, on the device of the
        solve.
    dim
        d, from which the unit of a length follows: K is in ℓ^{d−2}, M in ℓ^d.
    linear
        K₁ and M₁ of the same points, spectrally close, with fewer entries. None if they are (K, M).
    fixed
        Points where functions vanish (Dirichlet).
    losing
        The fixed points, and points where K1 > 0 (Robin); on components without any K1 = 0. By default `fixed`.
    tolerance
        Bound on the estimated relative error of every eigenvalue, 1.5e-8 k² by default; closer ones are not separated.

    Raises EigenbasisError where that is not reached, K has a negative eigenvalue, or M a diagonal that is not positive.

    >>> path = sparse.csr_array([[1.0, -1.0], [-1.0, 1.0]])
    >>> pencil_eigenbasis(path, sparse.eye_array(2).tocsr(), torch.ones(2), 2).eigenvalues
    tensor([0., 2.], dtype=torch.float64)
    """
    fixed = np.zeros(len(mass), dtype=bool) if fixed is None else fixed
    losing = fixed if losing is None else losing
    if not (mass_matrix.diagonal() > 0).all():
        raise EigenbasisError(
            "eigenbasis: the mass matrix is not positive; a shape so small that areas are zero in float32 has to be "
            "scaled, or kept in float64"
        )
    # A power of two as the unit of length: float32 holds the entries, and scaling rounds nothing.
    length = 2.0 ** round(float(np.log2(abs(mass_matrix).sum())) / dim)
    units = length ** (dim - 2), length**dim
    whole = _narrow(stiffness, units[0]), _narrow(mass_matrix, units[1])
    near = linear and (_narrow(linear[0], units[0]), _narrow(linear[1], units[1]))
    component, pattern = _components(whole, near)
    areas = np.bincount(component, whole[1].sum(axis=1))
    areas[component[losing]] = 0.0
    zeros = min(int((areas > 0).sum()), k)
    if linear is None:
        tolerance = EPS
    elif tolerance is None:
        tolerance = min(ROOT_EPS * k**2, SMALL)
    parts = _parts(whole, near, fixed, component, pattern, areas) if zeros < k else []
    found = [_pairs(part, k, tolerance, mass.device) for part in parts]
    null = constants(component, areas, zeros)
    return _merged(parts, found, (null, whole[1] @ null), mass, k, tolerance, (length**2, units[1]))


def _components(whole: Pair, near: Pair | None) -> tuple[np.ndarray, Sparse]:
    """The connected component of every point under both matrices, and the pattern of the P1 pair."""
    pattern = _joined(*(near or whole))
    count, component = csgraph.connected_components(pattern, directed=False)
    if near and count > 1:  # fits may connect components
        component = csgraph.connected_components(_joined(*whole), directed=False)[1]
    return component, pattern


def _parts(
    whole: Pair,
    near: Pair | None,
    fixed: np.ndarray,
    component: np.ndarray,
    pattern: Sparse,
    areas: np.ndarray,
) -> list[_Part]:
    """The components without fixed points, numbered by reverse Cuthill–McKee, which halves the time of products."""
    order = csgraph.reverse_cuthill_mckee(pattern, symmetric_mode=True)
    order = order[np.argsort(component[order], kind="stable")]
    parts = []
    for points in np.split(order, np.cumsum(np.bincount(component))[:-1]):
        free = points[~fixed[points]]
        if len(free):
            linear = None if near is None else _renumbered(near, free)
            k, m = _renumbered(whole, free)
            parts.append(_Part(free, k, m, linear, bool(areas[component[free[0]]] > 0)))
    return parts


def _renumbered(pair: Pair, order: np.ndarray) -> Pair:
    """Symmetric matrices with these rows and columns, in this order."""
    if not on_one_pattern(*pair):
        one, other = (sparse.csr_array(matrix[order].T)[order] for matrix in pair)
        return one, other
    number = np.arange(pair[0].nnz, dtype=np.int32)
    places = sparse.csr_array((number, pair[0].indices, pair[0].indptr), pair[0].shape)
    places = sparse.csr_array(places[order].T)[order]  # with ascending columns
    pattern = places.indices, places.indptr
    one, other = (sparse.csr_array((m.data[places.data], *pattern), places.shape) for m in pair)
    return one, other


def _narrow(matrix: Sparse, unit: float) -> Sparse:
    """A matrix with 32-bit indices, in float64, divided by a unit."""
    ends = (part.astype(np.int32, copy=False) for part in (matrix.indices, matrix.indptr))
    return sparse.csr_array((np.divide(matrix.data, unit, dtype=float), *ends), shape=matrix.shape)


def _joined(one: Sparse, other: Sparse) -> Sparse:
    """|A| + |B|, without zeros; in a tenth of the time for a common pattern."""
    if on_one_pattern(one, other):
        data = abs(one.data) + abs(other.data)
        if data.all():
            return sparse.csr_array((data, one.indices, one.indptr), shape=one.shape)
    return sparse.csr_array(abs(one) + abs(other))


def _pairs(part: _Part, k: int, tolerance: float, device: torch.device) -> tuple[Tensor, ...]:
    """Eigenvalues of a component without 0, relative errors, U and MU: the k smallest, with groups whole, or all."""
    size, zero = len(part.points), int(part.conserving)
    count = min(k + BLOCK, size)
    mass = partial(multiply, *on_device(part.mass_matrix, device))
    if size <= max(DENSE, SHARE * count):
        dense = (part.stiffness.toarray(), part.mass_matrix.toarray())
        found = linalg.eigh(*dense, subset_by_index=(0, count - 1))
        values, u = (torch.from_numpy(x).to(device) for x in found)
        errors, mu = torch.zeros_like(values), mass(u)
    else:
        k1, m1 = part.linear or (part.stiffness, part.mass_matrix)
        null = None
        if zero:
            null = torch.full((size,), float(m1.sum()) ** -0.5, dtype=torch.float64, device=device)
        accuracy = ROOT_EPS if part.linear is None else START
        settings = {"tolerance": accuracy, "more": BLOCK, "null": null, "device": device}
        solve, (values, u) = lanczos_of_pair(
            k1, m1, k - zero, SHIFT / float(abs(m1).sum()), **settings
        )
        if null is not None:
            values, u = pad(values, (1, 0)), torch.cat([null.to(u)[:, None], u], dim=1)
        if part.linear is None:
            errors, mu = torch.full_like(values, tolerance), mass(u)
        else:
            swept = _swept(part, u, k, solve, tolerance)
            if swept is None:
                warn(
                    f"eigenbasis: after {ROUNDS} sweeps some of {k} eigenvalues are not accurate to {tolerance:.1g}, "
                    "as where spacings change abruptly. Factors of the whole pair take over, at many times the memory "
                    "and time; a larger `tolerance` does without"
                )
                return _pairs(part._replace(linear=None), k, EPS, device)
            values, errors, u, mu = swept
    values[:zero] = 0.0
    if bool((values[zero:] <= 0).any()):
        raise EigenbasisError(
            f"eigenbasis: the stiffness has the eigenvalue {float(values[zero:].min()):.3g} on a component of {size} "
            "points, where it should be positive"
        )
    keep = _closed(values, k, tolerance)
    return values[zero:keep], errors[zero:keep], u[:, zero:keep], mu[:, zero:keep]


def _closed(values: Tensor, k: int, tolerance: float) -> int:
    """The least number of pairs, k or more, that splits no group of equal eigenvalues; all if there is none."""
    gaps = pad(values.diff() > max(ROOT_EPS, tolerance) * values[1:], (0, 1), value=True)
    gaps[: min(k, len(values)) - 1] = False
    return int(gaps.int().argmax()) + 1


def _swept(
    part: _Part, u: Tensor, k: int, solve: Linear, tolerance: float
) -> tuple[Tensor, ...] | None:
    """Sweep from the P1 eigenvectors until the first k eigenvalues are accurate; None if that takes too many sweeps."""
    assert part.linear is not None
    matrices = [on_device(m, u.device) for m in (part.stiffness, part.mass_matrix, part.linear[1])]
    whole = [partial(multiply, *matrix) for matrix in matrices[:2]]
    *single, on_linear_mass = (partial(multiply, c, i, v.float()) for c, i, v in matrices)
    rough = without_small_entries(*matrices[0])
    sums = absolute_row_sums(rough[0], rough[2])
    cycle = two_grid(partial(multiply, *rough), sums, solve)

    def shifted(p: Tensor, shifts: Tensor) -> Tensor:
        return single[0](p).sub_(on_linear_mass(p).mul_(shifts))

    count, zero = u.shape[1], int(part.conserving)
    u = u.float().contiguous()
    values, known = _ritz((u, *(on(u) for on in single)), count)
    for sweep in range(ROUNDS + 1):
        keep = _closed(values, k, tolerance) if sweep else count
        (u, ku, mu), shifts = known, values[:keep].to(known[0])
        residual = torch.addcmul(ku[:, :keep], mu[:, :keep], shifts, value=-1)
        size = residual.norm(dim=0).clamp_min(TINY)
        r = (residual / size).float()
        z = cycle(r)
        scale = SAFETY * size.double() ** 2 / values[:keep].abs().clamp_min(TINY)
        errors = scale * _dots(r, z).abs()
        errors[:zero] = 0.0
        if sweep and float(errors.max()) <= tolerance:
            return values[:keep], errors, u[:, :keep], mu[:, :keep]
        coarse = float(errors[:k].max()) > ASTRAY
        active = (errors > tolerance if sweep else torch.ones_like(errors)).nonzero()[:, 0]
        # each step leaves a quarter of the energy or less, so the last one takes off FACTOR times what is left
        enough = FACTOR * (SMALL * errors).clamp_min(tolerance) / scale.clamp_min(TINY)
        right = [x.float().index_select(-1, active) for x in (r, z, shifts, enough)]
        small = u.float(), mu.float()
        w = _correction(shifted, cycle, small, right, 1 if coarse else LONGEST).double()
        if sweep:
            w -= u @ (mu.T @ w)
        elif coarse:
            w = torch.cat([u, w], dim=1)
        else:
            w = u - w * size
        new = (w, *(on(w) for on in whole))
        if sweep:
            new = tuple(torch.cat(both, dim=1) for both in zip(known, new, strict=True))
        values, known = _ritz(new, count)
    if len(part.points) > LARGEST_FACTORED:
        raise EigenbasisError(
            f"eigenbasis: after {ROUNDS} sweeps the estimated relative error of some of {k} eigenvalues is above "
            f"{tolerance:.1g}; ask for a larger tolerance"
        )
    return None


def _correction(
    shifted: Callable[[Tensor, Tensor], Tensor],
    cycle: Linear,
    known: tuple[Tensor, Tensor],
    right: list[Tensor],
    steps: int,
) -> Tensor:
    """Conjugate gradients for every column of (K − λM)w = r, M-orthogonal to U; of [U, MU] and [r, cycle(r), λ, ε].

    A column ends with the step that reduces its energy by less than ε, or with the last step.
    """
    (u, mu), (r, z, shifts, enough) = known, right
    w, p, square = torch.zeros_like(r), torch.zeros_like(r), torch.ones_like(enough)
    at, found = torch.arange(r.shape[1], device=r.device), []
    for step in range(steps):
        z = z - u @ (mu.T @ z)
        before, square = square, _dots(r, z).clamp_min(0)  # negative only by rounding
        p = torch.addcmul(z, p, torch.where(before > 0, square / before, 0.0))
        product = shifted(p, shifts)
        curvature = _dots(p, product)
        length = torch.where(curvature > 0, square / curvature, 0.0)
        w.addcmul_(p, length)
        goes_on = (length * square > enough) & (step < steps - 1)
        ends, stays = (where.nonzero()[:, 0] for where in (~goes_on, goes_on))
        if len(ends):
            found.append((at[ends], w.index_select(1, ends)))
            parts = r, product, length, w, p, at, square, shifts, enough
            r, product, length, w, p, at, square, shifts, enough = (
                x.index_select(-1, stays) for x in parts
            )
        if len(stays) == 0:
            break
        r = torch.addcmul(r, product, length, value=-1)
        z = cycle(r)
    order, w = (torch.cat(parts, -1) for parts in zip(*found, strict=True))
    return w.index_select(1, order.argsort())


def _dots(x: Tensor, y: Tensor) -> Tensor:
    return torch.linalg.vecdot(x, y, dim=0)


def _ritz(space: Blocks, count: int) -> tuple[Tensor, Blocks]:
    """Rayleigh–Ritz on the span of U, from (U, KU, MU): the smallest values, ascending, and these for their vectors."""
    a, b = ((space[0].T @ x).double() for x in space[1:])
    scale = torch.where(b.diagonal() > 0, b.diagonal(), np.inf) ** -0.5  # drop vectors without mass
    squares, q = torch.linalg.eigh(b * scale * scale[:, None])
    q = (scale[:, None] * q / squares.clamp_min(TINY).sqrt())[:, squares > ROUNDING]
    values, y = torch.linalg.eigh(q.T @ a @ q)
    y = (q @ y[:, :count]).to(space[0])
    u, ku, mu = (x @ y for x in space)
    return values[:count], (u, ku, mu)


def _merged(
    parts: list[_Part],
    found: list[tuple[Tensor, ...]],
    null: tuple[np.ndarray, np.ndarray],
    mass: Tensor,
    k: int,
    tolerance: float,
    units: tuple[float, float],
) -> Eigenbasis:
    """Constants Φ and MΦ followed by the other pairs of the components, ascending, in units of `mass`."""
    zeros = null[0].shape[1]
    start = mass.new_zeros(zeros)
    values, errors = (torch.cat([start, *(f[i] for f in found)]) for i in (0, 1))
    order = values.sort(stable=True).indices
    values = values[order]
    keep = _closed(values, k, tolerance) if len(values) else 0
    values, errors, order = values[:keep], errors[order[:keep]], order[:keep]
    phi, left = mass.new_zeros(2, len(mass), keep)
    phi[:, :zeros], left[:, :zeros] = (torch.from_numpy(x).to(mass) for x in null)
    at = zeros
    for part, (own, _, *vectors) in zip(parts, found, strict=True):
        points = torch.from_numpy(part.points).to(mass.device)
        here = ((order >= at) & (order < at + len(own))).nonzero()[:, 0]
        for whole, columns in zip((phi, left), vectors, strict=True):
            whole[points[:, None], here] = columns[:, order[here] - at].to(whole)
        at += len(own)
    square, unit = units  # of 1/λ, and of M
    signs = 1 - 2 * (-phi.amin(0) > phi.amax(0)).to(phi)  # the largest entry is positive
    phi *= signs / unit**0.5
    left *= signs * unit**0.5
    return Eigenbasis(values / square, phi, mass, left, relative_errors=errors)
