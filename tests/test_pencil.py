"""Factors, block Lanczos and the eigenbasis of a symmetric pair (K, M)."""

import sys

import numpy as np
import pytest
import torch
from scipy import sparse

from torchlb.linalg.factor import cholesky


def path_matrix(size, shift):
    """Graph Laplacian of a path, plus a shift."""
    ones = np.ones(size - 1)
    degree = np.r_[1, np.full(size - 2, 2), 1] + shift
    return sparse.diags_array([-ones, degree, -ones], offsets=[-1, 0, 1]).tocsr()


@pytest.mark.parametrize("shift", [0.5, -0.5])  # positive definite, indefinite
@pytest.mark.parametrize("shape", [(30,), (30, 1), (30, 200), (30, 0)])
def test_a_factor_solves_in_the_type_of_the_right_hand_side(shift, shape):
    matrix, b = path_matrix(30, shift), torch.randn(shape, dtype=torch.float64)
    factor = cholesky(matrix)
    assert factor.is_cholesky == (shift > 0)
    torch.testing.assert_close(torch.from_numpy(matrix @ factor.solve(b).numpy()), b)
    assert factor.solve(b.float()).dtype == torch.float32


def test_a_factor_takes_unsorted_and_unsymmetric_matrices():
    matrix, b = path_matrix(30, 1.0), torch.randn(30, 2, dtype=torch.float64)
    solution = cholesky(matrix).solve(b)
    flipped = matrix.copy()
    for start, end in zip(matrix.indptr[:-1], matrix.indptr[1:], strict=True):
        flipped.indices[start:end] = matrix.indices[start:end][::-1]
        flipped.data[start:end] = matrix.data[start:end][::-1]
    flipped.has_sorted_indices = False
    torch.testing.assert_close(cholesky(flipped).solve(b), solution)
    upper = sparse.triu(matrix)
    torch.testing.assert_close(torch.from_numpy(upper @ cholesky(upper).solve(b).numpy()), b)


def test_a_factor_does_without_cholespy(monkeypatch):
    matrix, b = path_matrix(30, 1.0), torch.randn(30, 2, dtype=torch.float64)
    solution = cholesky(matrix).solve(b)
    monkeypatch.setitem(sys.modules, "cholespy", None)
    factor = cholesky(matrix)
    assert not factor.is_cholesky
    torch.testing.assert_close(factor.solve(b), solution)
