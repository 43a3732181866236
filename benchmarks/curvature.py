"""Curvatures beside libigl's, a Markdown table: python benchmarks/curvature.py [SHAPE.npz ...]

Torus and ellipsoid with exact curvatures: errors in the mean square, relative. A shape has the control mesh of a limit
surface of subdivision, `control` and `faces0`: the median absolute error at the vertices of levels 0, 1 and 2 against
torchlb's curvatures at order 4 on level 3 (77k vertices), over the median size. libigl fits quadrics to balls around
the vertices, `igl.principal_curvature`, radius 5 (its default) and 2, and has K as the angle defect,
`igl.gaussian_curvature`, over Voronoi areas.
"""

from __future__ import annotations

import sys
from pathlib import Path

import igl
import numpy as np
import torch
from _common import versions
from torch import Tensor

from torchlb import LaplaceBeltrami
from torchlb.surfaces import Ellipsoid, Torus, limit_surface

Pair = tuple[Tensor, Tensor]  # K, H
AXES = (1.0, 0.8, 0.6)


def angle_defect(points: Tensor, faces: Tensor) -> Tensor:
    mesh = points.numpy(), faces.numpy()
    area = igl.massmatrix(*mesh, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    return torch.from_numpy(igl.gaussian_curvature(*mesh) / area)


def by_igl(points: Tensor, faces: Tensor, radius: int) -> Pair:
    found = igl.principal_curvature(points.numpy(), faces.numpy(), radius)
    k1, k2 = (torch.from_numpy(np.asarray(found[i])) for i in (2, 3))
    return k1 * k2, (k1 + k2) / 2


def ours(lb: LaplaceBeltrami) -> Pair:
    found = lb.curvatures()
    return found.gaussian, found.mean


def of_torus(points: Tensor) -> Pair:
    cos = (points[:, :2].norm(dim=1) - 1) / 0.4
    k1, k2 = 1 / 0.4, cos / (1 + 0.4 * cos)
    return k1 * k2, (k1 + k2) / 2


def of_ellipsoid(points: Tensor) -> Pair:
    a = torch.tensor(AXES, dtype=torch.float64)
    weight = (points.square() / a**4).sum(1)
    mean = (a.square().sum() - points.square().sum(1)) / (2 * a.prod() ** 2 * weight**1.5)
    return 1 / (a.prod() ** 2 * weight**2), mean


def errors(found: Pair, exact: Pair) -> list[Tensor]:
    """Of K, and of H, whose sign depends on the side of the normals."""
    side = (found[1] * exact[1]).sum().sign()
    return [found[0] - exact[0], side * found[1] - exact[1]]


def root_mean_square(found: Pair, exact: Pair) -> list[str]:
    pairs = zip(errors(found, exact), exact, strict=True)
    return [f"{float(x.norm() / y.norm()):.1e}" for x, y in pairs]


def median(found: Pair, exact: Pair) -> list[str]:
    pairs = zip(errors(found, exact), exact, strict=True)
    return [f"{float(x.abs().median() / y.abs().median()):.1e}" for x, y in pairs]


def main() -> None:
    print("\n".join(versions()))
    print(
        "\n| shape | vertices | torchlb, K | H | random cloud, K | H | libigl, K | H | libigl, radius 2, K | H "
        "| angle defect, K |"
    )
    print("|:--|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|")
    for surface, exact in ((Torus(1.0, 0.4), of_torus), (Ellipsoid(AXES), of_ellipsoid)):
        for count in (2000, 8000):
            vertices, faces = surface.mesh(count)
            cloud = LaplaceBeltrami.from_points(surface.random_points(count))
            cells = [
                *root_mean_square(
                    ours(LaplaceBeltrami.from_mesh(vertices, faces)), exact(vertices)
                ),
                *root_mean_square(ours(cloud), exact(cloud.points)),
                *(
                    x
                    for radius in (5, 2)
                    for x in root_mean_square(by_igl(vertices, faces, radius), exact(vertices))
                ),
                *root_mean_square(
                    (angle_defect(vertices, faces), exact(vertices)[1]), exact(vertices)
                )[:1],
            ]
            print(f"| {type(surface).__name__} | {count:,} | {' | '.join(cells)} |", flush=True)
    for path in sys.argv[1:]:
        data = np.load(path)
        control, faces0 = (torch.from_numpy(data[name]) for name in ("control", "faces0"))
        points, meshes = limit_surface(control, faces0.long(), 3)
        reference = ours(LaplaceBeltrami.from_mesh(points, meshes[3], order=4))
        for faces in meshes[:3]:
            vertices = points[: int(faces.max()) + 1]
            exact = reference[0][: len(vertices)], reference[1][: len(vertices)]
            cells = [
                *median(ours(LaplaceBeltrami.from_mesh(vertices, faces)), exact),
                "",
                "",
                *(x for radius in (5, 2) for x in median(by_igl(vertices, faces, radius), exact)),
                *median((angle_defect(vertices, faces), exact[1]), exact)[:1],
            ]
            print(f"| {Path(path).stem} | {len(vertices):,} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
