"""Stability on real and dirty shapes, as a Markdown table: python benchmarks/robustness.py [--data FOLDER].

Every mesh under the folder (.ply, .obj, .off, .stl; .npz with `vertices`, `faces`, of which a stack of vertices counts
as many shapes) and a few generated dirty ones, as a mesh and as the cloud of its vertices, at orders 1, 3, 5 with both
projections. What each row says:

rows at p: share of the rows that keep the order p, then that of low-order rows; abscissa: largest real part of an
eigenvalue of Δ over the spectral radius, densely up to 3,000 points, by Arnoldi above; λ: the largest relative
difference between eigenvalues 1 to 9 of −Δ and those of robust_laplacian on the same mesh, or on the mesh refined
twice by midpoints where `--refine 2` asks for it; seconds: of the build, with `--split` stencils + certificate.

`--summarize TABLE …` sums up tables printed before, over their shapes: ranges, and of λ and seconds the median.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
import robust_laplacian
import torch
import trimesh
from _common import versions
from scipy import sparse
from scipy.sparse.linalg import ArpackError, eigs, eigsh
from torch import Tensor
from tqdm import tqdm

from torchlb import LaplaceBeltrami, clean_mesh
from torchlb.surfaces import Sphere, Torus

DENSE = 3000
HEADER = [
    "shape",
    "N",
    "as",
    "p",
    "projection",
    "certificate",
    "rounds",
    "rows at p",
    "low order",
]
HEADER += ["abscissa", "λ", "seconds"]
SUMMARY = "| as | p | projection | shapes | certificate | rounds | % of rows at p | % low order "
SUMMARY += "| λ, median (max) % | seconds, median |"


class Shape(NamedTuple):
    name: str
    vertices: Tensor
    faces: Tensor


def shapes_in(folder: Path) -> Iterator[Shape]:
    """Every mesh below the folder, cleaned of what no vertex list may have."""
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder).with_suffix(""))
        if path.suffix == ".npz":
            with np.load(path) as data:
                stack, faces = np.atleast_3d(data["vertices"]), data["faces"]
            stack = stack if data_is_stack(stack, faces) else stack.reshape(1, -1, 3)
            for number, vertices in enumerate(stack):
                yield cleaned(f"{name} {number}" if len(stack) > 1 else name, vertices, faces)
        elif path.suffix in (".ply", ".obj", ".off", ".stl"):
            mesh = trimesh.load_mesh(path, process=False)
            yield cleaned(name, mesh.vertices, mesh.faces)


def data_is_stack(vertices: np.ndarray, faces: np.ndarray) -> bool:
    return vertices.ndim == 3 and vertices.shape[2] == 3 and vertices.shape[1] > faces.max()


def cleaned(name: str, vertices: np.ndarray, faces: np.ndarray) -> Shape:
    points = torch.as_tensor(np.asarray(vertices), dtype=torch.float64)
    points, corners, _ = clean_mesh(points, torch.as_tensor(np.asarray(faces).astype(np.int64)))
    return Shape(name, points, corners)


def dirty() -> Iterator[Shape]:
    """Shapes with what real ones have: jitter, slivers, creases, fins, sheets that touch, noise, uneven density."""
    generator = torch.Generator().manual_seed(0)
    vertices, faces = Sphere().mesh(1500)
    noise = torch.randn(vertices.shape, generator=generator, dtype=torch.float64)
    spacing = (Sphere().area / 1500) ** 0.5
    for share in (0.01, 0.1, 0.3):
        yield Shape(
            f"sphere, noise {share:.0%} of the spacing", vertices + share * spacing * noise, faces
        )
    yield Shape("sphere, denser towards a pole", *graded(vertices, faces))
    torus, corners = Torus().mesh(1500)
    yield Shape("torus, stretched 1:1:30", torus * torch.tensor([1.0, 1.0, 30.0]), corners)
    box = trimesh.creation.box().subdivide_loop(0)
    for _ in range(4):
        box = box.subdivide()
    yield cleaned("cube", box.vertices, box.faces)
    yield Shape("sphere with a fin", *finned(vertices, faces))
    touching = torch.cat([vertices, vertices[1:] + 2 * vertices[0]])
    second = torch.where(faces == 0, int(-vertices.matmul(vertices[0]).argmax()) * 0, faces + 1499)
    yield Shape("two spheres that share a vertex", touching, torch.cat([faces, second]))
    keep = torch.rand(len(faces), generator=generator) > 0.1
    yield cleaned("sphere without a tenth of its triangles", vertices.numpy(), faces[keep].numpy())


def graded(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """The sphere under a Möbius map: triangles 30 times larger at one pole than at the other."""
    plane = vertices[:, :2] / (1 - vertices[:, 2:]).clamp_min(1e-9) / 5.5
    square = plane.square().sum(1, keepdim=True)
    return torch.cat([2 * plane, square - 1], 1) / (1 + square), faces


def finned(vertices: Tensor, faces: Tensor) -> tuple[Tensor, Tensor]:
    """A triangle that stands on an edge of three: not a manifold there."""
    tip = 1.1 * vertices[faces[0, :2]].mean(0, keepdim=True)
    fin = torch.tensor([[faces[0, 0], faces[0, 1], len(vertices)]])
    return torch.cat([vertices, tip]), torch.cat([faces, fin])


def reference(shape: Shape, refine: int) -> np.ndarray:
    """First ten eigenvalues of robust_laplacian, on the mesh refined by midpoints."""
    vertices, faces = shape.vertices.numpy(), shape.faces.numpy()
    for _ in range(refine):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    weak, mass = robust_laplacian.mesh_laplacian(np.asarray(vertices), np.asarray(faces))
    weak = sparse.csc_matrix(weak)
    values = eigsh(weak, 10, mass, sigma=-1e-6 * abs(weak).max() / mass.diagonal().max() * 1e-2)[0]
    return np.sort(values)


def abscissa(lb: LaplaceBeltrami) -> float:
    """Largest real part of an eigenvalue over the spectral radius; NaN where Arnoldi does not converge."""
    n = lb.num_points
    if n <= DENSE:
        values = np.linalg.eigvals(lb.matrix.to_dense().numpy())
        return float(values.real.max() / np.abs(values).max())
    matrix = lb.to_scipy()
    try:
        radius = np.abs(eigs(matrix, 1, tol=1e-2, return_eigenvectors=False)[0])
        top = eigs(matrix, 2, which="LR", tol=1e-6, ncv=60, maxiter=200, return_eigenvectors=False)
    except ArpackError:
        return float("nan")
    return float(top.real.max() / radius)


def run(
    shape: Shape,
    kind: str,
    order: int,
    projection: str,
    known: Callable[[], np.ndarray],
    arnoldi: bool,
    split: bool,
) -> str:
    """One line of the table."""
    points = shape.vertices if kind == "mesh" else torch.unique(shape.vertices, dim=0)
    options = {"order": order, "projection": projection, "progress": False}

    def build(**more: bool) -> tuple[LaplaceBeltrami, float]:
        start = time.perf_counter()
        if kind == "mesh":
            lb = LaplaceBeltrami.from_mesh(points, shape.faces, **options, **more)
        else:
            lb = LaplaceBeltrami.from_points(points, **options, **more)
        return lb, time.perf_counter() - start

    stencils = build()[1] if split else None
    lb, whole = build(certify=True)
    certificate = lb.certificate
    assert certificate is not None
    counts = lb.report.order_counts
    n = lb.num_points
    cells = [shape.name, f"{n:,}", kind, str(order), projection]
    cells += ["holds" if certificate.holds else "FAILS", str(certificate.rounds)]
    cells += [f"{counts[order] / n:.1%}", f"{counts[0] / n:.1%}"]
    cells.append(f"{abscissa(lb):.0e}" if arnoldi or n <= DENSE else "–")
    values, exact = lb.eigenbasis(10).eigenvalues.numpy(), known()
    low = exact > 0.1 / float(lb.mass.sum())  # beyond zeros and necks
    cells.append(f"{np.abs(values[low] / exact[low] - 1).max():.1%}" if low.any() else "–")
    parts = f"{stencils:.1f} + {max(whole - stencils, 0):.1f}" if stencils else f"{whole:.1f}"
    cells.append(parts)
    return "| " + " | ".join(cells) + " |"


def summarize(tables: Sequence[Path]) -> Iterator[str]:
    """A line for each kind, order and projection, over all shapes of the tables."""
    yield SUMMARY
    yield "|" + "---|" * (SUMMARY.count("|") - 1)
    groups = defaultdict(list)
    for table in tables:
        for line in table.read_text().splitlines():
            cells = [cell.strip() for cell in line.strip("|").split("|")]
            if len(cells) == len(HEADER) and cells[5] in ("holds", "FAILS"):
                groups[cells[2], cells[3], cells[4]].append(cells)
    for (kind, order, projection), lines in groups.items():

        def numbers(column: int, lines: list[list[str]] = lines) -> list[float]:
            return [float(cells[column].rstrip("%")) for cells in lines if cells[column] != "–"]

        ranges = [f"{min(numbers(k)):g}–{max(numbers(k)):g}" for k in (6, 7, 8)]
        failures = sum(cells[5] == "FAILS" for cells in lines)
        verdict = f"{failures} FAIL" if failures else "all hold"
        known = numbers(10)
        spectrum = f"{median(known):.2g} ({max(known):.3g})" if known else "–"
        cells = [kind, order, projection, str(len(lines)), verdict, *ranges, spectrum]
        yield "| " + " | ".join([*cells, f"{median(numbers(11)):.0f}"]) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, help="folder of meshes; without it the generated ones")
    parser.add_argument("--only", default="", help="part of the names to take")
    parser.add_argument("--skip", type=int, default=0, help="number of shapes to leave out first")
    parser.add_argument("--limit", type=int, default=10**9, help="number of shapes to take")
    parser.add_argument("--orders", type=int, nargs="+", default=[1, 3, 5])
    parser.add_argument("--projections", nargs="+", default=["tangent", "normal"])
    parser.add_argument("--kinds", nargs="+", default=["mesh", "cloud"], choices=["mesh", "cloud"])
    parser.add_argument(
        "--refine", type=int, default=0, help="midpoint refinements of the reference"
    )
    parser.add_argument("--arnoldi", action="store_true", help="the abscissa of large shapes too")
    parser.add_argument(
        "--split", action="store_true", help="seconds of stencils + certificate, by building twice"
    )
    parser.add_argument("--summarize", type=Path, nargs="+", metavar="TABLE")
    options = parser.parse_args()
    if options.summarize:
        print(*summarize(options.summarize), sep="\n")
        return
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    every = list(shapes_in(options.data)) if options.data else list(dirty())
    taken = [shape for shape in every if options.only in shape.name]
    taken = taken[options.skip :][: options.limit]
    print("# Robustness\n", *versions(), sep="\n")
    print("\n| " + " | ".join(HEADER) + " |\n|" + "---|" * len(HEADER), flush=True)
    for shape in tqdm(taken, "shapes"):
        found: list[np.ndarray] = []

        def known(shape: Shape = shape, found: list[np.ndarray] = found) -> np.ndarray:
            if not found:
                found.append(reference(shape, options.refine))
            return found[0]

        for kind in options.kinds:
            for order in options.orders:
                for projection in options.projections:
                    line = run(
                        shape, kind, order, projection, known, options.arnoldi, options.split
                    )
                    print(line, flush=True)


if __name__ == "__main__":
    main()
