"""Conversion from and to trimesh, and shapes from files: meshes through trimesh, arrays through NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from torchlb.errors import InputError
from torchlb.io.files import SUFFIXES, arrays_of, read_shape
from torchlb.linalg.checks import check_operator
from torchlb.operator.dispatch import Operator, build_operator
from torchlb.operator.laplace_beltrami import LaplaceBeltrami

__all__ = ["SUFFIXES", "from_trimesh", "read_shape", "to_trimesh"]


def from_trimesh(shape: Any, *, operator: Operator = "stencil", **options: Any) -> LaplaceBeltrami:
    """Operator of a `trimesh.Trimesh`, `trimesh.PointCloud` or `trimesh.Scene`, in float64.

    Parameters
    ----------
    shape
        Vertices in ℓ. The geometries of a scene are placed and joined; they stay separate components.
    operator, **options
        "stencil", or "cotangent" for libigl's; options of `LaplaceBeltrami.from_mesh` or `from_points`.

    Raises ValueError for bad input, such as vertices that belong to no face: `shape.remove_unreferenced_vertices()`.

    Examples
    --------
    >>> import trimesh
    >>> from_trimesh(trimesh.creation.icosphere(subdivisions=2), order=3).num_points
    162
    """
    vertices, faces = arrays_of(shape)
    return build_operator(vertices, faces, operator=operator, **options)


def to_trimesh(lb: LaplaceBeltrami, faces: Any = None, **attributes: Any) -> Any:
    """The points and faces of an operator as a `trimesh.Trimesh`, or without faces as a `trimesh.PointCloud`.

    Parameters
    ----------
    lb, faces
        Operator of N points in R³, and (F, 3) instead of its own faces.
    **attributes
        (N,) or (N, C) data, such as ``curvature=lb.mean_curvature_normal()``, for `vertex_attributes`; files such as
        .ply keep them. A point cloud holds them in `metadata`.

    Raises ValueError for points of another dimension, or an attribute of another length.
    """
    import trimesh

    check_operator(lb)
    if lb.points.ndim != 2 or lb.points.shape[1] != 3:
        raise InputError(f"expected points in R³, got shape {tuple(lb.points.shape)}")
    arrays = {name: _array(value) for name, value in attributes.items()}
    for name, array in arrays.items():
        if len(array) != lb.num_points:
            raise InputError(f"{name}: expected {lb.num_points} rows, got shape {array.shape}")
    points = _array(lb.points).astype(np.float64)
    faces = lb.faces if faces is None else faces
    if len(faces) == 0 or lb.dim != 2:
        return trimesh.PointCloud(points, metadata=arrays)
    mesh = trimesh.Trimesh(points, _array(faces), process=False)
    mesh.vertex_attributes.update(arrays)
    return mesh


def _array(values: Any) -> np.ndarray:
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)
