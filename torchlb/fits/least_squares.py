"""Many small least-squares problems, each with one factorisation for every right-hand side (`method.md`, section 2)."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor


def left_inverse(
    values: Float[Tensor, "B K M"], root: Float[Tensor, "B K"]
) -> tuple[Float[Tensor, "B M K"], Float[Tensor, " B"]]:
    """C = (VᵀΩV)⁻¹VᵀΩ, with which Cu are the coefficients of the weighted fit to u, and its condition.

    By the modified Gram–Schmidt process on √ω V = QR and back substitution, C = R⁻¹Qᵀ√ω: every row has the accuracy of
    Householder's QR (`decisions.md`, *Compiled kernels*). Columns that are dependent to the last digit leave what is
    not finite.

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
        ‖R⁻¹‖ in the Frobenius norm, the columns of √ω V scaled to length one: as those of R have length one then, ‖R‖
        is between 1 and √M.

    >>> left_inverse(torch.ones(1, 4, 1, dtype=torch.float64), torch.ones(1, 4, dtype=torch.float64))[0].tolist()
    [[[0.25, 0.25, 0.25, 0.25]]]
    """
    from torchlb.linalg import kernels

    columns, weights = values.mT.contiguous().numpy(), root.contiguous().numpy()
    found, condition = kernels.left_inverse(columns, weights)
    return torch.from_numpy(found), torch.from_numpy(condition)
