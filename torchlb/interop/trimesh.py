"""trimesh in and out, and shapes from files: meshes through trimesh, arrays through NumPy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.laplace_beltrami import LaplaceBeltrami
from torchlb.operators import build_operator

__all__ = ["SUFFIXES", "from_trimesh", "read_shape", "to_trimesh"]

SUFFIXES = (".glb", ".gltf", ".npy", ".npz", ".obj", ".off", ".ply", ".stl", ".xyz")
"""Of files that `read_shape` takes."""
Shape = tuple[Float[Tensor, "N n"], Int[Tensor, "F v"] | None]


def from_trimesh(shape: Any, *, operator: str = "stencil", **options: Any) -> LaplaceBeltrami:
    """Operator of a `trimesh.Trimesh`, `trimesh.PointCloud` or `trimesh.Scene`, in float64.

    Parameters
    ----------
    shape : vertices in ℓ. The geometries of a scene are joined, each in its place; they stay components of their own.
    operator : "stencil", or "cotangent" for libigl's.
    **options : of `LaplaceBeltrami.from_mesh` or `from_points`.

    Raises
    ------
    ValueError : for bad input, such as vertices that belong to no face: `shape.remove_unreferenced_vertices()`.

    Examples
    --------
    >>> from_trimesh(trimesh.creation.icosphere(subdivisions=2), order=3).num_points
    162
    """
    vertices, faces = _arrays(shape)
    return build_operator(vertices, faces, operator=operator, **options)


def to_trimesh(lb: LaplaceBeltrami, faces: Any = None, **attributes: Any) -> Any:
    """The points of an operator as a `trimesh.Trimesh`, or without faces as a `trimesh.PointCloud`.

    Parameters
    ----------
    lb : of N points in R³.
    faces : (F, 3), which an operator does not keep.
    **attributes : (N,) or (N, C) data, such as ``curvature=lb.mean_curvature_normal()``, for `vertex_attributes`;
        files such as .ply keep them. A point cloud has no place for them but in `metadata`.

    Raises
    ------
    ValueError : for points of another dimension, or an attribute of another length.
    """
    if lb.points.ndim != 2 or lb.points.shape[1] != 3:
        raise ValueError(f"expected points in R³, got shape {tuple(lb.points.shape)}")
    arrays = {name: _array(value) for name, value in attributes.items()}
    for name, array in arrays.items():
        if len(array) != lb.num_points:
            raise ValueError(f"{name}: expected {lb.num_points} rows, got shape {array.shape}")
    points = _array(lb.points).astype(np.float64)
    if faces is None:
        return trimesh.PointCloud(points, metadata=arrays)
    mesh = trimesh.Trimesh(points, _array(faces), process=False)
    mesh.vertex_attributes.update(arrays)
    return mesh


def _array(values: Any) -> np.ndarray:
    return values.detach().cpu().numpy() if isinstance(values, Tensor) else np.asarray(values)


def _arrays(shape: Any) -> Shape:
    """Vertices, and faces or None, of what trimesh read."""
    if isinstance(shape, trimesh.Scene):
        shape = trimesh.util.concatenate(shape.dump())
    if not hasattr(shape, "vertices"):
        raise ValueError(f"expected a Trimesh, PointCloud or Scene of trimesh, got {type(shape)}")
    vertices = torch.tensor(np.array(shape.vertices, dtype=np.float64))
    faces = np.array(getattr(shape, "faces", []), dtype=np.int64)
    return vertices, torch.tensor(faces) if faces.size else None


def read_shape(path: str | Path) -> Shape:
    """Vertices, float64, and faces, int64 or None, of a file, in its order.

    Parameters
    ----------
    path : a mesh or cloud that trimesh reads (.ply, .obj, .off, .stl, .glb, .gltf, .xyz); an array (N, n) of points in
        .npy; or a .npz with `vertices` (or `points`, or `pos`) and, for a mesh, `faces`. The corners of an .stl, which
        has no vertices, are merged where they coincide; nothing else is changed.

    Raises
    ------
    FileNotFoundError : if there is none.
    ValueError : if it is no shape; the message names the file.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        if path.suffix == ".npy":
            vertices, faces = torch.from_numpy(np.load(path, allow_pickle=False)), None
        elif path.suffix == ".npz":
            vertices, faces = _npz(path)
        else:
            loaded = trimesh.load(path, process=False, maintain_order=True, skip_materials=True)
            vertices, faces = _arrays(loaded)
        if vertices.ndim != 2 or vertices.numel() == 0:
            raise ValueError(f"vertices of shape {tuple(vertices.shape)}, expected (N, n)")
    except Exception as error:  # each reader has its own
        raise ValueError(
            f"{path}: not a mesh or cloud that can be read; {', '.join(SUFFIXES)} can ({error})"
        ) from error
    if path.suffix.lower() == ".stl" and faces is not None:
        vertices, merged = torch.unique(vertices, dim=0, return_inverse=True)
        faces = merged[faces]
    return vertices.double(), faces


def _npz(path: Path) -> Shape:
    with np.load(path, allow_pickle=False) as archive:
        names = [name for name in ("vertices", "points", "pos") if name in archive.files]
        if not names:
            raise ValueError(f"neither vertices nor points among {archive.files}")
        vertices = torch.from_numpy(archive[names[0]])
        faces = torch.from_numpy(archive["faces"]).long() if "faces" in archive.files else None
    return vertices, None if faces is None or faces.numel() == 0 else faces
