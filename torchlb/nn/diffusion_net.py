"""DiffusionNet (Sharp, Attaiki, Crane, Ovsjanikov 2022) on any operator: diffusion, gradients, pointwise networks.

Differences from the original: the operator is one argument, `forward(x, lb)`; learned times are positive by
parametrisation; batches of different shapes are one operator; diffusion has other methods than "spectral". Weights
trained on the original load: `load_original_state_dict`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.functional import linear

from torchlb.errors import InputError
from torchlb.linalg.checks import check_choice, check_tensor
from torchlb.nn.diffusion import diffusion_by, raw_of_time
from torchlb.nn.gradient_features import GradientBlock, TangentMap
from torchlb.nn.pointwise import unrounded
from torchlb.nn.poisson_block import PoissonBlock
from torchlb.nn.tangent import TangentBlock
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.pde.heat import Method

Place = Literal["vertices", "edges", "faces", "global_mean", "tangent"]
Block = Literal["diffusion", "implicit", "poisson"]
LEAST_TIME = 1e-8
"""Least time in the original, which clamps its times to it before use, ℓ²."""


class DiffusionNetBlock(GradientBlock):
    """Diffusion, gradient features of the result, a pointwise network of x and both, and a skip connection.

    Parameters
    ----------
    width
        Channels in and out.
    hidden, dropout
        Widths of the hidden layers of the pointwise network, [width, width] by default, and whether it drops half of
        its hidden values in training.
    gradient_features, rotations
        Whether there are gradient features, and whether they rotate gradients: see `GradientFeatures`.
    method, k
        Arguments of `Diffusion`; method="implicit" uses `ImplicitDiffusion` instead.
    """

    def __init__(
        self,
        width: int,
        *,
        hidden: Sequence[int] | None = None,
        dropout: bool = True,
        gradient_features: bool = True,
        rotations: bool = True,
        method: Method | Literal["implicit"] = "spectral",
        k: int = 128,
    ) -> None:
        layer = diffusion_by(method, width, k)
        super().__init__("diffusion", layer, hidden, dropout, gradient_features, rotations)


class DiffusionNet(nn.Module):
    """A network of `num_blocks` blocks between two pointwise linear maps.

    Blocks communicate by diffusion in an eigenbasis, "diffusion", or without one: by an "implicit" step of diffusion
    (`ImplicitDiffusion`), or by a Poisson solve, "poisson" (`PoissonBlock`).

    Parameters
    ----------
    in_channels, out_channels, width
        Channels of the features, of the output, and of the blocks.
    num_blocks, block
        Number of blocks, and their kind: "diffusion", "implicit" or "poisson".
    outputs_at
        "vertices", "edges", "faces" (means over the corners) or "global_mean" (over the surface, by mass); "tangent"
        for tangent fields as space vectors at the vertices, with tangent=True.
    last_activation
        Applied to the output, such as ``lambda y: y.log_softmax(-1)``.
    hidden, dropout, gradient_features, rotations, method, k
        Arguments of the blocks, the last two of "diffusion" blocks.
    tangent
        Whether blocks are `TangentBlock`, whose fields start as gradients of the first linear map: "diffusion" blocks
        with method="spectral", or "implicit" ones.

    Raises InputError for an unknown block, method or value of `outputs_at`, and for options that do not go with
    `tangent`.

    Examples
    --------
    >>> theta = torch.arange(36) * torch.pi / 18
    >>> circle = torch.stack([theta.cos(), theta.sin()], dim=1)
    >>> lb = LaplaceBeltrami.from_points(circle)
    >>> DiffusionNet(2, 5, width=8, rotations=False)(circle, lb).shape
    torch.Size([36, 5])
    """

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        *,
        width: int = 128,
        num_blocks: int = 4,
        block: Block = "diffusion",
        outputs_at: Place = "vertices",
        last_activation: Callable[[Tensor], Tensor] | None = None,
        hidden: Sequence[int] | None = None,
        dropout: bool = True,
        gradient_features: bool = True,
        rotations: bool = True,
        method: Method = "spectral",
        k: int = 128,
        tangent: bool = False,
    ) -> None:
        super().__init__()
        check_choice("outputs_at", outputs_at, Place)
        check_choice("block", block, Block)
        with_fields = block != "poisson" and gradient_features
        if (outputs_at == "tangent" and not tangent) or (tangent and not with_fields):
            raise InputError(
                "tangent fields: expected tangent=True, gradient features and block 'diffusion' or 'implicit', got "
                f"{tangent=}, {gradient_features=}, {block=}"
            )
        self.in_channels, self.out_channels = in_channels, out_channels
        self.outputs_at, self.last_activation = outputs_at, last_activation
        self.first_lin = nn.Linear(in_channels, width)
        shared = {"hidden": hidden, "dropout": dropout, "rotations": rotations}
        if not tangent:
            shared["gradient_features"] = gradient_features
        if block != "poisson":
            shared |= {"method": "implicit" if block == "implicit" else method, "k": k}
        plain = PoissonBlock if block == "poisson" else DiffusionNetBlock
        kind = TangentBlock if tangent else plain
        self.blocks = nn.ModuleList(kind(width, **shared) for _ in range(num_blocks))
        self.tangent, self.last_lin = tangent, nn.Linear(width, out_channels)
        if outputs_at == "tangent":
            self.last_lin = TangentMap(width, out_channels, rotations=rotations)

    def forward(
        self,
        x: Float[Tensor, "*B N C"],
        lb: LaplaceBeltrami,
        faces: Int[Tensor, "F corners"] | None = None,
        edges: Int[Tensor, "E ends"] | None = None,
    ) -> Tensor:
        """Outputs (…, N, out_channels), or (…, F, ·), (…, E, ·), (…, ·), (…, N, n, ·), according to `outputs_at`.

        Parameters
        ----------
        x, lb
            Features (N, in_channels), or (B, N, in_channels) of B inputs on one surface, and the operator of one shape
            or of a batch, whose global mean is (S, out_channels), one for each shape.
        faces, edges
            For outputs at faces or edges; in a batch, the indices of shape s moved by ``lb.offsets[s]``.
        """
        x = unrounded(x, lb, self.in_channels, self.first_lin.weight)
        y = self.first_lin(x)
        u = linear(lb.local_gradient(x).to(x), self.first_lin.weight) if self.tangent else None
        for block in self.blocks:
            y, u = (block(y, lb), None) if u is None else block(y, u, lb)
        if u is not None and isinstance(self.last_lin, TangentMap):
            y = lb._turned("ind,...idc->...inc", self.last_lin.mapped(u))
        else:
            y = self.last_lin(y)
        if self.outputs_at == "global_mean":
            y = (lb.integral(y) / lb.integral(torch.ones_like(lb.mass))[..., None]).to(y.dtype)
        elif self.outputs_at in ("faces", "edges"):
            corners = faces if self.outputs_at == "faces" else edges
            y = y[..., _checked_corners(self.outputs_at, corners, lb), :].mean(-2)
        return y if self.last_activation is None else self.last_activation(y)

    def load_original_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Load `state`, the weights of a trained network of the original code; strict.

        Parameters keep their names, except ``block_{i}``, which is ``blocks.{i}``, ``mlp.miniMLP_mlp_layer_{jjj}``,
        which is ``mlp.linear_{j}``, and ``diffusion.diffusion_time``, from which ``diffusion.raw_time`` follows.
        Times below 1e-8, which the original raises to it when it runs, become 1e-8. With method="spectral" and the same
        operators the network then computes the original's results. Raises InputError for missing or unexpected keys,
        which it lists, or a shape that differs.
        """
        own, names = self.state_dict(), {}
        for key in own:
            name = key.replace("blocks.", "block_").replace("raw_time", "diffusion_time")
            name = re.sub(r"linear_(\d+)", lambda n: f"miniMLP_mlp_layer_{int(n[1]):03}", name)
            names[name] = key
        missing, unexpected = names.keys() - state.keys(), state.keys() - names.keys()
        if missing or unexpected:
            raise InputError(
                f"state of another network: missing {sorted(missing)}, unexpected {sorted(unexpected)}; "
                "width, num_blocks, hidden and the options on gradients have to be those it was trained with"
            )
        taken = {}
        for original, key in names.items():
            value = state[original].to(own[key])
            if value.shape != own[key].shape:
                raise InputError(
                    f"{original}: expected shape {tuple(own[key].shape)}, got {tuple(value.shape)}"
                )
            timed = key.endswith("raw_time")
            taken[key] = raw_of_time(value.clamp_min(LEAST_TIME)) if timed else value
        self.load_state_dict(taken)


