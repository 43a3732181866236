"""Seconds and memory until eigenvalues are right: python benchmarks/time_to_accuracy.py [SHAPE.npz ...] [--plot FILE]

Meshes of the sphere and the torus, and of limit shapes (as in `limit_shapes.py`, with `control` and `faces0`), refined
until --limit. The error is the median over the eigenvalues 1 to 40, relative; the seconds are those of one thread to
build and to find 41 pairs, the memory is that of the process above what was loaded. What is asked of a method between
two of its meshes is interpolated in logarithms; beyond the finest it is extrapolated from the last two, marked by *.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from _common import alone, peak, versions
from tqdm import tqdm

from torchlb import LaplaceBeltrami
from torchlb.surfaces import Sphere, Surface, Torus, limit_surface

PAIRS, GOALS = 41, [1e-2, 1e-3, 1e-4, 1e-5, 1e-6]
METHODS = {
    "cotangent": lambda *mesh: LaplaceBeltrami.from_cotangent(*mesh),
    **{
        f"torchlb, p = {order}": lambda *mesh, order=order: LaplaceBeltrami.from_mesh(
            *mesh, order=order, progress=False
        )
        for order in (1, 2, 3, 5)
    },
}
Mesh = tuple[np.ndarray, np.ndarray, np.ndarray]


def analytic(surface: Surface) -> Iterator[Mesh]:
    """(vertices, faces, eigenvalues), finer and finer."""
    for n in (1000, 4000, 16_000, 64_000, 256_000):
        points, faces = surface.mesh(n)
        yield points.numpy(), faces.numpy(), surface.eigenvalues(PAIRS).numpy()


def subdivided(path: Path) -> Iterator[Mesh]:
    with np.load(path) as shape:
        control = torch.from_numpy(shape["control"].astype(float))
        faces, exact = torch.from_numpy(shape["faces0"].astype(np.int64)), shape["eigenvalues"]
    points, meshes = limit_surface(control, faces, 4)
    for mesh in meshes[1:]:
        yield points[: int(mesh.max()) + 1].numpy(), mesh.numpy(), exact


def measure(name: str, mesh: Mesh) -> None:
    """In a process of its own: prints error, seconds and MiB as JSON."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    vertices, faces, exact = mesh
    small = Sphere().points(500)
    METHODS[name](small.numpy(), Sphere().triangulate(small).numpy()).eigenbasis(PAIRS)
    before = peak()
    seconds = []
    for _ in range(3 if len(vertices) < 3e4 else 1):
        start = time.perf_counter()
        values = METHODS[name](vertices, faces).eigenbasis(PAIRS).eigenvalues.numpy()
        seconds.append(time.perf_counter() - start)
    error = float(np.median(np.abs(values[1:] / exact[1:PAIRS] - 1)))
    grown = peak() - before
    print(json.dumps([error, statistics.median(seconds), grown]))


def needed(goal: float, series: np.ndarray) -> str:
    """Seconds and MiB for an error, from the rows (error, seconds, MiB) of a method."""
    error, *costs = np.log(series).T
    if series[0, 0] <= goal:
        return f"≤ {series[0, 1]:.2g} s, {series[0, 2]:.0f}"
    last = np.flatnonzero(series[:, 0] <= goal)
    k = last[0] if len(last) else len(series) - 1
    share = (np.log(goal) - error[k - 1]) / (error[k] - error[k - 1])
    if not len(last) and error[k] >= error[k - 1]:
        return "—"
    seconds, size = (float(np.exp(c[k - 1] + share * (c[k] - c[k - 1]))) for c in costs)
    return f"{seconds:.2g} s{'' if len(last) else '*'}, {size:,.0f}"


def draw(found: dict[str, dict[str, np.ndarray]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    colors = ["0.55", "#c6dbef", "#9ecae1", "#4292c6", "#08519c"]
    columns = min(len(found), 3)
    rows = -(-len(found) // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(4 * columns, 3.4 * rows), sharey=True, squeeze=False
    )
    for ax in axes.flat[len(found) :]:
        ax.remove()
    for ax, (shape, methods) in zip(axes.flat, found.items(), strict=False):
        for color, (name, series) in zip(colors, methods.items(), strict=True):
            ax.loglog(series[:, 1], series[:, 0], "o-", color=color, label=name, markersize=4)
        ax.set(title=shape, xlabel="seconds, one thread")
        ax.grid(alpha=0.3)
    for ax in axes[:, 0]:
        ax.set_ylabel("median error of eigenvalues 1–40")
    axes[0, 0].legend(frameon=False)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("shapes", nargs="*", type=Path, help="files of limit shapes")
    parser.add_argument("--limit", type=float, default=200.0, help="s a mesh")
    parser.add_argument("--plot", type=Path)
    parser.add_argument("--one", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.one:
        with np.load(asked.shapes[0]) as mesh:
            measure(asked.one, (mesh["vertices"], mesh["faces"], mesh["exact"]))
        return
    print("\n".join(versions()))
    sources = {"sphere": analytic(Sphere()), "torus": analytic(Torus())}
    sources |= {path.stem: subdivided(path) for path in asked.shapes}
    found: dict[str, dict[str, np.ndarray]] = {}
    for shape, meshes in sources.items():
        rows: dict[str, list[list[float]]] = {name: [] for name in METHODS}
        for vertices, faces, exact in meshes:
            for name in tqdm(METHODS, f"{shape}, {len(vertices):,}", leave=False):
                if rows[name] and 4 * rows[name][-1][1] > asked.limit:
                    continue
                with tempfile.TemporaryDirectory() as folder:
                    path = Path(folder) / "mesh.npz"
                    np.savez(path, vertices=vertices, faces=faces, exact=exact)
                    rows[name].append(alone(__file__, [str(path), "--one", name]))
        found[shape] = {name: np.array(series) for name, series in rows.items()}
        print(f"\n#### {shape}\n\nSeconds, MiB for a median error of\n")
        print(f"| | {' | '.join(f'{goal:.0e}' for goal in GOALS)} | finest: N, error, s |")
        print("|:--|" + "--:|" * (len(GOALS) + 1))
        for name, series in found[shape].items():
            cells = [needed(goal, series) for goal in GOALS]
            cells.append(f"level {len(series)}, {series[-1, 0]:.1e}, {series[-1, 1]:.1f}")
            print(f"| {name} | {' | '.join(cells)} |", flush=True)
    if asked.plot:
        draw(found, asked.plot)


if __name__ == "__main__":
    main()
