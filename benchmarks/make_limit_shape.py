"""A limit shape as the other benchmarks take it: python benchmarks/make_limit_shape.py MESH OUT.npz [--control 1200]

MESH is a closed surface, in a file as `python -m torchlb` takes it. Decimated to `--control` vertices it controls a
surface of Loop's subdivision, scaled to an area of 1: `control`, `faces0`; `vertices` of the second level, with
`faces1` and `faces2`; `irregular_vertices`, with `irregular_faces`, are these moved along an edge of the fourth level,
by a fourth of their spacing. The reference is the cotangent's on the levels 3 and 4, extrapolated by its order 2:
`eigenvalues` 0 to 40; their relative `uncertainty`, by how much the extrapolation of the levels 2 and 3 differs, over
four; the `solution` of u − 0.02 Δu = cos 6x sin(5y + 0.3) + z. Level 4 has 256 times the vertices of `control`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import igl
import numpy as np
import torch
from limit_shapes import TIME, cotangent, source
from scipy.sparse.linalg import eigsh, splu
from torch import Tensor

from torchlb.io.files import read_shape
from torchlb.surfaces import limit_surface

LEVELS, PAIRS = 4, 41


def decimated(path: Path, size: int) -> tuple[Tensor, Tensor]:
    """Control points and their faces."""
    shape, triangles = read_shape(path)
    if triangles is None:
        raise SystemExit(f"{path}: expected a closed mesh, got points alone")
    control, coarse, _, _ = igl.decimate(shape.numpy(), triangles.numpy(), 2 * size)
    if len(control) == 0:
        raise SystemExit(f"{path}: expected a manifold, libigl does not decimate others")
    return torch.from_numpy(control), torch.from_numpy(coarse.astype(np.int64))


def answers(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues 0 to 40, and the solution at the vertices, by the cotangent."""
    stiffness, mass = cotangent(points, faces)
    values = np.sort(eigsh(stiffness, PAIRS, mass, sigma=-0.01, return_eigenvectors=False))
    return values, splu(mass + TIME * stiffness).solve(mass @ source(points))


def shaken(faces: np.ndarray, size: int) -> np.ndarray:
    """For each of the first vertices one of its neighbours, by chance."""
    pairs = np.random.default_rng(0).permutation(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2))
    _, first = np.unique(pairs[:, 0], return_index=True)
    return pairs[first[:size], 1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("mesh", type=Path, help="a closed surface")
    parser.add_argument("out", type=Path, help="the .npz to write")
    parser.add_argument("--control", type=int, default=1200, help="number of control points")
    options = parser.parse_args()
    control, faces = decimated(options.mesh, options.control)
    limit, levels = limit_surface(control, faces, LEVELS)
    meshes = [level.numpy() for level in levels]
    side = np.sqrt(igl.doublearea(limit.numpy(), meshes[-1]).sum() / 2)
    points = limit.numpy() / side
    counts = [int(mesh.max()) + 1 for mesh in meshes]
    second, third, fourth = (answers(points[: counts[i]], meshes[i]) for i in (2, 3, 4))
    coarse, fine = (b[0] + (b[0] - a[0]) / 3 for a, b in ((second, third), (third, fourth)))
    u, near = fourth[1][: counts[2]], third[1][: counts[2]]
    uncertainty = np.abs(coarse[1:] / fine[1:] - 1) / 4
    print(
        f"{counts} vertices; relative uncertainty of the eigenvalues up to {uncertainty.max():.1e}"
    )
    np.savez(
        options.out,
        **{f"faces{i}": meshes[i] for i in range(3)},
        control=control.numpy() / side,
        vertices=points[: counts[2]],
        eigenvalues=fine,
        uncertainty=uncertainty,
        solution=u + (u - near) / 3,
        irregular_vertices=points[shaken(meshes[-1], counts[2])],
        irregular_faces=meshes[2],
    )


if __name__ == "__main__":
    main()
