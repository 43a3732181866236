"""Seconds and memory of operators beside their peers: python benchmarks/speed.py [MESH ...] [--sizes N ...]

Meshes of a star-shaped surface, evenly spread, and those named (.npz with `vertices` and `faces`, or what trimesh
reads), and clouds of their vertices. Every figure is of a process of its own that has run the same on 500 points:
medians of the seconds to build and of the seconds until 128 eigenpairs (--pairs) are there too, the latter over those
of DiffusionNet's `get_operators` in brackets, and by how much the resident memory grew at most. What does not give
eigenpairs has a dash, and is compared by its build. A method that would take longer than --limit at the next size,
were it to grow linearly, is left out there. Growth is the exponent between the last two sizes. Seconds are those of
the processor by one thread, or with --threads those that pass.

`get_operators` is DiffusionNet's own where the environment variable DIFFUSION_NET names the folder `src` of a checkout,
else its steps as they are restated here: cotangents or robust_laplacian, eigsh, and point by point the least-squares
gradient of the tangent plane.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from _common import alone, peak, versions
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, eigsh
from scipy.spatial import KDTree
from tqdm import tqdm

from torchlb import LaplaceBeltrami
from torchlb.surfaces import StarShaped

NEIGHBORS = 30
CHECKOUT = os.environ.get("DIFFUSION_NET")
Method = tuple[Callable[..., Any], Callable[[Any, int], Any] | None]
"""From points (and faces) to what is built, and from that to so many eigenpairs."""


def ours(build: Callable[..., LaplaceBeltrami], **options: Any) -> Method:
    return lambda *shape: build(*shape, **options), lambda lb, k: lb.eigenbasis(k)


def pairs(matrices: tuple[Any, Any, Any], k: int) -> Any:
    """Smallest eigenpairs as DiffusionNet finds them, of (stiffness, mass, gradients)."""
    shifted = sparse.csc_matrix(matrices[0] + 1e-8 * sparse.identity(matrices[0].shape[0]))
    return eigsh(shifted, k, matrices[1], sigma=1e-8)


def pairs_by_cholesky(matrices: tuple[Any, Any, Any], k: int) -> Any:
    """The same by ARPACK with a Cholesky factor, CHOLMOD's, instead of SuperLU's."""
    from cholespy import CholeskySolverD, MatrixType

    stiffness, mass, _ = matrices
    count, sigma = len(mass.diagonal()), -1e-2
    shifted = sparse.coo_matrix(stiffness - sigma * mass)
    solver = CholeskySolverD(count, shifted.row, shifted.col, shifted.data, MatrixType.COO)

    def solve(b: np.ndarray) -> np.ndarray:
        x = np.empty_like(b, dtype=float)
        solver.solve(np.ascontiguousarray(b), x)
        return x

    inverse = LinearOperator((count, count), matvec=solve, dtype=float)
    return eigsh(sparse.csc_matrix(stiffness), k, mass, sigma=sigma, OPinv=inverse)


def libigl(points: np.ndarray, faces: np.ndarray) -> Any:
    import igl

    mass = igl.massmatrix(points, faces, igl.MASSMATRIX_TYPE_VORONOI)
    return -igl.cotmatrix(points, faces), mass, None


def robust(points: np.ndarray, faces: np.ndarray | None = None) -> Any:
    import robust_laplacian

    if faces is None:
        return *robust_laplacian.point_cloud_laplacian(points), None
    return *robust_laplacian.mesh_laplacian(points, faces), None


def lapy(points: np.ndarray, faces: np.ndarray) -> Any:
    from lapy import Solver, TriaMesh

    solver = Solver(TriaMesh(points, faces), lump=False, use_cholmod=False)
    return solver.stiffness, solver.mass, None


def pycompadre(points: np.ndarray) -> Any:
    from accuracy import compadre_operator

    return compadre_operator(points, degree=4)


def get_operators(points: np.ndarray, faces: np.ndarray | None = None) -> Any:
    """DiffusionNet's own in full, or what it would have without the eigenpairs."""
    import igl
    import potpourri3d

    if faces is None:
        stiffness, mass, _ = robust(points)
        tails = KDTree(points).query(points, NEIGHBORS + 1)[1][:, 1:]
        near = points[tails] - points[tails].mean(1, keepdims=True)
        normals = np.linalg.svd(near, full_matrices=False)[2][:, 2]
    else:
        stiffness = potpourri3d.cotan_laplacian(points, faces, denom_eps=1e-10)
        areas = potpourri3d.vertex_areas(points, faces)
        mass = sparse.diags(areas + 1e-8 * areas.mean())
        normals = igl.per_vertex_normals(points, faces)
        rows = sparse.csr_matrix(stiffness)
        tails = np.split(rows.indices, rows.indptr[1:-1])
    axis = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = np.cross(normals, np.cross(axis, normals))
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    frames = np.stack([first, np.cross(normals, first)], axis=1)
    rows, columns, entries = [], [], []
    for point, near in enumerate(tails):  # one by one, as there
        near = near[near != point]
        edges = (points[near] - points[point]) @ frames[point].T
        weights = np.linalg.solve(edges.T @ edges + 1e-5 * np.eye(2), edges.T)
        rows += [point] * (len(near) + 1)
        columns += [point, *near.tolist()]
        entries += [-weights.sum(1), *weights.T]
    place, values = (rows, columns), np.array(entries)
    gradients = [sparse.csc_matrix((v, place), stiffness.shape) for v in values.T]
    return stiffness, mass, gradients


