"""Many small least-squares problems, each with one factorisation for every right-hand side (`method.md`, section 2)."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from torchlb import compiled

AT_ONCE = 2**16
"""Entries of matrices at a time in NumPy, half a MB, which stay in the cache."""


def left_inverse(
    values: Float[Tensor, "B K M"], root: Float[Tensor, "B K"]
) -> tuple[Float[Tensor, "B M K"], Float[Tensor, " B"]]:
    """C = (VᵀΩV)⁻¹VᵀΩ, with which Cu are the coefficients of the weighted fit to u, and its condition.

    By the modified Gram–Schmidt process on √ω V = QR and back substitution, C = R⁻¹Qᵀ√ω: every row has the accuracy of
    Householder's QR (`decisions.md`, *Compiled kernels*). Columns that are dependent to the last digit leave what is
    not finite.

    Parameters
    ----------
    values : V, K ≥ M, float64.
    root : √ω.

    Returns
    -------
    inverse : C.
    condition : ‖R⁻¹‖ in the Frobenius norm, the columns of √ω V scaled to length one: as those of R have length one
        then, ‖R‖ is between 1 and √M.

    >>> left_inverse(torch.ones(1, 4, 1, dtype=torch.float64), torch.ones(1, 4, dtype=torch.float64))[0].tolist()
    [[[0.25, 0.25, 0.25, 0.25]]]
    """
    columns, weights = values.mT.contiguous().numpy(), root.contiguous().numpy()
    inverses = compiled.kernel("left_inverse") or _left_inverse
    found, condition = inverses(columns, weights)
    return torch.from_numpy(found), torch.from_numpy(condition)


@compiled.standing_in()
def _left_inverse(
    columns: Float[np.ndarray, "B M K"], root: Float[np.ndarray, "B K"]
) -> tuple[Float[np.ndarray, "B M K"], Float[np.ndarray, " B"]]:
    """The same in NumPy."""
    found, condition = np.empty_like(columns), np.empty(len(columns))
    lanes = max(AT_ONCE // (columns.shape[1] * columns.shape[2]), 2)
    for first in range(0, len(columns), lanes):
        part = slice(first, first + lanes)
        found[part], condition[part] = _side_by_side(columns[part], root[part])
    return found, condition


def _side_by_side(
    columns: Float[np.ndarray, "B M K"], root: Float[np.ndarray, "B K"]
) -> tuple[Float[np.ndarray, "B M K"], Float[np.ndarray, " B"]]:
    """Sums are taken in order, as NumPy does along all axes but the last, which therefore has at least two places."""
    batch, terms, size = columns.shape
    a, r = np.ones((terms, size, max(batch, 2))), np.empty((terms, terms, max(batch, 2)))
    a[..., :batch] = (columns * root[:, None]).transpose(1, 2, 0)
    square = (a * a).sum(1)
    with np.errstate(all="ignore"):
        for j in range(terms):
            r[j, j] = 1 / np.sqrt((a[j] * a[j]).sum(0))
            a[j] *= r[j, j]
            r[j, j + 1 :] = (a[j + 1 :] * a[j]).sum(1)
            a[j + 1 :] -= r[j, j + 1 :, None] * a[j]
        for j in reversed(range(terms)):
            a[j] *= r[j, j]
            a[:j] -= r[:j, j, None] * a[j]
        condition = np.sqrt(((a * a).sum(1) * square).sum(0))
    return a[..., :batch].transpose(2, 0, 1) * root[:, None], condition[:batch]
