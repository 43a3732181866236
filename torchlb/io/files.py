"""Shapes from files: meshes through trimesh, arrays through NumPy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.errors import InputError
from torchlb.operator.inputs import as_tensor

SUFFIXES = (".glb", ".gltf", ".npy", ".npz", ".obj", ".off", ".ply", ".stl", ".xyz")
"""Of files that `read_shape` takes."""
Shape = tuple[Float[Tensor, "N n"], Int[Tensor, "F v"] | None]


def arrays_of(shape: Any) -> Shape:
    """Vertices, and faces or None, of what trimesh read."""
    import trimesh

    if isinstance(shape, trimesh.Scene):
        shape = trimesh.util.concatenate(shape.dump())
    if not hasattr(shape, "vertices"):
        raise InputError(f"expected a Trimesh, PointCloud or Scene of trimesh, got {type(shape)}")
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
    path = Path(path).expanduser()
    suffix = path.suffix.lower()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        if suffix == ".npy":
            vertices, faces = as_tensor(np.load(path, allow_pickle=False)), None
        elif suffix == ".npz":
            vertices, faces = _npz(path)
        else:
            import trimesh

            loaded = trimesh.load(path, process=False, maintain_order=True, skip_materials=True)
            vertices, faces = arrays_of(loaded)
        if vertices.ndim != 2 or vertices.numel() == 0:
            raise InputError(f"vertices of shape {tuple(vertices.shape)}, expected (N, n)")
    except Exception as error:  # each reader has its own
        raise InputError(
            f"{path}: not a mesh or cloud that can be read; {', '.join(SUFFIXES)} can ({error})"
        ) from error
    if suffix == ".stl" and faces is not None:
        vertices, merged = torch.unique(vertices, dim=0, return_inverse=True)
        faces = merged[faces]
    return vertices.double(), faces


def _npz(path: Path) -> Shape:
    with np.load(path, allow_pickle=False) as archive:
        names = [name for name in ("vertices", "points", "pos") if name in archive.files]
        if not names:
            raise InputError(f"neither vertices nor points among {archive.files}")
        vertices = as_tensor(archive[names[0]])
        faces = as_tensor(archive["faces"]).long() if "faces" in archive.files else None
    return vertices, None if faces is None or faces.numel() == 0 else faces
