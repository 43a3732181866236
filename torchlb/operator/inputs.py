"""Points and faces as they come, as tensors, arrays or lists, become checked tensors."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.errors import InputError, InputTypeError, first_few, warn

ArrayLike = Tensor | np.ndarray | Sequence[Any]
"""Input that becomes a tensor."""


def as_tensor(values: ArrayLike) -> Tensor:
    """As `torch.as_tensor`, also for arrays of any byte order and stride."""
    if isinstance(values, np.ndarray):
        values = np.ascontiguousarray(values, values.dtype.newbyteorder("="))
    return torch.as_tensor(values)


def float_type(values: ArrayLike) -> torch.dtype:
    """Floating type of the input and of the result; torch's default for integers."""
    dtype = as_tensor(values).dtype
    return dtype if dtype.is_floating_point else torch.get_default_dtype()


def warn_of_gradients(points: ArrayLike, what: str) -> None:
    """Warn of positions that require a gradient: an operator is constant and passes none on to them."""
    if isinstance(points, Tensor) and points.requires_grad and torch.is_grad_enabled():
        warn(
            f"{what}: they require gradients, but an operator is a constant of what is computed with it, so that the "
            f"gradients of results lack all that comes by the geometry; pass {what}.detach() if that is meant"
        )


def check_points(
    points: ArrayLike, what: str = "points", device: str | torch.device = "cpu"
) -> Float[Tensor, "N n"]:
    """Points as (N, n) float64 on a device, detached; ValueError for a wrong shape or type, none, NaN, infinity."""
    try:
        points = as_tensor(points)
    except (TypeError, ValueError, RuntimeError) as error:
        hint = "; a mesh goes to from_trimesh" if hasattr(points, "faces") else ""
        if isinstance(points, str | Path):
            hint = "; vertices, faces = torchlb.read_shape(path) reads a file"
        raise InputError(
            f"{what}: expected an (N, n) tensor or array, got {type(points)}{hint}"
        ) from error
    if points.ndim != 2:
        raise InputError(f"{what}: expected shape (N, n), got {tuple(points.shape)}")
    if len(points) == 0 or points.shape[1] == 0:
        raise InputError(f"{what}: got none (shape {tuple(points.shape)})")
    if len(points) < points.shape[1]:
        raise InputError(
            f"{what}: shape {tuple(points.shape)} is {len(points)} points in R^{points.shape[1]}, which have no "
            f"manifold; if they are columns, pass {what}.T"
        )
    if points.is_complex() or points.dtype == torch.bool:
        raise InputError(f"{what}: expected real numbers, got {points.dtype}")
    points = points.detach().to(device, torch.float64, copy=True)  # the operator keeps it
    if len(bad := (~points.isfinite()).any(1).nonzero()[:, 0]):
        raise InputError(
            f"{what}: {len(bad)} are NaN or infinite ({first_few(bad)}); remove or repair them"
        )
    return points


def check_path(path: Any, what: str = "path") -> Path:
    """A path with the home directory for "~"; InputTypeError for anything else, as where arguments are swapped."""
    if not isinstance(path, str | Path):
        raise InputTypeError(
            f"{what}: expected the name of a file or folder, got a {type(path).__name__}; write_shape(path, points, "
            "cells), save_operator(lb, path), precompute_operators(shapes, out)"
        )
    return Path(path).expanduser()


def check_mask(mask: ArrayLike, num_points: int, what: str = "mask") -> Bool[Tensor, " N"]:
    """A boolean mask of all points on the CPU; ValueError for anything else."""
    mask = as_tensor(mask).detach().cpu()
    if mask.dtype != torch.bool or mask.shape != (num_points,):
        raise InputError(
            f"{what}: expected a boolean mask of shape ({num_points},), as f > 0, got {mask.dtype} {tuple(mask.shape)}"
        )
    return mask


def check_corners(faces: ArrayLike, num_points: int) -> Int[Tensor, "F v"]:
    """Faces as (F, d + 1) int64 on the CPU; ValueError for wrong shapes, types or indices."""
    try:
        faces = as_tensor(faces if isinstance(faces, Tensor) else np.asarray(faces))
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputError(f"faces: expected an (F, 3) tensor or array, got {type(faces)}") from error
    if faces.ndim != 2 or faces.shape[1] not in (2, 3, 4):
        raise InputError(
            f"faces: expected shape (F, 3) (or (F, 2) segments, (F, 4) tetrahedra), got {tuple(faces.shape)}"
        )
    if len(faces) == 0:
        raise InputError("faces: got none; use LaplaceBeltrami.from_points for a cloud")
    if faces.is_floating_point() or faces.is_complex() or faces.dtype == torch.bool:
        raise InputError(f"faces: expected integers, got {faces.dtype}; vertices come first")
    faces = faces.detach().to("cpu", torch.int64)
    if len(bad := ((faces < 0) | (faces >= num_points)).any(1).nonzero()[:, 0]):
        from_one = faces.min() == 1 and faces.max() == num_points
        hint = "; they count from 1: subtract 1" if from_one else ""
        raise InputError(
            f"faces: {len(bad)} of them ({first_few(bad)}) have indices outside 0 … {num_points - 1}: "
            f"face {int(bad[0])} is {faces[bad[0]].tolist()}{hint}"
        )
    return faces
