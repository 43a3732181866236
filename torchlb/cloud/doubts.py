"""What may be wrong with the surface through a cloud: warnings that name the points, and say what to do.

Triangles may join what is apart, or close what is open. The evidence is local and independent of the triangles: on a
sound surface a point surrounded by its own sheet has no edge along its normal, and no edge is much longer than the
spacing. On a random cloud a few triangles are always in doubt, most of them without effect, so that it is their effect
on the first eigenvalues that counts.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.linalg import eigh
from scipy.spatial import KDTree
from scipy.special import pdtrc
from torch import Tensor

from torchlb.cloud.cocone import REACH
from torchlb.cloud.complexes import in_words, places_of
from torchlb.cloud.manifold import face_vectors
from torchlb.cloud.noise import SAMPLE, spacing_at
from torchlb.cloud.surface import CloudSurface
from torchlb.errors import first_few, warn
from torchlb.geometry.boundary import open_sides
from torchlb.geometry.compatibility import compatible_neighbors
from torchlb.geometry.complex import Faces, edges_of
from torchlb.geometry.fit_search import REASONS
from torchlb.geometry.frames import complete_frames
from torchlb.geometry.local_fits import FitPlan
from torchlb.geometry.thresholds import FACTOR, LEVEL, NEAREST, OBTUSE, RING, ROUGH, SLIGHT, WIDER
from torchlb.geometry.vectors import Mask, Near, Points, Vectors, inner, largest, lengths
from torchlb.linalg.precision import DENSE, LOW, NEGLIGIBLE, ROOT_EPS, SMALL

CROWD = 256
"""Rank of the neighbour whose distance sets the scale where more points than the nearest crowd into one place."""
PAIRS = 11
"""Number of eigenpairs, the constant included."""
PATCH = 40
"""Number of points around each whose heights are tested for two layers."""
UNIMODAL = 1.6
"""Kurtosis of the residuals of quadratics below which they form two layers: 1 for two values, at least 9/5 for a
symmetric unimodal distribution, 3 for a normal one."""


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
    return torch.zeros(count, dtype=torch.bool).index_fill(0, open_sides(cells)[0].flatten(), True)


def warn_of_buried(cells: Int[Tensor, "F corners"], boundary: Bool[Tensor, " N"]) -> None:
    """Warn of points of a declared boundary that lie inside the shape."""
    within = torch.isin(torch.arange(len(boundary)), cells) & ~on_rim(cells, len(boundary))
    inside = (boundary & within).nonzero()[:, 0]
    if len(inside):
        warn(
            f"boundary: {len(inside)} of its points ({first_few(inside)}) lie inside the shape through the cloud, as "
            "around a hole that was closed because it is hardly wider than the spacing; add points around it, or give "
            "the mesh"
        )


def warn_of_near_duplicates(points: Points, neighbors: Near, dim: int) -> None:
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
    """Warn if much of a cloud lies in two layers, a spacing apart or closer, that may be taken for one noisy sheet.

    A local quadratic is fitted around each of a sample of points. Residuals of one noisy layer have one peak, those of
    two layers have two with few points between, which their kurtosis tells. Clouds of fewer than 2 `PATCH` points are
    not tested.
    """
    some, places = np.arange(0, len(points), -(-len(points) // SAMPLE)), points.numpy()
    if len(points) < 2 * PATCH:
        return
    distance, index = (np.asarray(part) for part in KDTree(places).query(places[some], k=PATCH))
    offset = places[index] - places[index].mean(1, keepdims=True)
    axes = np.linalg.eigh(offset.transpose(0, 2, 1) @ offset)[1]
    height, v, u = np.moveaxis(offset @ axes / distance[:, -1:, None], -1, 0)
    basis = np.linalg.qr(np.stack([np.ones_like(u), u, v, u * u, u * v, v * v], -1))[0]
    height -= (basis @ (basis.transpose(0, 2, 1) @ height[..., None]))[..., 0]
    square = np.square(height).mean(1)
    layered = (height**4).mean(1) < UNIMODAL * square**2
    layered &= square > LOW**2 * np.pi / PATCH
    if layered.mean() > LOW:  # 0.4 and more on plates, 0.001 on noisy shapes
        warn(
            f"points: around {layered.mean():.0%} of them ({first_few(torch.from_numpy(some[layered]))}) they lie "
            "in two layers about a spacing apart or closer, as on a thin plate sampled on both sides; the surface may "
            "be one sheet there, with half of the area. Add points until they are closer than it is thick, keep one "
            "side alone, or give the mesh if there is one"
        )


def _surrounded(points: Points, normals: Points, near: Int[Tensor, "B K"]) -> np.ndarray:
    """Whether the first point of each row is surrounded by its own sheet: no gap of 120° in the tangent plane."""
    good = compatible_neighbors(points, normals, near)[:, 1:]
    good &= good.cumsum(1) <= NEAREST
    flat = (points[near[:, 1:]] - points[near[:, :1]]) @ complete_frames(normals[near[:, 0]])
    angle = torch.atan2(*flat.unbind(-1)).masked_fill(~good, torch.inf).sort(1).values
    after = torch.cat([angle[:, 1:], torch.full_like(angle[:, :1], torch.inf)], 1)
    after = torch.where(after.isinf(), angle[:, :1] + 2 * torch.pi, after)
    gap = (after - angle).masked_fill(angle.isinf(), 0.0).amax(1)
    return np.asarray(good.any(1) & (gap < OBTUSE))


def in_doubt(surface: CloudSurface, faces: Faces) -> Bool[np.ndarray, " F"]:
    """Triangles with an edge that crosses between sheets, or is far longer than the spacing.

    Edges between points that are among the nearest of each other, as along the wide side of a grid, are not long.
    """
    points, normals = surface.points.numpy(), surface.normals.numpy()
    near, count = surface.neighbors.numpy(), len(points)
    edges = edges_of(faces, count)
    i, j = edges.keys // count, edges.keys % count
    edge = points[j] - points[i]
    length = lengths(edge)
    spacing = spacing_at(points, near)
    small, large = np.minimum(spacing[i], spacing[j]), np.maximum(spacing[i], spacing[j])
    beyond = spacing_at(points, near, NEAREST)
    # long against the larger spacing of their ends, or against the smaller one
    found = length > np.minimum(REACH * large, FACTOR * small)
    found &= length > np.minimum(beyond[i], beyond[j])
    steep_i, steep_j = (np.abs(inner(edge, normals[k])) > LEVEL * length for k in (i, j))
    steep = steep_i | steep_j
    if steep.any():
        amid, ends = np.zeros(count, dtype=bool), np.unique([i[steep], j[steep]])
        amid[ends] = _surrounded(surface.points, surface.normals, surface.neighbors[ends])
        across = (steep_i & amid[i]) | (steep_j & amid[j])
        close = np.isin(np.arange(count), [i[across], j[across]])
        beside = close[i] | close[j]
        close = np.isin(np.arange(count), [i[beside], j[beside]])
        found |= steep & close[i] & close[j]
    return np.asarray(found[edges.of].reshape(-1, 3).any(1))


def spectral_change(surface: CloudSurface) -> tuple[float, Mask]:
    """(relative rise of one of the first eigenvalues over another by triangles in doubt, to first order; their points).

    Without these triangles an eigenvalue would be lower by their share of the energy ∫|∇φ|² of its mode. Scattered
    triangles have the same share of every mode; a bridge has nearly all of a mode that it alone bounds.
    """
    points, parts = surface.points.numpy(), (surface.cells.numpy(), surface.stars.numpy())
    faces = np.concatenate(parts)
    weight = np.array([1.0, 1 / 3]).repeat([len(part) for part in parts])
    doubtful = in_doubt(surface, faces)
    marked = np.isin(np.arange(len(points)), faces[doubtful])
    if not doubtful.any():
        return 0.0, marked
    stiffness, mass = _elements(points, faces, weight)
    sound, _ = _elements(points, faces, np.where(doubtful, SMALL, 1.0) * weight)
    used = mass > 0  # points in no face have none
    stiffness, sound = (sparse.csr_matrix(part[used][:, used]) for part in (stiffness, sound))
    basis = _coarse_space(sound)
    whole, sound, mass = (
        (basis.T @ part @ basis).toarray() for part in (stiffness, sound, sparse.diags(mass[used]))
    )
    values, modes = eigh(whole, mass, subset_by_index=[0, min(PAIRS, len(whole)) - 1])
    moving = values > ROOT_EPS * values.max()
    values, modes = values[moving], modes[:, moving]
    rest = (modes * (sound @ modes)).sum(0) / values
    return float(1 - rest.min() / rest.max()) if len(rest) else 0.0, marked


def _coarse_space(sound: sparse.csr_matrix) -> Any:
    """Smoothed aggregates (Vaněk, Mandel, Brezina 1996), none of which reaches across triangles in doubt."""
    import pyamg

    hierarchy = pyamg.smoothed_aggregation_solver(
        sound + sparse.diags(NEGLIGIBLE * sound.diagonal()),
        strength=("symmetric", {"theta": SMALL}),  # pyright: ignore[reportArgumentType]
        symmetry="symmetric",
        smooth=("jacobi", {"weighting": "local"}),
        improve_candidates=None,
        max_coarse=DENSE,
        coarse_solver="splu",
    )
    basis = sparse.identity(len(sound.diagonal()), format="csr")
    for level in hierarchy.levels[:-1]:
        basis = basis @ level.P
    return basis


def _elements(
    points: Vectors, faces: Faces, weight: Float[np.ndarray, " F"]
) -> tuple[sparse.csr_array, Float[np.ndarray, " N"]]:
    """P1 stiffness matrix and lumped mass; the heights of flat triangles are bounded from below."""
    count = len(points)
    side = points[np.roll(faces, -2, 1)] - points[np.roll(faces, -1, 1)]
    longest = largest(lengths(side.reshape(-1, 3)).reshape(-1, 3))
    area = np.maximum(lengths(face_vectors(points, faces)), NEGLIGIBLE * longest**2)
    entry = np.einsum("fkx,flx->fkl", side, side) * (weight / (4 * area))[:, None, None]
    row, col = faces.repeat(3, axis=1).ravel(), np.tile(faces, 3).ravel()
    stiffness = sparse.coo_array((entry.ravel(), (row, col)), shape=(count, count)).tocsr()
    return stiffness, np.bincount(faces.ravel(), (area * weight).repeat(3) / 3, count)
