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
from torchlb.io.formats import READERS, numbers_of
from torchlb.io.libraries import (
    BY_MESHIO,
    BY_NIBABEL,
    MAP,
    SURFACE,
    read_meshio,
    read_nibabel,
    start_of,
    write_meshio,
    write_nibabel,
)
from torchlb.operator.cleaning import merged, proper_faces, triangles_of
from torchlb.operator.inputs import ArrayLike, as_tensor, check_corners, check_points

SUFFIXES = tuple(sorted([".gii", ".glb", ".gltf", ".npy", ".npz", ".stl", *BY_MESHIO, *READERS]))
"""Endings of the files that `read_shape` takes."""
STEPS = 4
"""Largest difference of coinciding corners in an .stl, in steps of float32 at the largest coordinate."""
OF_THE_SHAPE = ("vertices", "points", "pos", "faces")
"""Names in a .npz that are not of data."""
WRITTEN = ".npz, .vtk, .vtu, .gii"
"""Formats with data of the points that are written."""
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
        FreeSurfer's maps (lh.thickness, lh.curv, …), through nibabel.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If it holds no such data, or the library is missing that reads it; the message names the file.
    """
    data = _read(path)[2]
    if not data:
        raise InputError(
            f"{path}: no data of points are read from it; {WRITTEN}, .mgh, .annot and FreeSurfer's maps hold some"
        )
    return {name: as_tensor(values) for name, values in data.items()}


def _read(path: str | Path) -> tuple[Tensor | None, Tensor | None, dict[str, np.ndarray]]:
    """The vertices, cells and data in a file, if any."""
    path = Path(path).expanduser()
    suffix, data = path.suffix.lower(), {}
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        if suffix == ".npy":
            vertices, faces = as_tensor(np.load(path, allow_pickle=False)), None
        elif suffix == ".npz":
            vertices, faces, data = _npz(path)
        elif suffix in READERS:
            vertices, faces = _triangulated(*READERS[suffix](path))
        elif suffix in (*BY_MESHIO, *BY_NIBABEL) or start_of(path) in (SURFACE, MAP):
            places, cells, data = (read_meshio if suffix in BY_MESHIO else read_nibabel)(path)
            vertices = None if places is None else as_tensor(np.asarray(places, dtype=float))
            faces = None if cells is None or isinstance(cells, tuple) else as_tensor(cells).long()
            if isinstance(cells, tuple):
                vertices, faces = _triangulated(np.asarray(vertices), *cells)
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
        Data are held by .npz, by .vtk and .vtu (through meshio), and by .gii (through nibabel, in single precision;
        .func.gii and .shape.gii hold the data alone). Without data also .ply, .obj, .stl, .off, … (through trimesh).
    points, cells
        (N, n) and (F, 3) triangles, (F, 2) segments or (F, 4) tetrahedra, such as ``lb.points, lb.faces``; None for a
        cloud.
    **point_data
        (N,) or (N, C) each, by name, such as ``thickness=f``.

    Raises
    ------
    ValueError
        For data of another length, a format that holds no data or no such cells, and where its library is missing.

    Examples
    --------
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
    n, writer = places.shape[1], write_meshio if suffix in BY_MESHIO else write_nibabel
    if suffix == ".npz":
        np.savez(path, **{"vertices": places, "faces": corners, **data})
    elif (
        suffix in (*BY_MESHIO, ".gii")
        and n < 4
        and (corners.shape[1] == 3 == n or suffix != ".gii")
    ):
        writer(path, places, corners, data)
    elif data or n != 3 or corners.shape[1] != 3:
        raise InputError(
            f"{path}: this format does not hold {list(data) or 'such cells'} on these points of R^{n}, with cells of "
            f"{corners.shape[1]} corners; .npz holds all, .vtk and .vtu all in R² and R³, .gii triangles and data in R³"
        )
    else:
        _write_trimesh(path, places, corners)


def _write_trimesh(path: Path, points: np.ndarray, cells: np.ndarray) -> None:
    import trimesh

    mesh = trimesh.Trimesh(points, cells, process=False)
    shape: Any = mesh if len(cells) else trimesh.PointCloud(points)
    try:
        shape.export(path)
    except (ValueError, KeyError) as error:
        raise InputError(
            f"{path}: no format that can be written; {WRITTEN}, .ply, .obj, .off, .stl can ({error})"
        ) from error


def may_be_shape(path: Path) -> bool:
    """Whether a file is taken for a shape, by its ending; .txt and .csv by three numbers in their first row."""
    if path.suffix.lower() not in (".csv", ".txt"):
        return path.suffix.lower() in SUFFIXES or start_of(path) == SURFACE
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


def _npz(path: Path) -> tuple[Tensor | None, Tensor | None, dict[str, np.ndarray]]:
    with np.load(path, allow_pickle=False) as archive:
        names = [name for name in ("vertices", "points", "pos") if name in archive.files]
        vertices = as_tensor(archive[names[0]]) if names else None
        faces = as_tensor(archive["faces"]).long() if "faces" in archive.files else None
        data = {name: archive[name] for name in archive.files if name not in OF_THE_SHAPE}
    return vertices, None if faces is None or faces.numel() == 0 else faces, data
