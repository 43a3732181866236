"""Heat flow e^{tΔ}f, for given times and for learned ones (`method.md`, section 8).

method="full", the default, is exact at every scale: on the span of the slow eigenvectors by their own small matrix, on
the rest, split off by the oblique projector, by a short Chebyshev series, since nothing of it is left after about
16/λ_k. "spectral" is the first part alone: everything beyond the basis is dropped, also as t → 0. "chebyshev" and
"rational" need no basis.
"""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import softplus

from torchlb.errors import DiffusionError, InputError
from torchlb.linalg.exponential import EXPANSIONS, heat
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.spectral.eigenbasis import Eigenbasis

__all__ = ["Diffusion", "heat_flow", "raw_of_time"]

METHODS = ["full", "spectral", *EXPANSIONS]
TOLERANCE = 1e-7
SHARPNESS = 100.0
"""Of the softplus that keeps learned times positive: above 0.05 ℓ² it is the identity to 1 %."""


def heat_flow(
    lb: LaplaceBeltrami,
    f: Float[Tensor, "*B N C"] | Float[Tensor, " N"],
    t: float | Tensor,
    *,
    method: str = "full",
    k: int = 128,
    tolerance: float = TOLERANCE,
) -> Tensor:
    """e^{tΔ}f: what f becomes when it diffuses over the surface for a time t; differentiable in f and t.

    Parameters
    ----------
    lb : operator of one shape, or of a batch.
    f : (N,), (N, C) or (B, N, C).
    t : time ≥ 0 in ℓ², one for all channels or (C,). (In a time t a peak spreads to a width of √(2t).)
    method : "full", "spectral", "chebyshev" or "rational".
    k : number of eigenpairs, for the first two.
    tolerance : of the others, relative to f.

    Raises
    ------
    ValueError : for negative times, an unknown method, or a time that would take too many products.
    DiffusionError : where the eigenbasis cannot be had.

    Examples
    --------
    >>> theta = torch.arange(36, dtype=torch.float64) * torch.pi / 18
    >>> lb = LaplaceBeltrami.from_points(torch.stack([theta.cos(), theta.sin()], dim=1))
    >>> bool(torch.allclose(heat_flow(lb, theta.cos(), 0.5), math.exp(-0.5) * theta.cos(), atol=1e-2))
    True
    """
    check_method(method)
    x = f[:, None] if f.ndim == 1 else f
    time = torch.as_tensor(t, dtype=torch.promote_types(x.dtype, torch.float32), device=x.device)
    if not torch.compiler.is_compiling() and bool((time < 0).any()):
        raise InputError(f"t: expected times of at least 0, got {float(time.min()):.3g}")
    time = time.expand(x.shape[-1])
    y = _flow(lb, x, time, method, k, tolerance)
    return y[:, 0] if f.ndim == 1 else y


def check_method(method: str) -> None:
    """ValueError for a method that is none."""
    if method not in METHODS:
        raise InputError(f"method: expected one of {METHODS}, got {method!r}")


def _flow(
    lb: LaplaceBeltrami, x: Tensor, time: Tensor, method: str, k: int, tolerance: float
) -> Tensor:
    """e^{tΔ}x, computed in the wider of the types of x and the operator, at least float32, also under autocast."""
    if not (x.ndim in (2, 3) and x.shape[-2] == lb.num_points):
        raise InputError(
            f"expected features of shape (N, C) or (B, N, C) with N = {lb.num_points}, got {tuple(x.shape)}"
        )
    dtype = torch.promote_types(torch.promote_types(x.dtype, lb.values.dtype), torch.float32)
    with torch.autocast(x.device.type, enabled=False):
        wide, time = x.to(dtype), time.to(dtype)
        if method == "spectral":
            y = _spectral(lb.eigenbasis(k), wide, time)
        elif method == "full":
            y = _full(lb, lb.eigenbasis(k, closed=True), wide, time, tolerance)
        else:
            y = _expanded(lb, wide, time, method, tolerance)
    return y.to(x.dtype) if x.dtype.itemsize < 4 else y


def _spectral(basis: Eigenbasis, x: Tensor, time: Tensor) -> Tensor:
    """Φ e^{−λt} Φᵀ(πx)."""
    decay = torch.exp(-basis.eigenvalues.to(x.dtype)[..., None] * time)
    return basis.from_basis(decay * basis.to_basis(x))


