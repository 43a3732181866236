"""What a reconstruction hands on."""

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
        (N, n), ℓ: where the shape is at each point; the point itself if the cloud has no noise.
    cells
        (F, d + 1), segments, triangles or tetrahedra.
    shares
        (F,), which part of each counts, where they overlap; None where all do, and meet as those of a mesh.
    """

    points: Float[Tensor, "N n"]
    cells: Int[Tensor, "F corners"]
    shares: Float[Tensor, " F"] | None = None
