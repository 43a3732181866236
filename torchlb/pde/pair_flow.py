r"""e^{−tM⁻¹K}x with a weak pair (K, M): `linalg.exponential`'s rational series of Z = (M + γK)⁻¹M."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchlb.galerkin.forms import BilinearForm
from torchlb.linalg.exponential import chebyshev_vectors, poles, rational_coefficients
from torchlb.linalg.once import once_differentiable
from torchlb.operator.pair_methods import PairMethods
from torchlb.operator.systems import pair_system
from torchlb.operator.through import Origins, origins
from torchlb.pde.checks import uncompiled


def pair_flow(
    lb: PairMethods, x: Float[Tensor, "N C"], time: Float[Tensor, " C"], tolerance: float
) -> Float[Tensor, "N C"]:
    """The flow of each column for its own time, differentiable once in x, the times, points and medium.

    Zero at Dirichlet points. The error is at most `tolerance` in the norm of M, relative to x.
    """
    found = origins(lb)
    variables = () if found is None else found.variables
    return _flow(x.double(), time.double(), lb, found, tolerance, *variables)


class _Flow(torch.autograd.Function):
    """Σ_k c_k(t) T_k(2Z − 1)x; its adjoint is the same series of Zᵀ = M(M + γK)⁻¹."""

    @staticmethod
    def forward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,
        x: Tensor,
        time: Tensor,
        lb: Any,
        found: Origins | None,
        tolerance: float,
        *variables: Tensor,
    ) -> Tensor:
        ctx.save_for_backward(x, time, *variables)
        ctx.rest = lb, found, tolerance
        return _summed(lb, x, time, tolerance, False)[0]  # pyright: ignore[reportCallIssue]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        x, time, *_ = ctx.saved_tensors
        lb, found, tolerance = ctx.rest
        grad_x, slope = _summed(lb, g, time, tolerance, True)  # pyright: ignore[reportCallIssue]
        gradients = [] if found is None else found.gradient(_forms(lb, x, g, time, tolerance))
        return grad_x, (slope * x).sum(0), None, None, None, *gradients


_flow: Any = uncompiled(_Flow.apply)


def _summed(
    lb: PairMethods, x: Tensor, time: Tensor, tolerance: float, transposed: bool
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


def _forms(
    lb: PairMethods, x: Tensor, g: Tensor, time: Tensor, tolerance: float
) -> list[BilinearForm]:
    """Forms with the derivative of ⟨g, Σ_k c_k v_k⟩ in K and M, v_k = T_k(2Z − 1)x.

    dZ = S(dM(1 − Z) − γ dK Z) with S = (M + γK)⁻¹; what v_k is multiplied by follows from Clenshaw's recurrence,
    b_k = c_k g + 2Aᵀb_{k+1} − b_{k+2}, A = 2Z − 1, and 2⟨b_{k+1}, dA v_k⟩ add up, the first one once.
    """
    solver, times, forms = pair_system(lb), time.detach().cpu().numpy(), []
    x = solver.inside(x)
    for pole, chosen in poles(times):
        columns = torch.from_numpy(chosen).to(x.device)
        at_pole = x.new_full((len(chosen),), pole)

        def solve(v: Tensor, at_pole: Tensor = at_pole) -> Tensor:
            return solver.solve(v, at_pole, tolerance / 10)

        def doubled(v: Tensor) -> Tensor:
            return 2 * solve(solver.mass_product(v)) - v

        c, _ = rational_coefficients(times[chosen] / pole, tolerance)
        v = list(chebyshev_vectors(doubled, x[:, columns], len(c)))
        own = solver.inside(g[:, columns])
        after = before = torch.zeros_like(own)  # b_{k+2}, b_{k+1}
        applied = torch.zeros_like(own)  # Aᵀb_{k+1}
        for k in range(len(c) - 1, 0, -1):
            current = torch.from_numpy(c[k]).to(x) * own + 2 * applied - after
            after, before = before, current
            solved = solve(current)
            applied = 2 * solver.mass_product(solved) - current
            # A v_{k−1} by the recurrence, and Z = (1 + A)/2
            advanced = v[1] if k == 1 else (v[k] + v[k - 2]) / 2
            smooth = (v[k - 1] + advanced) / 2
            weight = torch.full((len(chosen),), 2.0 if k == 1 else 4.0, dtype=x.dtype)
            forms += [
                BilinearForm("energy", solved, smooth, -pole * weight),
                BilinearForm("mass", solved, v[k - 1] - smooth, weight),
            ]
    return forms
