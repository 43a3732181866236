"""Preconditioned conjugate gradients for many right-hand sides at once."""

from __future__ import annotations

from collections.abc import Callable

import torch
from jaxtyping import Float
from torch import Tensor

from torchlb.errors import DiffusionError
from torchlb.linalg.precision import TINY

Linear = Callable[[Tensor], Tensor]


def conjugate_gradients(
    product: Linear,
    b: Float[Tensor, "N C"],
    precondition: Linear,
    *,
    tolerance: float = 1e-10,
    max_steps: int = 1000,
) -> tuple[Float[Tensor, "N C"], int]:
    """Return A⁻¹b for a symmetric A ≥ 0, and the number of steps; each column has its own step lengths.

    Iterations stop when √(rᵀBr) ≤ `tolerance` √(bᵀBb) for every residual r, B the preconditioner, which estimates the
    relative error in the norm of A. b has to be in the range of A. Raises DiffusionError if that is not reached within
    `max_steps`, or b is not finite.

    >>> a = torch.tensor([[2.0, 1.0], [1.0, 3.0]])
    >>> x, steps = conjugate_gradients(lambda v: a @ v, torch.tensor([[3.0], [4.0]]), lambda r: r, tolerance=1e-5)
    >>> x.T.round(decimals=4).tolist(), steps
    ([[1.0, 1.0]], 2)
    """
    x, r = torch.zeros_like(b), b
    z = precondition(r)
    p, square = z, (r * z).sum(0)
    if not bool(square.isfinite().all()):
        what = "preconditioner" if bool(b.isfinite().all()) else "right-hand side"
        raise DiffusionError(f"conjugate gradients: the {what} has NaN or infinite values")
    enough = tolerance**2 * square
    for step in range(max_steps):
        if bool((square <= enough).all()):
            return x, step
        q = product(p)
        curvature = (p * q).sum(0)
        length = torch.where(square > enough, square / curvature, 0.0)
        x.addcmul_(length, p)
        r = torch.addcmul(r, length, q, value=-1)
        z = precondition(r)
        before, square = square, (r * z).sum(0)
        p = torch.addcmul(z, torch.where(before > 0, square / before, 0.0), p)
    left = float((square / enough.clamp_min(TINY)).max()) ** 0.5 * tolerance
    raise DiffusionError(
        f"conjugate gradients: {left:.1e} of the residual is left after {max_steps} steps, not {tolerance:.0e}. "
        "Some cells are too degenerate, or shapes of one batch differ too much in size: merge vertices that nearly "
        "coincide, solve for shapes one by one, or raise `tolerance`"
    )
