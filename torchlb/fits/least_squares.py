"""Batches of small least-squares problems, each factored once for all right-hand sides (`method.md`, section 2)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def left_inverse(
    values: Float[Tensor, "B K M"], root: Float[Tensor, "B K"]
) -> tuple[Float[Tensor, "B M K"], Float[Tensor, " B"]]:
    """C = (VᵀΩV)⁻¹VᵀΩ, for which Cu are the coefficients of the weighted fit to u, and the condition.

    Modified Gram–Schmidt on √ω V = QR and back substitution give C = R⁻¹Qᵀ√ω, every row as accurate as by Householder's
    QR (`decisions.md`, *Compiled kernels*). Columns that are dependent to the last digit give non-finite results.

    Parameters
    ----------
    values
        V, K ≥ M, float64.
    root
        √ω.

    Returns
    -------
    inverse
        C.
    condition
        Frobenius norm ‖R⁻¹‖ for columns of √ω V scaled to unit length; ‖R‖ is then between 1 and √M.

    >>> left_inverse(torch.ones(1, 4, 1, dtype=torch.float64), torch.ones(1, 4, dtype=torch.float64))[0].tolist()
    [[[0.25, 0.25, 0.25, 0.25]]]
    """
    from torchlb.linalg import kernels

    columns, weights = values.mT.contiguous().numpy(), root.contiguous().numpy()
    found, condition = kernels.left_inverse(columns, weights)
    return torch.from_numpy(found), torch.from_numpy(condition)
