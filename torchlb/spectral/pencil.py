"""Eigenpairs of a symmetric weak pair K u = λ M u (`method.md`, section 10), component by component.

Block Lanczos for the P1 pair (K₁, M₁), whose factor is 20 times sparser than that of K; Rayleigh–Ritz in (K, M); then
Jacobi–Davidson sweeps (`sweeps`). All run on the device of the operator; small components are solved densely.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import linalg, sparse
from scipy.sparse import csgraph
from torch import Tensor
from torch.nn.functional import pad

from torchlb.errors import EigenbasisError, warn
from torchlb.linalg.lanczos import BLOCK, lanczos_of_pair
from torchlb.linalg.precision import DENSE, EPS, ROOT_EPS, ROUNDS, SMALL
from torchlb.linalg.sparse import multiply, on_device
from torchlb.spectral.eigenbasis import Eigenbasis
from torchlb.spectral.sweeps import CHUNK, closed, swept

SHARE = 9
"""If more than a ninth of the spectrum is wanted, a dense solve is as fast."""
SHIFT = 10.0
"""Shift of the factor times the size of a component: about half of its first eigenvalue, were it a disk."""
START = 0.003
"""Relative residual of the eigenpairs of the P1 pair, whose distance from (K, M) is of that order."""

Sparse = sparse.csr_array
Pair = tuple[Sparse, Sparse]


class _Part(NamedTuple):
    """One component, without its fixed points."""

    points: np.ndarray
    matrices: list[Sparse]  # K, M; then K₁, M₁, if they differ
    zero: int  # 1 where constants have the eigenvalue 0


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

    K, in ℓ^{`dim`−2}, is positive semidefinite, and M, in ℓ^`dim`, positive definite; the solve is on the device of the
    diagonal mass. `linear` are K₁ and M₁ of the same points, spectrally close, with fewer entries, None if they are
    (K, M). Functions vanish at points that are `fixed` (Dirichlet), constants lose at the points `losing`, the fixed
    ones by default, and those where K1 > 0 (Robin). The tolerance bounds the estimated relative error of every
    eigenvalue, None for 1.5e-8 k²; closer ones are not separated.

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
    given = stiffness, mass_matrix, *(linear or ())
    matrices = [_narrow(m, unit) for m, unit in zip(given, 2 * units, strict=False)]
    k1, m1 = matrices[-2:]  # connected where (K, M) is, with fewer entries
    pattern = sparse.csr_array(abs(k1) + abs(m1))  # without those that are zero
    component = csgraph.connected_components(pattern, directed=False)[1]
    areas = np.bincount(component, matrices[1].sum(axis=1))
    areas[component[losing]] = 0.0
    zeros = min(int((areas > 0).sum()), k)
    if linear is None:
        tolerance = EPS
    elif tolerance is None:
        tolerance = min(ROOT_EPS * k**2, SMALL)
    parts = _parts(matrices, pattern, fixed, component, areas) if zeros < k else []
    found = [_pairs(part, k, tolerance, mass.device) for part in parts]
    null = constants(component, areas, zeros)
    return _merged(
        parts, found, (null, matrices[1] @ null), mass, k, tolerance, (length**2, units[1])
    )


def constants(
    component: np.ndarray, areas: Float[np.ndarray, " P"], k: int
) -> Float[np.ndarray, "N k"]:
    """The first k of orthonormal functions that are constant on every component; the first is constant everywhere.

    They vanish on components whose area is given as 0; k is at most the number of the others.

    >>> constants(np.array([0, 0, 1]), np.array([2.0, 2.0]), 2)
    array([[ 0.5,  0.5],
           [ 0.5,  0.5],
           [ 0.5, -0.5]])
    """
    on = areas > 0
    root, values = np.sqrt(areas[on]), np.zeros((len(areas), k))
    if k:
        q = np.linalg.qr(np.column_stack([root, np.eye(len(root), k - 1)]))[0]
        values[on] = q * np.sign(q[0, 0]) / root[:, None]
        values[on, 0] = 1 / linalg.norm(root)
    return values[component]


def _parts(
    matrices: list[Sparse],
    pattern: Sparse,
    fixed: np.ndarray,
    component: np.ndarray,
    areas: np.ndarray,
) -> list[_Part]:
    """The components without fixed points, numbered by reverse Cuthill–McKee, which halves the time of products."""
    order = csgraph.reverse_cuthill_mckee(pattern, symmetric_mode=True)
    order = order[np.argsort(component[order], kind="stable")]
    parts = []
    for points in np.split(order, np.cumsum(np.bincount(component))[:-1]):
        free = points[~fixed[points]]
        if len(free):
            own = [sparse.csr_array(m[free].T)[free] for m in matrices]  # symmetric
            parts.append(_Part(free, own, int(areas[component[free[0]]] > 0)))
    return parts


def _narrow(matrix: Sparse, unit: float) -> Sparse:
    """A matrix with 32-bit indices, in float64, divided by a unit."""
    # copies, since SciPy sorts in place
    ends = (part.astype(np.int32) for part in (matrix.indices, matrix.indptr))
    return sparse.csr_array((np.divide(matrix.data, unit, dtype=float), *ends), shape=matrix.shape)


def _pairs(part: _Part, k: int, tolerance: float, device: torch.device) -> tuple[Tensor, ...]:
    """Eigenvalues of a component without 0, relative errors, U and MU: the k smallest, with groups whole, or all."""
    size, zero = len(part.points), part.zero
    count, linear = min(k + BLOCK, size), part.matrices[2:]
    mass_matrix = on_device(part.matrices[1], device)
    if size <= max(DENSE, SHARE * count):
        dense = [matrix.toarray() for matrix in part.matrices[:2]]
        found = linalg.eigh(*dense, subset_by_index=(0, count - 1))
        values, u = (torch.from_numpy(x).to(device) for x in found)
        errors, mu = torch.zeros_like(values), multiply(*mass_matrix, u)
    else:
        k1, m1 = part.matrices[-2:]
        null = None
        if zero:
            null = torch.full((size,), float(m1.sum()) ** -0.5, dtype=torch.float64, device=device)
        accuracy = START if linear else ROOT_EPS
        settings = {"tolerance": accuracy, "more": BLOCK, "null": null, "device": device}
        solve, (values, u) = lanczos_of_pair(
            k1, m1, k - zero, SHIFT / float(abs(m1).sum()), **settings
        )
        if null is not None:
            values, u = pad(values, (1, 0)), torch.cat([null.to(u)[:, None], u], dim=1)
        if not linear:
            errors, mu = torch.full_like(values, tolerance), multiply(*mass_matrix, u)
        else:
            matrices = [on_device(part.matrices[0], device), mass_matrix, on_device(m1, device)]
            found = swept(matrices, u, k, solve, tolerance, zero)
            if found is None:
                warn(
                    f"eigenbasis: after {ROUNDS} sweeps some of {k} eigenvalues are not accurate to {tolerance:.1g}, "
                    "as where spacings change abruptly. Factors of the whole pair take over, at many times the memory "
                    "and time; a larger `tolerance` does without"
                )
                return _pairs(part._replace(matrices=part.matrices[:2]), k, EPS, device)
            values, errors, u, mu = found
    values[:zero] = 0.0
    if bool((values[zero:] <= 0).any()):
        raise EigenbasisError(
            f"eigenbasis: the stiffness has the eigenvalue {float(values[zero:].min()):.3g} on a component of {size} "
            "points, where it should be positive"
        )
    keep = closed(values, k, tolerance)
    return values[zero:keep], errors[zero:keep], u[:, zero:keep], mu[:, zero:keep]


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
    keep = closed(values, k, tolerance) if len(values) else 0
    values, errors, order = values[:keep], errors[order[:keep]], order[:keep]
    phi, left = mass.new_zeros(2, len(mass), keep)
    phi[:, :zeros], left[:, :zeros] = (torch.from_numpy(x).to(mass) for x in null)
    at = zeros
    for part, (own, _, *vectors) in zip(parts, found, strict=True):
        points = torch.from_numpy(part.points).to(mass.device)
        here = ((order >= at) & (order < at + len(own))).nonzero()[:, 0]
        for some in here.split(CHUNK):
            for whole, columns in zip((phi, left), vectors, strict=True):
                whole[points[:, None], some] = columns[:, order[some] - at].to(whole)
        at += len(own)
    square, unit = units  # of 1/λ, and of M
    signs = 1 - 2 * (-phi.amin(0) > phi.amax(0)).to(phi)  # the largest entry is positive
    phi *= signs / unit**0.5
    left *= signs * unit**0.5
    return Eigenbasis(values / square, phi, mass, left, relative_errors=errors)
