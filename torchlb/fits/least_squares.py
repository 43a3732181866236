"""Batches of small least-squares problems, each factored once for all right-hand sides (`method.md`, section 2)."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchlb.linalg.once import once_differentiable


def left_inverse(
    values: Float[Tensor, "B K M"], root: Float[Tensor, "B K"]
) -> tuple[Float[Tensor, "B M K"], Float[Tensor, " B"]]:
    """C = (VᵀΩV)⁻¹VᵀΩ, for which Cu are the coefficients of the weighted fit to u, and the condition.

    Modified Gram–Schmidt on √ω V = QR and back substitution give C = R⁻¹Qᵀ√ω, every row as accurate as by Householder's
    QR (`decisions.md`, *Compiled kernels*). Columns that are dependent to the last digit give non-finite results.

    V has K ≥ M rows, in float64; `root` is √ω. The condition is the Frobenius norm ‖R⁻¹‖ for columns of √ω V scaled to
    unit length; ‖R‖ is then between 1 and √M.

    >>> left_inverse(torch.ones(1, 4, 1, dtype=torch.float64), torch.ones(1, 4, dtype=torch.float64))[0].tolist()
    [[[0.25, 0.25, 0.25, 0.25]]]
    """
    return _LeftInverse.apply(values, root)  # pyright: ignore[reportReturnType]


class _LeftInverse(torch.autograd.Function):
    """C and its condition; the condition has no derivative.

    With A = VᵀΩV and H = A⁻¹C̄ derivatives are V̄ = Ω(H(I − VC)ᵀ)ᵀ − Cᵀ(C̄Cᵀ), and the column sums of H(I − VC)ᵀ ∘ Vᵀ
    for ω. As C Ω^{−½} = R⁻¹Qᵀ, it gives A⁻¹ = R⁻¹R⁻ᵀ without another factorisation.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor, root: Tensor) -> tuple[Tensor, Tensor]:  # pyright: ignore[reportIncompatibleMethodOverride]
        from torchlb.linalg import kernels

        columns, weights = values.mT.contiguous().numpy(), root.contiguous().numpy()
        inverse, condition = (
            torch.from_numpy(found) for found in kernels.left_inverse(columns, weights)
        )
        ctx.save_for_backward(values, root, inverse)
        ctx.mark_non_differentiable(condition)
        return inverse, condition

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, _: Tensor) -> tuple[Tensor, Tensor]:  # pyright: ignore[reportIncompatibleMethodOverride]
        values, root, inverse = ctx.saved_tensors
        half = torch.where(root[:, None] > 0, inverse / root[:, None], 0.0)
        h = half @ (half.mT @ grad)
        rest = h - (h @ inverse.mT) @ values.mT
        of_values = root[..., None].square() * rest.mT - inverse.mT @ (grad @ inverse.mT)
        return of_values, 2 * root * (rest * values.mT).sum(1)
