"""Shapes from files and to files: by `formats`, by NumPy, and through trimesh, nibabel and meshio."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.errors import InputError
from torchlb.geometry.complex import edges_of
from torchlb.io import libraries
from torchlb.io.formats import READERS, numbers_of, triangulated
from torchlb.operator.cleaning import merged, proper_faces
from torchlb.operator.inputs import ArrayLike, as_tensor, check_corners, check_points

SUFFIXES = tuple(
    sorted([".gii", ".glb", ".gltf", ".npy", ".npz", ".stl", ".vtk", ".vtu", *READERS])
)
"""Endings of the files that `read_shape` takes."""
STEPS = 4
"""Largest difference of coinciding corners in an .stl, in steps of float32 at the largest coordinate."""
OF_THE_SHAPE = ("vertices", "points", "pos", "faces")
"""Names in a .npz that are not of data."""
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
        diagonal of a quad; without faces it is a cloud. A surface in GIFTI (.gii) or FreeSurfer's format (lh.pial, …),
        through nibabel. VTK's .vtk and .vtu, through meshio: tetrahedra, else polygons, else lines. A cloud in .pcd, or
        a table of numbers (.xyz, .txt, .csv, .pts, .asc) with the coordinates in the columns x, y, z, or in the first
        three. An array (N, n) of points in .npy; or a .npz with `vertices` (or `points`, or `pos`) and, for a mesh,
        `faces`. The corners of an .stl, which has no vertices, are merged where they coincide, and along open edges
        where they differ by rounding.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it is no shape, or the library is missing that reads it; the message names the file.
    """
    vertices, faces, data = _read(path)
    if vertices is None:
        raise InputError(
            f"{path}: not a mesh or cloud, neither vertices nor points among {list(data)}; torchlb.read_point_data "
            "reads data"
        )
    return vertices.double(), faces


def read_point_data(path: str | Path) -> dict[str, Tensor]:
    """Data of the points in a file by name, (N,) or (N, C), in the type and order of the file.

    Parameters
    ----------
    path
        A .npz: its arrays except the shape; .vtk (no polydata) or .vtu, through meshio; .gii, .mgh, .annot and
        FreeSurfer's maps (lh.thickness, lh.curv, …), through nibabel. Errors are those of `read_shape`, and a
        ValueError for a file without data.
    """
    data = _read(path)[2]
    if not data:
        raise InputError(
            f"{path}: no data of points; .npz, .vtk, .vtu, .gii, .mgh, .annot and FreeSurfer's maps may hold some"
        )
    return {name: as_tensor(values) for name, values in data.items()}


def _read(path: str | Path) -> libraries.Contents:
    """The vertices, cells and data in a file, if any."""
    path, data = Path(path).expanduser(), {}
    suffix = path.suffix.lower()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        if suffix == ".npy":
            vertices, faces = as_tensor(np.load(path, allow_pickle=False)), None
        elif suffix == ".npz":
            vertices, faces, data = _npz(path)
        elif suffix in READERS:
            vertices, faces = triangulated(*READERS[suffix](path))
        elif (found := libraries.read(path)) is not None:
            vertices, faces, data = found
        else:
            import trimesh

            loaded = trimesh.load(path, process=False, maintain_order=True, skip_materials=True)
            vertices, faces = arrays_of(loaded)
            if suffix == ".stl" and faces is not None:
                vertices, faces = _sewn(vertices, faces)
        if vertices is not None and (vertices.ndim != 2 or vertices.numel() == 0):
            raise InputError(f"vertices of shape {tuple(vertices.shape)}, expected (N, n)")
    except Exception as error:  # each reader raises its own
        raise InputError(
            f"{path}: not a mesh or cloud that can be read; {', '.join(SUFFIXES)} and FreeSurfer's surfaces can "
            f"({error})"
        ) from error
    return vertices, faces, data


def write_shape(
    path: str | Path, points: ArrayLike, cells: ArrayLike | None = None, **point_data: ArrayLike
) -> None:
    """Write a mesh or cloud, with data of its points, in the format that the ending names.

    Parameters
    ----------
    path
        .npz; .vtk or .vtu (through meshio), in R² and R³; .gii (through nibabel), triangles and data in single
        precision, or data alone in .func.gii and .shape.gii; .ply, .obj, .off, .stl, .glb (through trimesh), triangles
        or points in R³ without data.
    points, cells
        (N, n), and (F, 3) triangles, (F, 2) segments or (F, 4) tetrahedra, or None: ``lb.points, lb.faces``.
    **point_data
        (N,) or (N, C) each, by name, such as ``thickness=f``.

    Raises ValueError for data of another length, a format that does not hold them, and where its library is missing.

    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_shape(f"{folder}/a.npz", torch.eye(3), [[0, 1, 2]], f=torch.ones(3))
    ...     print(read_shape(f"{folder}/a.npz")[1], read_point_data(f"{folder}/a.npz"))
    tensor([[0, 1, 2]]) {'f': tensor([1., 1., 1.])}
    """
    path, places = Path(path).expanduser(), check_points(points).numpy()
    suffix, corners = path.suffix.lower(), np.zeros((0, 3), dtype=np.int64)
    if cells is not None and len(cells):
        corners = check_corners(cells, len(places)).numpy()
    data = {name: as_tensor(f).detach().cpu().numpy() for name, f in point_data.items()}
    for name, values in data.items():
        if values.ndim not in (1, 2) or len(values) != len(places) or name in OF_THE_SHAPE:
            raise InputError(
                f"{name}: expected data of {len(places)} points, (N,) or (N, C), under a name other than "
                f"{', '.join(OF_THE_SHAPE)}; got shape {values.shape}"
            )
    flat = places.shape[1] == corners.shape[1] == 3
    if suffix == ".npz":
        np.savez(path, **{"vertices": places, "faces": corners, **data})
    elif (suffix in libraries.BY_MESHIO and places.shape[1] < 4) or (suffix == ".gii" and flat):
        libraries.write(path, places, corners, data)
    elif suffix in (".ply", ".obj", ".off", ".stl", ".glb") and flat and not data:
        import trimesh

        mesh = trimesh.Trimesh(places, corners, process=False)
        _ = (mesh if len(corners) else trimesh.PointCloud(places)).export(path)
    else:
        what = f", with {', '.join(data)}" if data else ""
        raise InputError(
            f"{path}: this format does not hold cells {corners.shape} on points {places.shape}{what}; .npz holds all, "
            ".vtk and .vtu all in R² and R³, .gii triangles in R³ and data, .ply, .obj, .off, .stl, .glb triangles or "
            "points in R³ without data"
        )


def may_be_shape(path: Path) -> bool:
    """Whether a file is taken for a shape, by its ending; .txt and .csv by three numbers in their first row."""
    if path.suffix.lower() not in (".csv", ".txt"):
        return path.suffix.lower() in SUFFIXES or libraries.begins(path, libraries.SURFACE)
    try:
        return len(next(numbers_of(path), ([], []))[1]) > 2
    except InputError:
        return False


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


def _npz(path: Path) -> libraries.Contents:
    with np.load(path, allow_pickle=False) as archive:
        arrays = dict(archive)
    data = {name: array for name, array in arrays.items() if name not in OF_THE_SHAPE}
    shape = [as_tensor(arrays[name]) for name in OF_THE_SHAPE if name in arrays]
    faces = shape.pop() if "faces" in arrays else None
    return (
        shape[0] if shape else None,
        None if faces is None or faces.numel() == 0 else faces.long(),
        data,
    )
