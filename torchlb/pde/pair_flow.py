r"""e^{−tM⁻¹K}x with a weak pair (K, M), by solves with one real pole (`method.md`, section 8).

In z = 1/(1 + γλ), between 0 and 1, e^{−tλ} = exp(−(t/γ)(1/z − 1)) is smooth, and Chebyshev polynomials of z take about
20 terms for all t between 5γ and 50γ. z is the operator Z = (M + γK)⁻¹M: a solve a term, all with the same matrix. The
poles are powers of ten, so that times near each other, and those of the next step of a training, share the factors.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.fft import dct
from torch import Tensor

from torchlb.linalg.once import once_differentiable
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.pde.checks import uncompiled
from torchlb.pde.systems import PairSystem, pair_system

SHORTEST = 5.0
"""t/γ of the shortest time that shares a pole; the longest is ten times longer."""
POINTS = 256
"""Of the interpolation that gives the coefficients."""


def pair_flow(
    lb: LaplaceBeltrami, x: Float[Tensor, "N C"], time: Float[Tensor, " C"], tolerance: float
) -> Float[Tensor, "N C"]:
    """The flow of each column for a time of its own, differentiable once in x and in the times.

    Zero at Dirichlet points. The error is `tolerance` in the norm of M, relative to x.
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
    """Σ c_k v_k and Σ c_k' v_k; at t = 0, of the transposed, x and −KM⁻¹x."""
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
    level = np.floor(np.log10(np.where(times > 0, times / SHORTEST, 1.0)))
    for exponent in np.unique(level[times > 0]).tolist():
        chosen = (level == exponent) & (times > 0)
        columns = torch.from_numpy(chosen).to(x.device)
        pole = 10.0**exponent
        c, derivative = (
            torch.from_numpy(np.stack(part, 1)).to(x)
            for part in zip(
                *(_coefficients(t / pole, tolerance) for t in times[chosen]), strict=True
            )
        )
        needed = int(c.any(1).sum())
        for k, v in enumerate(
            _polynomials(solver, pole, x[:, columns], needed, tolerance / 10, transposed)
        ):
            result[:, columns] += c[k] * v
            slope[:, columns] += derivative[k] / pole * v
    return solver.inside(result), solver.inside(slope)  # Zᵀ leads out to Dirichlet points


def _polynomials(
    solver: PairSystem, pole: float, x: Tensor, count: int, tolerance: float, transposed: bool
) -> Iterator[Tensor]:
    """T_k(2Z − 1)x for k < count; of Zᵀ if transposed."""
    poles = torch.full_like(x[0], pole)

    def doubled(v: Tensor) -> Tensor:
        if transposed:
            return 2 * solver.mass_product(solver.solve(v, poles, tolerance)) - v
        return 2 * solver.solve(solver.mass_product(v), poles, tolerance) - v

    yield x
    before, v = x, x
    for k in range(1, count):
        before, v = v, doubled(v) if k == 1 else 2 * doubled(v) - before
        yield v


@lru_cache(maxsize=4096)
def _coefficients(ratio: float, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """c_k and dc_k/d(t/γ) for t/γ, so that constants, z = 1, stay exactly.

    >>> c, slope = _coefficients(10.0, 1e-7)
    >>> bool(abs(np.polynomial.chebyshev.chebval(2 / (1 + 0.3) - 1, c) - np.exp(-10 * 0.3)) < 1e-7)
    True
    """
    decay = 2 / (1 + np.cos(np.pi * (np.arange(POINTS) + 0.5) / POINTS)) - 1
    flow = np.exp(-ratio * decay)
    c, derivative = np.asarray(dct(np.stack([flow, -decay * flow]))) / POINTS
    c[0], derivative[0] = c[0] / 2, derivative[0] / 2
    count = int((np.cumsum(np.abs(c[::-1]))[::-1] > tolerance / 2).sum())
    c[count:] = derivative[count:] = 0
    c[0] += 1 - c.sum()
    derivative[0] -= derivative.sum()
    return c, derivative
