"""Layers on tangent fields: diffusion by the connection Laplacian, and a block of functions and fields.

Fields are given in the frames, (N, d, C) or (B, N, d, C), as `lb.local_gradient` gives them. Other frames leave
functions as they are and turn the components of fields.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchlb.errors import InputError
from torchlb.linalg.checks import check_choice, check_operator, check_tensor
from torchlb.nn.diffusion import diffusion_by
from torchlb.nn.gradient_features import TangentMap
from torchlb.nn.pointwise import mlp, unrounded
from torchlb.operator.laplace_beltrami import LaplaceBeltrami

FieldMethod = Literal["spectral", "implicit"]
Functions = Float[Tensor, "*B N C"]
Fields = Float[Tensor, "*B N d C"]


class TangentDiffusion(nn.Module):
    """Diffusion of tangent fields by `lb.connection`, for the learned times of `diffusion`, a layer for functions.

    Parameters
    ----------
    channels, init_time
        C, and the initial time, ℓ².
    method, k
        "spectral" is `Diffusion` by the first k eigenfields; "implicit" is one implicit step, as `ImplicitDiffusion`.

    Examples
    --------
    >>> from torchlb.surfaces import Sphere
    >>> lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(300)).float()
    >>> u = lb.local_gradient(lb.points)  # λ = 1
    >>> bool((TangentDiffusion(3, k=16)(u, lb) - u * torch.exp(torch.tensor(-0.01))).abs().max() < 1e-3)
    True
    """

    def __init__(
        self,
        channels: int,
        *,
        method: FieldMethod = "spectral",
        k: int = 128,
        init_time: float = 0.01,
    ) -> None:
        super().__init__()
        check_choice("method", method, FieldMethod)
        self.diffusion = diffusion_by(method, channels, k, init_time)

    def forward(self, u: Fields, lb: LaplaceBeltrami) -> Fields:
        """Diffuse fields u on the shape or batch of `lb`; shape and type stay, and InputError is raised for others."""
        check_operator(lb)
        check_tensor(u, "u")
        if u.ndim not in (3, 4) or u.shape[-3:-1] != (lb.num_points, lb.dim):
            raise InputError(
                f"u: expected fields in the frames, (N, d, C) or (B, N, d, C) with N = {lb.num_points}, d = {lb.dim}, "
                f"got {tuple(u.shape)}; lb.connection.components(v) makes (N d, C) of space vectors"
            )
        return self.diffusion(u.flatten(-3, -2), lb.connection).view_as(u)


class TangentBlock(nn.Module):
    """Functions x and tangent fields u diffuse to x' and u', act on each other, and are added to.

    With m = A(u, u', ∇x') by a `TangentMap` a pointwise network of x, x', tanh⟨m, ∇x'⟩, tanh⟨m, u'⟩, tanh div u' and,
    with rotations, tanh curl u' gives what is added to x, and gates g; (1 + g)m is added to u.

    Parameters
    ----------
    width, hidden, dropout, rotations
        Channels C of functions and of fields; the others as for `DiffusionNetBlock`, rotations of the fields too.
    method, k
        Of the diffusion of both: "spectral" by k eigenpairs of each, or "implicit".

    Examples
    --------
    >>> from torchlb.surfaces import Sphere
    >>> lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(300)).float()
    >>> x, u = TangentBlock(3, k=16)(lb.points, lb.local_gradient(lb.points), lb)
    >>> x.shape, u.shape
    (torch.Size([300, 3]), torch.Size([300, 2, 3]))
    """

    def __init__(
        self,
        width: int,
        *,
        hidden: Sequence[int] | None = None,
        dropout: bool = True,
        rotations: bool = True,
        method: FieldMethod = "spectral",
        k: int = 128,
    ) -> None:
        super().__init__()
        self.tangent_diffusion = TangentDiffusion(width, method=method, k=k)
        self.diffusion = diffusion_by(method, width, k)
        self.map = TangentMap(3 * width, width, rotations=rotations)
        hidden = [width, width] if hidden is None else hidden
        self.mlp = mlp((6 if rotations else 5) * width, hidden, 2 * width, dropout)

    def forward(self, x: Functions, u: Fields, lb: LaplaceBeltrami) -> tuple[Functions, Fields]:
        """Functions x (…, N, C) and fields u (…, N, d, C) after the block, on the shape or batch of `lb`.

        Raises InputError for another shape or type, and for rotations where d is not 2.
        """
        x = unrounded(x, lb, self.diffusion.channels, self.diffusion.raw_time)
        smooth, field = self.diffusion(x, lb), self.tangent_diffusion(u, lb).to(x)
        gradient = lb.local_gradient(smooth).to(x)
        mapped = self.map.mapped(torch.cat([u.to(x), field, gradient], dim=-1))
        products = [(mapped * gradient).sum(-2), (mapped * field).sum(-2)]
        products += _divergence_and_curl(field, lb)[: 2 if self.map.rotations else 1]
        added = self.mlp(torch.cat([x, smooth, *map(torch.tanh, products)], dim=-1))
        added, gates = added.chunk(2, dim=-1)
        return x + added, u + (1 + gates[..., None, :]) * mapped


def _divergence_and_curl(u: Fields, lb: LaplaceBeltrami) -> list[Functions]:
    """div u and, where d = 2, curl u by the components E_a·∂_b u of the covariant derivative."""
    vectors = lb._turned("ind,...idc->...inc", u)
    change = lb.local_gradient(vectors.flatten(-2)).to(u).unflatten(-1, vectors.shape[-2:])
    change = lb._turned("ina,...ibnc->...iabc", change)
    found = [change.diagonal(dim1=-3, dim2=-2).sum(-1)]
    return found if lb.dim != 2 else [*found, change[..., 1, 0, :] - change[..., 0, 1, :]]
