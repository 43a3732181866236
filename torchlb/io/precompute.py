"""The operators of a data set in one cache, in parallel; repeated calls complete it.

Stored operators are not computed again, so that the same call resumes a run that was killed; a shape that fails does
not stop the others. The workers are joblib's: the cores of this machine, or within ``joblib.parallel_config`` the
machines of a Dask or Ray cluster (`docs/precompute.md`).
"""

from __future__ import annotations

import csv
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from torchlb.errors import InputError
from torchlb.io.cache import load_or_build, operator_key, written_whole
from torchlb.io.files import SUFFIXES, may_be_shape, read_shape
from torchlb.linalg.threads import threads_for
from torchlb.operator.cleaning import cleaned
from torchlb.operator.dispatch import Operator, check_options_of

TABLE = "precompute.csv"
"""File in the cache that lists the result of every shape in the last run."""
STALE = 24 * 3600
"""Age, s, after which temporary files of killed writers are removed. Nobody writes one file for a day."""


@dataclass(frozen=True)
class ShapeResult:
    """Result of one shape.

    Attributes
    ----------
    name
        File, relative to the folder, or "shape 7" for arrays.
    status
        "built", "cached" (stored before) or "failed".
    points
        Number of points; 0 if failed.
    seconds
        Time taken.
    file
        File of its operator, for `load_operator`; empty if failed.
    message
        Reason of the failure, or the warnings.
    """

    name: str
    status: str
    points: int
    seconds: float
    file: str
    message: str


@dataclass(frozen=True)
class PrecomputeReport:
    """Results of all shapes, in their order. `print` it for the counts and a table of failures.

    Attributes
    ----------
    results
        A `ShapeResult` for each shape.
    skipped
        Files of the folder that are no shapes, by their endings or, of .txt and .csv, by their first lines.
    """

    results: tuple[ShapeResult, ...]
    skipped: tuple[str, ...] = ()

    @property
    def failed(self) -> tuple[ShapeResult, ...]:
        """Results of the shapes that failed."""
        return tuple(result for result in self.results if result.status == "failed")

    @property
    def files(self) -> dict[str, Path]:
        """File of each shape's operator by its name, without failed shapes."""
        return {result.name: Path(result.file) for result in self.results if result.file}

    def __str__(self) -> str:
        """Counts, then a line for each shape that failed or had warnings."""
        counts = Counter(result.status for result in self.results)
        parts = [f"{counts[status]} {status}" for status in ("built", "cached", "failed")]
        lines = [", ".join([f"{len(self.results)} shapes", *parts])]
        for title, chosen in (
            ("failed", self.failed),
            ("warned", [r for r in self.results if r.message and r.status != "failed"]),
        ):
            width = max((len(result.name) for result in chosen), default=0)
            lines += [title] if chosen else []
            lines += [f"  {r.name:<{width}}  {' '.join(r.message.split())}" for r in chosen]
        if self.skipped:
            endings = Counter(Path(name).suffix or name for name in self.skipped)
            kinds = ", ".join(f"{number} {ending}" for ending, number in sorted(endings.items()))
            lines.append(f"skipped, as no meshes or tables of points: {kinds}")
        return "\n".join(lines)


def precompute_operators(
    shapes: str | Path | Iterable[Any],
    out: str | Path,
    *,
    operator: Operator = "stencil",
    k: int = 0,
    workers: int = -1,
    clean: bool = False,
    progress: bool = True,
    **options: Any,
) -> PrecomputeReport:
    """Build and store the operators of a data set; a training script then loads each by `load_or_build`.

    Parameters
    ----------
    shapes
        A folder, searched recursively for files that `torchlb.read_shape` takes, of .txt and .csv those whose rows have
        three numbers or more; or a list of files or of (vertices, faces) pairs, faces None for a cloud.
    out
        Folder of the cache. ``load_or_build(vertices, faces, cache=out, …)`` with the same options finds the entries.
    operator, k
        As for `load_or_build`.
    workers
        Processes, each with one thread; −1 for one per core. Within ``joblib.parallel_config(backend="dask")`` the
        workers are those of the Dask client.
    clean
        Whether to apply `clean_mesh` to meshes, and `clean_points` to clouds; the data set then has to do the same.
    progress
        Whether to show a bar, on a terminal.
    **options
        Options of `LaplaceBeltrami.from_mesh` or `from_points`.

    Returns the result of each shape; also in `out`/precompute.csv. Exceptions of shapes are caught. Raises ValueError
    or TypeError for unknown options, a folder that is missing or has no shapes, before any work.
    """
    check_options_of(operator, options)
    cache = Path(out).expanduser()
    sources, skipped = _sources(shapes, cache)
    settings: dict[str, Any] = {"operator": operator, "k": k, "options": options}
    work = partial(_solve, cache=str(cache.resolve()), clean=clean, **settings)
    cache.mkdir(parents=True, exist_ok=True)
    _remove_stale(cache)
    results: dict[int, ShapeResult] = {}
    try:
        with tqdm(total=len(sources), unit="shape", disable=None if progress else True) as bar:
            for index, result in _run(work, sources, workers):
                results[index] = result
                bar.set_postfix(failed=sum(r.status == "failed" for r in results.values()))
                bar.update()
    finally:
        report = PrecomputeReport(tuple(results[i] for i in sorted(results)), skipped)
        with written_whole(cache / TABLE, "x", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, [field.name for field in fields(ShapeResult)])
            writer.writeheader()
            writer.writerows(asdict(result) for result in report.results)
    return report


