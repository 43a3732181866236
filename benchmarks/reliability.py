"""How often an operator can be relied on: python benchmarks/reliability.py [FOLDER] [--quick] [--alone].

Without a folder, some 380 meshes and 160 clouds: shapes of known eigenvalues, damaged as files are (`_damages.py`), and
surfaces that installed packages ship. With one, every mesh below it. A shape is *passed* by an operator that
- is built, and hands out a stiffness matrix K and a mass matrix M without NaN;
- has them symmetric, K1 = 0, K ≥ 0, M > 0: by the pivots of a factorisation of both, scaled to a diagonal of ones;
- has 20 eigenpairs, whose eigenvalues are those of ARPACK for the same matrices to 1e-3 of the last one;
- has eigenvalues that lie in the range of those of the whole shape and those of the damaged one, within 5 % and, where
  they are zero, within 1e-5 of the last. Those of the whole are exact or of a mesh of 12,000 vertices. Those of the
  damaged are of its mesh (of a cloud, triangles through its points) as a polyhedron, by linear elements on intrinsic
  Delaunay triangles, robust_laplacian's, of the mesh itself and of its refinement. So an operator may mend a damage or
  represent it, but not do worse. Pieces that a damage cuts off add zeros to those of the whole;
- ends within a minute.
An error of the library's own kind (any ValueError, of peers) is a refusal, which is no pass but is no wrong answer. Any
other exception, crash or time-out is a failure. A wrong answer is told after a warning, and silent without one.

Peers have their eigenpairs by ARPACK with shift and invert, torchlb by `lb.eigenbasis`. `--quick` takes a part of the
shapes, and torchlb alone. The score is printed last, and the exit code is 0 where it holds: of the meshes 99 % passed
and none silently wrong, of the clouds 95 % passed.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
import torch
from _common import installed, versions
from _damages import Case, clouds, meshes
from _shapes import PAIRS, components, eigenvalues, lowest
from scipy import sparse
from scipy.sparse.linalg import splu
from tqdm import tqdm

from torchlb import LaplaceBeltrami, read_shape
from torchlb.errors import TorchlbError

TIMEOUT = 60.0
NEAR, NONE = 0.05, 1e-5
SUFFIXES = (".obj", ".off", ".ply", ".stl")
Pencil = tuple[sparse.csc_array, sparse.csc_array]
Solved = tuple[sparse.csc_array, sparse.csc_array, np.ndarray, np.ndarray]  # K, M, values, vectors


class Verdict(NamedTuple):
    """What came of a case: passed, told, silent, refused or failed; why; the seconds."""

    word: str
    reason: str
    seconds: float


# Operators


def torchlb_pair(points: np.ndarray, faces: np.ndarray | None) -> Solved:
    if faces is None:
        lb = LaplaceBeltrami.from_points(points, progress=False)
    else:
        lb = LaplaceBeltrami.from_mesh(points, faces, progress=False)
    basis = lb.eigenbasis(PAIRS)
    matrices = (sparse.csc_array(lb.to_scipy(name)) for name in ("stiffness", "mass"))
    return *matrices, basis.eigenvalues.numpy(), basis.eigenvectors.numpy()


def by_arpack(pencil: Callable[[np.ndarray, np.ndarray | None], tuple]) -> Callable[..., Solved]:
    def solved(points: np.ndarray, faces: np.ndarray | None) -> Solved:
        stiffness, mass = (sparse.csc_array(matrix) for matrix in pencil(points, faces))
        return stiffness, mass, *lowest(stiffness, mass)

    return solved


@by_arpack
def cotangent(points, faces):
    import igl

    mass = igl.massmatrix(points, faces, igl.MASSMATRIX_TYPE_VORONOI)
    return -igl.cotmatrix(points, faces), mass


@by_arpack
def robust(points, faces):
    import robust_laplacian

    if faces is None:
        return robust_laplacian.point_cloud_laplacian(points)
    return robust_laplacian.mesh_laplacian(points, faces)


@by_arpack
def linear_elements(points, faces):
    import lapy

    solver = lapy.Solver(lapy.TriaMesh(points, faces), lump=False, use_cholmod=False)
    return solver.stiffness, solver.mass


@by_arpack
def potpourri(points, faces):
    """Of a cloud: the mean of its local triangulations, in which a triangle is there three times."""
    import potpourri3d

    count = 1
    if faces is None:
        local = potpourri3d.PointCloudLocalTriangulation(points)
        faces, count = local.get_local_triangulation().reshape(-1, 3), 3
        faces = faces[(faces >= 0).all(1)]
    area = potpourri3d.vertex_areas(points, faces)
    return potpourri3d.cotan_laplacian(points, faces) / count, sparse.diags_array(area / count)


OPERATORS = {
    "torchlb": torchlb_pair,
    "libigl": cotangent,
    "robust_laplacian": robust,
    "lapy": linear_elements,
    "potpourri3d": potpourri,
}
ON_CLOUDS = ("torchlb", "robust_laplacian", "potpourri3d")


# What a pass is


def pivots(matrix: sparse.csc_array, shift: float) -> np.ndarray:
    """Those of a symmetric matrix scaled to a diagonal of ones, plus a shift; as many are negative as eigenvalues."""
    diagonal = np.abs(matrix.diagonal())
    scale = sparse.diags_array(1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)))
    scaled = scale @ matrix @ scale + shift * sparse.eye_array(len(diagonal))
    options = {"SymmetricMode": True}
    factor = splu(sparse.csc_array(scaled), "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return factor.U.diagonal()


def fault_of_pencil(stiffness: sparse.csc_array, mass: sparse.csc_array) -> str:
    """What of the definition the matrices break, or nothing."""
    if not (np.isfinite(stiffness.data).all() and np.isfinite(mass.data).all()):
        return "NaN in the matrices"
    for name, matrix in (("K", stiffness), ("M", mass)):
        if abs(matrix - matrix.T).max() > 1e-10 * abs(matrix).max():
            return f"{name} is not symmetric"
    ones = np.ones(len(mass.diagonal()))
    if (np.abs(stiffness @ ones) > 1e-7 * (abs(stiffness) @ ones)).any():
        return "K1 is not 0"
    if (mass.diagonal() <= 0).any() or (pivots(mass, 0.0) <= 0).any():
        return "M is not positive"
    if (pivots(stiffness, 1e-9) <= 0).any():
        return "K has a negative eigenvalue"
    return ""


def fault(case: Case, solved: Solved, own: list[np.ndarray]) -> str:
    """What of the definition a solved case breaks, or nothing."""
    stiffness, mass, values, vectors = solved
    broken = fault_of_pencil(stiffness, mass)
    if broken:
        return broken
    if len(values) < PAIRS or not (np.isfinite(values).all() and np.isfinite(vectors).all()):
        return "NaN or too few of the eigenpairs"
    scale = max(values[-1], 4 * np.pi / mass.sum())
    if np.abs(lowest(stiffness, mass)[0] - values).max() > 1e-3 * scale:
        return "eigenpairs have not converged"
    known = own if case.known is None else [case.known, *own]
    if not known:
        return ""
    lower, upper = np.min(known, 0), np.max(known, 0)
    none = NONE * scale
    low, high = (1 - NEAR) * lower - none - values, values - (1 + NEAR) * upper - none
    worst = int(np.maximum(low, high).argmax())
    if max(low[worst], high[worst]) > 0:
        return f"eigenvalue {worst} is {values[worst]:.4g}, not {lower[worst]:.4g} to {upper[worst]:.4g}"
    return ""


def of_whole(case: Case) -> Case:
    """The case with a zero more for every piece that its damage cuts off."""
    if case.known is None or case.own is None or case.faces is None:
        return case
    more = np.zeros(max(components(*case.own) - 1, 0))
    return case._replace(known=np.concatenate([more, case.known])[:PAIRS])


def judged(name: str, case: Case, own: list[np.ndarray]) -> Verdict:
    """One operator on one case, in this process."""
    start = time.perf_counter()
    clear = TorchlbError if name == "torchlb" else ValueError
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            solved = OPERATORS[name](case.points, case.faces)
        except clear as error:
            return Verdict("refused", f"{type(error).__name__}: {error}", 0.0)
        except Exception as error:
            return Verdict("failed", f"{type(error).__name__}: {error}", 0.0)
    seconds = time.perf_counter() - start
    try:
        broken = fault(of_whole(case), solved, own)
    except RuntimeError as error:  # a factor that breaks down
        broken = f"no factor: {error}"
    first = str(told[0].message) if told else ""
    word = ("told" if told else "silent") if broken else "passed"
    return Verdict(word, broken + (f" (told: {first})" if broken and told else ""), seconds)


# Processes, so that a crash or a loop without end costs one case


def serve(pipe: Connection) -> None:
    torch.set_num_threads(1)
    while True:
        task, *arguments = pipe.recv()
        try:
            pipe.send({"judged": judged, "eigenvalues": eigenvalues}[task](*arguments))
        except Exception as error:
            pipe.send(error)


class Worker:
    """A process that is started again after a crash or a time-out."""

    def __init__(self) -> None:
        self.process = None

    def __call__(self, *task, timeout: float):
        """What comes of the task, or the exception that ended it."""
        if self.process is None or not self.process.is_alive():
            context = multiprocessing.get_context("fork")
            self.pipe, theirs = context.Pipe()
            self.process = context.Process(target=serve, args=(theirs,), daemon=True)
            self.process.start()
            theirs.close()
        self.pipe.send(task)
        try:
            if self.pipe.poll(timeout):
                return self.pipe.recv()
            result = TimeoutError(f"nothing after {timeout:.0f} s")
        except EOFError:
            result = RuntimeError("the process crashed")
        self.process.kill()
        self.process.join()
        return result


def scored(cases: Iterator[Case], operators: list[str], timeout: float, title: str):
    """{operator: [(case, verdict)]}"""
    found: dict[str, list[tuple[Case, Verdict]]] = {name: [] for name in operators}
    work = Worker()
    for case in tqdm(cases, title):
        own = []
        for refine in () if case.own is None else (0, 1):
            values = work("eigenvalues", *case.own, refine, timeout=timeout)
            if isinstance(values, np.ndarray) and np.isfinite(values).all():
                own.append(values)
        for name in operators:
            result = work("judged", name, case, own, timeout=timeout)
            if isinstance(result, Exception):
                result = Verdict("failed", f"{type(result).__name__}: {result}", timeout)
            found[name].append((case, result))
    return found


# Tables

WORDS = ["passed", "refused", "failed", "told", "silent"]
HEADER = [
    "operator",
    "shapes",
    "passed",
    "refused",
    "failed",
    "wrong, told",
    "wrong, silently",
    "s, median",
]


def row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def share(pairs: list[tuple[Case, Verdict]], word: str) -> float:
    return sum(verdict.word == word for _, verdict in pairs) / max(len(pairs), 1)


def tables(found: dict[str, list[tuple[Case, Verdict]]]) -> Iterator[str]:
    yield from (row(HEADER), "|:--" + "|--:" * (len(HEADER) - 1) + "|")
    for name, pairs in found.items():
        words = [verdict.word for _, verdict in pairs]
        seconds = [v.seconds for _, v in pairs if v.word in ("passed", "told", "silent")] or [0.0]
        shares = [f"{share(pairs, word):.1%}" for word in WORDS]
        yield row([name, str(len(words)), *shares, f"{median(seconds):.2f}"])
    yield from ("", row(["passed of", *found]), "|:--" + "|--:" * len(found) + "|")
    for kind in dict.fromkeys(case.kind for case, _ in next(iter(found.values()))):
        cells = [kind]
        for pairs in found.values():
            words = [verdict.word for case, verdict in pairs if case.kind == kind]
            cells.append(f"{words.count('passed')} of {len(words)}")
        yield row(cells)
    yield ""
    for name, pairs in found.items():
        for case, verdict in pairs:
            if verdict.word != "passed" and name == "torchlb":
                yield f"- {verdict.word}: {case.name}: {verdict.reason}"


def in_folder(folder: Path) -> Iterator[Case]:
    for path in sorted(path for path in folder.rglob("*") if path.suffix.lower() in SUFFIXES):
        points, faces = read_shape(path)
        if faces is None:
            continue
        mesh = points.numpy(), faces.numpy()
        yield Case(str(path.relative_to(folder)), path.suffix, *mesh, None, mesh)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "folder", nargs="?", type=Path, help="meshes; without it the generated ones"
    )
    parser.add_argument("--quick", action="store_true", help="a part, torchlb alone, three minutes")
    parser.add_argument("--only", default="", help="part of the names of cases to take")
    parser.add_argument("--seed", type=int, default=0, help="of the damages")
    parser.add_argument("--alone", action="store_true", help="torchlb without its peers")
    parser.add_argument("--timeout", type=float, default=TIMEOUT, help="seconds of a case")
    options = parser.parse_args()
    torch.set_num_threads(1)
    alone = options.quick or options.alone
    names = [n for n in OPERATORS if n == "torchlb" or (installed(n) and not alone)]
    step = 5 if options.quick else 1

    def take(name: str, number: int) -> bool:
        return number % step == 0 and options.only in name

    print("# Reliability\n", *versions(), sep="\n")
    given = in_folder(options.folder) if options.folder else meshes(options.seed, take)
    of_meshes = scored(given, names, options.timeout, "meshes")
    print("\n## Meshes\n", *tables(of_meshes), sep="\n", flush=True)
    passed, silent = (share(of_meshes["torchlb"], word) for word in ("passed", "silent"))
    score = f"meshes {passed:.1%} passed, {silent:.1%} silently wrong"
    holds = passed >= 0.99 and silent == 0
    if not options.folder:
        clouds_of = [name for name in names if name in ON_CLOUDS]
        of_clouds = scored(clouds(options.seed, take), clouds_of, options.timeout, "clouds")
        print("\n## Clouds\n", *tables(of_clouds), sep="\n", flush=True)
        passed = share(of_clouds["torchlb"], "passed")
        holds, score = holds and passed >= 0.95, f"{score}; clouds {passed:.1%} passed"
    print(f"\nScore: {score}: {'holds' if holds else 'does not hold'}.")
    sys.exit(not holds)


if __name__ == "__main__":
    main()
