"""Shapes from files and to files: by `formats`, by NumPy, and through trimesh, nibabel and pyvista."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.errors import InputError
from torchlb.io.formats import READERS, numbers_of
from torchlb.operator.cleaning import merged, triangles_of
from torchlb.operator.inputs import ArrayLike, as_tensor, check_corners, check_path, check_points

CELLS = ("VERTEX", "LINE", "TRIANGLE", "TETRA")
STEPS = 4
"""Largest difference of coinciding corners in an .stl, in steps of float32 at the largest coordinate."""
OF_THE_SHAPE = ("vertices", "points", "pos", "faces")
"""Names in a .npz that are not of data."""
SURFACE, MAP = b"\xff\xff\xfe", b"\xff\xff\xff"
"""Beginnings of FreeSurfer's files, whose endings may be any."""
Shape = tuple[Float[Tensor, "N n"], Int[Tensor, "F v"] | None]
Contents = tuple[Any, Any, dict[str, Any]]
"""Vertices and cells, or None, and the data of the points by name."""


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
    """Vertices, float64, and faces, int64 or None, of the file `path`, in its order.

    A mesh (.ply, .obj, .off, .stl, .glb, .gltf), whose polygons are split into triangles, along the shorter diagonal of
    a quad; without faces it is a cloud. A surface of GIFTI (.gii) or FreeSurfer (lh.pial, …), through nibabel. Polydata
    or an unstructured grid of VTK (.vtk, .vtp, .vtu), through pyvista: tetrahedra, else triangles, else lines. A cloud
    in .pcd, or a table of numbers (.xyz, .txt, .csv, .pts, .asc) with the coordinates in the columns x, y, z, or in the
    first three. An array (N, n) of points in .npy; or a .npz with `vertices` (or `points`, or `pos`) and, for a mesh,
    `faces`. The corners of an .stl, which has no vertices, are merged where they coincide to rounding.

    Raises FileNotFoundError if there is no such file, and ValueError if it is no shape, or the library is missing that
    reads it; the message names the file.
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


def _read(path: str | Path) -> Contents:
    """The vertices, cells and data in a file, if any."""
    path = check_path(path)
    suffix = path.suffix.lower()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        named = suffix in (".annot", ".mgh", ".mgz") or _start(path) in (SURFACE, MAP)
        found = KINDS.get(suffix, _freesurfer if named else _by_trimesh)(path)
        shape = (1, 1) if found[0] is None else found[0].shape
        if len(shape) != 2 or 0 in shape:
            raise InputError(f"vertices of shape {tuple(shape)}, expected (N, n)")
    except Exception as error:  # each reader raises its own
        raise InputError(
            f"{path}: not a mesh or cloud that can be read; {', '.join(SUFFIXES)} and FreeSurfer's surfaces can "
            f"({error})"
        ) from error
    return found


def _library(name: str) -> Any:
    """The module; InputError that says how to install it where it is missing."""
    try:
        return import_module(name)
    except ImportError as error:
        raise InputError(f"{name} is needed: pip install {name}, or torchlb[files]") from error


def _start(path: Path) -> bytes:
    with open(path, "rb") as file:
        return file.read(len(SURFACE))


def _vtk(path: Path) -> Contents:
    """A polydata or unstructured grid: its cells of the highest dimension, polygons and strips as triangles."""
    pyvista = _library("pyvista")
    with pyvista.VtkErrorCatcher(send_to_logging=False) as heard:
        mesh = pyvista.read(path)
    if heard.events:  # of a damaged file VTK makes up the rest
        raise InputError(f"VTK says: {heard.events[0]}")
    body = path.read_bytes().split(b"\n", 2)[-1].lstrip() if path.suffix == ".vtk" else b""
    if body[:5].upper() == b"ASCII":  # of points that are cut off it says nothing
        numbers = body.partition(b"POINTS")[2].split()[2:]
        if len(numbers) < 3 * mesh.n_points:
            raise InputError(f"{mesh.n_points} points, and {len(numbers)} numbers follow")
    if isinstance(mesh, pyvista.PolyData):
        mesh = mesh.triangulate(pass_lines=True)
    grid = mesh.cast_to_unstructured_grid()
    cells = {pyvista.CellType(kind).name: corners for kind, corners in grid.cells_dict.items()}
    other = ", ".join(cells.keys() - {*CELLS}).lower()
    if other:
        raise InputError(f"cells {other}; expected tetrahedra, triangles or lines")
    chosen = next((cells[kind] for kind in CELLS[:0:-1] if kind in cells), None)
    return mesh.points, chosen, dict(mesh.point_data)


def _gifti(path: Path) -> Contents:
    """A surface and maps of GIFTI; maps without a name are numbered."""
    data = {}
    for number, array in enumerate(_library("nibabel").load(path).darrays):
        role = {1008: "POINTSET", 1009: "TRIANGLE"}.get(array.intent)  # codes of NIfTI
        name = role or array.meta.get("Name") or f"data_{number}"
        data[f"{name}_{number}" if name in data else name] = array.data
    return data.pop("POINTSET", None), data.pop("TRIANGLE", None), data


def _freesurfer(path: Path) -> Contents:
    """A surface, or labels or maps under the last part of their name, as of lh.thickness and lh.thickness.mgz."""
    nibabel, suffix = _library("nibabel"), path.suffix.lower()
    if _start(path) == SURFACE:
        return *nibabel.freesurfer.read_geometry(path), {}
    if suffix in (".mgh", ".mgz"):
        values = np.asarray(nibabel.load(path).dataobj)
        if values.shape[1:3] != (1, 1):
            raise InputError(f"a volume of shape {values.shape}, not a map of points")
        return None, None, {path.stem.rpartition(".")[2]: values.squeeze((1, 2))}
    if suffix == ".annot":
        return None, None, {path.stem.rpartition(".")[2]: nibabel.freesurfer.read_annot(path)[0]}
    return None, None, {suffix[1:]: nibabel.freesurfer.read_morph_data(path)}


def _by_trimesh(path: Path) -> Contents:
    """What trimesh reads; the corners of an .stl become vertices."""
    import trimesh

    shape = trimesh.load(path, process=False, maintain_order=True, skip_materials=True)
    vertices, faces = arrays_of(shape)
    if path.suffix.lower() == ".stl" and faces is not None:
        vertices, faces = _sewn(vertices, faces)
    return vertices, faces, {}


def write_shape(
    path: str | Path, points: ArrayLike, cells: ArrayLike | None = None, **point_data: ArrayLike
) -> None:
    """Write a mesh or cloud, with data of its points, in the format that the ending of `path` names.

    .npz holds every shape; .vtk and .vtu, through pyvista, those of R² and R³; .gii, through nibabel, triangles, in
    single precision, and .func.gii and .shape.gii the data alone; .obj and .off triangles and points of R³ without
    data, as .ply and .glb do through trimesh in single precision, and .stl triangles. `points` are (N, n), `cells`
    (F, 3) triangles, (F, 2) segments, (F, 4) tetrahedra or None, `point_data` (N,) or (N, C), by name:
    ``write_shape("a.vtu", points, faces, thickness=f)``.

    Raises ValueError for data of another length, a format that does not hold them, and where its library is missing.
    """
    path, places = check_path(path), check_points(points).numpy()
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
        _write(path, places, corners, data)
    elif suffix in (".obj", ".off") and flat and not data:
        _write_text(path, places, corners)
    elif suffix in (".ply", ".glb", *([".stl"] if len(corners) else [])) and flat and not data:
        import trimesh

        mesh = trimesh.Trimesh(places, corners, process=False)
        _ = (mesh if len(corners) else trimesh.PointCloud(places)).export(path)
    else:
        what = ", ".join([f"cells {corners.shape} on points {places.shape}", *data])
        raise InputError(
            f"{path}: this format does not hold {what}; .npz holds all, .vtk and .vtu all in R² and R³, .gii triangles "
            "and data in R³, .ply, .obj, .off and .glb triangles and points of R³ without data, .stl triangles"
        )


def _write_text(path: Path, points: np.ndarray, cells: np.ndarray) -> None:
    """An .obj or .off, in all digits."""
    is_obj = path.suffix.lower() == ".obj"
    with open(path, "w", encoding="ascii") as file:
        if not is_obj:
            file.write(f"OFF\n{len(points)} {len(cells)} 0\n")
        np.savetxt(file, points, "v %.17g %.17g %.17g" if is_obj else "%.17g %.17g %.17g")
        np.savetxt(file, cells + is_obj, "f %d %d %d" if is_obj else "3 %d %d %d")


def _write(path: Path, points: np.ndarray, cells: np.ndarray, data: dict[str, np.ndarray]) -> None:
    """VTK's unstructured grid in three columns, or GIFTI, in float32 and int32 and by columns of the data."""
    if path.suffix.lower() != ".gii":
        pyvista, corners = _library("pyvista"), cells.shape[1] if len(cells) else 1
        cells = cells if len(cells) else np.arange(len(points))[:, None]
        points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        grid = pyvista.UnstructuredGrid({pyvista.CellType[CELLS[corners - 1]]: cells}, points)
        for name, values in data.items():
            grid.point_data[name] = values.astype(np.int32) if values.dtype == bool else values
        return grid.save(path)
    nibabel, arrays = _library("nibabel"), [("", "POINTSET", points), ("", "TRIANGLE", cells)]
    if path.name.lower().endswith((".func.gii", ".shape.gii")):
        arrays = []
    for name, values in data.items():
        for c, column in enumerate(values.reshape(len(values), -1).T):
            arrays.append((name if values.ndim == 1 else f"{name}_{c}", "NONE", column))
    image, array_of = nibabel.GiftiImage(), nibabel.gifti.GiftiDataArray
    for name, intent, values in arrays:
        values = values.astype(np.int32 if values.dtype.kind in "biu" else np.float32)
        array = array_of(values, f"NIFTI_INTENT_{intent}", meta={"Name": name})
        image.darrays += [array] if len(values) else []
    return nibabel.save(image, path)


