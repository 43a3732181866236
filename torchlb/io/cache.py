"""Operators on disk: one file each, named by a hash of its input.

The file is a NumPy archive (.npz) of the `state_dict`, opened with ``allow_pickle=False``: no code is ever run from it,
only NumPy is needed to look inside, and the archive's checksums detect a single flipped bit, which neither safetensors
nor `torch.load` do. It is written under a temporary name and renamed, so that a file is complete or absent, even if
several processes write it.
"""

from __future__ import annotations

import hashlib
import json
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from torch import Tensor

from torchlb.errors import CacheWarning, InputError, OperatorFileError, warn
from torchlb.linalg.checks import check_operator
from torchlb.operator.dispatch import Operator, build_operator, builder_of, complete_options
from torchlb.operator.inputs import ArrayLike, as_tensor, check_path, float_type, warn_of_gradients
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.stencils.conditions import Condition
from torchlb.version import __version__

FORMAT = 4
"""Version of the file format; it changes when other versions of torchlb could not read the file."""


def load_or_build(
    vertices: ArrayLike,
    faces: ArrayLike | None = None,
    *,
    cache: str | Path,
    operator: Operator = "stencil",
    k: int = 0,
    overwrite: bool = False,
    progress: bool = True,
    **options: Any,
) -> LaplaceBeltrami:
    """Load the operator of a mesh or cloud from the folder `cache`, or build and store it there.

    The stored operator is float64 whatever the input's type, under a hash of its input (`operator_key`): positions,
    faces, every option, and the version of torchlb. Float32 positions and their float64 copy, int32 and int64 faces,
    arrays and tensors share an entry. Any number of processes may use one folder at the same time.

    Parameters
    ----------
    vertices, faces
        (N, n) tensor or array, ℓ, and (F, 3) indices; None or empty for a point cloud.
    cache
        Folder; made if missing, "~" is the home directory.
    operator, k
        "stencil" (`from_mesh` or `from_points`) or "cotangent" (`from_cotangent`), and the number of eigenpairs to have
        in the file. A file with fewer is completed; one with more serves.
    overwrite, progress, **options
        Whether to build the operator even if it is stored; arguments of the builder, such as ``order=5``.

    Returns what the builder returns, in the floating type of `vertices`, on the CPU, and raises what it raises; an
    InputError if `cache` is a file, an OSError if the folder cannot be read. A `CacheWarning` reports a file that is
    damaged or of another version, which is replaced, and a folder that cannot be written.

    >>> import tempfile
    >>> from torchlb.surfaces import Sphere
    >>> vertices, faces = Sphere().mesh(100)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     first = load_or_build(vertices, faces, cache=folder, order=2)
    ...     again = load_or_build(vertices, faces, cache=folder, order=2)  # from the file
    >>> torch.equal(first.stencil.values, again.stencil.values)
    True
    """
    warn_of_gradients(vertices, "vertices")
    _, points, corners = builder_of(vertices, faces, operator)
    key = operator_key(points, corners, operator=operator, **options)
    path = check_path(cache, "cache") / f"{key}.npz"
    if path.parent.exists() and not path.parent.is_dir():
        raise InputError(f"cache: expected a folder, {path.parent} is a file")
    lb = None if overwrite else _cached(path, key)
    if lb is None or not lb.modes.has(k):
        if lb is None:
            lb = build_operator(points, corners, operator=operator, progress=progress, **options)
        if k > 0:
            lb.eigenbasis(k, store=True)
        try:
            save_operator(lb, path, key=key)
        except OSError as error:  # the result must not be lost
            warn(f"{path}: not written ({error}), so the next call computes it again", CacheWarning)
    return lb.to(float_type(vertices))


def operator_key(
    vertices: ArrayLike,
    faces: ArrayLike | None = None,
    *,
    operator: Operator = "stencil",
    **options: Any,
) -> str:
    """Name of an operator in a cache: SHA-256 of positions, faces, options and version, 64 hexadecimal digits.

    Parameters are those of `load_or_build`; defaults and the same values spelt out give the same key, as do integers
    and floats of any width. Faces that repeat a corner, which no operator uses, do not count.

    Examples
    --------
    >>> operator_key(torch.eye(3), order=3) == operator_key(np.eye(3), weights="least_squares")
    True
    """
    builder, points, corners = builder_of(vertices, faces, operator)
    values = {"points": points, "faces": corners, "operator": operator, "version": __version__}
    digest = hashlib.sha256()
    for name, value in sorted((values | complete_options(builder, options)).items()):
        value = value.plain if isinstance(value, Condition) else value
        if isinstance(value, Tensor | np.ndarray | list | tuple):
            array = as_tensor(value).detach().cpu()
            kind = "<f8" if array.is_floating_point() else "<i8"
            data = array.numpy().astype(kind, order="C") + 0  # −0.0 becomes 0.0
            digest.update(f"{name} {kind} {data.shape}\n".encode() + data.tobytes())
        else:
            value = value.item() if isinstance(value, np.generic) else value
            digest.update(f"{name} {json.dumps(value, sort_keys=True)}\n".encode())
    return digest.hexdigest()