def _sources(
    shapes: str | Path | Iterable[Any], cache: Path
) -> tuple[list[tuple[str, Any]], tuple[str, ...]]:
    """Name and file, or arrays, of every shape, and the names of other files in the folder."""
    if isinstance(shapes, str | Path):
        folder = Path(shapes).expanduser()
        if not folder.is_dir():
            raise InputError(
                f"{folder}: no such folder; give a folder, or a list of files or of arrays"
            )
        files = [
            (str(path.relative_to(folder)), path.resolve())
            for path in sorted(folder.rglob("*"))
            if path.is_file()
            and not path.name.startswith(".")
            and cache.resolve() not in path.resolve().parents
        ]
        found = [file for file in files if may_be_shape(file[1])]
        if not found:
            raise InputError(f"{folder}: no shapes in it; they end in {', '.join(SUFFIXES)}")
        return found, tuple(name for name, path in files if (name, path) not in found)
    named = []
    for i, shape in enumerate(shapes):
        if isinstance(shape, str | Path):
            named.append((str(shape), Path(shape).expanduser().resolve()))
        elif isinstance(shape, tuple | list) and len(shape) == 2:
            named.append((f"shape {i}", tuple(shape)))
        else:
            raise InputError(f"shape {i}: expected a file or (vertices, faces), got {type(shape)}")
    if not named:
        raise InputError("shapes: got none")
    return named, ()


def _run(
    work: Callable[..., Any], sources: Sequence[tuple[str, Any]], workers: int
) -> Iterator[tuple[int, ShapeResult]]:
    """Yield results as they come. Where a worker dies, the tasks that may have killed it run again, each by itself."""
    import joblib

    pending = dict(enumerate(sources))
    while pending:
        try:
            for index, result in _parallel(work, workers, pending):
                del pending[index]
                yield index, result
        except Exception:  # the worker catches errors of a shape: here the worker itself died
            number = joblib.effective_n_jobs(workers)
            for index in list(pending)[: 2 * number]:
                task = {index: pending.pop(index)}
                try:
                    [(_, result)] = _parallel(work, max(2, number), task)
                except Exception as error:
                    reason = f"its process died: {type(error).__name__}: {error}".partition("\n")[0]
                    result = ShapeResult(task[index][0], "failed", 0, 0.0, "", reason)
                yield index, result


def _parallel(
    work: Callable[..., Any], workers: int, tasks: dict[int, tuple[str, Any]]
) -> Iterable[tuple[int, ShapeResult]]:
    import joblib

    backend, _ = joblib.parallel.get_active_backend()
    lazy = getattr(backend, "supports_return_generator", False)
    way = "generator_unordered" if lazy else "list"
    settings: dict[str, Any] = {"n_jobs": workers, "batch_size": 1, "return_as": way}
    parallel: Any = joblib.Parallel(**settings)
    return parallel([joblib.delayed(work)(index, *task) for index, task in tasks.items()])


def _solve(
    index: int, name: str, source: Any, *, clean: bool, **settings: Any
) -> tuple[int, ShapeResult]:
    """Compute one shape on one thread; any exception becomes its result."""
    start = time.perf_counter()
    try:
        with threads_for(0), warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", UserWarning)
            vertices, faces = read_shape(source) if isinstance(source, Path) else source
            if clean:
                vertices, faces = cleaned(vertices, faces)
            status, points, file = _stored(vertices, faces, **settings)
        notes = {str(w.message) for w in caught if concerns_the_shape(w.message)}
        message = "; ".join(sorted(notes))
    except Exception as error:
        status, points, file, message = "failed", 0, "", f"{type(error).__name__}: {error}"
    seconds = time.perf_counter() - start
    return index, ShapeResult(name, status, points, seconds, file, message)


def concerns_the_shape(warning: Warning | str) -> bool:
    """Whether a warning concerns the shape; torch's about its own sparse tensors does not."""
    return isinstance(warning, UserWarning) and not str(warning).startswith("Sparse ")


def _stored(
    vertices: Any, faces: Any, cache: str, operator: Operator, k: int, options: dict[str, Any]
) -> tuple[str, int, str]:
    """Store the operator of one shape; return its status, number of points and file."""
    path = Path(cache) / f"{operator_key(vertices, faces, operator=operator, **options)}.npz"
    before = _identity(path)
    settings: dict[str, Any] = {"cache": cache, "operator": operator, "k": k, **options}
    lb = load_or_build(vertices, faces, progress=False, **settings)
    after = _identity(path)
    if after is None:
        raise OSError("its operator was built and could not be written")
    return "cached" if after == before else "built", lb.num_points, str(path)


def _identity(path: Path) -> tuple[int, int] | None:
    """Inode and time of a file, which change when it is replaced; None without a file."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return None
    return found.st_ino, found.st_mtime_ns


def _remove_stale(cache: Path) -> None:
    """Remove old temporary files of writers that were killed."""
    for path in cache.glob(".*.tmp"):
        try:
            if time.time() - path.stat().st_mtime > STALE:
                path.unlink()
        except FileNotFoundError:
            continue  # another run was faster
