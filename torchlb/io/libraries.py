"""Files that other libraries read and write: GIFTI and FreeSurfer through nibabel, VTK through meshio."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchlb.errors import InputError
from torchlb.io.formats import concatenated, read_polydata, triangulated

Contents = tuple[Tensor | None, Tensor | None, dict[str, np.ndarray]]
SURFACE, MAP = b"\xff\xff\xfe", b"\xff\xff\xff"  # which FreeSurfer's files begin with
BY_MESHIO, BY_NIBABEL = (".vtk", ".vtu"), (".annot", ".gii", ".mgh", ".mgz")
SIMPLICES, FLAT = {2: "line", 3: "triangle", 4: "tetra"}, {"triangle", "quad", "polygon"}


def library(name: str) -> Any:
    """The module; InputError that says how to install it where it is missing."""
    try:
        return import_module(name)
    except ImportError as error:
        hint = f'pip install {name}, or torchlb with its extra "files"'
        raise InputError(f"{name} is needed for it: {hint}") from error


def begins(path: Path, *starts: bytes) -> bool:
    """Whether a file begins as FreeSurfer's do, whose ending may be any."""
    with open(path, "rb") as file:
        return file.read(3) in starts


def read(path: Path) -> Contents | None:
    """Vertices, cells and data of the points, if any; None for a file that neither library reads."""
    suffix, shape, data = path.suffix.lower(), [None, None], {}
    if suffix in BY_MESHIO:
        return _vtk(path, suffix)
    if suffix not in BY_NIBABEL and not begins(path, SURFACE, MAP):
        return None
    nibabel = library("nibabel")
    if suffix == ".gii":
        image = nibabel.load(path)
        found = [image.get_arrays_from_intent(name) for name in ("pointset", "triangle")]
        shape = [arrays[0].data if arrays else None for arrays in found]
        for number, array in enumerate(image.darrays):
            if not any(array is other for arrays in found for other in arrays):
                name = array.meta.get("Name") or f"data_{number}"
                data[f"{name}_{number}" if name in data else name] = array.data
    elif suffix in (".mgh", ".mgz"):
        data[path.stem] = np.asarray(nibabel.load(path).dataobj).squeeze()
    elif suffix == ".annot":
        data["annot"] = nibabel.freesurfer.read_annot(path)[0]
    elif begins(path, SURFACE):
        shape = nibabel.freesurfer.read_geometry(path)
    else:
        data[suffix[1:]] = nibabel.freesurfer.read_morph_data(path)
    points, cells = (None if x is None else torch.from_numpy(x.astype(float)) for x in shape)
    return points, None if cells is None else cells.long(), data


def _vtk(path: Path, suffix: str) -> Contents:
    """Tetrahedra, else polygons, else lines."""
    polydata = read_polydata(path) if suffix == ".vtk" else None
    if polydata is not None:
        return *triangulated(*polydata), {}
    mesh = getattr(library("meshio"), suffix[1:]).read(path)
    kinds = {block.type for block in mesh.cells} - {"vertex"}
    if not kinds <= {*SIMPLICES.values(), *FLAT}:
        raise InputError(f"cells {', '.join(sorted(kinds))}; expected tetrahedra, polygons, lines")
    chosen = {"tetra"} & kinds or FLAT & kinds or kinds
    rows = [row for block in mesh.cells if block.type in chosen for row in block.data]
    if chosen & FLAT:
        return *triangulated(mesh.points.astype(float), *concatenated(rows)), mesh.point_data
    cells = torch.from_numpy(np.array(rows, dtype=np.int64)) if rows else None
    return torch.from_numpy(mesh.points.astype(float)), cells, mesh.point_data


def write(path: Path, points: np.ndarray, cells: np.ndarray, data: dict[str, np.ndarray]) -> None:
    """VTK's unstructured grid in three columns, or GIFTI, in float32 and int32 and by columns of the data."""
    if path.suffix.lower() in BY_MESHIO:
        kind = SIMPLICES[cells.shape[1]] if len(cells) else "vertex"
        cells = cells if len(cells) else np.arange(len(points))[:, None]
        points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        plain = {k: v.astype(np.uint8) if v.dtype == bool else v for k, v in data.items()}
        library("meshio").write_points_cells(path, points, [(kind, cells)], point_data=plain)
        return
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
    nibabel.save(image, path)
