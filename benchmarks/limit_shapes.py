"""The weak pair beside its peers on real smooth shapes: python benchmarks/limit_shapes.py SHAPE.npz ... [--quick]

A shape is a smooth limit surface of subdivision with its eigenvalues known (`method.md`, section 9): `vertices`, faces
`faces1`, `faces2` on the first of them, `irregular_vertices`, `irregular_faces`, `eigenvalues` 0 to 40, and `solution`
of u − 0.02 Δu = cos 6x sin(5y + 0.3) + z. Printed are relative errors, median and worst of the eigenvalues 1 to 40, and
of the solve; of the wave kernel signature at 4.8k points against that at 19k; and what it costs on one thread.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path

import igl
import lapy
import numpy as np
import robust_laplacian
import torch
from _common import versions
from scipy import sparse
from scipy.sparse.linalg import eigsh, splu
from torch import Tensor

from torchlb import LaplaceBeltrami, implicit_step, wave_kernel_signature
from torchlb.surfaces import Sphere

TIME, PAIRS = 0.02, 128
Pair = tuple[sparse.csc_array, sparse.csc_array]


def source(points: np.ndarray) -> np.ndarray:
    x, y, z = points.T
    return np.cos(6 * x) * np.sin(5 * y + 0.3) + z


def cotangent(points: np.ndarray, faces: np.ndarray) -> Pair:
    mass = igl.massmatrix(points, faces, igl.MASSMATRIX_TYPE_VORONOI)
    return sparse.csc_array(-igl.cotmatrix(points, faces)), sparse.csc_array(mass)


def robust(points: np.ndarray, faces: np.ndarray) -> Pair:
    stiffness, mass = robust_laplacian.mesh_laplacian(points, faces)
    return sparse.csc_array(stiffness), sparse.csc_array(mass)


def linear_elements(points: np.ndarray, faces: np.ndarray) -> Pair:
    solver = lapy.Solver(lapy.TriaMesh(points, faces), lump=False, use_cholmod=False)
    return sparse.csc_array(solver.stiffness), sparse.csc_array(solver.mass)


def by_pair(pair: Callable[[np.ndarray, np.ndarray], Pair]):
    """(seconds to build, eigenvalues, seconds, solution) of a peer's pair."""

    def run(points: np.ndarray, faces: np.ndarray) -> tuple[float, np.ndarray, float, np.ndarray]:
        start = time.perf_counter()
        stiffness, mass = pair(points, faces)
        built = time.perf_counter()
        values = np.sort(eigsh(stiffness, PAIRS, mass, sigma=-0.01)[0])
        solved = time.perf_counter()
        u = splu(sparse.csc_array(mass + TIME * stiffness)).solve(mass @ source(points))
        return built - start, values, solved - built, u

    return run


def by_torchlb(**options):
    def run(points: np.ndarray, faces: np.ndarray) -> tuple[float, np.ndarray, float, np.ndarray]:
        start = time.perf_counter()
        lb = LaplaceBeltrami.from_mesh(points, faces, progress=False, **options)
        built = time.perf_counter()
        values = lb.eigenbasis(PAIRS).eigenvalues.numpy()
        solved = time.perf_counter()
        u = implicit_step(lb, torch.from_numpy(source(points)), TIME).numpy()
        return built - start, values, solved - built, u

    return run


METHODS = {
    "cotangent (libigl)": by_pair(cotangent),
    "robust_laplacian": by_pair(robust),
    "linear elements (LaPy)": by_pair(linear_elements),
    "weak pair, p = 1": by_torchlb(order=1),
    "weak pair, p = 3": by_torchlb(),
}


def meshes(shape: dict[str, np.ndarray], quick: bool):
    """(name, points, faces, known solution or None)."""
    for level in ("faces1",) if quick else ("faces1", "faces2"):
        faces = shape[level].astype(np.int64)
        count = int(faces.max()) + 1
        yield level, shape["vertices"][:count].astype(float), faces, shape["solution"][:count]
    if not quick:
        irregular = shape["irregular_faces"].astype(np.int64)
        yield "irregular", shape["irregular_vertices"].astype(float), irregular, None


def show(name: str, shape: dict[str, np.ndarray], quick: bool) -> None:
    exact = shape["eigenvalues"][1:41]
    for level, points, faces, known in meshes(shape, quick):
        area = igl.massmatrix(points, faces, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
        first: list[float] = []
        for method, run in METHODS.items():
            build, values, solve, u = run(points, faces)
            error = np.abs(values[1:41] / exact - 1)
            figures = [float(np.median(error)), float(error.max())]
            if known is not None:
                figures.append(float(np.sqrt(area @ (u - known) ** 2 / (area @ known**2))))
            first = first or figures
            cells = [f"{f:.1e} ({f / one:.2f})" for f, one in zip(figures, first, strict=True)]
            cells += ["—"] * (3 - len(cells))
            row = [name, f"{level}, {len(points)}", method, *cells, f"{build:.1f}", f"{solve:.1f}"]
            print("| " + " | ".join(row) + " |", flush=True)


def signature(points: Tensor, faces: Tensor, build: Callable[..., LaplaceBeltrami]) -> Tensor:
    """Wave kernel signature, at the function's own energies for each mesh."""
    return wave_kernel_signature(build(points, faces), k=100)


def show_signatures(name: str, shape: dict[str, np.ndarray]) -> None:
    for method, build in (
        ("cotangent (libigl)", LaplaceBeltrami.from_cotangent),
        ("weak pair, p = 3", LaplaceBeltrami.from_mesh),
    ):
        found = []
        for level in ("faces1", "faces2"):
            faces = torch.from_numpy(shape[level].astype(np.int64))
            points = torch.from_numpy(shape["vertices"][: int(faces.max()) + 1].astype(float))
            found.append(signature(points, faces, build))
        coarse, fine = found[0], found[1][: len(found[0])]
        print(
            f"| {name} | {method} | {float((coarse - fine).norm() / fine.norm()):.1e} |", flush=True
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("shapes", nargs="+", type=Path, help="files of limit shapes")
    parser.add_argument("--quick", action="store_true", help="the 4.8k meshes alone")
    options = parser.parse_args()
    torch.set_num_threads(1)
    shapes = {path.stem: dict(np.load(path)) for path in options.shapes}
    print("\n".join(versions()), end="\n\n")
    print("In brackets: over the cotangent's.\n")
    LaplaceBeltrami.from_mesh(*Sphere().mesh(1000)).eigenbasis(PAIRS)  # what is loaded once
    print("| shape | mesh | operator | λ1–40 median | worst | solve | build s | 128 pairs s |")
    print("|:--|:--|:--|--:|--:|--:|--:|--:|", flush=True)
    for name, shape in shapes.items():
        show(name, shape, options.quick)
    print("\n| shape | operator | wave kernel signature, 4.8k against 19k |\n|:--|:--|--:|")
    for name, shape in shapes.items():
        if not options.quick:
            show_signatures(name, shape)


if __name__ == "__main__":
    main()
