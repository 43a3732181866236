"""Clouds of real smooth shapes beside robust_laplacian: python benchmarks/clouds.py SHAPE.npz ... [--quick]

A shape is a smooth limit surface of subdivision as in `limit_shapes.py`, with its control points (`control`,
`faces0`). Its clouds are the vertices of a level, as many uniformly random points of level 4, and both with noise of
5 and 10 % of √(area/N). Printed are median and worst relative error of the eigenvalues 1 to 40, over
robust_laplacian's in brackets, the number of zero eigenvalues, and what it costs on one thread.
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path

import numpy as np
import robust_laplacian
import torch
from _common import versions
from scipy import sparse
from scipy.sparse.linalg import eigsh

from torchlb import LaplaceBeltrami
from torchlb.surfaces import Sphere, limit_surface

PAIRS = 41


def clouds(shape: dict[str, np.ndarray], quick: bool):
    """(name, points)."""
    control = torch.from_numpy(shape["control"].astype(float))
    points, meshes = limit_surface(control, torch.from_numpy(shape["faces0"].astype(np.int64)), 4)
    vertices, faces = points.numpy(), meshes[4].numpy()
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1) / 2
    for level in ("faces1",) if quick else ("faces2", "faces1"):
        count = int(shape[level].max()) + 1
        random = np.random.default_rng(0)
        chosen = random.choice(len(faces), count, p=area / area.sum())
        shares = random.dirichlet([1, 1, 1], count)
        kinds = {
            "even": shape["vertices"][:count].astype(float),
            "random": (corners[chosen] * shares[..., None]).sum(1),
        }
        for noise in (0, 5, 10):
            for kind, points in kinds.items():
                spacing = (area.sum() / count) ** 0.5
                moved = points + noise / 100 * spacing * random.normal(size=points.shape)
                yield f"{kind}, {count}" + (f", noise {noise} %" if noise else ""), moved


def robust(points: np.ndarray) -> tuple[float, np.ndarray]:
    start = time.perf_counter()
    stiffness, mass = robust_laplacian.point_cloud_laplacian(points)
    seconds = time.perf_counter() - start
    matrices = sparse.csc_array(stiffness), sparse.csc_array(mass)
    return seconds, np.sort(eigsh(matrices[0], PAIRS, matrices[1], sigma=-0.01)[0])


def pair(points: np.ndarray) -> tuple[float, np.ndarray]:
    start = time.perf_counter()
    lb = LaplaceBeltrami.from_points(points, progress=False)
    seconds = time.perf_counter() - start
    return seconds, lb.eigenbasis(PAIRS).eigenvalues.numpy()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("shapes", nargs="+", type=Path, help="files of limit shapes")
    parser.add_argument("--quick", action="store_true", help="the 4.8k clouds alone")
    options = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    print("\n".join(versions()), end="\n\n")
    pair(Sphere().points(500).numpy())  # what is loaded once
    print("| shape | cloud | robust_laplacian | torchlb | zeros | build s (robust_laplacian's) |")
    print("|:--|:--|:--|:--|--:|--:|", flush=True)
    for path in options.shapes:
        shape = dict(np.load(path))
        exact = shape["eigenvalues"][1:PAIRS]
        for name, points in clouds(shape, options.quick):
            cells, first = [], []
            times, zeros = [], 0
            for run in (robust, pair):
                seconds, values = run(points)
                error = np.abs(values[1:] / exact - 1)
                figures = [float(np.median(error)), float(error.max())]
                ratios = [f" ({f / g:.2f})" for f, g in zip(figures, first, strict=False)] or [
                    ""
                ] * 2
                first = first or figures
                cells.append(", ".join(f"{f:.1e}{r}" for f, r in zip(figures, ratios, strict=True)))
                times.append(seconds)
                zeros = int((values < 1e-8 * values[-1]).sum())
            row = [path.stem, name, *cells, str(zeros), f"{times[1]:.1f} ({times[0]:.1f})"]
            print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
