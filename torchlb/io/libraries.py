"""Files that other libraries read and write: GIFTI and FreeSurfer through nibabel, VTK through meshio.

Readers return the vertices or None, cells or None, and the data of the points by name.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from torchlb.errors import InputError
from torchlb.io.formats import concatenated, read_polydata

Contents = tuple[np.ndarray | None, Any, dict[str, np.ndarray]]
SURFACE, MAP = b"\xff\xff\xfe", b"\xff\xff\xff"  # which FreeSurfer's files begin with
BY_MESHIO, BY_NIBABEL = (".vtk", ".vtu"), (".annot", ".gii", ".mgh", ".mgz")
SIMPLICES = {2: "line", 3: "triangle", 4: "tetra"}
FLAT = ("triangle", "quad", "polygon")


def library(name: str) -> Any:
    """The module; InputError that says how to install it where it is missing."""
    try:
        return import_module(name)
    except ImportError as error:
        raise InputError(
            f'{name} is needed for it: pip install {name}, or torchlb with its extra "files"'
        ) from error


def start_of(path: Path) -> bytes:
    """The first bytes of a file, as SURFACE or MAP in FreeSurfer's, whose ending may be any."""
    with open(path, "rb") as file:
        return file.read(len(SURFACE))


def read_nibabel(path: Path) -> Contents:
    """GIFTI, and FreeSurfer's surfaces, maps and labels."""
    nibabel, suffix = library("nibabel"), path.suffix.lower()
    if suffix in (".mgh", ".mgz"):
        return None, None, {path.stem: np.asarray(nibabel.load(path).dataobj).squeeze()}
    if suffix == ".annot":
        return None, None, {"annot": nibabel.freesurfer.read_annot(path)[0]}
    if suffix != ".gii" and start_of(path) == SURFACE:
        return *nibabel.freesurfer.read_geometry(path), {}
    if suffix != ".gii":
        return None, None, {suffix[1:]: nibabel.freesurfer.read_morph_data(path)}
    shape, data = {}, {}
    for number, array in enumerate(nibabel.load(path).darrays):
        intent = nibabel.nifti1.intent_codes.label[array.intent]
        name = array.meta.get("Name") or f"data_{number}"
        into = shape if intent in ("pointset", "triangle") else data
        name = intent if into is shape else f"{name}_{number}" if name in data else name
        into[name] = array.data
    return shape.get("pointset"), shape.get("triangle"), data


def read_meshio(path: Path) -> Contents:
    """VTK's cells of the highest dimension; polygons as their corners and the numbers of them."""
    suffix = path.suffix.lower()
    polydata = read_polydata(path) if suffix == ".vtk" else None
    if polydata is not None:
        return polydata[0], polydata[1:], {}
    meshio = library("meshio")
    mesh = (meshio.vtk if suffix == ".vtk" else meshio.vtu).read(path)
    kinds = {block.type for block in mesh.cells} - {"vertex"}
    other = kinds - {*SIMPLICES.values(), *FLAT}
    if other:
        raise InputError(
            f"cells {', '.join(sorted(other))}; expected tetrahedra, polygons or lines"
        )
    chosen = "tetra" if "tetra" in kinds else FLAT if kinds & {*FLAT} else "line"
    rows = [row for block in mesh.cells if block.type in chosen for row in block.data]
    cells = concatenated(rows) if chosen is FLAT else np.array(rows) if rows else None
    return mesh.points, cells, mesh.point_data


def write_meshio(path: Path, points: np.ndarray, cells: np.ndarray, data: dict[str, Any]) -> None:
    """An unstructured grid of VTK, in the 3 columns that it has."""
    kind = SIMPLICES[cells.shape[1]] if len(cells) else "vertex"
    cells = cells if len(cells) else np.arange(len(points))[:, None]
    points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
    plain = {k: v.astype(np.uint8) if v.dtype == bool else v for k, v in data.items()}
    library("meshio").write_points_cells(path, points, [(kind, cells)], point_data=plain)


def write_nibabel(path: Path, points: np.ndarray, cells: np.ndarray, data: dict[str, Any]) -> None:
    """GIFTI, in float32 and int32: columns of data apart, and no surface in .func.gii and .shape.gii."""
    nibabel, arrays = library("nibabel"), [(points, "POINTSET", ""), (cells, "TRIANGLE", "")]
    if path.name.lower().endswith((".func.gii", ".shape.gii")):
        arrays = []
    for name, values in data.items():
        columns = [(name, values)] if values.ndim == 1 else enumerate(values.T)
        arrays += [(f, "NONE", n if n == name else f"{name}_{n}") for n, f in columns]
    made = [
        nibabel.gifti.GiftiDataArray(
            values.astype(np.int32 if values.dtype.kind in "biu" else np.float32),
            f"NIFTI_INTENT_{intent}",
            meta={"Name": name} if name else None,
        )
        for values, intent, name in arrays
        if len(values)
    ]
    nibabel.save(nibabel.GiftiImage(darrays=made), path)
