"""Diffusion for learned times, one for each channel: heat flow, and an implicit step of it."""

from __future__ import annotations

import math
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from torchlb.errors import InputError
from torchlb.linalg.checks import check_choice
from torchlb.linalg.precision import SINGLE
from torchlb.nn.pointwise import check_features
from torchlb.operator.pair_methods import PairMethods
from torchlb.operator.systems import Tolerance
from torchlb.pde.heat import Method, flow
from torchlb.pde.solves import TOLERANCE, implicit_by_elements, implicit_step

SHARPNESS = 100.0
"""β of the softplus that keeps learned times positive: above 0.05 ℓ² it is the identity to 1 %."""


class LearnedTimes(nn.Module):
    """Diffusion of each channel for a learned time, positive by parametrisation."""

    used_k = 0

    def __init__(self, channels: int, init_time: float) -> None:
        super().__init__()
        if not 0 < init_time < math.inf:
            raise InputError(f"init_time: expected a positive time, got {init_time}")
        self.channels = channels
        self.raw_time = nn.Parameter(raw_of_time(torch.full((channels,), float(init_time))))

    @property
    def time(self) -> Float[Tensor, " C"]:
        """Diffusion times t > 0, ℓ²."""
        return softplus(self.raw_time, beta=SHARPNESS)

    def forward(self, x: Float[Tensor, "*B N C"], lb: PairMethods) -> Float[Tensor, "*B N C"]:
        """Diffuse features x, (N, C) or (B, N, C), on the shape or batch of `lb`; shape and type are those of x."""
        dtype = check_features(x, lb, self.channels, self.raw_time, self.used_k)
        with torch.autocast(x.device.type, enabled=False):
            return self._diffused(x.to(dtype), lb, self.time.to(dtype)).to(x.dtype)

    def _diffused(self, x: Tensor, lb: PairMethods, time: Tensor) -> Tensor:
        raise NotImplementedError


class Diffusion(LearnedTimes):
    """Diffusion of each channel for a learned time: y_c = e^{t_c Δ}x_c, t = softplus(100 raw_time)/100 > 0.

    Parameters
    ----------
    channels, init_time
        C, and the initial time, ℓ². Shapes of radius about one are expected.
    method, k
        "spectral" by k eigenpairs (as in the original DiffusionNet: Φe^{−λt}ΦᵀM, which drops everything beyond the
        basis), or "rational" (exact at every scale; no basis, but solves). See `docs/conventions.md`.
    tolerance
        Tolerance of "rational", see `heat_flow`; None for 1e-5 in float32, 1e-10 in float64.

    Examples
    --------
    >>> from torchlb import LaplaceBeltrami
    >>> theta = torch.arange(36) * torch.pi / 18
    >>> lb = LaplaceBeltrami.from_points(torch.stack([theta.cos(), theta.sin()], dim=1))
    >>> Diffusion(3)(torch.ones(36, 3), lb).mean().item()
    1.0
    """

    def __init__(
        self,
        channels: int,
        *,
        method: Method = "spectral",
        k: int = 128,
        init_time: float = 0.01,
        tolerance: float | None = None,
    ) -> None:
        super().__init__(channels, init_time)
        check_choice("method", method, Method)
        self.method, self.k, self.tolerance = method, k, tolerance
        self.used_k = k if method == "spectral" else 0

    def _diffused(self, x: Tensor, lb: PairMethods, time: Tensor) -> Tensor:
        return flow(lb, x, time, self.method, self.k, tolerance_for(x, self.tolerance))

    def extra_repr(self) -> str:
        """Channels, method, k."""
        return f"{self.channels}, method={self.method!r}" + (f", k={self.k}" if self.used_k else "")


class ImplicitDiffusion(LearnedTimes):
    """One implicit step of each channel for a learned time: y_c = (1 − t_c Δ)⁻¹x_c, t as in `Diffusion`.

    It decays as 1/(1 + tλ) where `Diffusion` does as e^{−tλ}: as far, and less sharply. It needs no eigenbasis and
    drops nothing. All channels share the factors of a few times, kept with the operator (`method.md`, section 10).

    Parameters
    ----------
    channels, init_time
        As for `Diffusion`.
    tolerance
        "P1" for four solves by P1 elements, to 1e-3 of |x|, which is accurate enough for learning and has no derivative
        in points and medium; else the relative tolerance of solves with the weak pair, by conjugate gradients, None for
        1e-5 in float32, 1e-10 in float64.

    Examples
    --------
    >>> from torchlb import LaplaceBeltrami
    >>> from torchlb.surfaces import Sphere
    >>> lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(300)).float()
    >>> ImplicitDiffusion(3, init_time=0.5)(lb.points, lb).div(lb.points).median().round(decimals=3).item()
    0.5
    """

    def __init__(
        self, channels: int, *, init_time: float = 0.01, tolerance: Tolerance = "P1"
    ) -> None:
        super().__init__(channels, init_time)
        self.tolerance: Tolerance = tolerance

    def _diffused(self, x: Tensor, lb: PairMethods, time: Tensor) -> Tensor:
        if self.tolerance == "P1":
            return implicit_by_elements(lb, x, time)
        return implicit_step(lb, x, time, tolerance=tolerance_for(x, self.tolerance))

    def extra_repr(self) -> str:
        """Channels, tolerance."""
        return f"{self.channels}, tolerance={self.tolerance}"


def tolerance_for(x: Tensor, tolerance: float | None) -> float:
    """Tolerance of a layer for features x; None for the accuracy of their type, 1e-5 in float32, 1e-10 in float64."""
    own = TOLERANCE if x.dtype == torch.float64 else SINGLE
    return own if tolerance is None else tolerance


def diffusion_by(
    method: Method | Literal["implicit"], channels: int, k: int, init_time: float = 0.01
) -> LearnedTimes:
    """`ImplicitDiffusion`, or `Diffusion` by another method with k eigenpairs."""
    if method == "implicit":
        return ImplicitDiffusion(channels, init_time=init_time)
    return Diffusion(channels, method=method, k=k, init_time=init_time)


def raw_of_time(time: Float[Tensor, " C"]) -> Float[Tensor, " C"]:
    """The parameter of `Diffusion` for given times t > 0.

    >>> bool(softplus(raw_of_time(torch.tensor([1e-8, 0.5])), beta=100.0).allclose(torch.tensor([1e-8, 0.5])))
    True
    """
    double = time.double()
    return (double + torch.log(-torch.expm1(-SHARPNESS * double)) / SHARPNESS).to(time.dtype)
