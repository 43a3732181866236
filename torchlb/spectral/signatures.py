r"""Signatures, wavelets and diffusion maps from the eigenbasis.

Every function takes the operator, whose basis is solved once and kept, and `k`, the number of pairs to use. A batch of
shapes gives the results of its shapes, concatenated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from torchlb.errors import EigenbasisError, InputError, shown
from torchlb.linalg.checks import check_operator, check_sources, takes_arrays
from torchlb.spectral.eigenbasis import Eigenbasis, Spectral


def _basis(lb: Spectral, k: int) -> tuple[Eigenbasis, Tensor]:
    """The basis of k pairs, and its eigenvalues; InputTypeError for anything but an operator."""
    check_operator(lb)
    basis = lb.eigenbasis(k)
    return basis, basis.eigenvalues


def _present(basis: Eigenbasis) -> Tensor:
    """Mask of the pairs of each shape, without padding: (k,) or (S, k)."""
    if basis.sizes is None:
        return torch.ones_like(basis.eigenvalues, dtype=torch.bool)
    return torch.stack([(part != 0).any(0) for part in basis.eigenvectors.split(basis.sizes)])


def _first_positive(basis: Eigenbasis) -> Tensor:
    """λ_1, the smallest positive eigenvalue, (1,) or (S, 1); EigenbasisError if a shape has none."""
    values = basis.eigenvalues
    first = torch.where(values > 0, values, torch.inf).amin(-1, keepdim=True)
    if first.isinf().any():
        raise EigenbasisError(
            f"signature: expected a positive eigenvalue, got {values.shape[-1]} pairs of eigenvalue zero, one for each "
            "connected component; ask for a larger k"
        )
    return first


def _evenly(start: Tensor, end: Tensor, count: int) -> Tensor:
    """`count` equally spaced numbers from start to end, along the last axis."""
    fraction = torch.linspace(0, 1, count, dtype=start.dtype, device=start.device)
    return start * (1 - fraction) + end * fraction


def _numbers(name: str, given: Any, values: Tensor, least: float = 0.0) -> Float[Tensor, " T"]:
    """One number or a list of them, in the type of the eigenvalues; InputError unless each is at least `least`."""
    dtype = given.dtype if isinstance(given, Tensor) else torch.float64
    found = torch.as_tensor(given, dtype=dtype).to(values)
    if found.ndim > 1 or not found.numel() or not bool(((found >= least) & found.isfinite()).all()):
        raise InputError(
            f"{name}: expected one finite number or more, none below {least:g}, got {shown(given)}"
        )
    return found.reshape(-1)


def heat_kernel_signature(
    lb: Spectral,
    times: Float[Tensor, " T"] | Sequence[float] | float | None = None,
    *,
    count: int = 16,
    k: int = 128,
) -> Float[Tensor, "N T"]:
    """The heat that remains at its source: Σ_k e^{−λ_k t} φ_k(x)², 1/ℓ^d (Sun, Ovsjanikov, Guibas 2009).

    Parameters
    ----------
    lb
        Operator of one shape or of a batch.
    times
        ℓ². By default `count` of them, from 4 ln 10/λ_k to 4 ln 10/λ_1 of each shape, equally spaced in log t.
    k
        Number of eigenpairs.

    Examples
    --------
    >>> from torchlb import LaplaceBeltrami
    >>> theta = torch.arange(36, dtype=torch.float64) * torch.pi / 18
    >>> lb = LaplaceBeltrami.from_points(torch.stack([theta.cos(), theta.sin()], dim=1))
    >>> bool((heat_kernel_signature(lb, torch.tensor([50.0])) * lb.mass.sum()).allclose(torch.tensor(1.0).double()))
    True
    """
    basis, values = _basis(lb, k)
    if times is None:
        first, last = values[..., -1:].log(), _first_positive(basis).log()
        times = 4 * math.log(10) / _evenly(first, last, count).exp()
    else:
        times = _numbers("times", times, values)
    decay = torch.exp(-values[..., :, None] * times[..., None, :])
    return basis.synthesise(basis.eigenvectors**2, decay)


def wave_kernel_signature(
    lb: Spectral,
    energies: Float[Tensor, " T"] | Sequence[float] | float | None = None,
    *,
    count: int = 16,
    k: int = 128,
    width: float = 7.0,
) -> Float[Tensor, "N T"]:
    """Probability that a quantum particle of energy e is at x, a band-pass (Aubry, Schlickewei, Cremers 2011).

    Σ_k φ_k(x)² exp(−(e − ln λ_k)²/2σ²), divided by Σ_k exp(…), over λ_k > 0; 1/ℓ^d.

    Parameters
    ----------
    lb, k
        Operator of one shape or of a batch, and number of its eigenpairs.
    energies
        e, logarithms of eigenvalues in 1/ℓ². By default `count`, equally spaced from ln λ_1 + 2σ to ln λ_k − 2σ of each
        shape, where σ is `width` times their spacing in the original: (ln λ_k − ln λ_1)/100.
    width
        Width σ of the Gaussians, in units of that spacing.
    """
    basis, values = _basis(lb, k)
    low, high = _first_positive(basis).log(), values[..., -1:].log()
    sigma = width * (high - low) / 100 + torch.finfo(values.dtype).eps
    if energies is None:
        energies = _evenly(low + 2 * sigma, high - 2 * sigma, count)
    else:
        energies = _numbers("energies", energies, values, -torch.inf)
    positive = (values > 0) & _present(basis)
    logs = torch.where(positive, values, values.new_ones(())).log()
    exponent = -(((energies[..., None, :] - logs[..., :, None]) / sigma[..., None]) ** 2) / 2
    weights = torch.where(positive[..., :, None], exponent, -torch.inf).softmax(dim=-2)
    return basis.synthesise(basis.eigenvectors**2, weights)


@takes_arrays
def spectral_wavelets(
    lb: Spectral,
    f: Shaped[Tensor, "N C"] | Shaped[Tensor, " N"],
    scales: Float[Tensor, " T"] | Sequence[float] | float,
    *,
    k: int = 128,
) -> Float[Tensor, "N T_plus_1 *C"]:
    """Wavelet coefficients of f: one low-pass and T band-pass copies (Hammond, Vandergheynst, Gribonval 2011).

    The bands are g(sλ) with g(z) = z e^{1−z}, the low-pass e^{−λ s_max}, all divided by the root of the sum of their
    squares, so that the frame is tight: applying them again and summing gives f's part in the span of the k
    eigenvectors, and Σ |coefficients|²_π is its energy.

    Parameters
    ----------
    lb, f
        Operator of one shape or of a batch, and a function (N,) or (N, C).
    scales
        s, ℓ²; a band has its peak at the eigenvalue 1/s.
    """
    if isinstance(f, Tensor) and f.ndim == 1:
        return spectral_wavelets(lb, f[:, None], scales, k=k)[..., 0]
    basis, values = _basis(lb, k)
    gains = _wavelet_gains(values, _numbers("scales", scales, values))
    coefficients = basis.to_basis(f)
    gains = gains.to(coefficients.dtype)[..., None]
    return torch.stack([basis.from_basis(g * coefficients) for g in gains.unbind(-2)], dim=-2)


def _wavelet_gains(values: Tensor, scales: Tensor) -> Tensor:
    """Gains (…, k, T + 1) of the low-pass and the bands, with Σ gain² = 1 at each eigenvalue."""
    z = values[..., None] * scales
    low = torch.exp(-values[..., None] * scales.max())
    bands = torch.cat([low, z * torch.exp(1 - z)], dim=-1)
    norm = bands.square().sum(-1, keepdim=True).sqrt()
    # Far above all bands every gain underflows; the finest band takes these eigenvalues.
    finest = torch.nn.functional.one_hot(scales.argmin() + 1, len(scales) + 1).to(values)
    return torch.where(norm > 1e-30, bands / norm.clamp_min(1e-30), finest)


def diffusion_map(
    lb: Spectral, time: float, *, dim: int = 2, k: int | None = None
) -> Float[Tensor, "N dim"]:
    """Coordinates e^{−λ_k t} φ_k(x) in which distances are diffusion distances (Coifman, Lafon 2006); ℓ^{−d/2}.

    The constants, of λ_0 = 0, are left out; a shape with a Dirichlet or Robin condition has none. `k` eigenpairs of
    `lb`, `dim` + 1 or more, may be asked for to share a basis. The `time` is in ℓ². A cloud may lie in any Rⁿ.
    """
    basis, values = _basis(lb, max(dim + 1, k or 0))
    decay = torch.exp(-values * _numbers("time", time, values))
    chosen = torch.arange(min(dim, values.shape[-1] - 1), device=values.device)
    chosen = chosen + (values[..., :1] == 0).long()
    columns = torch.nn.functional.one_hot(chosen, values.shape[-1]).mT * decay[..., None]
    return basis.from_basis(columns)


def diffusion_distance(
    lb: Spectral, sources: int | Sequence[int] | Tensor, time: float, *, k: int = 128
) -> Float[Tensor, "N S"]:
    """Diffusion distance of every point to each source: (Σ_k e^{−2λ_k t}(φ_k(x) − φ_k(y))²)^{1/2}, ℓ^{−d/2}.

    It is the L² distance between heat that spreads on `lb` from a point x and from y for the `time` t, ℓ², seen by `k`
    eigenpairs. The `sources` y are an index, several, or a mask of the points. Raises InputError for others, and for a
    batch.
    """
    basis, values = _basis(lb, k)
    if basis.sizes is not None:
        raise InputError("diffusion_distance: got a batch; ask each shape by itself")
    index = check_sources(sources, len(basis.mass))
    coordinates = basis.eigenvectors * torch.exp(-values * _numbers("time", time, values))
    # By a matrix product the distance of a point from itself would not be zero.
    mode = "donot_use_mm_for_euclid_dist"
    return torch.cdist(coordinates, coordinates[index.to(values.device)], compute_mode=mode)
