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
from torchlb.galerkin.pair import BilinearForm
from torchlb.linalg.csr import side_by_side
from torchlb.linalg.once import once_differentiable
from torchlb.operator.plan import Plan

Forms = Callable[[Float[Tensor, "..."]], list[BilinearForm]]
"""From the gradient of a result the bilinear forms whose sum has its derivative."""


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


def known(lb: Any, result: Tensor, what: str, forms: Forms) -> Tensor:
    """A result with its derivative in the operator's points, by the forms that a gradient makes; of a batch refused."""
    if lb.sizes is not None:
        return refused(lb.points, result, f"{what} of a batch")
    return _Known.apply(lb.points, result.detach(), lb.plan, forms)  # pyright: ignore[reportReturnType]


def carrying(lb: Any, points: Any) -> Any:
    """The operator; where points require a gradient, it comes by what has one, and errors by all else.

    Raises
    ------
    DerivativeError
        Where nothing of the operator has a derivative.
    """
    if not (isinstance(points, Tensor) and points.requires_grad and torch.is_grad_enabled()):
        return lb
    if not lb.has_weak_form or len(lb.weak.near.values) > 3 or len(lb.plan.moved):
        raise DerivativeError(
            "points: they require gradients, which there are none of without a weak pair, with a Robin condition, "
            "and of noisy curves, whose points are moved; pass points.detach() if results may be constants of them"
        )
    one = torch.ones(lb.num_points, 1, dtype=torch.float64)

    def forms(g: Tensor) -> list[BilinearForm]:
        return [BilinearForm("lumped", one, g[:, None], one[0])]

    lb.points = points.to(lb.points).view_as(lb.points)  # a buffer is no Parameter
    lb.mass = known(lb, lb.mass, "mass", forms)
    lb.stencil.values = refused(points, lb.stencil.values, "rows of Δ and ∇")
    lb.frames = refused(points, lb.frames, "frames")
    lb.normals = refused(points, lb.normals, "normals")
    return lb


def through_product(lb: Any, name: Any, f: Tensor, result: Tensor) -> Tensor:
    """The product of a matrix and f with its derivative in the points."""
    if name == "boundary_mass":
        return result + refused(lb.points, torch.zeros_like(result), name)

    other = side_by_side(f.detach().cpu().double())

    def forms(g: Tensor) -> list[BilinearForm]:
        return [BilinearForm(name, side_by_side(g), other, torch.ones_like(other[0]))]

    return result + known(lb, torch.zeros_like(result), name, forms)
