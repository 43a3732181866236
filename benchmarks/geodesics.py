"""Seconds and errors of geodesic distances from many sources: python benchmarks/geodesics.py [--sizes N ...]

Even meshes of the unit sphere, where the distance is that of great circles, and of the pial surface of fsaverage5.
Seconds are the processor's, of one thread. `first` is one source by itself, `each` what every further one takes among
50; potpourri3d is the heat method, which keeps its factor. Errors are means over the mean distance.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import potpourri3d
import torch
from _common import versions

from torchlb import LaplaceBeltrami, geodesic_distance
from torchlb.surfaces import Sphere

SOURCES = 50


def cortex() -> tuple[torch.Tensor, torch.Tensor]:
    import nibabel
    from nilearn.datasets import fetch_surf_fsaverage

    vertices, faces = nibabel.load(fetch_surf_fsaverage("fsaverage5")["pial_left"]).agg_data()
    return torch.from_numpy(vertices.astype(float)), torch.from_numpy(faces.astype(np.int64))


def timed(call: Callable[..., Any], *arguments: Any, **options: Any) -> tuple[float, Any]:
    start = time.process_time()
    result = call(*arguments, **options)
    return time.process_time() - start, result


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[10000, 40000])
    sizes = parser.parse_args().sizes
    print("\n".join(versions()))
    print("\n| | torchlb, first | each | potpourri3d, first | each | error | of potpourri3d |")
    print("|:--|--:|--:|--:|--:|--:|--:|")
    meshes = {f"sphere, {n:,}": Sphere().mesh(n) for n in sizes} | {"cortex, 10,242": cortex()}
    geodesic_distance(LaplaceBeltrami.from_cotangent(*Sphere().mesh(100)), 0)  # loads what it needs
    for name, (vertices, faces) in meshes.items():
        lb = LaplaceBeltrami.from_cotangent(vertices, faces)
        sources = np.linspace(0, len(vertices) - 1, SOURCES).astype(int).tolist()
        first, _ = timed(geodesic_distance, lb, sources[0])
        whole, ours = timed(geodesic_distance, lb, sources, each=True)
        arrays = vertices.numpy(), faces.numpy()
        setup, solver = timed(potpourri3d.MeshHeatMethodDistanceSolver, *arrays)
        further, theirs = timed(list, map(solver.compute_distance, sources))
        columns = [(whole - first) / (SOURCES - 1), setup + further / SOURCES, further / SOURCES]
        errors = ["–", "–"]
        if name.startswith("sphere"):
            exact = torch.acos((vertices @ vertices[sources].T).clamp(-1, 1))
            found = ours, torch.from_numpy(np.stack(theirs, 1))
            errors = [f"{float((d - exact).abs().mean() / exact.mean()):.1e}" for d in found]
        row = " | ".join(f"{seconds:.3f}" for seconds in [first, *columns])
        print(f"| {name} | {row} | {' | '.join(errors)} |", flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
