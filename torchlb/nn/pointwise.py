"""What layers have in common: checks of features, networks at each point, and the block that ends in one."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchlb.errors import InputError, warn
from torchlb.operator.pair_methods import PairMethods
from torchlb.pde.checks import check_shape

Widths = Sequence[int] | None
"""Widths of the hidden layers of a pointwise network."""


def check_features(
    x: Tensor, lb: PairMethods, channels: int, parameter: Tensor, k: int = 0
) -> torch.dtype:
    """The type to compute in: that of features and parameters, at least float32; the operator is cast to it.

    Warns where the operator holds a basis of fewer than k pairs: the forward pass solves for more and only that
    operator keeps them, so that operators made for every step, as by a data loader, pay for it each time. Raises
    InputError for a wrong shape, and for features of another type than the parameters, unless autocast made them so.
    """
    check_shape(x, lb)
    if x.shape[-1] != channels:
        raise InputError(f"expected {channels} channels, got x of shape {tuple(x.shape)}")
    device = x.device.type
    cast = torch.is_autocast_enabled(device) and x.dtype == torch.get_autocast_dtype(device)
    if x.dtype != parameter.dtype and not cast:
        raise InputError(
            f"expected features of the type of the layer's parameters, {parameter.dtype}, got {x.dtype}: cast one of "
            "them, x.to(…) or layer.to(…); the operator may have any type"
        )
    if k and not torch.compiler.is_compiling() and lb.modes.count and not lb.modes.has(k):
        warn(
            f"the operator holds a basis of {lb.modes.count} pairs, a layer asks for k = {k}: it is solved anew, for "
            f"each operator that is made; store k = {k} pairs, or give the layer k = {lb.modes.count}"
        )
    return torch.promote_types(x.dtype, torch.float32)


def unrounded(x: Tensor, lb: PairMethods, channels: int, parameter: Tensor) -> Tensor:
    """Features, checked, in the type of parameters where autocast rounded them: a gradient amplifies that by 1/h."""
    check_features(x, lb, channels, parameter)
    return x.to(parameter.dtype)


class Dropout(nn.Dropout):
    """`nn.Dropout` that, on the CPU at p = ½, draws one random bit for each value instead of a random number.

    Without Intel's library random numbers take ten times as long, a sixth of a training step.
    """

    def forward(self, input: Tensor) -> Tensor:
        """Half of the values doubled, the others zero, in training."""
        if not self.training or self.p != 0.5 or input.device.type != "cpu":
            return super().forward(input)
        rows, place = input.shape[:-1].numel(), torch.arange(8, dtype=torch.uint8)
        empty = torch.empty(-(-rows // 8), input.shape[-1], dtype=torch.uint8)
        bits = torch.ops.aten.random(empty) >> place[:, None, None] & 1
        return input * (2 * bits.flatten(0, 1)[:rows].view(input.shape))


def mlp(inputs: int, hidden: Widths, width: int, dropout: bool) -> nn.Sequential:
    """Linear layers, two hidden by default, with ReLU between, half of the values dropped before all but the first."""
    sizes = [inputs, *([width, width] if hidden is None else hidden), width]
    layers: OrderedDict[str, nn.Module] = OrderedDict()
    for i in range(len(sizes) - 1):
        if i > 0:
            layers[f"relu_{i}"] = nn.ReLU(inplace=True)
        if i > 0 and dropout:
            layers[f"dropout_{i}"] = Dropout(0.5)
        layers[f"linear_{i}"] = nn.Linear(sizes[i], sizes[i + 1])
    return nn.Sequential(layers)
