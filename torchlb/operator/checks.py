"""Checks of the input: errors name the points and the remedy."""

from __future__ import annotations

from collections.abc import Sequence
from numbers import Real
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from torchlb.errors import InputError, InputTypeError, first_few, warn
from torchlb.geometry.boundary import folded_sides
from torchlb.geometry.vectors import Points
from torchlb.linalg.precision import NEGLIGIBLE, ROUNDING, SMALL
from torchlb.operator import cleaning
from torchlb.operator.inputs import ArrayLike, check_corners, check_mask, check_points
from torchlb.stencils.conditions import Condition

MAX_EXTENT = 1e30
"""Largest extent of the points, and inverse of the smallest, for which all libraries called keep their digits."""


def check_none(given: Sequence[Any], what: str) -> None:
    """Refuse arguments by place, such as a mesh where points are expected."""
    if given:
        raise InputTypeError(
            f"{what}; an operator is built by LaplaceBeltrami.from_mesh(vertices, faces), from_points(points) or "
            "from_cotangent(vertices, faces)"
        )


def check_scale(points: Points) -> None:
    """Raise ValueError if the points extend so far, or so little, that 1/ℓ² leaves the range of numbers."""
    extent = float((points - points[0]).abs().max())
    if len(points) > 1 and extent == 0:
        raise InputError(f"points: all {len(points)} share one place; remove duplicates")
    if len(points) > 1 and not 1 / MAX_EXTENT < extent < MAX_EXTENT:
        raise InputError(
            f"points: they extend over {extent:.3g}, and 1/ℓ² of that leaves the range of numbers; "
            "rescale them to an extent near 1"
        )


def check_distinct(points: Points) -> None:
    """Raise a ValueError that names coincident points."""
    spacing, other, bad = cleaning.coincident(points)
    _warn_of_rounding(points, spacing)
    if len(bad):
        pair = sorted((int(bad[0]), int(other[bad[0]])))
        raise InputError(
            f"points: {len(bad)} points share a place with another, such as {pair[0]}, {pair[1]} (all: "
            f"{first_few(bad)}); remove duplicates with points, kept = torchlb.clean_points(points)"
        )


def _warn_of_rounding(points: Points, spacing: Float[Tensor, " N"]) -> None:
    """Warn of single-precision positions so far from 0 that their rounding shows between neighbours."""
    step = torch.finfo(torch.float32).eps * float(points.abs().max())
    width = float(spacing.median())
    if step > SMALL * width and bool((points.float() == points).all()):
        warn(
            f"points: neighbours are {width:.2g} apart, and float32 has steps of {step:.2g} so far from 0, which Δ "
            "will show; centre the points in float64 before they are rounded: (points − points.mean(0)).float()"
        )


def check_dimension(points: Points, dim: int | None, *, hypersurface: bool = False) -> int:
    """Return `dim`, or its default n − 1; ValueError if points of R², R⁴, R⁵, … do not look like a hypersurface.

    The local dimension is estimated from the 3n nearest neighbours of a point, as the median over up to 500 points,
    where there are at least 32n points. Clouds in R³ are taken for surfaces. In four columns or more the first three
    alone must not form a surface: the others may be attributes.
    """
    count, n = points.shape
    if dim is not None or hypersurface or n in (1, 3) or count < 32 * n:
        return max(n - 1, 1) if dim is None else dim
    found, advice = _local_dimension(points, 0.4), ""
    if n > 3:
        found = 2 if _local_dimension(points[:, :3], 0.2) < 3 else found
        advice = f"; if the last {n - 3} columns are attributes, pass points[:, :3]"
    if found != n - 1:
        raise InputError(
            f"points: without `dim`, points in R^{n} are taken for a manifold of dimension {n - 1}, but these look "
            f"like one of dimension {found}: pass dim={found}, or dim={n - 1} if it is meant{advice}"
        )
    return n - 1


