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
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from torchlb.errors import InputError, TorchlbWarning
from torchlb.io.cache import load_or_build, operator_key, written_whole
from torchlb.io.files import SUFFIXES, may_be_shape, read_shape
from torchlb.linalg.threads import threads_for
from torchlb.operator.cleaning import cleaned
from torchlb.operator.dispatch import Operator, check_options_of
from torchlb.operator.inputs import check_path

STALE = 24 * 3600
"""Age, s, after which temporary files of killed writers are removed. Nobody writes one file for a day."""


class ShapeResult(NamedTuple):
    """Result of one shape.

    Attributes
    ----------
    name, status
        File, relative to the folder, or "shape 7" for arrays; "built", "cached" (stored before) or "failed".
    points, seconds
        Number of points, 0 if failed; time taken.
    file, message
        File of its operator, for `load_operator`, empty if failed; reason of the failure, or the warnings.
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
    results, skipped
        A `ShapeResult` for each shape; files of the folder that are no shapes, by their endings or, of .txt and .csv,
        by their first lines.
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
        warned = [r for r in self.results if r.message and r.status != "failed"]
        for title, chosen in (("failed", self.failed), ("warned", warned)):
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
    progress, **options
        Whether to show a bar, on a terminal; options of `LaplaceBeltrami.from_mesh` or `from_points`.

    Returns the result of each shape; also in `out`/precompute.csv. Exceptions of shapes are caught. Raises ValueError
    or TypeError for unknown options, a folder that is missing or has no shapes, before any work.
    """
    check_options_of(operator, options)
    cache = check_path(out, "out")
    sources, skipped = _sources(shapes, cache)
    settings: dict[str, Any] = {"operator": operator, "k": k, **options}
    work = partial(_solve, clean=clean, cache=str(cache.resolve()), settings=settings)
    cache.mkdir(parents=True, exist_ok=True)
    for path in cache.glob(".*.tmp"):  # of writers that were killed; another run may be faster
        with suppress(FileNotFoundError):
            if time.time() - path.stat().st_mtime > STALE:
                path.unlink()
    results: dict[int, ShapeResult] = {}
    try:
        with tqdm(total=len(sources), unit="shape", disable=None if progress else True) as bar:
            for index, result in _run(work, sources, workers):
                results[index] = result
                bar.set_postfix(failed=sum(r.status == "failed" for r in results.values()))
                bar.update()
    finally:
        report = PrecomputeReport(tuple(results[i] for i in sorted(results)), skipped)
        with written_whole(cache / "precompute.csv", "x", encoding="utf-8", newline="") as file:
            csv.writer(file).writerows([ShapeResult._fields, *report.results])
    return report


def _sources(
    shapes: str | Path | Iterable[Any], cache: Path
) -> tuple[list[tuple[str, Any]], tuple[str, ...]]:
    """Name and file, or arrays, of every shape, and the names of other files in the folder."""
    if not isinstance(shapes, str | Path):
        named: list[tuple[str, Any]] = []
        for i, shape in enumerate(shapes):
            if isinstance(shape, str | Path):
                named.append((str(shape), Path(shape).expanduser().resolve()))
            elif isinstance(shape, tuple | list) and len(shape) == 2:
                named.append((f"shape {i}", tuple(shape)))
            else:
                got = type(shape)
                raise InputError(f"shape {i}: expected a file or (vertices, faces), got {got}")
        if not named:
            raise InputError("shapes: got none")
        return named, ()
    folder, skipped, found = Path(shapes).expanduser(), [], []
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a folder, or a list of files or arrays")
    for path in sorted(folder.rglob("*")):
        name, place = str(path.relative_to(folder)), path.resolve()
        if path.is_file() and path.name[0] != "." and cache.resolve() not in place.parents:
            if may_be_shape(place):
                found.append((name, place))
            else:
                skipped.append(name)
    if not found:
        raise InputError(f"{folder}: no shapes in it; they end in {', '.join(SUFFIXES)}")
    return found, tuple(skipped)


def _run(
    work: Callable[..., Any], sources: Sequence[tuple[str, Any]], workers: int
) -> Iterator[tuple[int, ShapeResult]]:
    """Yield results as they come. Where a worker dies, the tasks that may have killed it run again, each by itself."""
    import joblib

    lazy = getattr(joblib.parallel.get_active_backend()[0], "supports_return_generator", False)
    way = "generator_unordered" if lazy else "list"
    settings: dict[str, Any] = {"batch_size": 1, "return_as": way}

    def results(indices: Iterable[int], workers: int) -> Any:
        parallel: Any = joblib.Parallel(n_jobs=workers, **settings)
        return parallel([joblib.delayed(work)(i, *sources[i]) for i in indices])

    pending = dict.fromkeys(range(len(sources)))
    while pending:
        try:
            for index, result in results(pending, workers):
                del pending[index]
                yield index, result
        except Exception:  # the worker catches errors of a shape: here the worker itself died
            number = joblib.effective_n_jobs(workers)
            for index in list(pending)[: 2 * number]:
                del pending[index]
                try:
                    [(_, result)] = results([index], max(2, number))
                except Exception as error:
                    reason = f"its process died: {type(error).__name__}: {error}".partition("\n")[0]
                    result = ShapeResult(sources[index][0], "failed", 0, 0.0, "", reason)
                yield index, result


def _solve(
    index: int, name: str, source: Any, *, clean: bool, cache: str, settings: dict[str, Any]
) -> tuple[int, ShapeResult]:
    """Compute and store the operator of one shape on one thread; any exception becomes its result."""
    start = time.perf_counter()
    try:
        with threads_for(0), warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", TorchlbWarning)
            vertices, faces = read_shape(source) if isinstance(source, Path) else source
            if clean:
                vertices, faces = cleaned(vertices, faces)
            options = {name: value for name, value in settings.items() if name != "k"}
            path = Path(cache) / f"{operator_key(vertices, faces, **options)}.npz"
            before = path.stat().st_mtime_ns if path.exists() else None
            lb = load_or_build(vertices, faces, cache=cache, progress=False, **settings)
            if not path.exists():
                raise OSError("its operator was built and could not be written")
        status = "cached" if path.stat().st_mtime_ns == before else "built"
        notes = {str(w.message) for w in caught if issubclass(w.category, TorchlbWarning)}
        points, file, message = lb.num_points, str(path), "; ".join(sorted(notes))
    except Exception as error:
        status, points, file, message = "failed", 0, "", f"{type(error).__name__}: {error}"
    return index, ShapeResult(name, status, points, time.perf_counter() - start, file, message)
