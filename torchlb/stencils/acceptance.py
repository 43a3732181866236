"""The local tests that a stencil has to pass (`method.md`, section 4)."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.fits.weights import Weights

__all__ = ["first_failure"]

MAX_DOMINANCE = 3.0
MAX_GROWTH = 3.0
MAX_GROWTH_OF_SPLINES = 12.0
"""Good splines have 2 to 3 times the growth of good least squares, and one-sided ones more."""
MAX_GROWTH_AT_BOUNDARY = 12.0
MAX_DOMINANCE_AT_BOUNDARY = 6.0
"""One-sided stencils have larger weights, and wide ones would be balanced but poor: a lower order is better there."""
MAX_SIZE_AT_BOUNDARY = 2.5
"""Points of a stencil per polynomial that holds points of the boundary."""
MAX_RESIDUAL = 1e-10
MAX_MISFIT = 0.07
MAX_MISFIT_ON_MESH = 0.03
"""Heights that no polynomial of the stencil's degree follows: a crease, an unresolved fold, noise. Triangles know more
of the surface there than a fit, points alone do not."""
DEGREE_OF_MISFIT = 4
"""The bound on a mesh holds up to it; beyond it falls as g∞ rises, as heights do to Δ misfit times growth."""
WIDE_ON_MESH = 3.0
MISFIT_OF_WIDE = 1 / 3
"""Share of the bound for stencils with more points per polynomial than that: uneven points of a surface that is well
resolved need them, and a fit to folds does not become better over more of them."""
MISFIT_OF_NORMALS = 0.5
"""Share of the bound beyond degree 2 by the note's projection, whose errors on the same mesh are larger."""
HOPELESS = 2.5
"""The widest stencil of a degree on a cloud is 2.5 times as wide as the first, so noise of the heights can fall by that
much. A size that the user fixed cannot widen and falls only beyond."""


def first_failure(
    weights: Weights,
    max_growth: Float[Tensor, " B"],
    max_dominance: Float[Tensor, " B"],
    max_misfit: float,
) -> Int[Tensor, " B"]:
    """Which of the local tests a stencil fails first, as an index into `REASONS`; 0 if none."""
    laplacian = weights.laplacian
    center, others = laplacian[:, 0], laplacian[:, 1:].abs().sum(1)
    failure = torch.zeros(len(center), dtype=torch.int64)
    for code, passed in (
        (2, weights.deficit == 0),
        (3, weights.residual <= MAX_RESIDUAL),  # false for NaN
        (8, weights.misfit <= max_misfit),
        (4, center < 0),
        (5, others <= max_dominance * center.abs()),
        (6, weights.radius.square() * (others + center.abs()) <= max_growth),
    ):
        failure = torch.where((failure == 0) & ~passed, code, failure)
    return failure