def _local_dimension(points: Points, thin: float) -> int:
    """Median number of directions, over a sample, in which neighbours spread by more than `thin` of the largest."""
    centers = points[:: -(-len(points) // 500)].numpy()
    _, near = KDTree(points.numpy()).query(centers, k=3 * points.shape[1])
    around = points[torch.from_numpy(near)]
    spread = torch.linalg.svdvals(around - around.mean(1, keepdim=True))
    return int((spread > thin * spread[:, :1]).sum(1).median())


def mended_faces(vertices: Points, faces: Int[Tensor, "F v"]) -> Int[Tensor, "G v"]:
    """Faces without duplicates and with triangles oriented alike; warnings name changed faces and coincident vertices.

    Raises ValueError for quads, and for triangles none of which has an area.
    """
    if faces.shape[1] == 4 and cleaning.are_quads(faces):
        raise InputError(
            f"faces: shape {tuple(faces.shape)} is for tetrahedra, but these look like quads, since most share no "
            "three corners with another; split them with vertices, faces, kept = torchlb.clean_mesh(vertices, faces)"
        )
    if faces.shape[1] == 3:
        a, b = (vertices[faces[:, i]] - vertices[faces[:, 0]] for i in (1, 2))
        lengths = a.square().sum(1) * b.square().sum(1)
        if (lengths - (a * b).sum(1).square() <= ROUNDING * lengths).all():
            raise InputError(
                f"faces: none of the {len(faces)} triangles has an area, since all have their corners on a line; pass "
                "the vertices of a surface, or a curve by its edges, (F, 2)"
            )
    if faces.shape[1] == 2:
        ends = vertices[faces]
        if len(none := (ends[:, 0] == ends[:, 1]).all(1).nonzero()[:, 0]):
            raise InputError(
                f"faces: {len(none)} segments ({first_few(none)}) have no length, their ends share a place; make one "
                "vertex of the two with vertices, faces, kept = torchlb.clean_mesh(vertices, faces, merge=True)"
            )
    if faces.shape[1] == 4:
        _warn_of_flat_tetrahedra(vertices, faces)
    first = cleaning.first_of_each(faces)
    if len(again := (~first).nonzero()[:, 0]):
        warn(
            f"faces: {len(again)} have the corners of an earlier one ({first_few(again)}) and are left out; "
            "torchlb.clean_mesh(vertices, faces) removes them"
        )
        faces = faces[first]
    turned = cleaning.turned_faces(faces)
    if len(wrong := turned.nonzero()[:, 0]):
        if vertices.shape[1] <= faces.shape[1]:  # else there are no normals
            warn(
                f"faces: {len(wrong)} are wound against their neighbours ({first_few(wrong)}) and are turned round, so "
                "that the normals agree; torchlb.clean_mesh(vertices, faces) does it in the mesh"
            )
        faces = torch.where(turned[:, None], faces.flip(1), faces)
    spacing, _, bad = cleaning.coincident(vertices)
    _warn_of_rounding(vertices, spacing)
    if len(bad):
        warn(
            f"vertices: {len(bad)} share a place with another ({first_few(bad)}), so the mesh is cut open along them; "
            "if it should not be, merge them: vertices, faces, kept = torchlb.clean_mesh(vertices, faces, merge=True)"
        )
    return faces


def _warn_of_flat_tetrahedra(vertices: Points, faces: Int[Tensor, "F 4"]) -> None:
    """Warn of tetrahedra without volume, and of what is left of them where they were removed."""
    edges = vertices[faces[:, 1:]] - vertices[faces[:, :1]]
    longest = (vertices[faces[:, None]] - vertices[faces[:, :, None]]).norm(dim=-1).amax((1, 2))
    flat = torch.linalg.svdvals(edges)[:, :3].prod(1) <= NEGLIGIBLE * longest**3
    if len(none := flat.nonzero()[:, 0]):
        warn(
            f"faces: {len(none)} tetrahedra have no volume ({first_few(none)}) and count for nothing; that is "
            "right of slivers between others, as Delaunay's of a grid"
        )
    if len(within := folded_sides(vertices, faces).unique()):
        warn(
            f"faces: at {len(within)} vertices ({first_few(within)}) sides of tetrahedra lie on one another, not "
            "one and the same, as where slivers between them were removed: they are a boundary within, where "
            "conditions and boundary data hold, too. Keep the slivers, which count for nothing"
        )


def check_faces(faces: ArrayLike, num_points: int) -> Int[Tensor, "F v"]:
    """Faces with distinct corners, checked as by `check_corners`; ValueError also for unreferenced vertices."""
    faces = cleaning.proper_faces(check_corners(faces, num_points))
    if len(lost := (faces.flatten().bincount(minlength=num_points) == 0).nonzero()[:, 0]):
        raise InputError(
            f"faces: {len(lost)} vertices ({first_few(lost)}) belong to no face with distinct corners; drop them with "
            "vertices, faces, kept = torchlb.clean_mesh(vertices, faces)"
        )
    return faces


def check_normals(normals: ArrayLike, points: Points) -> Points:
    """Unit normals of the shape of `points`; ValueError for wrong shapes, NaN or zero vectors."""
    normals = check_points(normals, "normals")
    if normals.shape != points.shape:
        raise InputError(
            f"normals: expected the shape of points {tuple(points.shape)}, got {tuple(normals.shape)}"
        )
    length = normals.norm(dim=1)
    if len(bad := (length == 0).nonzero()[:, 0]):
        raise InputError(
            f"normals: {len(bad)} are zero ({first_few(bad)}); leave `normals` out to have them estimated"
        )
    return normals / length[:, None]


def check_boundary(boundary: Any, num_points: int) -> Bool[Tensor, " N"] | None:
    """A mask of all points, or None, also for "detect"; ValueError for anything else."""
    if boundary is None or (isinstance(boundary, str) and boundary == "detect"):
        return None
    if isinstance(boundary, str):
        hint = f"; pass condition={boundary!r}" if boundary in Condition.known else ""
        raise InputError(
            f"boundary: expected a mask of the points, 'detect' or None, got {boundary!r}{hint}"
        )
    return check_mask(boundary, num_points, "boundary")


def check_tolerance(tolerance: Any) -> None:
    """Raise InputError unless the tolerance is a number between 0 and 1.

    >>> check_tolerance(0.0)
    Traceback (most recent call last):
    torchlb.errors.InputError: tolerance: expected a number between 0 and 1, got 0.0
    """
    if not isinstance(tolerance, Real) or not 0 < float(tolerance) < 1:
        raise InputError(f"tolerance: expected a number between 0 and 1, got {tolerance!r}")
