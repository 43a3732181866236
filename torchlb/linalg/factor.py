"""Sparse factors: Cholesky of symmetric positive definite matrices, LU of nearly symmetric patterns."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu
from torch import Tensor

from torchlb.errors import InputError
from torchlb.linalg.precision import LOW, ROUNDING

COLUMNS = {"cpu": 16, "cuda": 128}
"""Right-hand sides per call of cholespy: on the CPU they save a fifth of the time, on CUDA 128 is the limit."""
TRIALS = 4
"""Random right-hand sides of the test for singular matrices."""


def factorized(matrix: sparse.csc_array, threshold: float) -> SuperLU:
    """Sparse LU with an ordering for nearly symmetric patterns, several times faster here than the default."""
    return splu(
        matrix,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=threshold,
        options={"SymmetricMode": True},
    )


def cholesky(matrix: Any) -> Factor:
    """Factor of a sparse matrix, (N, N), scipy's or anything scipy accepts, for right-hand sides on any device.

    CHOLMOD (`cholespy`) is 2.5 times faster than SuperLU, and 6 times in the solves. SuperLU takes over where the
    matrix is not symmetric and positive definite. InputError for a complex matrix or right-hand side, and for a matrix
    that is singular, or so close to singular that the rounding of its entries decides.

    >>> cholesky(sparse.diags_array([2.0, 4.0])).solve(torch.tensor([2.0, 2.0]))
    tensor([1.0000, 0.5000])
    """
    matrix = sparse.csr_array(matrix)
    _check_real("matrix", np.iscomplexobj(matrix.data))
    if matrix.shape[0] != matrix.shape[1] or not np.isfinite(matrix.data).all():
        raise InputError(f"matrix: expected a square one of finite entries, got {matrix.shape}")
    precision = np.finfo(matrix.dtype).eps if np.issubdtype(matrix.dtype, np.floating) else 0.0
    try:
        factor = Factor(sparse.csr_array(matrix, dtype=np.float64))
    except RuntimeError as error:  # a pivot of zero
        raise InputError(SINGULAR) from error
    factor.check(float(precision))
    return factor


SINGULAR = (
    "matrix: it is singular, at least to the rounding of its entries; a stiffness matrix K is, since K1 = 0: add a "
    "multiple of the mass matrix, K + cM, take out the rows and columns of points with given values, or call "
    "torchlb.poisson_solve, which splits the constants off"
)


def _check_real(name: str, is_complex: bool) -> None:
    if is_complex:
        raise InputError(
            f"{name}: expected real numbers, got complex ones; scipy.sparse.linalg.splu factors complex matrices, and "
            "torch.view_as_real(b) makes real columns of a right-hand side"
        )


class Factor:
    """A⁻¹ of a sparse matrix, factored in float64, once for each device of a right-hand side.

    `is_cholesky` says whether the factor is Cholesky's, and the matrix thus positive definite.
    """

    def __init__(self, matrix: sparse.csr_array) -> None:
        self._matrix, self._solvers = matrix, {}
        skew = abs(matrix - matrix.T)
        symmetric = skew.nnz == 0 or skew.max() <= ROUNDING * abs(matrix).max()
        self.is_cholesky = symmetric and bool((matrix.diagonal() > 0).all())
        self._solver(torch.device("cpu"))

    def check(self, precision: float) -> None:
        """Raise InputError if the matrix is singular, its entries known to a relative `precision`.

        For a random b and any x, b − Ax keeps the component of b along a left null vector, |g|/√N of |b| for a normal
        g. Where that vector is null only up to rounding, a large x hides the component in the rounding of |A||x|.
        """
        b = np.random.default_rng(0).standard_normal((len(self._matrix.indptr) - 1, TRIALS))
        x = self.solve(torch.from_numpy(b)).numpy()
        left = np.linalg.norm(b - self._matrix @ x, axis=0)
        rounding = precision * np.linalg.norm(abs(self._matrix) @ abs(x), axis=0)
        lost = np.sqrt(len(b)) * np.maximum(left, LOW * rounding) / np.linalg.norm(b, axis=0)
        if not bool((lost < LOW).all()):
            raise InputError(SINGULAR)

    def solve(self, b: Float[Tensor, "N ..."]) -> Float[Tensor, "N ..."]:
        """A⁻¹b, (N,) or (N, C), in the type and on the device of b; without derivatives."""
        _check_real("b", b.is_complex())
        solver, most = self._solver(b.device), COLUMNS.get(b.device.type, 1)
        if isinstance(solver, SuperLU):
            return torch.from_numpy(solver.solve(b.detach().double().cpu().numpy())).to(b)
        if b.ndim > 1 and b.shape[1] > most:
            return torch.cat([self.solve(part) for part in b.split(most, dim=1)], dim=1)
        right = b.detach().to(torch.float64).contiguous()
        x = torch.empty_like(right)
        if right.numel():
            solver.solve(right, x)
        return x.to(b.dtype)

    def _solver(self, device: torch.device) -> Any:
        key = device if self.is_cholesky else torch.device("cpu")
        if key not in self._solvers:
            self._solvers[key] = self._factored(key)
        return self._solvers[key]

    def _factored(self, device: torch.device) -> Any:
        from cholespy import CholeskySolverD, MatrixType  # pyright: ignore[reportAttributeAccessIssue]

        if self.is_cholesky:
            # As CSC the arrays are sorted and reallocated in place, at times wrongly; CSR, here the same, is copied.
            arrays = self._matrix.indptr.astype(np.int32), self._matrix.indices.astype(np.int32)
            parts = (torch.from_numpy(x).to(device) for x in (*arrays, self._matrix.data))
            try:
                return CholeskySolverD(len(arrays[0]) - 1, *parts, MatrixType.CSR)
            except ValueError:  # not positive definite
                self.is_cholesky = False
        return factorized(sparse.csc_array(self._matrix), 1e-1)
