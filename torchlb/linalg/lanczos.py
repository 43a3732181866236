"""Block Lanczos for the smallest eigenpairs of a symmetric pencil K u = λ M u (`method.md`, section 10)."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from torch import Tensor
from torch.linalg import LinAlgError  # pyright: ignore
from torch.nn.functional import pad

from torchlb.errors import EigenbasisError
from torchlb.linalg.conjugate_gradients import Linear
from torchlb.linalg.factor import Factor
from torchlb.linalg.precision import AT_ONCE, EPS, LOW, ROUNDS, SMALL
from torchlb.linalg.sparse import multiply, on_device

BLOCK = 16
"""Block size, the largest multiplicity that is surely found; 8 to 32 take about the same time."""
CHECK = 2
"""Blocks between two checks of the residuals."""

Pairs = tuple[Float[Tensor, " k"], Float[Tensor, "N k"]]


class ShiftTooLarge(Exception):
    """The shift is far above the requested eigenvalues, the largest of which is at most the argument."""


def lanczos_of_pair(
    stiffness: sparse.csr_array,
    mass_matrix: sparse.csr_array,
    k: int,
    shift: float,
    *,
    device: torch.device,
    **settings: Any,
) -> tuple[Linear, Pairs]:
    """Product with (K + shift M)⁻¹, and the eigenpairs by `lanczos`; the shift is lowered where necessary.

    Eigenvalues of a shape as narrow as a ribbon are those of a curve, far below the inverse of its area. The shift is
    lowered to them there, but not below the rounding of K.
    """
    size = len(stiffness.diagonal())
    least = EPS * float(stiffness.diagonal().max()) / float(mass_matrix.diagonal().max())
    mass = partial(multiply, *on_device(mass_matrix, device))
    kind = {"device": device, "least": least, **settings}
    while True:
        solve = Factor(sparse.csr_array(stiffness + shift * mass_matrix)).solve
        try:
            return solve, lanczos(solve, mass, size, k, shift=shift, **kind)
        except ShiftTooLarge as error:
            (shift,) = error.args


def lanczos(
    solve: Linear,
    mass: Linear,
    size: int,
    k: int,
    *,
    shift: float,
    tolerance: float,
    device: torch.device | str = "cpu",
    more: int = 0,
    null: Float[Tensor, " N"] | None = None,
    least: float = np.inf,
) -> Pairs:
    """The k smallest eigenpairs except `null`, ascending and M-orthonormal, and `more` less accurate ones.

    The Krylov space of (K + shift M)⁻¹M, a product of `solve` and `mass`, from pseudo-random vectors (N = `size`) is
    orthogonalised in full, without restarts, on the device. The shift, in the unit of λ, is small and positive; `least`
    is the smallest one worth trying instead. The tolerance bounds the residuals in the M-norm, relative to
    1/(λ + shift); the error of eigenvalues is about its square.

    Raises ShiftTooLarge if `LOW` times the shift serves better and `least` allows it; EigenbasisError if N vectors do
    not suffice, or `ROUNDS` times those requested.
    """
    count, first, rough = k + more, int(null is not None), tolerance > SMALL
    generator = np.random.default_rng(0)
    z = torch.from_numpy(generator.standard_normal((BLOCK, size))).to(device)
    basis = z.new_empty(min(4 * count + 4 * BLOCK, size), size)
    if null is not None:
        basis[0] = null
    h, end, look = z.new_zeros(first, first), first, first + 2 * count
    while end + BLOCK <= min(size, ROUNDS * (count + BLOCK)):
        coupling = _orthogonalise(z, mass, basis[:end], 1 if rough else 2)
        h[:, max(end - BLOCK, first) : end] = coupling.T if end > first else 0.0
        try:
            z, mz, r = _orthonormal(z, mass)
        except LinAlgError:  # the space is invariant: go on from new vectors
            z = torch.from_numpy(generator.standard_normal((BLOCK, size))).to(device)
            _orthogonalise(z, mass, basis[:end], 2)
            (z, mz, _), r = _orthonormal(z, mass), h.new_zeros(BLOCK, BLOCK)
        if end >= look:
            theta, y = (x.flip(-1)[..., :count] for x in torch.linalg.eigh(h[first:, first:], "U"))
            if (bound := max(1 / float(theta[k - 1]) - shift, least)) < LOW * shift:
                raise ShiftTooLarge(bound)
            if bool(((r @ y[-BLOCK:, :k]).norm(dim=0) <= tolerance * theta[:k]).all()):
                y = y.to(torch.float32 if rough else torch.float64)
                parts = basis[first:end].split(AT_ONCE, dim=1)
                return 1 / theta - shift, torch.cat([part.to(y).T @ y for part in parts])
            look = end + CHECK * BLOCK
        if end + BLOCK > len(basis):
            basis = torch.cat([basis, torch.empty_like(basis)])
        basis[end : end + BLOCK] = z
        h, end = pad(h, (0, BLOCK, 0, BLOCK)), end + BLOCK
        z = solve(mz.T.contiguous()).T.contiguous()
    raise EigenbasisError(
        f"eigenbasis: block Lanczos did not find {k} pairs of {size} points to {tolerance:.1g}; ask for fewer, or "
        "for a medium of less contrast"
    )


def _orthogonalise(z: Tensor, mass: Linear, basis: Tensor, passes: int) -> Tensor:
    """Orthogonalise the rows of z against the basis, in place; return the coefficients."""
    total = z.new_zeros(len(z), len(basis))
    for _ in range(passes):
        coefficients = mass(z.T).T @ basis.T
        z.addmm_(coefficients, basis, alpha=-1)
        total += coefficients
    return total


def _orthonormal(z: Tensor, mass: Linear) -> tuple[Tensor, Tensor, Tensor]:
    """M-orthonormal rows, their products with M, and R with z = Rᵀ × rows; LinAlgError if z is dependent."""
    mz = mass(z.T).T
    lower = torch.linalg.cholesky(z @ mz.T)
    back = torch.linalg.inv(lower)
    return back @ z, back @ mz, lower.T
