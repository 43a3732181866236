"""What may be wrong with the surface through a cloud: warnings that name the points, and what to do."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchlb.errors import first_few, warn
from torchlb.geometry.boundary import boundary_faces
from torchlb.geometry.doubtful import spectral_change
from torchlb.geometry.fit_search import REASONS
from torchlb.geometry.local_fits import FitPlan
from torchlb.geometry.places import in_words, places_of
from torchlb.geometry.surface import CloudSurface

DOUBTFUL = 0.1
"""Share of the points that do not resolve the surface of a cloud, or of the area that those without a fit hold, from
which on a warning names them."""
NOISY = 0.3
"""The first of these shares where the cloud is noisy, and was smoothed: 0.1 to 0.15 at a fifth of the spacing, which
leaves eigenvalues within a few per cent; 0.66 at half of it."""
CHANGE = 0.075
"""What triangles in doubt raise one of the first eigenvalues by over another, from which on a warning says where they
are. Of 56 clouds with eigenvalues that are off by a tenth and more 49 are warned of, of 79 others 9."""
ASTRAY = 0.02
"""Of the points of a declared boundary: how many may lie inside."""


def warn_of_doubts(surface: CloudSurface, plan: FitPlan, mass: Float[Tensor, " N"]) -> None:
    """Warnings that name points where a cloud does not resolve its surface, if they are many or hold much of it."""
    apart = ~torch.isin(torch.arange(len(surface.points)), surface.faces)
    doubtful = (plan.reason == REASONS.index("points do not resolve the surface")) | apart
    flat = (plan.degree == 0) | apart
    large = float(mass[flat].sum() / mass.sum()) >= DOUBTFUL
    doubtful |= flat & large
    most = NOISY if surface.summary.noise else DOUBTFUL
    if large or float(doubtful.double().mean()) >= most:
        index = doubtful.nonzero()[:, 0]
        warn(
            f"points: at {len(index)} of {len(doubtful)} the cloud is too coarse or noisy for the surface through it "
            f"to be trusted ({first_few(index)}); add points there, remove outliers, or give the mesh if there is one"
        )


def warn_of_joins(surface: CloudSurface, boundary: Bool[Tensor, " N"] | None) -> None:
    """Warnings where triangles may join what is apart, or close what is open, also around a declared boundary."""
    points, faces = surface.points, surface.faces
    change, marked = spectral_change(surface)
    if change > CHANGE:
        places = in_words(places_of(points.numpy(), surface.neighbors.numpy(), marked))
        warn(
            "points: triangles that are steep to the surface or long for its spacing raise "
            f"one of its first eigenvalues by {change:.0%} over another, most of them near {places}; the surface may "
            "join what only touches there, or wall up a gap between parts. Add points there, build each part by "
            "itself (LaplaceBeltrami.batch), or give the mesh if there is one"
        )
    if boundary is not None:
        rim = torch.zeros_like(boundary).index_fill(0, boundary_faces(faces).flatten(), True)
        inside = (boundary & ~rim & torch.isin(torch.arange(len(points)), faces)).nonzero()[:, 0]
        if len(inside) > ASTRAY * int(boundary.sum()):
            warn(
                f"boundary: {len(inside)} of its points ({first_few(inside)}) lie inside the surface through the "
                "cloud, as around a hole that was closed because it is hardly wider than the spacing; add points "
                "around it, or give the mesh"
            )
