"""Features of gradients that do not depend on the choice of tangent frames, and blocks that end in them."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import linear

from torchlb.errors import InputError
from torchlb.nn.pointwise import Widths, check_features, mlp, unrounded
from torchlb.operator.laplace_beltrami import LaplaceBeltrami


class TangentMap(nn.Module):
    """A learned linear map of C tangent fields, Σ_j A_cj v_j, that commutes with rotations of the frames.

    Parameters
    ----------
    channels, out_channels
        C, and the number of the fields that it gives, C by default.
    rotations
        Whether A is complex, so that it also rotates vectors in the tangent plane; that needs a surface whose normals
        are oriented consistently (a mesh, or a cloud with oriented normals). A real A takes any dimension.
    """

    def __init__(
        self, channels: int, out_channels: int | None = None, *, rotations: bool = True
    ) -> None:
        super().__init__()
        self.channels, self.rotations = channels, rotations
        out = channels if out_channels is None else out_channels
        if rotations:
            self.A_re = nn.Linear(channels, out, bias=False)
            self.A_im = nn.Linear(channels, out, bias=False)
        else:
            self.A = nn.Linear(channels, out, bias=False)

    def gradients(self, x: Tensor, lb: LaplaceBeltrami) -> tuple[Tensor, Tensor]:
        """∇x in the frames, and its image under the map, (…, N, d, C); x of (N, C) or (B, N, C)."""
        dtype = check_features(x, lb, self.channels, next(self.parameters()))
        rows = [lb.stencil.product(1 + c, x, dtype=dtype) for c in range(lb.dim)]
        gradient = torch.stack(rows, dim=-2)
        return gradient, self.mapped(gradient)

    def mapped(self, v: Float[Tensor, "*B N d C"]) -> Float[Tensor, "*B N d D"]:
        """The image of tangent fields, given in the frames."""
        if not self.rotations:
            return self.A(v)
        if (dim := v.shape[-2]) != 2:
            raise InputError(f"rotations need a surface, got dim={dim}; use rotations=False")
        # the complex z ↦ Az as a real map of real and imaginary parts, concatenated
        upper = torch.cat([self.A_re.weight, -self.A_im.weight], dim=1)
        lower = torch.cat([self.A_im.weight, self.A_re.weight], dim=1)
        return linear(v.flatten(-2), torch.cat([upper, lower])).unflatten(-1, (2, -1))


class GradientFeatures(TangentMap):
    """Features tanh(Re⟨∇x_c, Σ_j A_cj ∇x_j⟩) of the gradients, the same in any tangent frame.

    Parameters
    ----------
    channels, rotations
        C, and whether A is complex, see `TangentMap`.

    Examples
    --------
    >>> theta = torch.arange(36) * torch.pi / 18
    >>> lb = LaplaceBeltrami.from_points(torch.stack([theta.cos(), theta.sin()], dim=1))
    >>> GradientFeatures(3, rotations=False)(torch.ones(36, 3), lb).abs().max() < 1e-5
    tensor(True)
    """

    def forward(self, x: Float[Tensor, "*B N C"], lb: LaplaceBeltrami) -> Float[Tensor, "*B N C"]:
        """Features of x, (N, C) or (B, N, C), on the shape or batch of `lb`, in the shape and type of x."""
        gradient, mapped = self.gradients(x, lb)
        return torch.tanh((gradient * mapped).sum(-2))


class GradientBlock(nn.Module):
    """A named layer, gradient features of its result, a pointwise network of x and both, and a skip connection."""

    def __init__(
        self, name: str, layer: Any, hidden: Widths, dropout: bool, gradients: bool, rotations: bool
    ) -> None:
        super().__init__()
        self.add_module(name, layer)
        self._layer, width = name, layer.channels
        self.gradient_features = GradientFeatures(width, rotations=rotations) if gradients else None
        self.mlp = mlp((3 if gradients else 2) * width, hidden, width, dropout)

    def forward(self, x: Float[Tensor, "*B N C"], lb: LaplaceBeltrami) -> Float[Tensor, "*B N C"]:
        """Features of x, (N, width) or (B, N, width), on the shape or batch of `lb`, in the shape of x."""
        layer: Any = getattr(self, self._layer)
        features = [x, layer(unrounded(x, lb, layer.channels, next(layer.parameters())), lb)]
        if self.gradient_features is not None:
            features.append(self.gradient_features(features[1], lb))
        return x + self.mlp(torch.cat(features, dim=-1))
