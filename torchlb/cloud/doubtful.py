"""Triangles that may join or close in error, and their effect on the first eigenvalues.

The evidence is local and independent of the triangles: on a sound surface a point surrounded by its own sheet has no
edge along its normal, and no edge is much longer than the spacing. On a random cloud a few triangles are always in
doubt, most of them without effect.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.linalg import eigh
from torch import Tensor

from torchlb.cloud.cocone import REACH
from torchlb.cloud.manifold import face_vectors
from torchlb.cloud.outliers import spacing_at
from torchlb.cloud.surface import CloudSurface
from torchlb.geometry.compatibility import admissible_neighbors
from torchlb.geometry.complex import Faces, edges_of
from torchlb.geometry.frames import complete_frames
from torchlb.geometry.thresholds import FACTOR, LEVEL, NEAREST, OBTUSE
from torchlb.geometry.vectors import inner, largest, lengths
from torchlb.linalg.precision import DENSE, NEGLIGIBLE, ROOT_EPS, SMALL

PAIRS = 11
"""Number of eigenpairs, the constant included."""


def _surrounded(
    points: Float[Tensor, "N 3"], normals: Float[Tensor, "N 3"], near: Int[Tensor, "B K"]
) -> Bool[np.ndarray, " B"]:
    """Whether the first point of each row is surrounded by its own sheet: no gap of 120° in the tangent plane."""
    good = admissible_neighbors(points, normals, near)[:, 1:]
    good &= good.cumsum(1) <= NEAREST
    flat = (points[near[:, 1:]] - points[near[:, :1]]) @ complete_frames(normals[near[:, 0]])
    angle = torch.atan2(*flat.unbind(-1)).masked_fill(~good, torch.inf).sort(1).values
    after = torch.cat([angle[:, 1:], torch.full_like(angle[:, :1], torch.inf)], 1)
    after = torch.where(after.isinf(), angle[:, :1] + 2 * torch.pi, after)
    gap = (after - angle).masked_fill(angle.isinf(), 0.0).amax(1)
    return np.asarray(good.any(1) & (gap < OBTUSE))


def in_doubt(surface: CloudSurface, faces: Faces) -> Bool[np.ndarray, " F"]:
    """Triangles with an edge that crosses between sheets, or is far longer than the spacing."""
    points, normals = surface.points.numpy(), surface.normals.numpy()
    near, count = surface.neighbors.numpy(), len(points)
    edges = edges_of(faces, count)
    i, j = edges.keys // count, edges.keys % count
    edge = points[j] - points[i]
    length = lengths(edge)
    spacing = spacing_at(points, near)
    small, large = np.minimum(spacing[i], spacing[j]), np.maximum(spacing[i], spacing[j])
    # long against the larger spacing of their ends, or against the smaller one
    found = length > np.minimum(REACH * large, FACTOR * small)
    steep_i, steep_j = (np.abs(inner(edge, normals[k])) > LEVEL * length for k in (i, j))
    steep = steep_i | steep_j
    if steep.any():
        amid, ends = np.zeros(count, dtype=bool), np.unique([i[steep], j[steep]])
        amid[ends] = _surrounded(surface.points, surface.normals, surface.neighbors[ends])
        across = (steep_i & amid[i]) | (steep_j & amid[j])
        close = np.zeros(count, dtype=bool)
        close[i[across]] = close[j[across]] = True
        beside = close[i] | close[j]
        close[i[beside]] = close[j[beside]] = True
        found |= steep & close[i] & close[j]
    return found[edges.of].reshape(-1, 3).any(1)


def spectral_change(surface: CloudSurface) -> tuple[float, Bool[np.ndarray, " N"]]:
    """(relative rise of one of the first eigenvalues over another by triangles in doubt, to first order; their points).

    Without these triangles an eigenvalue would be lower by their share of the energy ∫|∇φ|² of its mode. Scattered
    triangles have the same share of every mode; a bridge has nearly all of a mode that it alone bounds.
    """
    points, parts = surface.points.numpy(), (surface.cells.numpy(), surface.stars.numpy())
    faces = np.concatenate(parts)
    weight = np.array([1.0, 1 / 3]).repeat([len(part) for part in parts])
    doubtful, marked = in_doubt(surface, faces), np.zeros(len(points), dtype=bool)
    if not doubtful.any():
        return 0.0, marked
    marked[faces[doubtful]] = True
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
    points: Float[np.ndarray, "N 3"], faces: Faces, weight: Float[np.ndarray, " F"]
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
