"""The local tests that a stencil has to pass (`method.md`, section 4)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from torchlb.fits.rules import SIZE_FACTORS, reference
from torchlb.fits.weights import Weights
from torchlb.geometry.candidates import Candidate
from torchlb.geometry.thresholds import FACTOR
from torchlb.linalg.precision import NEGLIGIBLE
from torchlb.stencils.rows import Reason

RESOLVED_ON_MESH, RESOLVED_ON_CLOUD = 1.8, 4.1
"""Largest height residual of a stencil times the growth g∞, which turns it into an error of Δ. The bound is lower on a
mesh, whose triangles follow a surface that its points do not resolve better than a fit; along normals half of it."""
RESOLVING_DEGREE = 4
"""Degree up to which the bound stays constant: the residual of a low degree does not justify the next rows."""


@dataclass(frozen=True)
class Acceptance:
    """Tests for the stencils of a shape of dimension d, with coordinates by a projection.

    On a mesh, low-order rows follow the surface better than a fit that misses heights.
    """

    dim: int
    on_mesh: bool
    projection: str

    def judge(
        self, weights: Weights, candidate: Candidate, touching: Bool[Tensor, " B"]
    ) -> tuple[Int[Tensor, " B"], Bool[Tensor, " B"]]:
        """Return the first test that each stencil fails, a `Reason`, and whether to reject its whole degree.

        `touching` marks the stencils with boundary points.
        """
        inside = reference(self.dim, candidate.degree, candidate.rule)
        edge = reference(self.dim, candidate.degree, one_sided=True) if touching.any() else inside
        # at a boundary relative to the one-sided reference, or to the bound inside, since corners have more
        at_edge = FACTOR * max(edge.growth, FACTOR * inside.growth)
        max_growth = torch.where(touching, at_edge, FACTOR * inside.growth)
        max_ratio = FACTOR * torch.where(touching, edge.off_diagonal_ratio, 1.0)
        bound, loosest = self.resolved(candidate)
        center, others = weights.laplacian[:, 0], weights.laplacian[:, 1:].abs().sum(1)
        determined = weights.residual <= NEGLIGIBLE  # false for NaN
        failure = torch.zeros(len(center), dtype=torch.int64)
        for reason, passed in (
            (Reason.MOMENTS, determined),
            (Reason.UNRESOLVED, weights.height_residual <= bound),
            (Reason.RATIO, others <= -max_ratio * center),
            (Reason.GROWTH, weights.radius.square() * (others + center.abs()) <= max_growth),
        ):
            failure = torch.where((failure == 0) & ~passed, reason, failure)
        return failure, determined & (weights.height_residual > loosest)

    def resolved(self, candidate: Candidate) -> tuple[float, float]:
        """Bounds on the height residual: for this candidate, and for every candidate of its degree.

        On a mesh the bound shrinks with the number of points beyond 3 per polynomial: a fit to folds does not improve
        over more of them. On a cloud, noise may shrink by the ratio of the widest stencil to the first; a size fixed by
        the user cannot widen.
        """
        growth = max(reference(self.dim, m).growth for m in (candidate.degree, RESOLVING_DEGREE))
        if self.on_mesh:
            bound = RESOLVED_ON_MESH / (1 + (self.projection == "normal")) / growth
            return bound * FACTOR / max(candidate.factor, FACTOR), bound
        bound = RESOLVED_ON_CLOUD / growth
        factors = SIZE_FACTORS["least_squares"]
        widest = bound * (factors[-1] / factors[0]) ** (1 / self.dim)
        return (bound if candidate.factor else widest), widest