def may_be_shape(path: Path) -> bool:
    """Whether a file is taken for a shape, by its ending; .txt and .csv by three numbers in their first row."""
    if path.suffix.lower() not in (".csv", ".txt"):
        return path.suffix.lower() in SUFFIXES or _start(path) == SURFACE
    try:
        return len(next(numbers_of(path), ([], []))[1]) > 2
    except InputError:
        return False


def _triangulated(path: Path) -> Contents:
    """Polygons split into triangles, in their order; those with fewer than three corners are left out."""
    vertices, corners, sizes = READERS[path.suffix.lower()](path)
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
        return places, None, {}
    order = torch.cat(owners).argsort(stable=True)
    return places, torch.cat([part.flatten(0, 1) for part in parts])[order], {}


def _sewn(vertices: Float[Tensor, "N 3"], faces: Int[Tensor, "F 3"]) -> tuple[Tensor, Tensor]:
    """Merge the corners of triangles that are equal, and that differ by rounding unless an edge is as short as that."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].view(-1, 2)
    reach = STEPS * torch.finfo(torch.float32).eps * float(vertices.abs().max())
    kept, number = torch.unique(merged(vertices, reach, edges), return_inverse=True)
    return vertices[kept], number[faces]


def _numpy(path: Path) -> Contents:
    if path.suffix.lower() == ".npy":
        return np.load(path, allow_pickle=False), None, {}
    with np.load(path, allow_pickle=False) as archive:
        arrays = dict(archive)
    shape = {name: arrays.pop(name) for name in OF_THE_SHAPE if name in arrays}
    faces = shape.pop("faces", np.zeros(0))
    return next(iter(shape.values()), None), faces if faces.size else None, arrays


KINDS: dict[str, Callable[[Path], Contents]] = {
    ".gii": _gifti,
    **dict.fromkeys(READERS, _triangulated),
    **dict.fromkeys((".npy", ".npz"), _numpy),
    **dict.fromkeys((".vtk", ".vtp", ".vtu"), _vtk),
    **dict.fromkeys((".glb", ".gltf", ".stl"), _by_trimesh),
}
SUFFIXES = tuple(sorted(KINDS))
"""Endings of the files that `read_shape` takes."""