def _cached(path: Path, key: str) -> LaplaceBeltrami | None:
    """The operator in a file; None without a file, or with a warning for a damaged one."""
    try:
        lb, header = load_with_header(path)
        if header["key"] != key:
            raise OperatorFileError(f"{path}: holds another operator than its name says")
        return lb
    except FileNotFoundError:
        return None
    except OperatorFileError as error:
        warn(f"{error}. It is computed again and replaced", CacheWarning)
        return None


def save_operator(lb: LaplaceBeltrami, path: str | Path, *, key: str = "") -> None:
    """Write an operator to one file, with its certificate, its report, and the eigenbasis if it is in `state_dict`.

    Parameters
    ----------
    lb, key
        Any operator, also a batch, and its `operator_key`, for a file of a cache.
    path
        Path of the file, best with the ending .npz. Its folder is made if missing; an existing file is replaced as a
        whole, even if the program is killed or several write it.

    Raises OSError where the file cannot be written; no part of it remains.
    """
    check_operator(lb)
    path = check_path(path)
    state = lb.state_dict()
    header = {"format": FORMAT, "version": __version__, "key": key}
    header |= {"state": state.pop("_extra_state")}
    header["types"] = {name: str(x.dtype).removeprefix("torch.") for name, x in state.items()}
    arrays: dict[str, Any] = {n: _compact(x.detach().cpu()).numpy() for n, x in state.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(path, "xb") as file:
        np.savez(file, **arrays, header=np.array(json.dumps(header)))


@contextmanager
def written_whole(path: Path, mode: str, **options: Any) -> Iterator[IO[Any]]:
    """A temporary file that is renamed to `path` once all data are on disk, and removed on failure."""
    # Not tempfile: its files are readable by their owner alone, and a cache is shared.
    beside = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        with open(beside, mode, **options) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def _compact(tensor: Tensor) -> Tensor:
    """Indices as int32 where they fit, and half-precision types, which NumPy lacks in part, as float32."""
    if tensor.dtype == torch.int64 and (len(tensor) == 0 or int(tensor.max()) < 2**31):
        return tensor.to(torch.int32)
    return tensor.float() if tensor.dtype in (torch.bfloat16, torch.float16) else tensor


def load_operator(path: str | Path) -> LaplaceBeltrami:
    """Read the operator in the file `path`, by `save_operator` or of a cache, bit for bit, on the CPU.

    Raises FileNotFoundError if there is no such file, and OperatorFileError if it is something else, damaged, or of a
    version with another format.
    """
    return load_with_header(path)[0]


def load_with_header(path: str | Path) -> tuple[LaplaceBeltrami, dict[str, Any]]:
    """As `load_operator`, with the header: version, key, …; read in full, so that every checksum is verified."""
    path = check_path(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            header = json.loads(str(archive["header"]))
            if header["format"] != FORMAT:
                raise OperatorFileError(
                    f"{path}: written by torchlb {header['version']} in format {header['format']}, and torchlb "
                    f"{__version__} reads format {FORMAT}; build the operator again"
                )
            types = header["types"]
            if types.keys() != set(archive.files) - {"header"}:
                raise InputError("its parts are not those that it lists")
            state: dict[str, Any] = {
                name: torch.from_numpy(archive[name]).to(getattr(torch, types[name]))
                for name in types
            }
        lb = LaplaceBeltrami()
        lb.load_state_dict(state | {"_extra_state": header["state"]})
    except (FileNotFoundError, PermissionError, IsADirectoryError, OperatorFileError):
        raise
    except Exception as error:  # a damaged archive fails in a dozen ways
        raise OperatorFileError(
            f"{path}: not an operator of torchlb, or damaged ({type(error).__name__}: {error})"
        ) from error
    return lb, header
