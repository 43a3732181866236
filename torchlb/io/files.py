"""Shapes from files and to files: by `formats`, by NumPy, and through trimesh, nibabel and pyvista."""

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
from torchlb.io.formats import READERS, numbers_of
from torchlb.operator.cleaning import merged, proper_faces, triangles_of
from torchlb.operator.inputs import ArrayLike, as_tensor, check_corners, check_points

OTHERS = (".gii", ".glb", ".gltf", ".npy", ".npz", ".stl")
SUFFIXES = tuple(sorted([*OTHERS, *libraries.VTK, *READERS]))
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
        diagonal of a quad; without faces it is a cloud. A surface of GIFTI (.gii) or FreeSurfer (lh.pial, …), through
        nibabel. Polydata or an unstructured grid of VTK (.vtk, .vtp, .vtu), through pyvista: tetrahedra, else
        triangles, else lines. A cloud in .pcd, or a table of numbers (.xyz, .txt, .csv, .pts, .asc) with the
        coordinates in the columns x, y, z, or in the first three. An array (N, n) of points in .npy; or a .npz with
        `vertices` (or `points`, or `pos`) and, for a mesh, `faces`. The corners of an .stl, which has no vertices, are
        merged where they coincide, and along open edges where they differ by rounding.

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
            f"{path}: not a mesh or cloud, neither vertices nor points among {list(data)}; "
            "torchlb.read_point_data reads data"
        )
    return as_tensor(vertices).double(), None if faces is None else as_tensor(faces).long()


def read_point_data(path: str | Path) -> dict[str, Tensor]:
    """Data of the points in the file `path` by name, (N,) or (N, C), in the type and order of the file.

    Arrays of a .npz besides the shape; those of .vtk, .vtp and .vtu, through pyvista; of .gii, and FreeSurfer's maps
    (lh.thickness, .mgh, .mgz) and labels (.annot, as numbers of its table), through nibabel. Raises a ValueError for a
    file without data, else as `read_shape`.
    """
    data = _read(path)[2]
    if not data:
        raise InputError(f"{path}: no data of points; .npz, .vtk, .gii, .mgz, lh.curv, … hold some")
    return {name: as_tensor(values) for name, values in data.items()}


def _read(path: str | Path) -> libraries.Contents:
    """The vertices, cells and data in a file, if any."""
    path = Path(path).expanduser()
    suffix = path.suffix.lower()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        if suffix == ".npy":
            found = np.load(path, allow_pickle=False), None, {}
        elif suffix == ".npz":
            found = _npz(path)
        elif suffix in READERS:
            found = *_triangulated(*READERS[suffix](path)), {}
        elif (found := libraries.read(path)) is None:
            found = *_by_trimesh(path), {}
        shape = (1, 1) if found[0] is None else found[0].shape
        if len(shape) != 2 or 0 in shape:
            raise InputError(f"vertices of shape {tuple(shape)}, expected (N, n)")
    except Exception as error:  # each reader raises its own
        raise InputError(
            f"{path}: not a mesh or cloud that can be read; {', '.join(SUFFIXES)} and FreeSurfer's surfaces can "
            f"({error})"
        ) from error
    return found


def _by_trimesh(path: Path) -> Shape:
    """What trimesh reads; the corners of an .stl become vertices."""
    import trimesh

    shape = trimesh.load(path, process=False, maintain_order=True, skip_materials=True)
    vertices, faces = arrays_of(shape)
    if path.suffix.lower() == ".stl" and faces is not None:
        return _sewn(vertices, faces)
    return vertices, faces


def write_shape(
    path: str | Path, points: ArrayLike, cells: ArrayLike | None = None, **point_data: ArrayLike
) -> None:
    """Write a mesh or cloud, with data of its points, in the format that the ending of `path` names.

    .npz holds every shape; .vtk and .vtu, through pyvista, those of R² and R³; .gii, through nibabel, triangles, in
    single precision, and .func.gii and .shape.gii the data alone; .ply, .obj, .off, .stl and .glb, through trimesh,
    triangles and points of R³ without data. `points` are (N, n), `cells` (F, 3) triangles, (F, 2) segments, (F, 4)
    tetrahedra or None, `point_data` (N,) or (N, C), by name: ``write_shape("a.vtu", points, faces, thickness=f)``.

    Raises ValueError for data of another length, a format that does not hold them, and where its library is missing.
    """
    path, places = Path(path).expanduser(), check_points(points).numpy()
    suffix, corners = path.suffix.lower(), np.zeros((0, 3), dtype=np.int64)
    if cells is not None and len(cells):
        corners = check_corners(cells, len(places)).numpy()
    data = {name: as_tensor(f).detach().cpu().numpy() for name, f in point_data.items()}
    for name, values in data.items():
        if values.ndim not in (1, 2) or len(values) != len(places) or name in OF_THE_SHAPE:
            raise InputError(
                f"{name}: expected data of {len(places)} points, (N,) or (N, C), under another name than "
                f"{', '.join(OF_THE_SHAPE)}; got shape {values.shape}"
            )
    flat = places.shape[1] == corners.shape[1] == 3
    if suffix == ".npz":
        np.savez(path, **{"vertices": places, "faces": corners, **data})
    elif (suffix in (".vtk", ".vtu") and places.shape[1] < 4) or (suffix == ".gii" and flat):
        libraries.write(path, places, corners, data)
    elif suffix in (".ply", ".obj", ".off", ".stl", ".glb") and flat and not data:
        import trimesh

        mesh = trimesh.Trimesh(places, corners, process=False)
        _ = (mesh if len(corners) else trimesh.PointCloud(places)).export(path)
    else:
        what = (
            f"cells {corners.shape} on points {places.shape}{''.join(f', {name}' for name in data)}"
        )
        raise InputError(
            f"{path}: this format does not hold {what}; .npz holds all, .vtk and .vtu all in R² and R³, .gii triangles "
            "and data in R³, .ply, .obj, .off, .stl and .glb triangles and points of R³ without data"
        )


def may_be_shape(path: Path) -> bool:
    """Whether a file is taken for a shape, by its ending; .txt and .csv by three numbers in their first row."""
    if path.suffix.lower() not in (".csv", ".txt"):
        return path.suffix.lower() in SUFFIXES or libraries.begins(path, libraries.SURFACE)
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


def _npz(path: Path) -> libraries.Contents:
    with np.load(path, allow_pickle=False) as archive:
        arrays = dict(archive)
    shape = {name: arrays.pop(name) for name in OF_THE_SHAPE if name in arrays}
    faces = shape.pop("faces", None)
    vertices = next(iter(shape.values()), None)
    return vertices, None if faces is None or faces.size == 0 else faces, arrays
