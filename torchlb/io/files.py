"""Shapes from files: polygons and points by `formats`, .stl and .glb through trimesh, arrays through NumPy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.errors import InputError
from torchlb.geometry.complex import edges_of
from torchlb.io.formats import READERS, numbers_of
from torchlb.operator.cleaning import merged, proper_faces, triangles_of
from torchlb.operator.inputs import as_tensor

SUFFIXES = tuple(sorted([".glb", ".gltf", ".npy", ".npz", ".stl", *READERS]))
"""Endings of the files that `read_shape` takes."""
STEPS = 4
"""Largest difference of coinciding corners in an .stl, in steps of float32 at the largest coordinate."""
Shape = tuple[Float[Tensor, "N n"], Int[Tensor, "F v"] | None]


def arrays_of(shape: Any) -> Shape:
    """Vertices, and faces or None, of an object of trimesh."""
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
    path
        A mesh (.ply, .obj, .off, .stl, .glb, .gltf), whose polygons are split into triangles, along the shorter
        diagonal of a quad; without faces it is a cloud. A cloud in .pcd, or a table of numbers (.xyz, .txt, .csv, .pts,
        .asc) with the coordinates in the columns x, y, z, or in the first three. An array (N, n) of points in .npy; or
        a .npz with `vertices` (or `points`, or `pos`) and, for a mesh, `faces`. The corners of an .stl, which has no
        vertices, are merged where they coincide, and along open edges where they differ by rounding.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no shape; the message names the file.
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
        elif suffix in READERS:
            vertices, faces = _triangulated(*READERS[suffix](path))
        else:
            import trimesh

            loaded = trimesh.load(path, process=False, maintain_order=True, skip_materials=True)
            vertices, faces = arrays_of(loaded)
        if vertices.ndim != 2 or vertices.numel() == 0:
            raise InputError(f"vertices of shape {tuple(vertices.shape)}, expected (N, n)")
    except Exception as error:  # each reader raises its own
        raise InputError(
            f"{path}: not a mesh or cloud that can be read; {', '.join(SUFFIXES)} can ({error})"
        ) from error
    if suffix == ".stl" and faces is not None:
        vertices, faces = _sewn(vertices, faces)
    return vertices.double(), faces


def may_be_shape(path: Path) -> bool:
    """Whether a file is taken for a shape, by its ending; .txt and .csv by three numbers in their first row."""
    if path.suffix.lower() not in (".csv", ".txt"):
        return path.suffix.lower() in SUFFIXES
    try:
        return len(next(numbers_of(path), ([], []))[1]) > 2
    except InputError:
        return False


def _triangulated(
    vertices: Float[np.ndarray, "N n"], corners: Int[np.ndarray, " C"], sizes: Int[np.ndarray, " P"]
) -> Shape:
    """Split polygons into triangles, in their order; those with fewer than three corners are left out."""
    places, every = torch.from_numpy(vertices), torch.from_numpy(corners)
    bad = corners[(corners < 0) | (corners >= len(vertices))]
    if len(bad):
        raise InputError(f"faces have a corner {bad[0]}, and there are {len(vertices)} vertices")
    starts, parts, owners = np.cumsum(sizes) - sizes, [], []
    for size in np.unique(sizes[sizes > 2]).tolist():
        chosen = np.flatnonzero(sizes == size)
        polygons = every[torch.from_numpy(starts[chosen][:, None] + np.arange(size))]
        parts.append(polygons[:, None] if size == 3 else triangles_of(places, polygons))
        owners.append(torch.from_numpy(chosen).repeat_interleave(size - 2))
    if not parts:
        return places, None
    order = torch.cat(owners).argsort(stable=True)
    return places, torch.cat([part.flatten(0, 1) for part in parts])[order]


def _sewn(vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]) -> tuple[Tensor, Tensor]:
    """Merge the corners of triangles into vertices: equal corners, and at open edges those that differ by rounding.

    An open edge belongs to one triangle; ends of an edge are never merged. So a closed mesh keeps all its vertices.
    """
    vertices, number = torch.unique(vertices, dim=0, return_inverse=True)
    faces = number[faces]
    found = edges_of(proper_faces(faces).numpy(), len(vertices))
    edges = np.stack(np.divmod(found.keys, len(vertices)), 1)
    rim = np.unique(edges[found.uses == 1])
    if len(rim) == 0:
        return vertices, faces
    between = torch.from_numpy(np.searchsorted(rim, edges[np.isin(edges, rim).all(1)]))
    reach = STEPS * torch.finfo(torch.float32).eps * float(vertices.abs().max())
    one, rim = torch.arange(len(vertices)), torch.from_numpy(rim)
    one[rim] = rim[merged(vertices[rim], reach, between)]
    kept, number = torch.unique(one, return_inverse=True)
    return vertices[kept], number[faces]


def _npz(path: Path) -> Shape:
    with np.load(path, allow_pickle=False) as archive:
        names = [name for name in ("vertices", "points", "pos") if name in archive.files]
        if not names:
            raise InputError(f"neither vertices nor points among {archive.files}")
        vertices = as_tensor(archive[names[0]])
        faces = as_tensor(archive["faces"]).long() if "faces" in archive.files else None
    return vertices, None if faces is None or faces.numel() == 0 else faces