def from_checkout(points: np.ndarray, faces: np.ndarray | None = None) -> Any:
    sys.path.insert(0, str(CHECKOUT))
    from diffusion_net.geometry import compute_operators  # pyright: ignore[reportMissingImports]

    triangles = torch.zeros(0, 3).long() if faces is None else torch.from_numpy(faces)
    shape = torch.from_numpy(points), triangles
    return shape, compute_operators, compute_operators(*shape, 0)


REFERENCE = "get_operators" if CHECKOUT else "get_operators, restated"
ORIGINAL: Method = (
    (from_checkout, lambda built, k: built[1](*built[0], k)) if CHECKOUT else (get_operators, pairs)
)
MESH: dict[str, Method] = {
    REFERENCE: ORIGINAL,
    "torchlb, cotangent": ours(LaplaceBeltrami.from_cotangent),
    **{
        f"torchlb, p = {order}": ours(LaplaceBeltrami.from_mesh, order=order, progress=False)
        for order in (1, 3, 5)
    },
    "robust_laplacian": (robust, pairs),
    "libigl": (libigl, pairs),
    "libigl, ARPACK with CHOLMOD": (libigl, pairs_by_cholesky),
    "LaPy": (lapy, pairs),
}
CLOUD: dict[str, Method] = {
    REFERENCE: ORIGINAL,
    **{
        f"torchlb, p = {order}": ours(LaplaceBeltrami.from_points, order=order, progress=False)
        for order in (1, 3, 5)
    },
    "torchlb, p = 3, bare stencil": (
        ours(LaplaceBeltrami.from_points, weak_form=False, progress=False)[0],
        None,
    ),
    "robust_laplacian": (robust, pairs),
    "pycompadre, p = 3": (pycompadre, None),
}


def measure(method: Method, shape: list[np.ndarray], k: int, repeats: int, twice: bool) -> None:
    """In a process of its own: prints seconds to build, seconds with k pairs and MiB, as JSON.

    `twice` says that the pairs are found by another build.
    """
    build, solve = method
    warnings.simplefilter("ignore")
    small = StarShaped().points(500)
    first = small.numpy(), StarShaped().triangulate(small).numpy()
    warm = build(*first[: len(shape)])
    if solve:
        solve(warm, min(k, 128))
    before = peak()
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    builds, totals = [], []
    for _ in range(repeats):
        start = clock()
        built = build(*shape)
        builds.append(clock() - start)
        start = clock()
        if solve:
            solve(built, k)
        totals.append(clock() - start + (0 if twice else builds[-1]))
    grown = peak() - before
    total = statistics.median(totals) if solve else None
    print(json.dumps([statistics.median(builds), total, grown]))


