"""Heat flow for learned times, one for each channel."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from torchlb.errors import InputError
from torchlb.linalg.precision import ROOT_EPS
from torchlb.nn.checks import check_features
from torchlb.operator.pair_methods import PairMethods
from torchlb.pde.checks import check_choice
from torchlb.pde.heat import Method, flow

SHARPNESS = 100.0
"""β of the softplus that keeps learned times positive: above 0.05 ℓ² it is the identity to 1 %."""


class LearnedTimes(nn.Module):
    """A learned time for each channel, positive by parametrisation."""

    def __init__(self, channels: int, init_time: float) -> None:
        super().__init__()
        if not 0 < init_time < math.inf:
            raise InputError(f"init_time: expected a positive time, got {init_time}")
        self.channels = channels
        self.raw_time = nn.Parameter(raw_of_time(torch.full((channels,), init_time)))

    @property
    def time(self) -> Float[Tensor, " C"]:
        """Diffusion times t > 0, ℓ²."""
        return softplus(self.raw_time, beta=SHARPNESS)


class Diffusion(LearnedTimes):
    """Diffusion of each channel for a learned time: y_c = e^{t_c Δ}x_c.

    Parameters
    ----------
    channels
        C.
    method
        "deflated" (exact at every scale), "spectral" (as in the original DiffusionNet: Φe^{−λt}Φᵀπ, which drops
        everything beyond the basis), "rational" (no basis, but solves).
    k
        Number of eigenpairs for the first two.
    init_time
        Initial time, ℓ². Shapes of radius about one are expected.
    tolerance
        Tolerance of the methods other than "spectral", see `heat_flow`.

    Attributes
    ----------
    raw_time
        (C,), the parameter; the times are t = softplus(100 raw)/100, positive by construction.

    Examples
    --------
    >>> from torchlb import LaplaceBeltrami
    >>> theta = torch.arange(36) * torch.pi / 18
    >>> lb = LaplaceBeltrami.from_points(torch.stack([theta.cos(), theta.sin()], dim=1))
    >>> layer = Diffusion(3)
    >>> layer(torch.ones(36, 3), lb).mean().item()
    1.0
    """

    def __init__(
        self,
        channels: int,
        *,
        method: Method = "deflated",
        k: int = 128,
        init_time: float = 0.01,
        tolerance: float = ROOT_EPS,
    ) -> None:
        super().__init__(channels, init_time)
        check_choice("method", method, Method)
        self.method, self.k, self.tolerance = method, k, tolerance

    def forward(self, x: Float[Tensor, "*B N C"], lb: PairMethods) -> Float[Tensor, "*B N C"]:
        """Diffuse features x, (N, C) or (B, N, C), on the shape or batch of `lb`; shape and type are those of x."""
        dtype = check_features(x, lb, self.channels, self.raw_time, self.used_k)
        with torch.autocast(x.device.type, enabled=False):
            time = self.time.to(dtype)
            y = flow(lb, x.to(dtype), time, self.method, self.k, self.tolerance)
        return y.to(x.dtype)

    @property
    def used_k(self) -> int:
        """Number of eigenpairs that the method needs."""
        return self.k if self.method in ("deflated", "spectral") else 0

    def extra_repr(self) -> str:
        """Channels, method, k."""
        basis = f", k={self.k}" if self.used_k else ""
        return f"{self.channels}, method={self.method!r}{basis}"


def raw_of_time(time: Float[Tensor, " C"]) -> Float[Tensor, " C"]:
    """The parameter of `Diffusion` for given times t > 0.

    >>> bool(softplus(raw_of_time(torch.tensor([1e-8, 0.5])), beta=100.0).allclose(torch.tensor([1e-8, 0.5])))
    True
    """
    double = time.double()
    return (double + torch.log(-torch.expm1(-SHARPNESS * double)) / SHARPNESS).to(time.dtype)
