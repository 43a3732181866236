"""A learned convolution in the spectrum."""

from __future__ import annotations

import math
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchlb.linalg.exponential import chebyshev_vectors
from torchlb.nn.pointwise import check_features
from torchlb.operator.laplace_beltrami import LaplaceBeltrami


class SpectralConv(nn.Module):
    """Learned filters in the spectrum that mix channels: y = Φ G(λ) Φᵀ(πx) + b.

    G_{oi}(λ) = Σ_f w_{foi} T_f(2u − 1), u = λ/(λ + scale): the filters are polynomials in u, functions of the
    eigenvalue and not of its index, so that they mean the same on every shape.

    Parameters
    ----------
    in_channels, out_channels
        Channels of the features (…, N, C).
    num_filters, k, bias
        Number of polynomials, T_0, …, and of eigenpairs, and whether to add b.
    scale
        1/ℓ², the eigenvalue in the middle of the filters' range; about 10 suits shapes of radius one.

    Examples
    --------
    >>> theta = torch.arange(36) * torch.pi / 18
    >>> lb = LaplaceBeltrami.from_points(torch.stack([theta.cos(), theta.sin()], dim=1))
    >>> SpectralConv(3, 5, k=8)(torch.randn(36, 3), lb).shape
    torch.Size([36, 5])
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        num_filters: int = 8,
        k: int = 128,
        scale: float = 10.0,
        bias: bool = True,
    ) -> None:
        super().__init__()
        self.in_channels, self.out_channels = in_channels, out_channels
        self.num_filters, self.k, self.scale = num_filters, k, scale
        self.weight = nn.Parameter(torch.empty(num_filters, out_channels, in_channels))
        self.bias = nn.Parameter(torch.zeros(out_channels)) if bias else None
        nn.init.normal_(self.weight, std=1 / math.sqrt(in_channels * num_filters))

    def forward(self, x: Float[Tensor, "*B N C"], lb: LaplaceBeltrami) -> Float[Tensor, "*B N D"]:
        """Features (…, N, out_channels) of x (…, N, in_channels), in its type, on the shape or batch of `lb`."""
        dtype = check_features(x, lb, self.in_channels, self.weight, self.k)
        basis = lb.eigenbasis(self.k)
        with torch.autocast(x.device.type, enabled=False):
            u = basis.eigenvalues.to(dtype) / (basis.eigenvalues.to(dtype) + self.scale)
            shifted = partial(torch.mul, 2 * u - 1)
            polynomials = chebyshev_vectors(shifted, torch.ones_like(u), self.num_filters)
            polynomials = torch.stack(list(polynomials), -1)
            filters = torch.einsum("...kf,foi->...koi", polynomials, self.weight.to(dtype))
            coefficients = basis.analyse(x.to(dtype))
            y = basis.from_basis((filters @ coefficients[..., None])[..., 0])
        y = y.to(x.dtype)
        return y if self.bias is None else y + self.bias.to(y.dtype)

    def extra_repr(self) -> str:
        """Channels, filters, k."""
        filters = f"num_filters={self.num_filters}, k={self.k}"
        return f"{self.in_channels}, {self.out_channels}, {filters}"
