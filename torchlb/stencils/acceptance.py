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
"""Heights may leave this much of a fit, over the growth g∞ that turns it into an error of Δ. Triangles know more of a
surface that its points do not resolve than a fit, points alone do not; on a mesh along normals half of it."""
RESOLVING_DEGREE = 4
"""Up to it the bound stays the same: what a low degree leaves of the heights is not worth the fall to the next rows."""


@dataclass(frozen=True)
class Acceptance:
    """The tests for the stencils of a shape.

    Attributes
    ----------
    dim
        d.
    on_mesh
        Whether low-order rows know the surface better than a fit that misses heights.
    projection
        Of the coordinates.
    """

    dim: int
    on_mesh: bool
    projection: str

    @staticmethod
    def too_wide_at_boundary(candidate: Candidate) -> bool:
        """Whether a stencil with boundary points would be so wide that it is lopsided, and a lower order better."""
        return candidate.degree > 2 and candidate.factor > FACTOR

    def judge(
        self, weights: Weights, candidate: Candidate, touching: Bool[Tensor, " B"]
    ) -> tuple[Int[Tensor, " B"], Bool[Tensor, " B"]]:
        """The first test that each stencil fails, as a `Reason`, and whether its whole degree is to be given up.

        `touching` are the stencils that hold boundary points.
        """
        inside = reference(self.dim, candidate.degree, candidate.rule)
        edge = reference(self.dim, candidate.degree, one_sided=True) if touching.any() else inside
        # at a boundary over the one-sided reference, or over what is accepted inside, since corners have more
        at_edge = FACTOR * max(edge.growth, FACTOR * inside.growth)
        max_growth = torch.where(touching, at_edge, FACTOR * inside.growth)
        max_ratio = FACTOR * torch.where(touching, edge.off_diagonal_ratio, 1.0)
        resolved, resolvable = self._resolved(candidate)
        center, others = weights.laplacian[:, 0], weights.laplacian[:, 1:].abs().sum(1)
        determined = weights.residual <= NEGLIGIBLE  # false for NaN
        failure = torch.zeros(len(center), dtype=torch.int64)
        for reason, passed in (
            (Reason.MOMENTS, determined),
            (Reason.UNRESOLVED, weights.height_residual <= resolved),
            (Reason.RATIO, others <= -max_ratio * center),
            (Reason.GROWTH, weights.radius.square() * (others + center.abs()) <= max_growth),
        ):
            failure = torch.where((failure == 0) & ~passed, reason, failure)
        return failure, determined & (weights.height_residual > resolvable)

    def follows(self, weights: Weights, candidate: Candidate) -> Bool[Tensor, " B"]:
        """Whether the points resolve the surface for this candidate."""
        return weights.height_residual <= self._resolved(candidate)[0]

    def _resolved(self, candidate: Candidate) -> tuple[float, float]:
        """Bounds on the residual of the heights: for this candidate, and for all of its degree.

        On a mesh they may leave the less the more points there are, from 3 a polynomial on: a fit to folds does not
        become better over more of them. On a cloud the noise of the heights may fall by as much as the widest stencil
        is wider than the first, and a size that the user fixed cannot widen.
        """
        growth = max(reference(self.dim, m).growth for m in (candidate.degree, RESOLVING_DEGREE))
        if self.on_mesh:
            bound = RESOLVED_ON_MESH / (1 + (self.projection == "normal")) / growth
            return bound * FACTOR / max(candidate.factor, FACTOR), bound
        bound = RESOLVED_ON_CLOUD / growth
        factors = SIZE_FACTORS["least_squares"]
        widest = bound * (factors[-1] / factors[0]) ** (1 / self.dim)
        return (bound if candidate.factor else widest), widest
