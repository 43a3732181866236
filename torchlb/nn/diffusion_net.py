"""DiffusionNet (Sharp, Attaiki, Crane, Ovsjanikov 2022) on any operator: diffusion, gradients, pointwise networks.

The arguments are those of the original where its users know them. What differs: the operator comes in as one argument,
`forward(x, lb)`; diffusion is "full" unless asked to be the original's "spectral"; learned times are positive by
parametrisation; batches of different shapes are one operator. Its trained weights load: `load_original_state_dict`.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from torchlb.errors import InputError
from torchlb.nn.diffusion import Diffusion, raw_of_time
from torchlb.nn.gradient_features import GradientFeatures
from torchlb.operator.laplace_beltrami import LaplaceBeltrami

__all__ = ["DiffusionNet", "DiffusionNetBlock"]

PLACES = ["vertices", "edges", "faces", "global_mean"]
LEAST_TIME = 1e-8
"""What the original cuts its times to before it uses them, ℓ²."""


class _Dropout(nn.Dropout):
    """`nn.Dropout`, but where half is dropped on the CPU a random bit decides, and not a random number for each value.

    Except with Intel's library the numbers take ten times as long, a sixth of a training step.
    """

    def forward(self, input: Tensor) -> Tensor:
        if not self.training or self.p != 0.5 or input.device.type != "cpu":
            return super().forward(input)
        count, place = input.numel(), torch.arange(8, dtype=torch.uint8)
        bits = torch.randint(256, (-(-count // 8),), dtype=torch.uint8) >> place[:, None] & 1
        return input * (2 * bits.flatten()[:count].view(input.shape))


def _mlp(sizes: Sequence[int], dropout: bool) -> nn.Sequential:
    """Linear layers with ReLU between them, and half of the values dropped before each but the first."""
    layers: OrderedDict[str, nn.Module] = OrderedDict()
    for i in range(len(sizes) - 1):
        if i > 0:
            layers[f"relu_{i}"] = nn.ReLU(inplace=True)
        if i > 0 and dropout:
            layers[f"dropout_{i}"] = _Dropout(0.5)
        layers[f"linear_{i}"] = nn.Linear(sizes[i], sizes[i + 1])
    return nn.Sequential(layers)


class DiffusionNetBlock(nn.Module):
    """Diffusion, gradient features of what has diffused, a pointwise network of all three, and a skip connection.

    Parameters
    ----------
    C_width : channels in and out.
    mlp_hidden_dims : widths of the hidden layers.
    dropout : whether the network drops half of its hidden values while it trains.
    diffusion_method, k : of `Diffusion`.
    with_gradient_features, with_gradient_rotations : see `GradientFeatures`.
    """

    def __init__(
        self,
        C_width: int,
        mlp_hidden_dims: Sequence[int],
        dropout: bool = True,
        diffusion_method: str = "full",
        with_gradient_features: bool = True,
        with_gradient_rotations: bool = True,
        *,
        k: int = 128,
    ) -> None:
        super().__init__()
        self.diffusion = Diffusion(C_width, diffusion_method, k=k)
        self.gradient_features = (
            GradientFeatures(C_width, with_gradient_rotations) if with_gradient_features else None
        )
        inputs = 3 if with_gradient_features else 2
        self.mlp = _mlp([inputs * C_width, *mlp_hidden_dims, C_width], dropout)

    def forward(self, x: Float[Tensor, "*B N C"], lb: LaplaceBeltrami) -> Float[Tensor, "*B N C"]:
        """Features (N, C_width) or (B, N, C_width) in the shape of x."""
        diffused = self.diffusion(x, lb)
        features = [x, diffused]
        if self.gradient_features is not None:
            features.append(self.gradient_features(diffused, lb))
        return x + self.mlp(torch.cat(features, dim=-1))


class DiffusionNet(nn.Module):
    """A network of `N_block` blocks between two pointwise linear maps.

    Parameters
    ----------
    C_in, C_out : channels of the input and of the output.
    C_width : channels of the blocks.
    N_block : number of blocks.
    last_activation : applied to the output, such as ``lambda y: y.log_softmax(-1)``.
    outputs_at : "vertices", "edges", "faces" (means over the corners) or "global_mean" (over the surface, by mass).
    mlp_hidden_dims : hidden widths of the blocks' networks; [C_width, C_width] by default.
    dropout, with_gradient_features, with_gradient_rotations : of the blocks.
    diffusion_method : "full", "spectral" (the original's), "chebyshev" or "rational".
    k : number of eigenpairs.

    Raises
    ------
    ValueError : for a method or a place that is none.

    Examples
    --------
    >>> theta = torch.arange(36) * torch.pi / 18
    >>> circle = torch.stack([theta.cos(), theta.sin()], dim=1)
    >>> lb = LaplaceBeltrami.from_points(circle)
    >>> DiffusionNet(2, 5, C_width=8, with_gradient_rotations=False)(circle, lb).shape
    torch.Size([36, 5])
    """

    def __init__(
        self,
        C_in: int,
        C_out: int,
        C_width: int = 128,
        N_block: int = 4,
        last_activation: Callable[[Tensor], Tensor] | None = None,
        outputs_at: str = "vertices",
        mlp_hidden_dims: Sequence[int] | None = None,
        dropout: bool = True,
        with_gradient_features: bool = True,
        with_gradient_rotations: bool = True,
        diffusion_method: str = "full",
        *,
        k: int = 128,
    ) -> None:
        super().__init__()
        if outputs_at not in PLACES:
            raise InputError(f"outputs_at: expected one of {PLACES}, got {outputs_at!r}")
        self.C_in, self.C_out, self.outputs_at = C_in, C_out, outputs_at
        self.last_activation = last_activation
        hidden = [C_width, C_width] if mlp_hidden_dims is None else mlp_hidden_dims
        self.first_lin = nn.Linear(C_in, C_width)
        self.blocks = nn.ModuleList(
            DiffusionNetBlock(
                C_width,
                hidden,
                dropout,
                diffusion_method,
                with_gradient_features,
                with_gradient_rotations,
                k=k,
            )
            for _ in range(N_block)
        )
        self.last_lin = nn.Linear(C_width, C_out)

    def forward(
        self,
        x: Float[Tensor, "*B N C"],
        lb: LaplaceBeltrami,
        faces: Int[Tensor, "F corners"] | None = None,
        edges: Int[Tensor, "E 2"] | None = None,
    ) -> Tensor:
        """Outputs (…, N, C_out), or (…, F, C_out), (…, E, C_out), (…, C_out) at the place asked for.

        Parameters
        ----------
        x : features (N, C_in), or (B, N, C_in) of B inputs on one surface.
        lb : operator of one shape or of a batch, whose global mean is (S, C_out), one for each shape.
        faces, edges : for outputs there; in a batch, moved by `lb.offsets`.
        """
        if not (x.shape[-1] == self.C_in):
            raise InputError(
                f"expected C_in = {self.C_in} channels, got x of shape {tuple(x.shape)}"
            )
        y = self.first_lin(x)
        for block in self.blocks:
            y = block(y, lb)
        y = self.last_lin(y)
        if self.outputs_at == "global_mean":
            y = _global_mean(y, lb)
        elif self.outputs_at != "vertices":
            corners = faces if self.outputs_at == "faces" else edges
            if corners is None:
                raise InputError(
                    f"outputs_at={self.outputs_at!r} needs {self.outputs_at}, got None"
                )
            y = y[..., corners, :].mean(-2)
        return y if self.last_activation is None else self.last_activation(y)

    def load_original_state_dict(self, state: Mapping[str, Tensor]) -> None:
        """Take the weights of a trained network of the original code; strict.

        ===============================================  ==========================================
        original                                         here
        ===============================================  ==========================================
        first_lin.*, last_lin.*                          the same
        block_{i}.diffusion.diffusion_time               blocks.{i}.diffusion.raw_time, by its time
        block_{i}.gradient_features.A_re.weight (…)      blocks.{i}.gradient_features.A_re.weight
        block_{i}.mlp.miniMLP_mlp_layer_{jjj}.weight     blocks.{i}.mlp.linear_{j}.weight
        ===============================================  ==========================================

        Times below 1e-8, which the original raises to it when it runs, become 1e-8. With diffusion_method="spectral"
        and the same operators the network then computes what the original did.

        Raises
        ------
        ValueError : that lists the missing and the unexpected keys, or a shape that differs.
        """
        own = self.state_dict()
        names = {_original_name(key): key for key in own}
        missing, unexpected = names.keys() - state.keys(), state.keys() - names.keys()
        if missing or unexpected:
            raise InputError(
                f"state of another network: missing {sorted(missing)}, unexpected {sorted(unexpected)}; "
                "C_width, N_block, mlp_hidden_dims and the options on gradients have to be those it was trained with"
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


def _original_name(key: str) -> str:
    """Name in the original code of a parameter of `DiffusionNet`.

    >>> _original_name("blocks.3.mlp.linear_2.bias")
    'block_3.mlp.miniMLP_mlp_layer_002.bias'
    """
    name = key.replace("blocks.", "block_").replace("raw_time", "diffusion_time")
    before, found, after = name.partition("linear_")
    if not found:
        return name
    number, _, kind = after.partition(".")
    return f"{before}miniMLP_mlp_layer_{int(number):03d}.{kind}"


def _global_mean(y: Tensor, lb: LaplaceBeltrami) -> Tensor:
    """Σ π y / Σ π over the surface, for each shape of a batch."""
    mass = lb.mass.to(y.dtype)[:, None]
    if lb.sizes is None:
        return (mass * y).sum(-2) / mass.sum()
    parts = zip(mass.split(lb.sizes), y.split(lb.sizes, dim=-2), strict=True)
    return torch.stack([(m * part).sum(-2) / m.sum() for m, part in parts], dim=-2)
