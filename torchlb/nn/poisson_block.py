"""A block that solves a Poisson problem for learned sources: global in one step, without an eigenbasis.

After PoissonNet (Maesumi, Thambiraja and others 2025), which maps gradients and returns to functions by such a solve.
Sources at the points are added, since mapped gradients alone reproduce the input (benchmarks/README.md, learning).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from torchlb.nn.gradient_features import GradientBlock, TangentMap
from torchlb.nn.pointwise import check_features
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.operator.systems import Tolerance
from torchlb.pde.solves import potential

SOURCE = 3.0
"""Initial size of the sources relative to the features, 1/ℓ²: about λ_1 of a shape of radius one."""


class PoissonFeatures(nn.Module):
    """u_c with −Δu_c = s_c − ∇·v_c, of mean zero, for learned sources s = Wx and fields v.

    The optional fields are g_c Σ_j A_cj ∇x_j: a linear map A of the gradients and gates g = sigmoid(Bx + b); where a
    gate closes the field ends, as at an edge. With gates and A equal to one and no source u is x less its mean.

    Parameters
    ----------
    channels, fields, rotations
        C, whether there are fields, which make a training step a third longer, and whether A is complex (`TangentMap`).
    tolerance
        Relative tolerance of the solves with the weak pair; "P1" for one exact solve by P1 elements, which is accurate
        enough for learning.
    """

    def __init__(
        self,
        channels: int,
        *,
        fields: bool = False,
        rotations: bool = True,
        tolerance: Tolerance = "P1",
    ) -> None:
        super().__init__()
        self.channels = channels
        self.tolerance: Tolerance = tolerance
        self.source = nn.Linear(channels, channels, bias=False)
        with torch.no_grad():
            self.source.weight.mul_(SOURCE)
        self.map = TangentMap(channels, rotations=rotations) if fields else None
        self.gate = nn.Linear(channels, channels) if fields else None

    def forward(self, x: Float[Tensor, "*B N C"], lb: LaplaceBeltrami) -> Float[Tensor, "*B N C"]:
        """Features of x, (N, C) or (B, N, C), on the shape or batch of `lb`, in the shape and type of x."""
        dtype = check_features(x, lb, self.channels, self.source.weight)
        field = None
        if self.map is not None and self.gate is not None:
            _, field = self.map.gradients(x, lb)
            field = (torch.sigmoid(self.gate(x))[..., None, :] * field).to(dtype)
        u = potential(lb, field, self.source(x).to(dtype), tolerance=self.tolerance)
        return u.to(x.dtype)


class PoissonBlock(GradientBlock):
    """Poisson features, gradient features of them, a pointwise network of these and x, and a skip connection.

    Parameters
    ----------
    width, hidden, dropout, gradient_features, rotations
        As for `DiffusionNetBlock`.
    fields, tolerance
        Arguments of `PoissonFeatures`.

    Examples
    --------
    >>> from torchlb.surfaces import Sphere
    >>> lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(300)).float()
    >>> PoissonBlock(3)(lb.points, lb).shape
    torch.Size([300, 3])
    """

    def __init__(
        self,
        width: int,
        *,
        hidden: Sequence[int] | None = None,
        dropout: bool = True,
        gradient_features: bool = True,
        rotations: bool = True,
        fields: bool = False,
        tolerance: Tolerance = "P1",
    ) -> None:
        layer = PoissonFeatures(width, fields=fields, rotations=rotations, tolerance=tolerance)
        super().__init__("features", layer, hidden, dropout, gradient_features, rotations)
