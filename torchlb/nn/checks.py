"""Checks of the features that layers take."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from torchlb.errors import InputError
from torchlb.operator.pair_methods import PairMethods
from torchlb.pde.checks import check_shape


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
        warnings.warn(
            f"the operator holds a basis of {lb.modes.count} pairs, a layer asks for k = {k}: it is solved anew, for "
            f"each operator that is made; store k = {k} pairs, or give the layer k = {lb.modes.count}",
            stacklevel=2,
        )
    return torch.promote_types(x.dtype, torch.float32)


def unrounded(x: Tensor, lb: PairMethods, channels: int, parameter: Tensor) -> Tensor:
    """Features in the type of the parameters, where autocast rounded them, for layers that are differentiated.

    Rounding before a gradient grows by 1/h. Errors as for `check_features`.
    """
    check_features(x, lb, channels, parameter)
    return x.to(parameter.dtype)
