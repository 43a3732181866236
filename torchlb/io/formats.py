"""Readers of polygons in .obj, .off and .ply, points in .pcd, and tables of numbers.

Each reader returns the vertices, (N, 3) or (N, n), the concatenated corners of all polygons, and the number of corners
of each; a shape without polygons is a cloud.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from torchlb.errors import InputError

Polygons = tuple[Float[np.ndarray, "N n"], Int[np.ndarray, " C"], Int[np.ndarray, " P"]]
TYPES = {"char": "i1", "uchar": "u1", "int": "i4", "uint": "u4", "float": "f4"}
"""Types of .ply that NumPy names otherwise."""
Property = tuple[str, ...]
"""Name of a property of .ply, its type, and that of its length if it is a list."""


def _polygons(vertices: Any, faces: list[Any]) -> Polygons:
    """Vertices and polygons, from faces as lists of corners."""
    sizes, corners = np.fromiter(map(len, faces), int), np.fromiter(chain(*faces), int)
    return np.asarray(vertices, dtype=float), corners, sizes


def read_obj(path: Path) -> Polygons:
    """Vertices, which texture splits not, and faces of an .obj; indices below zero count back from the last vertex."""
    vertices, faces = [], []
    for line in path.read_text("utf-8", "replace").replace("\\\n", " ").splitlines():
        key, *words = line.split("#")[0].split() or [""]
        if key == "v":
            vertices.append([float(word) for word in words[:3]])
        elif key == "f":
            numbers = [int(word.partition("/")[0]) for word in words]
            if 0 in numbers:
                raise InputError(f"a corner 0 in {line!r}; they count from 1")
            faces.append([i - 1 if i > 0 else len(vertices) + i for i in numbers])
    return _polygons(vertices, faces)


def read_off(path: Path) -> Polygons:
    """Vertices and faces of an .off, also of COFF, NOFF and their like, whose further columns are left out."""
    lines = (line.partition("#")[0] for line in path.read_text("utf-8", "replace").splitlines())
    head, *rest = (line.strip() for line in lines if line.strip())
    found = re.match(r"(ST)?C?N?(OFF)?", head)
    counts, *rows = ([head[found.end() :]] if found and head[found.end() :] else []) + rest
    count, number = (int(word) for word in counts.split()[:2])
    if len(rows) < count + number:
        raise InputError(f"{count} vertices and {number} faces announced, {len(rows)} lines")
    vertices = [[float(word) for word in row.split()[:3]] for row in rows[:count]]
    faces = []
    for row in rows[count : count + number]:
        size, *corners = row.split()
        faces.append([int(corner) for corner in corners[: int(size)]])
    return _polygons(vertices, faces)


def read_ply(path: Path) -> Polygons:
    """Vertices, faces and triangle strips of a .ply, ascii or binary."""
    data = path.read_bytes()
    end = re.search(rb"end_header[ \t]*\r?\n", data)
    if end is None or not data.startswith(b"ply"):
        raise InputError("no header of a .ply")
    order, at = "", end.end()
    elements: list[tuple[str, int, list[Property]]] = []
    for line in data[: end.start()].decode("ascii", "replace").splitlines():
        match line.split():
            case ["format", kind, *_]:
                order = {"binary_little_endian": "<", "binary_big_endian": ">"}.get(kind, "")
            case ["element", name, count]:
                elements.append((name, int(count), []))
            case ["property", *kinds, name]:  # of a list: those of its length and of its numbers
                types = [TYPES.get(k, k) if order else "f8" for k in kinds if k != "list"]
                *size, kind = ((order or "<") + np.dtype(each).str[1:] for each in types)
                elements[-1][2].append((name, kind, *size))
    if not order:  # an ascii file is read as a binary one of doubles
        data, at = np.array(data[at:].split()).astype("<f8").tobytes(), 0
    vertices, faces = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for name, count, properties in elements:
        blocks, at = _blocks(data, at, count, properties)
        if name == "vertex":
            vertices = [np.hstack([block[axis] for axis in "xyz"]) for block in blocks]
        elif name in ("face", "tristrips"):
            lists = [title for title, _, *size in properties if size]
            title = next((n for n in lists if n.startswith("vertex_ind")), lists[0])
            rows = [block[title].astype(int) for block in blocks]
            if name == "tristrips":
                rows = [triangle[None] for strip in chain(*rows) for triangle in _strip(strip)]
            faces += rows
    sizes = np.concatenate([np.full(len(rows), rows.shape[1]) for rows in faces])
    corners = np.concatenate([rows.ravel() for rows in faces]).astype(int)
    return np.concatenate(vertices).astype(float), corners, sizes


def _blocks(
    data: bytes, at: int, count: int, properties: list[Property]
) -> tuple[list[np.ndarray], int]:
    """Rows of an element, in blocks within which lists are as long as in the first row, and where they end."""
    blocks, ahead = [], count
    while count:
        fields: list[tuple[str, str, tuple[int, ...]]] = []
        for name, kind, *size in properties:
            length = 1
            if size:
                length = int(np.frombuffer(data, size[0], 1, at + np.dtype(fields).itemsize)[0])
                fields.append((f"size of {name}", size[0], ()))
            fields.append((name, kind, (length,)))
        row = np.dtype(fields)
        rows = max(1, min(ahead, count, (len(data) - at) // row.itemsize))
        table = np.frombuffer(data, row, rows, at)
        lists = [name for name, _, *size in properties if size]
        alike = np.all([table[f"size of {name}"] == table[name].shape[1] for name in lists], axis=0)
        blocks.append(table if alike.all() else table[: alike.argmin()])
        ahead = 2 * len(blocks[-1])  # one row in a thousand of another length costs no more
        count, at = count - len(blocks[-1]), at + blocks[-1].nbytes
    return blocks, at


def _strip(corners: Int[np.ndarray, " C"]) -> Iterator[np.ndarray]:
    """Triangles of concatenated strips, separated by −1; every second one has the opposite orientation.

    >>> [triangle.tolist() for triangle in _strip(np.array([0, 1, 2, 3, -1, 4, 5, 6]))]
    [[0, 1, 2], [3, 2, 1], [4, 5, 6]]
    """
    for strip in np.split(corners, np.flatnonzero(corners == -1)):
        strip = strip[strip != -1]
        for i in range(len(strip) - 2):
            triangle = strip[i : i + 3]
            if len(set(triangle)) == 3:  # degenerate triangles only continue the strip
                yield triangle[::-1] if i % 2 else triangle


def read_pcd(path: Path) -> Polygons:
    """The points of a .pcd, ascii or binary, without those that are NaN."""
    parts = re.split(rb"^[ \t]*DATA[ \t]+(\w+)\s*?\n", path.read_bytes(), maxsplit=1, flags=re.M)
    if len(parts) == 1:
        raise InputError("it has no line DATA, after which points are expected")
    head, kind, data = parts
    lines = map(str.split, head.decode("ascii", "replace").splitlines())
    header = {key: words for key, *words in filter(None, lines)}
    if kind == b"ascii":
        data = np.array(data.split()).astype("<f8").tobytes()
    elif kind != b"binary":
        raise InputError(
            f"its data are {kind.decode()}; write them as binary or ascii, as pcl_convert_pcd_ascii_binary does"
        )
    names, repeats = header["FIELDS"], header.get("COUNT", ["1"] * len(header["SIZE"]))
    columns = zip(header["TYPE"], header["SIZE"], repeats, strict=True)
    types = [("<f8" if kind == b"ascii" else f"<{t.lower()}{n}", int(c)) for t, n, c in columns]
    row = np.dtype([(str(i), *field) for i, field in enumerate(types)])
    table: Any = np.frombuffer(data, row, int(header["POINTS"][0]))
    places = [table[str(names.index(axis))].reshape(len(table), -1)[:, 0] for axis in "xyz"]
    points = np.stack(places, 1).astype(float)
    return _polygons(points[~np.isnan(points).any(1)], [])


def read_table(path: Path) -> Polygons:
    """Points from the columns x, y and z of a table of numbers, or its first three (two, if it has no more).

    Columns are separated by commas, semicolons or blanks. Lines before the numbers, such as names of the columns or the
    number of points, and comments by # or // are left out. Units may follow the names, and empty cells are NaN.
    """
    lines = numbers_of(path)
    names, first = next(lines, ([], []))
    width = len(first)
    if width < 2:
        raise InputError("no rows of two or more numbers")
    chosen = [names.index(axis) for axis in "xyz" if axis in names]
    if len(chosen) < 2:
        chosen = list(range(min(3, width)))
    elif len(names) != width and chosen != list(range(len(chosen))):
        raise InputError(
            f"{len(names)} names of columns ({', '.join(names)}) and rows of {width} numbers"
        )
    rows = [first, *(row for _, row in lines)]
    if any(len(row) != width for row in rows):
        raise InputError(f"rows of {width} numbers and of others")
    return _polygons(np.array(rows)[:, chosen], [])


def numbers_of(path: Path) -> Iterator[tuple[list[str], list[float]]]:
    """Rows of a table, each with the lower-case words of the line before the first row."""
    names: list[str] = []
    begun = said = False
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for i, line in enumerate(file, 1):
            text, _, comment = line.replace("//", "#").partition("#")
            only = not (begun or text.strip())
            text = comment if only else text
            text = text.replace(",", ".") if ";" in text else text  # decimal commas
            cells = re.split("[,;]", text) if re.search("[,;]", text) else text.split()
            if not any(cell.strip() for cell in cells):
                continue
            words = [word for cell in cells for word in cell.split() or ["nan"]]
            try:
                row = [float(word) for word in words]
            except ValueError:
                if begun:
                    raise InputError(f"line {i}: {line.strip()[:60]!r} has no numbers") from None
                row = []
            if len(row) > 1 and not line.lstrip().startswith(("#", "//")):
                begun = True  # and a comment may have been prose
                yield names if said or len(names) == len(row) else [], row
            elif not begun:
                said = not only
                names = [(cell.strip(" \t\n\"'").split() or [""])[0].lower() for cell in cells]


READERS: dict[str, Callable[[Path], Polygons]] = {
    ".obj": read_obj,
    ".off": read_off,
    ".pcd": read_pcd,
    ".ply": read_ply,
    **dict.fromkeys((".asc", ".csv", ".pts", ".txt", ".xyz"), read_table),
}
"""Readers by file ending."""
