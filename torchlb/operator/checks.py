"""Input that cannot work is refused here, with the points named and the remedy."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from torchlb.errors import InputError, warn
from torchlb.fits.polynomials import num_monomials

__all__ = [
    "check_boundary",
    "check_distinct",
    "check_faces",
    "check_normals",
    "check_options",
    "check_points",
    "check_scale",
    "clean_mesh",
    "warn_of_coincident",
]


MAX_EXTENT = 1e70
"""Largest extent of the points, and the inverse of the smallest: fourth powers of it must stay finite."""
COINCIDENT = 1e-12
"""Points closer than this share of the largest coordinate are one point: their difference is rounding."""


def _some(index: Tensor, limit: int = 8) -> str:
    """The first few of a list of indices."""
    names = ", ".join(str(i) for i in index[:limit].tolist())
    return names + (", …" if len(index) > limit else "")


def check_points(points: Any, what: str = "points") -> Float[Tensor, "N n"]:
    """As (N, n) float64 on the CPU, detached; ValueError for a wrong shape or type, none at all, NaN or infinity."""
    try:
        points = torch.as_tensor(points)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(
            f"{what}: expected an (N, n) tensor or array, got {type(points)}"
        ) from error
    if points.ndim != 2:
        raise InputError(f"{what}: expected shape (N, n), got {tuple(points.shape)}")
    if len(points) == 0 or points.shape[1] == 0:
        raise InputError(f"{what}: got none (shape {tuple(points.shape)})")
    if points.is_complex() or points.dtype == torch.bool:
        raise InputError(f"{what}: expected real numbers, got {points.dtype}")
    points = points.detach().to("cpu", torch.float64)
    bad = (~points.isfinite()).any(1).nonzero()[:, 0]
    if len(bad):
        raise InputError(
            f"{what}: {len(bad)} are NaN or infinite ({_some(bad)}); remove or repair them"
        )
    return points


def check_scale(points: Float[Tensor, "N n"]) -> None:
    """ValueError if the points extend so far, or so little, that 1/ℓ² leaves the range of numbers."""
    extent = float((points - points[0]).abs().max())
    if len(points) > 1 and not 1 / MAX_EXTENT < extent < MAX_EXTENT:
        raise InputError(
            f"points: they extend over {extent:.3g}, and 1/ℓ² of that leaves the range of numbers; "
            "rescale them to an extent near 1"
        )


def _twins(points: Float[Tensor, "N n"]) -> tuple[Int[Tensor, " N"], Int[Tensor, " T"]]:
    """(nearest other point of each, indices of those whose nearest is in the same place to rounding)."""
    distance, nearest = KDTree(points.numpy()).query(points.numpy(), k=min(2, len(points)))
    distance = torch.from_numpy(distance).view(len(points), -1)[:, -1]
    index = torch.arange(len(points))
    nearest = torch.from_numpy(nearest).view(len(points), -1)
    other = torch.where(nearest[:, 0] == index, nearest[:, -1], nearest[:, 0])
    close = (distance <= COINCIDENT * points.abs().max()) & (other != index)
    return other, close.nonzero()[:, 0]


def check_distinct(points: Float[Tensor, "N n"]) -> None:
    """ValueError that names points which coincide."""
    other, bad = _twins(points)
    if len(bad):
        pair = sorted((int(bad[0]), int(other[bad[0]])))
        raise InputError(
            f"points: {len(bad)} points share a place with another, such as {pair[0]}, {pair[1]} (all: {_some(bad)}); "
            "remove duplicates, for example with torch.unique(points.round(decimals=9), dim=0)"
        )


def warn_of_coincident(vertices: Float[Tensor, "N n"]) -> None:
    """UserWarning if vertices of a mesh coincide, as in STL files: the surface is cut open there."""
    _, bad = _twins(vertices)
    if len(bad):
        warn(
            f"vertices: {len(bad)} share a place with another ({_some(bad)}), so the mesh is cut open along them; if "
            "it should not be, merge them first, for example with trimesh.Trimesh(vertices, faces).merge_vertices()",
        )


def check_faces(faces: Any, num_points: int) -> Int[Tensor, "F v"]:
    """As (F, d + 1) int64 on the CPU; ValueError for wrong shapes, types, indices, or unreferenced vertices."""
    try:
        faces = torch.as_tensor(np.asarray(faces) if not isinstance(faces, Tensor) else faces)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"faces: expected an (F, 3) tensor or array, got {type(faces)}") from error
    if faces.ndim != 2 or faces.shape[1] not in (2, 3, 4):
        raise InputError(
            f"faces: expected shape (F, 3) (or (F, 2) segments, (F, 4) tetrahedra), got {tuple(faces.shape)}"
        )
    if len(faces) == 0:
        raise InputError("faces: got none; use LaplaceBeltrami.from_points for a cloud")
    if faces.is_floating_point() or faces.is_complex() or faces.dtype == torch.bool:
        raise InputError(f"faces: expected integers, got {faces.dtype}")
    faces = faces.detach().to("cpu", torch.int64)
    bad = ((faces < 0) | (faces >= num_points)).any(1).nonzero()[:, 0]
    if len(bad):
        raise InputError(
            f"faces: {len(bad)} of them ({_some(bad)}) have indices outside 0 … {num_points - 1}: "
            f"face {int(bad[0])} is {faces[bad[0]].tolist()}"
        )
    used = torch.zeros(num_points, dtype=torch.bool)
    used[_proper(faces).reshape(-1)] = True
    lost = (~used).nonzero()[:, 0]
    if len(lost):
        raise InputError(
            f"faces: {len(lost)} vertices ({_some(lost)}) belong to no face with distinct corners; drop them with "
            "vertices, faces, kept = torchlb.clean_mesh(vertices, faces)"
        )
    return _proper(faces)


def _proper(faces: Int[Tensor, "F v"]) -> Int[Tensor, "G v"]:
    """The faces whose corners are distinct; one that repeats a corner covers nothing."""
    ordered = faces.sort(dim=1).values
    return faces[(ordered[:, 1:] != ordered[:, :-1]).all(1)]


def clean_mesh(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Mesh without unreferenced vertices and without faces that repeat a corner.

    Parameters
    ----------
    vertices : (N, n).
    faces : (F, 3) indices.

    Returns
    -------
    vertices : (N', n), those in use, in their order.
    faces : (F', 3), renumbered.
    kept : (N',), their indices in the input: `values[kept]` carries data over.

    Examples
    --------
    >>> vertices, faces, kept = clean_mesh(torch.eye(4), torch.tensor([[0, 1, 3], [0, 0, 1]]))
    >>> faces.tolist(), kept.tolist()
    ([[0, 1, 2]], [0, 1, 3])
    """
    vertices, faces = torch.as_tensor(vertices), torch.as_tensor(faces)
    faces = _proper(faces)
    kept, renumbered = torch.unique(faces, return_inverse=True)
    return vertices[kept.long()], renumbered.to(faces.dtype), kept


