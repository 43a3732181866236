"""A block that acts on gradients and comes back by a Poisson solve: global in one step, and no eigenbasis.

After PoissonNet (Maesumi, Thambiraja and others 2025), here with gradients at the points, mapped as in DiffusionNet.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchlb.nn.gradient_features import TangentMap
from torchlb.nn.pointwise import mlp
from torchlb.nn.solves import potential
from torchlb.operator.laplace_beltrami import LaplaceBeltrami


class PoissonFeatures(TangentMap):
    """u_c with ∇u_c closest to the field g_c Σ_j A_cj ∇x_j, of mean zero: Ku = ∇ᵀ(π v) for each field v.

    The map A of the gradients is linear, the gates g = sigmoid(Bx + b) are pointwise: where they close the field stops,
    as at an edge. With gates and A of one u is x less its mean.

    Parameters
    ----------
    channels, rotations : C, and whether A is complex, see `TangentMap`.
    tolerance : of the solves with the weak pair, relative; by default linear elements are taken, one exact solve, since
        what is learned has no need of more. Without a weak pair the stencil's.
    """

    def __init__(
        self, channels: int, *, rotations: bool = True, tolerance: float | None = None
    ) -> None:
        super().__init__(channels, rotations=rotations)
        self.gate = nn.Linear(channels, channels)
        self.tolerance = tolerance

    def forward(self, x: Float[Tensor, "*B N C"], lb: LaplaceBeltrami) -> Float[Tensor, "*B N C"]:
        """The features of x, (N, C) or (B, N, C), in its shape and type."""
        _, field = self.gradients(x, lb)
        field = torch.sigmoid(self.gate(x))[..., None, :] * field
        return potential(lb, field, tolerance=self.tolerance)


class PoissonBlock(nn.Module):
    """Poisson features, a pointwise network of them and of what came in, and a skip connection.

    Parameters
    ----------
    width : channels in and out.
    hidden : widths of the hidden layers of the pointwise network; [width, width] by default.
    dropout : whether that network drops half of its hidden values while it trains.
    rotations, tolerance : of `PoissonFeatures`.

    Examples
    --------
    >>> from torchlb.surfaces import Sphere
    >>> vertices, faces = Sphere().mesh(300)
    >>> lb = LaplaceBeltrami.from_mesh(vertices.float(), faces)
    >>> PoissonBlock(3)(vertices.float(), lb).shape
    torch.Size([300, 3])
    """

    def __init__(
        self,
        width: int,
        *,
        hidden: Sequence[int] | None = None,
        dropout: bool = True,
        rotations: bool = True,
        tolerance: float | None = None,
    ) -> None:
        super().__init__()
        self.features = PoissonFeatures(width, rotations=rotations, tolerance=tolerance)
        hidden = [width, width] if hidden is None else hidden
        self.mlp = mlp([2 * width, *hidden, width], dropout)

    def forward(self, x: Float[Tensor, "*B N C"], lb: LaplaceBeltrami) -> Float[Tensor, "*B N C"]:
        """Features (N, width) or (B, N, width) in the shape of x."""
        return x + self.mlp(torch.cat([x, self.features(x, lb)], dim=-1))
