"""What holds at the boundary of a shape, and what that does to rows (`method.md`, section 6)."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.geometry.boundary import Boundary
from torchlb.stencils.rows import Rows

CLOSEST = 0.1
"""Share of the farthest distance in its row that a boundary point's own scale has at least: near pairs are stiff."""


class Condition:
    """Nothing is known at the boundary: stencils there are one-sided. Other conditions derive from it.

    Attributes
    ----------
    share : a of ∂_ν f + a f = 0, 1/ℓ, if stencils may use that at the boundary points that they hold, else None.
    conserves : whether rows sum to zero, so that constants stay.
    """

    share: float | None = None
    conserves: bool = True

    def finish(
        self,
        points: Float[Tensor, "N n"],
        boundary: Boundary,
        centers: Int[Tensor, " B"],
        rows: Rows,
    ) -> Rows:
        """The rows of `centers` as they stand in the operator."""
        return rows


class Neumann(Condition):
    """∂_ν f = 0."""

    share = 0.0


class Dirichlet(Condition):
    """f = 0: no entry joins a boundary point to another point.

    A boundary point has −4d/h² for itself, as a grid's fastest wave, h its distance to the nearest point, but at least
    `CLOSEST` of that to the farthest in its row.
    """

    conserves = False

    def finish(
        self,
        points: Float[Tensor, "N n"],
        boundary: Boundary,
        centers: Int[Tensor, " B"],
        rows: Rows,
    ) -> Rows:
        """The rows, decoupled from the boundary."""
        mask, dim = boundary.mask, rows.gradient.shape[1]
        local = torch.arange(len(centers)).repeat_interleave(rows.length)
        row, col = centers[local], rows.col
        square = (points[col] - points[row]).square().sum(1)
        farthest = square.new_zeros(len(centers)).scatter_reduce(0, local, square, "amax")
        square = torch.where(row == col, torch.inf, square)
        nearest = farthest.scatter_reduce(0, local, square, "amin").maximum(CLOSEST**2 * farthest)
        nearest = torch.where(nearest > 0, nearest, 1.0)  # a row of coincident points has no scale
        kept = torch.where(mask[row] | mask[col], 0.0, rows.laplacian)
        own = mask[row] & (row == col)
        return replace(rows, laplacian=torch.where(own, -4 * dim / nearest[local], kept))


ConditionName = Literal["neumann", "dirichlet"]
PAIRED: dict[str, type[Condition]] = {"neumann": Neumann, "dirichlet": Dirichlet}
"""The conditions that the weak pair has, too: the natural one, and the one that takes out rows and columns."""
CONDITIONS: dict[str, Condition] = {name: kind() for name, kind in PAIRED.items()}
"""The values of the option `condition`; None stands for no condition at all."""