def check_normals(normals: Any, points: Float[Tensor, "N n"]) -> Float[Tensor, "N n"]:
    """Unit normals of the shape of `points`; ValueError for wrong shapes, NaN or zero vectors."""
    normals = check_points(normals, "normals")
    if normals.shape != points.shape:
        raise InputError(
            f"normals: expected the shape of points {tuple(points.shape)}, got {tuple(normals.shape)}"
        )
    length = normals.norm(dim=1)
    bad = (length == 0).nonzero()[:, 0]
    if len(bad):
        raise InputError(
            f"normals: {len(bad)} are zero ({_some(bad)}); leave `normals` out to have them estimated"
        )
    return normals / length[:, None]


def check_boundary(boundary: Any, num_points: int) -> Bool[Tensor, " N"] | str | None:
    """A mask of all points, "detect" or None; ValueError for anything else."""
    if boundary is None or (isinstance(boundary, str) and boundary == "detect"):
        return boundary
    if isinstance(boundary, str):
        raise InputError(
            f"boundary: expected a mask of the points, 'detect' or None, got {boundary!r}"
        )
    mask = torch.as_tensor(boundary).detach().cpu()
    if mask.dtype != torch.bool or mask.shape != (num_points,):
        raise InputError(
            f"boundary: expected a boolean mask of shape ({num_points},), got {mask.dtype} of shape {tuple(mask.shape)}"
        )
    return mask


def _check_integer(name: str, number: Any) -> None:
    try:
        operator.index(number)
    except TypeError as error:
        raise InputError(f"{name}: expected an integer, got {number!r}") from error


def check_options(
    num_points: int,
    ambient_dim: int,
    dim: int,
    order: int,
    normal_order: int,
    num_neighbors: int | None,
    **choices: tuple[str, list[str]],
) -> None:
    """ValueError for options out of range, and for fewer points than one stencil has polynomials."""
    for name, (value, allowed) in choices.items():
        if value not in allowed:
            raise InputError(f"{name}: expected one of {allowed}, got {value!r}")
    numbers = {"dim": dim, "order": order, "normal_order": normal_order}
    for name, number in {**numbers, "num_neighbors": num_neighbors or 0}.items():
        _check_integer(name, number)
    if not 1 <= dim <= ambient_dim:
        raise InputError(
            f"dim: expected 1 … {ambient_dim} for points in R^{ambient_dim}, got {dim}"
        )
    if order < 1:
        raise InputError(f"order: expected an integer ≥ 1, got {order}")
    if normal_order < 0:
        raise InputError(
            f"normal_order: expected an integer ≥ 1, or 0 to keep the poor frames, got {normal_order}"
        )
    needed = num_monomials(dim, order + 1)
    if num_neighbors is not None and num_neighbors < needed:
        raise InputError(
            f"num_neighbors: order {order} in {dim} dimensions has {needed} polynomials and needs at least as many "
            f"neighbours (1.6 times as many, {-(-16 * needed // 10)}, is the default); got {num_neighbors}"
        )
    if num_neighbors is not None and num_neighbors > num_points:
        raise InputError(
            f"num_neighbors: {num_neighbors} are more than the {num_points} points; lower it, or leave it out"
        )
    if num_points < needed:
        fits = [p for p in range(1, order) if num_monomials(dim, p + 1) <= num_points]
        remedy = f"lower `order` to {max(fits)}" if fits else "add points"
        raise InputError(
            f"{num_points} points are fewer than the {needed} that a stencil of order {order} needs; {remedy}"
        )
