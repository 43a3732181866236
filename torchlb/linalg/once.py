"""Operations that are differentiable once, or computed twice."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from torchlb.errors import DerivativeError


def once_differentiable(backward: Callable[..., Any]) -> Callable[..., Any]:
    """Like torch's decorator of that name, but second derivatives raise an error however they are requested.

    Torch attaches its error to a separate leaf, which `torch.autograd.grad` and `functional.hessian` do not visit on
    their way to an input: they return a second derivative of zero.
    """

    @wraps(backward)
    def called(ctx: Any, *grads: Tensor) -> tuple[Any, ...]:
        with torch.no_grad():
            found = backward(ctx, *(g.detach() for g in grads))
        if not torch.is_grad_enabled():
            return found
        inputs = [t for t in (*grads, *ctx.saved_tensors) if t is not None and t.requires_grad]
        return tuple(_last(v, *inputs) if isinstance(v, Tensor) else v for v in found)

    return called


class _Last(torch.autograd.Function):
    """Identity of the first argument, with a dependence on the others that cannot be differentiated."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, *inputs: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        return value.clone()

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        raise DerivativeError(
            "second derivatives in points or medium: results are differentiable once in these, by backward(); "
            "torch.autograd.functional.jvp goes back twice, too; take vjp, or a difference quotient"
        )


_last: Any = _Last.apply


def computed_again(function: Callable[..., Tensor], *inputs: Any) -> Tensor:
    """What a function gives, which is computed again for its derivative instead of keeping what is between."""
    return checkpoint(function, *inputs, use_reentrant=False, preserve_rng_state=False)  # pyright: ignore[reportReturnType]
