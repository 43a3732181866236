"""Files that other libraries read and write: GIFTI and FreeSurfer through nibabel, VTK through meshio."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchlb.errors import InputError

Contents = tuple[Tensor | None, Tensor | None, dict[str, np.ndarray]]
SURFACE, MAP = b"\xff\xff\xfe", b"\xff\xff\xff"  # which FreeSurfer's files begin with
BY_MESHIO, CELLS = (".vtk", ".vtu"), ("vertex", "line", "triangle", "tetra")


def library(name: str) -> Any:
    """The module; InputError that says how to install it where it is missing."""
    try:
        return import_module(name)
    except ImportError as error:
        raise InputError(f"{name} is needed: pip install {name}, or torchlb[files]") from error


def begins(path: Path, *starts: bytes) -> bool:
    """Whether a file begins as FreeSurfer's do, whose ending may be any."""
    with open(path, "rb") as file:
        return file.read(3) in starts


def read(path: Path) -> Contents | None:
    """Vertices, cells and data of the points, if any; None for a file that neither library reads."""
    suffix, data = path.suffix.lower(), {}
    if suffix in BY_MESHIO:
        mesh = getattr(library("meshio"), suffix[1:]).read(path)
        other = {block.type for block in mesh.cells} - {*CELLS}
        if other:
            raise InputError(f"cells {', '.join(other)}; expected tetrahedra, triangles or lines")
        every = ([b.data for b in mesh.cells if b.type == kind] for kind in CELLS[:0:-1])
        blocks, data = next(filter(None, every), None), mesh.point_data
        shape = mesh.points, None if blocks is None else np.concatenate(blocks)
    elif suffix == ".gii":
        for number, array in enumerate(library("nibabel").load(path).darrays):
            role = {1008: "POINTSET", 1009: "TRIANGLE"}.get(array.intent)  # codes of NIfTI
            name = role or array.meta.get("Name") or f"data_{number}"
            data[f"{name}_{number}" if name in data else name] = array.data
        shape = data.pop("POINTSET", None), data.pop("TRIANGLE", None)
    elif begins(path, SURFACE):
        shape = library("nibabel").freesurfer.read_geometry(path)
    elif begins(path, MAP):
        shape = None, None
        data[suffix[1:]] = library("nibabel").freesurfer.read_morph_data(path)
    else:
        return None
    points, cells = (None if x is None else torch.from_numpy(x.astype(float)) for x in shape)
    return points, None if cells is None else cells.long(), data


def write(path: Path, points: np.ndarray, cells: np.ndarray, data: dict[str, np.ndarray]) -> None:
    """VTK's unstructured grid in three columns, or GIFTI, in float32 and int32 and by columns of the data."""
    if path.suffix.lower() in BY_MESHIO:
        cells = cells if len(cells) else np.arange(len(points))[:, None]
        points = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        data = {k: v.astype(np.uint8) if v.dtype == bool else v for k, v in data.items()}
        blocks = [(CELLS[cells.shape[1] - 1], cells)]
        return library("meshio").write_points_cells(path, points, blocks, point_data=data)
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