def _checked_corners(place: str, corners: Tensor | None, lb: LaplaceBeltrami) -> Tensor:
    """The corners of faces or edges, checked to have valid indices and, in a batch, to be moved by the offsets."""
    if corners is None:
        raise InputError(f"outputs_at={place!r} needs {place}, got None")
    check_tensor(corners, place)
    expected, got = 3 if place == "faces" else 2, tuple(corners.shape)
    if len(got) != 2 or got[1] != expected:
        raise InputError(
            f"{place}: expected a tensor of shape (·, {expected}), got {got}; PyG has the transpose"
        )
    if corners.numel() == 0 or torch.compiler.is_compiling():
        return corners
    last, starts = int(corners.max()), lb.offsets
    if not 0 <= int(corners.min()) <= last < starts[-1]:
        raise InputError(f"{place}: expected indices from 0 to {starts[-1] - 1}, got {last}")
    ends = torch.tensor(starts[1:], device=corners.device)
    shape = torch.bucketize(corners.contiguous(), ends, right=True)
    if last < starts[-2] or bool((shape != shape[:, :1]).any()):
        raise InputError(
            f"{place}: in a batch of {len(lb.sizes or ())} shapes, those of shape s have to be moved by lb.offsets[s]; "
            f"indices up to {last} leave some shapes without {place}, or join two of them"
        )
    return corners