def measured(
    kind: str, name: str, path: Path, asked: argparse.Namespace, repeats: int
) -> tuple[float, float | None, float] | None:
    """What `measure` prints, from a process of its own; None if it failed."""
    arguments = [str(path), "--one", kind, name, "--repeats", str(repeats)]
    arguments += ["--pairs", str(asked.pairs), "--threads", str(asked.threads)]
    try:
        build, total, grown = alone(__file__, arguments, asked.threads)
    except subprocess.CalledProcessError:
        return None  # it has said why
    return build, total, grown


def read(path: Path) -> tuple[np.ndarray, np.ndarray]:
    if path.suffix == ".npz":
        with np.load(path) as found:
            return found["vertices"].astype(float), found["faces"].astype(np.int64)
    mesh = trimesh.load_mesh(path, process=False)
    return np.array(mesh.vertices, dtype=float), np.array(mesh.faces, dtype=np.int64)


def show(kind: str, paths: dict[str, Path], asked: argparse.Namespace) -> None:
    methods = MESH if kind == "mesh" else CLOUD
    series = not asked.meshes
    methods = {name: methods[name] for name in asked.rows or methods if name in methods}
    print(f"\n#### {kind}\n\n| | {' | '.join(paths)} |{' growth |' if series else ''}")
    print("|:--|" + "--:|" * (len(paths) + series), flush=True)
    reference: dict[str, float] = {}
    for name in methods:
        cells, past = [], []
        for label, path in tqdm(paths.items(), name, leave=False):
            count = len(read(path)[0])
            slow = series and past and past[-1][1] * count / past[-1][0] > asked.limit
            found = None if slow else measured(kind, name, path, asked, 3 if count < 3e4 else 1)
            if found is None:
                cells.append("—")
                continue
            build, total, grown = found
            cost = total or build
            if name == REFERENCE:
                reference[label] = cost
            ratio = f" ({cost / reference[label]:.2f})" if label in reference else ""
            both = f"{total:.2f}" if total else "—"
            cells.append(f"{build:.2f}, {both}{ratio}, {grown:.0f}")
            past.append((count, cost))
        if series:
            (n, a), (m, b) = past[-2:] if len(past) > 1 else ((1, 1.0), (1, 1.0))
            cells.append(f"{math.log(b / a) / math.log(m / n):.2f}" if m > n else "—")
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("meshes", nargs="*", type=Path, help="instead of the star-shaped surface")
    parser.add_argument(
        "--sizes", nargs="+", type=int, default=[2000, 10_000, 50_000, 200_000, 1_000_000]
    )
    parser.add_argument("--limit", type=float, default=900.0, help="s")
    parser.add_argument("--rows", nargs="+", help="of the tables; all by default")
    parser.add_argument("--pairs", type=int, default=128)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--kinds", nargs="+", default=["mesh", "cloud"])
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--repeats", type=int, default=1, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.one:
        kind, name = asked.one
        shape = list(read(asked.meshes[0]))
        if kind == "cloud":
            shape = [np.unique(shape[0], axis=0)]
        method = (MESH if kind == "mesh" else CLOUD)[name]
        twice = bool(CHECKOUT) and name == REFERENCE
        torch.set_num_threads(asked.threads)
        measure(method, shape, asked.pairs, asked.repeats, twice)
        return
    print("\n".join(versions()))
    print(
        f"\n{asked.threads} thread(s): s to build, s with {asked.pairs} eigenpairs too (over get_operators'), MiB; "
        "DiffusionNet " + ("from a checkout." if CHECKOUT else "restated.")
    )
    with tempfile.TemporaryDirectory() as folder:
        paths = {path.stem: path for path in asked.meshes}
        for n in [] if paths else asked.sizes:
            points = StarShaped().points(n)
            paths[f"N = {n:,}"] = Path(folder) / f"{n}.npz"
            faces = StarShaped().triangulate(points)
            np.savez(paths[f"N = {n:,}"], vertices=points.numpy(), faces=faces.numpy())
        for kind in asked.kinds:
            show(kind, paths, asked)


if __name__ == "__main__":
    main()