def _full(
    lb: LaplaceBeltrami, basis: Eigenbasis, x: Tensor, time: Tensor, tolerance: float
) -> Tensor:
    """e^{−tB} on the span, a series on the rest, whose time is cut where it has decayed below the tolerance."""
    if basis.modal_transform is None or basis.decay_rates is None:
        raise DiffusionError(
            "method='full': the slow eigenvectors are too close to dependent, or fewer than the components; "
            "ask for another k, or use method='chebyshev' or 'spectral'"
        )
    coefficients = basis.to_basis_obliquely(x)
    v, inverse, turned = basis.modal_transform.to(x.dtype).unbind(-3)
    rates, frequencies = basis.decay_rates.to(x.dtype)[..., None].unbind(-3)
    decay = torch.exp(-rates * time)
    flowed = decay * (frequencies * time).cos() * (inverse @ coefficients)
    flowed = v @ (flowed + decay * (frequencies * time).sin() * (turned @ coefficients))
    slow = basis.from_basis(flowed)
    k = basis.eigenvectors.shape[1]
    if max(basis.sizes or (lb.num_points,)) <= k:
        return slow
    rest = x - basis.from_basis(coefficients)
    fastest = rates.amax((-2, -1))
    if basis.sizes is not None:  # a shape whose basis is complete has no rest
        incomplete = torch.tensor([size > k for size in basis.sizes], device=x.device)
        fastest = torch.where(incomplete, fastest, torch.inf).amin()
    enough = math.log(1 / tolerance) / fastest
    return slow + _expanded(lb, rest, torch.minimum(time, enough), "either", tolerance)


def _expanded(
    lb: LaplaceBeltrami, x: Tensor, time: Tensor, expansion: str, tolerance: float
) -> Tensor:
    """e^{tΔ}x by one of the expansions; the surfaces of a stack (B, N, C) become channels."""
    radius, height = lb.spectral_bounds
    if height is None:
        if expansion == "chebyshev":
            raise DiffusionError(
                "method='chebyshev': no ellipse in the left half plane holds the spectrum, as on an operator that "
                "is not stable; build it with certify=True, or use method='rational'"
            )
        expansion = "rational"
    extent = radius, height or 0.0
    pattern = [lb.crow, lb.col, lb.crow_t, lb.col_t, lb.order_t]
    values = lb.values.to(x.dtype)
    options = extent, expansion, tolerance, lb.sizes or (lb.num_points,)
    if x.ndim == 2:
        return heat(pattern, values, x, time, *options)
    columns = x.transpose(0, 1).flatten(1)
    y = heat(pattern, values, columns, time.repeat(len(x)), *options)
    return y.view(x.shape[1], x.shape[0], x.shape[2]).transpose(0, 1)


class Diffusion(nn.Module):
    """Diffusion of each channel for a time of its own, which is learned: y_c = e^{t_c Δ}x_c.

    Parameters
    ----------
    channels : C.
    method : "full" (exact at every scale), "spectral" (of the original DiffusionNet: Φe^{−λt}Φᵀπ, which drops
        everything beyond the basis), "chebyshev" or "rational" (no basis; the latter solves on the CPU).
    k : number of eigenpairs for the first two.
    init_time : ℓ², at the start. Shapes of radius about one are expected.
    tolerance : of "full", "chebyshev" and "rational", relative to x.

    Attributes
    ----------
    raw_time : (C,), the parameter; the times are t = softplus(100 raw)/100, positive by construction.

    Examples
    --------
    >>> theta = torch.arange(36) * torch.pi / 18
    >>> lb = LaplaceBeltrami.from_points(torch.stack([theta.cos(), theta.sin()], dim=1))
    >>> layer = Diffusion(3)
    >>> layer(torch.ones(36, 3), lb).mean().item()
    1.0
    """

    def __init__(
        self,
        channels: int,
        method: str = "full",
        *,
        k: int = 128,
        init_time: float = 0.01,
        tolerance: float = TOLERANCE,
    ) -> None:
        super().__init__()
        check_method(method)
        self.channels, self.method, self.k, self.tolerance = channels, method, k, tolerance
        self.raw_time = nn.Parameter(raw_of_time(torch.full((channels,), init_time)))

    @property
    def time(self) -> Float[Tensor, " C"]:
        """Diffusion times t > 0, ℓ²."""
        return softplus(self.raw_time, beta=SHARPNESS)

    def forward(self, x: Float[Tensor, "*B N C"], lb: LaplaceBeltrami) -> Float[Tensor, "*B N C"]:
        """The diffused features, of the shape of x: (N, C), or (B, N, C) on one surface."""
        if not (x.shape[-1] == self.channels):
            raise InputError(f"expected {self.channels} channels, got x of shape {tuple(x.shape)}")
        return _flow(lb, x, self.time, self.method, self.k, self.tolerance)

    def extra_repr(self) -> str:
        """Channels, method, k."""
        basis = f", k={self.k}" if self.method in ("full", "spectral") else ""
        return f"{self.channels}, method={self.method!r}{basis}"


def raw_of_time(time: Float[Tensor, " C"]) -> Float[Tensor, " C"]:
    """The parameter of `Diffusion` whose time is the given one, t > 0.

    >>> bool(softplus(raw_of_time(torch.tensor([1e-8, 0.5])), beta=100.0).allclose(torch.tensor([1e-8, 0.5])))
    True
    """
    double = time.double()
    return (double + torch.log(-torch.expm1(-SHARPNESS * double)) / SHARPNESS).to(time.dtype)
