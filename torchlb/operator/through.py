"""Through the geometry: results of an operator that are differentiable in the points it is evaluated at.

Eigenvalues, the mass and products with K and M follow from the weak pair alone, whose derivative in the points is that
of a bilinear form (`PairPlan.bilinear`). What has no such derivative raises an error where one is asked for: no
gradient is zero, or lacks a part, in silence.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchlb.errors import DerivativeError
from torchlb.galerkin.pair import FormName
from torchlb.linalg.once import once_differentiable
from torchlb.operator.plan import Plan

Forms = Callable[[Float[Tensor, "..."]], dict[FormName, tuple[Tensor, Tensor]]]
"""From the gradient of a result functions w and u, (N, C), of bilinear forms whose sum has its derivative."""


class _Known(torch.autograd.Function):
    """A result that is known, with its derivative in the points."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, result: Tensor, plan: Plan, forms: Forms) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.save_for_backward(points)
        ctx.plan, ctx.forms = plan, forms
        return result.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (points,) = ctx.saved_tensors
        forms = ctx.forms(grad.cpu().double())
        found = ctx.plan.gradient(points.detach().cpu().double(), forms)
        return found.to(points), None, None, None


def known(points: Tensor, result: Tensor, plan: Plan, forms: Forms) -> Tensor:
    """A result with its derivative in the points, by the forms that a gradient makes."""
    return _Known.apply(points, result.detach(), plan, forms)  # pyright: ignore[reportReturnType]


class _Refused(torch.autograd.Function):
    """A value that depends on the points in a way that is not differentiated."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, value: Tensor, what: str) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx.what = what
        return value.clone()

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        raise DerivativeError(
            f"{ctx.what}: no derivative in the points; eigenvalues, the mass and lb.product(name, f) with the weak "
            "pair have one. For derivatives in f, or of layers, take an operator at points.detach()"
        )


def refused(points: Tensor, value: Tensor, what: str) -> Tensor:
    """The value, which raises DerivativeError where its derivative in the points is asked for."""
    return _Refused.apply(points, value.detach(), what)  # pyright: ignore[reportReturnType]
