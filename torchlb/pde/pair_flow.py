r"""e^{−tM⁻¹K}x with a weak pair (K, M): `linalg.exponential`'s rational series of Z = (M + γK)⁻¹M."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchlb.linalg.exponential import chebyshev_vectors, poles, rational_coefficients
from torchlb.linalg.once import once_differentiable
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.pde.checks import uncompiled
from torchlb.pde.systems import pair_system


def pair_flow(
    lb: LaplaceBeltrami, x: Float[Tensor, "N C"], time: Float[Tensor, " C"], tolerance: float
) -> Float[Tensor, "N C"]:
    """The flow of each column for its own time, differentiable once in x and in the times.

    Zero at Dirichlet points. The error is at most `tolerance` in the norm of M, relative to x.
    """
    return _flow(x.double(), time.double(), lb, tolerance)


class _Flow(torch.autograd.Function):
    """Σ_k c_k(t) T_k(2Z − 1)x; its adjoint is the same series of Zᵀ = M(M + γK)⁻¹."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, time: Tensor, lb: Any, tolerance: float) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.save_for_backward(x, time)
        ctx.rest = lb, tolerance
        return _summed(lb, x, time, tolerance, False)[0]  # pyright: ignore[reportCallIssue]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        x, time = ctx.saved_tensors
        lb, tolerance = ctx.rest
        grad_x, slope = _summed(lb, g, time, tolerance, True)  # pyright: ignore[reportCallIssue]
        return grad_x, (slope * x).sum(0), None, None


_flow: Any = uncompiled(_Flow.apply)


def _summed(
    lb: LaplaceBeltrami, x: Tensor, time: Tensor, tolerance: float, transposed: bool
) -> tuple[Tensor, Tensor]:
    """Σ c_k v_k and Σ c_k' v_k; at t = 0, for the transposed flow, x and −KM⁻¹x."""
    result, slope = torch.zeros_like(x), torch.zeros_like(x)
    times = time.detach().cpu().numpy()
    at_zero = torch.from_numpy(times == 0).to(x.device)
    solver = pair_system(lb)
    x = solver.inside(x)
    if bool(at_zero.any()):
        result[:, at_zero] = start = x[:, at_zero]
        if transposed:
            still = solver.solve(start, torch.zeros_like(start[0]), tolerance)
            slope[:, at_zero] = -solver.stiffness_product(still)
    for pole, chosen in poles(times):
        columns = torch.from_numpy(chosen).to(x.device)
        at_pole = x.new_full((len(chosen),), pole)

        def doubled(v: Tensor, at_pole: Tensor = at_pole) -> Tensor:
            if transposed:
                return 2 * solver.mass_product(solver.solve(v, at_pole, tolerance / 10)) - v
            return 2 * solver.solve(solver.mass_product(v), at_pole, tolerance / 10) - v

        c, derivative = rational_coefficients(times[chosen] / pole, tolerance)
        for k, v in enumerate(chebyshev_vectors(doubled, x[:, columns], len(c))):
            result[:, columns] += torch.from_numpy(c[k]).to(x) * v
            slope[:, columns] += torch.from_numpy(derivative[k]).to(x) / pole * v
    return solver.inside(result), solver.inside(slope)  # Zᵀ is nonzero at Dirichlet points
