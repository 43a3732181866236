"""Diffusion by one implicit step for learned times: a linear solve, without an eigenbasis."""

from __future__ import annotations

from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor

from torchlb.linalg.precision import SINGLE
from torchlb.nn.checks import check_features
from torchlb.nn.diffusion import Diffusion, LearnedTimes
from torchlb.operator.pair_methods import PairMethods
from torchlb.pde.heat import Method
from torchlb.pde.solves import TOLERANCE, implicit_step


class ImplicitDiffusion(LearnedTimes):
    """One implicit step of each channel for a learned time: y_c = (1 − t_c Δ)⁻¹x_c.

    It decays as 1/(1 + tλ) where `Diffusion` does as e^{−tλ}: as far, and less sharply. It needs no eigenbasis and
    drops nothing. Conjugate gradients use the factors of a few times that all channels share, kept with the operator
    (`method.md`, section 10).

    Parameters
    ----------
    channels
        C.
    init_time
        Initial time, ℓ². Shapes of radius about one are expected.
    tolerance
        Relative tolerance of the solves; None for 1e-5 in float32, 1e-10 in float64. 1e-3 is enough for training.

    Attributes
    ----------
    raw_time
        (C,), the parameter; the times are t = softplus(100 raw)/100, positive by construction.

    Examples
    --------
    >>> from torchlb import LaplaceBeltrami
    >>> from torchlb.surfaces import Sphere
    >>> vertices, faces = Sphere().mesh(300)
    >>> lb = LaplaceBeltrami.from_mesh(vertices.float(), faces)
    >>> ImplicitDiffusion(3, init_time=0.5)(vertices.float(), lb).div(vertices).median().round(decimals=3).item()
    0.5
    """

    def __init__(
        self, channels: int, *, init_time: float = 0.01, tolerance: float | None = None
    ) -> None:
        super().__init__(channels, init_time)
        self.tolerance = tolerance

    def forward(self, x: Float[Tensor, "*B N C"], lb: PairMethods) -> Float[Tensor, "*B N C"]:
        """Diffuse features x, (N, C) or (B, N, C), on the shape or batch of `lb`; shape and type are those of x."""
        dtype = check_features(x, lb, self.channels, self.raw_time)
        with torch.autocast(x.device.type, enabled=False):
            tolerance = self.tolerance
            if tolerance is None:
                tolerance = TOLERANCE if dtype == torch.float64 else SINGLE
            y = implicit_step(lb, x.to(dtype), self.time.to(dtype), tolerance=tolerance)
        return y.to(x.dtype)

    def extra_repr(self) -> str:
        """Channels, tolerance."""
        return f"{self.channels}, tolerance={self.tolerance}"


def diffusion_by(
    method: Method | Literal["implicit"], channels: int, k: int, init_time: float = 0.01
) -> LearnedTimes:
    """`ImplicitDiffusion`, or `Diffusion` by another method with k eigenpairs."""
    if method == "implicit":
        return ImplicitDiffusion(channels, init_time=init_time)
    return Diffusion(channels, method=method, k=k, init_time=init_time)
