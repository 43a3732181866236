"""Warnings of what may be wrong with the surface through a cloud; they name the points, and what to do."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.special import pdtrc
from torch import Tensor

from torchlb.cloud.doubtful import spectral_change
from torchlb.cloud.noise import in_two_layers
from torchlb.cloud.places import in_words, places_of
from torchlb.cloud.surface import CloudSurface
from torchlb.errors import first_few, warn
from torchlb.geometry.boundary import boundary_faces
from torchlb.geometry.fit_search import REASONS
from torchlb.geometry.local_fits import FitPlan
from torchlb.geometry.thresholds import RING, ROUGH, SLIGHT, WIDER
from torchlb.linalg.precision import LOW, NEGLIGIBLE, SMALL

CROWD = 256
"""Rank of the neighbour whose distance sets the scale where more points than the nearest crowd into one place."""


def warn_of_doubts(surface: CloudSurface, plan: FitPlan, mass: Float[Tensor, " N"]) -> None:
    """Warn of points where the cloud does not resolve its surface, if they are many or hold much of its area."""
    apart = ~torch.isin(torch.arange(len(surface.points)), surface.cells)
    doubtful = (plan.reason == REASONS.index("points do not resolve the surface")) | apart
    flat = (plan.degree == 0) | apart
    large = float(mass[flat].sum() / mass.sum()) >= LOW
    doubtful |= flat & large
    # noise of a fifth of the spacing leaves 0.1 to 0.15 unresolved, and eigenvalues within a few per cent
    most = ROUGH if surface.summary.noise else LOW
    if large or float(doubtful.double().mean()) >= most:
        index = doubtful.nonzero()[:, 0]
        warn(
            f"points: at {len(index)} of {len(doubtful)} the cloud is too coarse or noisy for the surface through it "
            f"to be trusted ({first_few(index)}); add points there, remove outliers, or give the mesh if there is one"
        )


def warn_of_joins(surface: CloudSurface) -> None:
    """Warn where triangles may join what is apart, or close what is open."""
    points = surface.points
    change, marked = spectral_change(surface)
    if change > WIDER * SLIGHT:
        places = in_words(places_of(points.numpy(), surface.neighbors.numpy(), marked))
        warn(
            "points: triangles that are steep to the surface or long for its spacing raise "
            f"one of its first eigenvalues by {change:.0%} over another, most of them near {places}; the surface may "
            "join what only touches there, or wall up a gap between parts. Add points there, build each part by "
            "itself (LaplaceBeltrami.batch), or give the mesh if there is one"
        )


def on_rim(cells: Int[Tensor, "F corners"], count: int) -> Bool[Tensor, " N"]:
    """Points on the boundary of a complex."""
    return torch.zeros(count, dtype=torch.bool).index_fill(0, boundary_faces(cells).flatten(), True)


def warn_of_buried(cells: Int[Tensor, "F corners"], boundary: Bool[Tensor, " N"]) -> None:
    """Warn of points of a declared boundary that lie inside the shape."""
    within = torch.isin(torch.arange(len(boundary)), cells) & ~on_rim(cells, len(boundary))
    inside = (boundary & within).nonzero()[:, 0]
    if len(inside) > SLIGHT * int(boundary.sum()):
        warn(
            f"boundary: {len(inside)} of its points ({first_few(inside)}) lie inside the shape through the cloud, as "
            "around a hole that was closed because it is hardly wider than the spacing; add points around it, or give "
            "the mesh"
        )


def warn_of_near_duplicates(
    points: Float[Tensor, "N n"], neighbors: Int[Tensor, "N K"], dim: int
) -> None:
    """Warn of points that are closer to another than chance explains, as if scanned twice.

    Whatever the density of random points, the nearest is closer than t times the distance of the m-th neighbour with
    the probability 1 − (1 − t^d)^(m − 1), about (m − 1)t^d.
    """
    last = min(RING, neighbors.shape[1] - 1)
    distance = (points[neighbors[:, 1:]] - points[:, None]).norm(dim=-1)
    nearest, wide = distance.amin(1), distance.amax(1)
    share = (last - 1) * (nearest / distance[:, last - 1]).pow(dim)
    tight = (wide < SMALL * wide.median()).nonzero()[:, 0]
    if len(tight):  # more than K points in one place
        far = min(CROWD, len(points) - 1)
        reach, _ = KDTree(points.numpy()).query(points[tight].numpy(), k=far + 1)
        share[tight] = (far - 1) * (nearest[tight] / torch.from_numpy(reach)[:, -1]).pow(dim)
    ordered, order = share.sort()
    number = torch.arange(1, len(points) + 1)
    expected = len(points) * ordered
    chance = pdtrc((number // 2 - 1).clamp_min(0).numpy(), expected.numpy() / 2)
    excess = number - expected / LOW
    excess[(number < 2) | torch.from_numpy(chance > NEGLIGIBLE)] = 0
    if excess.max() > 0:
        close = order[: int(excess.argmax()) + 1]
        width = float(f"{1.01 * float(nearest[close].max()):.2e}")
        warn(
            f"points: {len(close)} are far closer to another than to those around ({first_few(close.sort().values)}), "
            "as where a part was scanned twice: such points say nothing that the other does not, and Δf may be wrong "
            f"by any amount there; merge them with points, kept = torchlb.clean_points(points, {width:g})"
        )


def warn_of_layers(points: Float[Tensor, "N 3"]) -> None:
    """Warn if much of a cloud lies in two layers so close that they may be taken for one noisy sheet."""
    layered, looked_at = in_two_layers(points.numpy())
    if len(layered) > LOW * looked_at:  # 0.4 and more on plates, 0.001 on noisy shapes
        warn(
            f"points: around {len(layered) / looked_at:.0%} of them ({first_few(torch.from_numpy(layered))}) they lie "
            "in two layers about a spacing apart or closer, as on a thin plate sampled on both sides; the surface may "
            "be one sheet there, with half of the area. Add points until they are closer than it is thick, keep one "
            "side alone, or give the mesh if there is one"
        )
