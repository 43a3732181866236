"""The result of a reconstruction."""

from __future__ import annotations

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, kw_only=True)
class Complex:
    """Cells through a cloud of points.

    Attributes
    ----------
    points
        (N, n), ℓ: the points, moved onto the shape if the cloud is noisy.
    cells
        (F, d + 1), segments, triangles or tetrahedra.
    shares
        (F,), share of each cell that counts where cells overlap; None if all count and meet as those of a mesh.
    """

    points: Float[Tensor, "N n"]
    cells: Int[Tensor, "F corners"]
    shares: Float[Tensor, " F"] | None = None
