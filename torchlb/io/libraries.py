"""Files that other libraries read and write: GIFTI and FreeSurfer through nibabel, VTK through pyvista."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from torchlb.errors import InputError

Contents = tuple[Any, Any, dict[str, np.ndarray]]
"""Vertices and cells, or None, and the data of the points by name."""
SURFACE, MAP = b"\xff\xff\xfe", b"\xff\xff\xff"  # which FreeSurfer's files begin with
VTK, CELLS = (".vtk", ".vtp", ".vtu"), ("VERTEX", "LINE", "TRIANGLE", "TETRA")


def library(name: str) -> Any:
    """The module; InputError that says how to install it where it is missing."""
    try:
        return import_module(name)
    except ImportError as error:
        raise InputError(f"{name} is needed: pip install {name}, or torchlb[files]") from error


def begins(path: Path, start: bytes) -> bool:
    """Whether a file begins as FreeSurfer's do, whose ending may be any."""
    with open(path, "rb") as file:
        return file.read(3) == start


def read(path: Path) -> Contents | None:
    """What is in a file; None if neither library reads it."""
    suffix = path.suffix.lower()
    if suffix in VTK:
        return _read_vtk(path)
    name = path.stem if suffix in (".annot", ".mgh", ".mgz") else path.name
    name, data = name.rpartition(".")[2], {}
    if suffix == ".gii":
        for number, array in enumerate(library("nibabel").load(path).darrays):
            role = {1008: "POINTSET", 1009: "TRIANGLE"}.get(array.intent)  # codes of NIfTI
            name = role or array.meta.get("Name") or f"data_{number}"
            data[f"{name}_{number}" if name in data else name] = array.data
        return data.pop("POINTSET", None), data.pop("TRIANGLE", None), data
    if suffix in (".mgh", ".mgz"):
        values = np.asarray(library("nibabel").load(path).dataobj)
        if values.shape[1:3] != (1, 1):
            raise InputError(f"a volume of shape {values.shape}, not a map of points")
        return None, None, {name: values.squeeze((1, 2))}
    if suffix == ".annot":
        return None, None, {name: library("nibabel").freesurfer.read_annot(path)[0]}
    if begins(path, SURFACE):
        return *library("nibabel").freesurfer.read_geometry(path), data
    if begins(path, MAP):
        return None, None, {name: library("nibabel").freesurfer.read_morph_data(path)}
    return None


def _read_vtk(path: Path) -> Contents:
    """A polydata or unstructured grid: its cells of the highest dimension, polygons and strips as triangles."""
    pyvista = library("pyvista")
    with pyvista.VtkErrorCatcher(send_to_logging=False) as heard:
        mesh = pyvista.read(path)
    if heard.events:  # of a damaged file VTK makes up the rest
        raise InputError(f"VTK says: {heard.events[0]}")
    if isinstance(mesh, pyvista.PolyData):
        mesh = mesh.triangulate(pass_lines=True)
    grid = mesh.cast_to_unstructured_grid()
    cells = {pyvista.CellType(kind).name: corners for kind, corners in grid.cells_dict.items()}
    other = ", ".join(cells.keys() - {*CELLS}).lower()
    if other:
        raise InputError(f"cells {other}; expected tetrahedra, triangles or lines")
    chosen = next((cells[kind] for kind in CELLS[:0:-1] if kind in cells), None)
    return mesh.points, chosen, dict(mesh.point_data)


def write(path: Path, points: np.ndarray, cells: np.ndarray, data: dict[str, np.ndarray]) -> None:
    """VTK's unstructured grid in three columns, or GIFTI, in float32 and int32 and by columns of the data."""
    if path.suffix.lower() in VTK:
        pyvista, corners = library("pyvista"), cells.shape[1] if len(cells) else 1
        cells = cells if len(cells) else np.arange(len(points))[:, None]
        points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        grid = pyvista.UnstructuredGrid({pyvista.CellType[CELLS[corners - 1]]: cells}, points)
        for name, values in data.items():
            grid.point_data[name] = values.astype(np.int32) if values.dtype == bool else values
        return grid.save(path)
    nibabel, arrays = library("nibabel"), [("", "POINTSET", points), ("", "TRIANGLE", cells)]
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
