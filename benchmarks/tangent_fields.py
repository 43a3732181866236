"""Tangent fields beside potpourri3d's and the usual connection Laplacian: python benchmarks/tangent_fields.py

Eigenvalues of the connection Laplacian on the unit sphere, l(l + 1) − 1, worst of the first 28. The usual matrix
carries vectors along edges by rescaled angles, with cotangent weights and a lumped mass. Parallel transport and the
logarithmic map of one vertex: mean errors where shortest paths are unique and shorter than 0.8 of the longest, against
geodesics by an ODE solver and Newton's method. Harmonic fields: the ratio of the first eigenvalue of Hodge's Laplacian
that is not one of theirs to the last that is, on sphere, torus and a block with two holes, smoothed by subdivision.
Hodge parts: their products over the square of the field.
"""

from __future__ import annotations

import time
from statistics import median
from typing import Any

import numpy as np
import torch
from _common import installed, versions
from scipy import sparse
from scipy.integrate import solve_ivp
from scipy.sparse.linalg import eigsh
from torch import Tensor

from torchlb import LaplaceBeltrami, hodge_decomposition, logarithmic_map, parallel_transport
from torchlb.surfaces import CliffordTorus, Sphere, Torus, limit_surface

AXES = np.array([1.0, 1.3, 0.7])
DEGREES = [degree for degree in range(1, 5) for _ in range(4 * degree + 2)][:28]


def worst(values: Any, expected: Any) -> float:
    return float(np.abs(np.asarray(values)[: len(expected)] / np.asarray(expected) - 1).max())


def usual(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The first 28 eigenvalues of the usual connection Laplacian of a closed mesh."""
    count, size = len(vertices), len(faces)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    sides = np.stack([b - a, c - b, a - c], 1)
    ways = sides / np.linalg.norm(sides, axis=2, keepdims=True)
    corner = np.arccos(-(ways * np.roll(ways, 1, 1)).sum(2))  # the angle at each corner
    total = np.bincount(faces.ravel(), corner.ravel(), count)
    following = {
        (faces[f, i], faces[f, (i + 1) % 3]): (f, i) for f in range(size) for i in range(3)
    }
    angle: dict[Any, float] = {}
    for f, i in zip(*np.divmod(np.arange(3 * size), 3), strict=True):
        start, reached, at = faces[f, i], faces[f, (i + 1) % 3], 0.0
        while (start, reached) not in angle:  # around the vertex, rescaled to 2π
            angle[start, reached] = at
            g, k = following[start, reached]
            at += corner[g, k] * 2 * np.pi / total[start]
            reached = faces[g, (k + 2) % 3]
    weight = {}
    for f in range(size):
        for i in range(3):
            pair = faces[f, (i + 1) % 3], faces[f, (i + 2) % 3]
            for x in (pair, pair[::-1]):
                weight[x] = weight.get(x, 0.0) + 0.5 / np.tan(corner[f, i])
    i, j = np.array(list(weight)).T
    w = np.array(list(weight.values()))
    turn = np.array([angle[x, y] - angle[y, x] + np.pi for x, y in zip(i, j, strict=True)])
    matrix = sparse.coo_array((-w * np.exp(1j * turn), (i, j)), (count, count)).tocsr()
    matrix = matrix + sparse.diags(np.bincount(i, w, count))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    mass = np.bincount(faces.ravel(), np.repeat(area / 3, 3), count)
    values = eigsh(matrix.tocsc(), 14, sparse.diags(mass).tocsc(), sigma=-0.1)[0]
    return np.repeat(np.sort(values), 2)  # complex eigenvalues are double ones


def double_torus(levels: int) -> tuple[Tensor, Tensor]:
    """A closed surface of genus 2: the limit of subdivision of a block of 5 × 3 × 2 cubes without two columns."""
    solid = np.zeros((7, 5, 4), int)
    solid[1:-1, 1:-1, 1:-1] = 1
    solid[[2, 4], 2] = 0
    axes, quads = np.eye(3, dtype=int), []
    for k in range(3):
        one, two = axes[(k + 1) % 3], axes[(k + 2) % 3]
        for sign, a, b in ((-1, one, two), (1, two, one)):  # counterclockwise, seen from outside
            first = np.argwhere(np.diff(solid, axis=k) == sign) + axes[k]
            quads.append(np.stack([first, first + a, first + one + two, first + b], 1))
    places, corners = np.unique(np.concatenate(quads).reshape(-1, 3), axis=0, return_inverse=True)
    cells = torch.from_numpy(corners.reshape(-1, 4))
    faces = torch.cat([cells[:, :3], cells[:, [0, 2, 3]]])
    points, meshes = limit_surface(torch.from_numpy(places.astype(float)), faces, levels)
    return points, meshes[levels]


def flowed(start: np.ndarray, axes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends of geodesics on an ellipsoid, and of vectors carried along, from (M, 9) places, velocities, vectors."""
    d = 1 / axes**2

    def slope(_: float, y: np.ndarray) -> np.ndarray:
        x, v, w = np.split(y.reshape(-1, 9), 3, 1)
        g = x * d
        bend = -g / (g * g).sum(1, keepdims=True)
        parts = [
            v,
            bend * (v * d * v).sum(1, keepdims=True),
            bend * (w * d * v).sum(1, keepdims=True),
        ]
        return np.concatenate(parts, 1).ravel()

    y = solve_ivp(slope, (0, 1), start.ravel(), rtol=1e-10, atol=1e-12, method="DOP853").y[:, -1]
    return y.reshape(-1, 9)[:, :3], y.reshape(-1, 9)[:, 6:]


def exact(
    points: np.ndarray, source: int, frame: np.ndarray, guess: np.ndarray, axes: np.ndarray
) -> Any:
    """Normal coordinates, the transported first vector of the frame, and where these are known."""
    many = np.repeat(points[source][None], len(points), 0)
    vector = np.repeat(frame[:, 0][None], len(points), 0)

    def ends(c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return flowed(np.concatenate([many, c @ frame.T, vector], 1), axes)

    c = guess.copy()
    for _ in range(10):
        x, _ = ends(c)
        jacobian = np.stack([(ends(c + 1e-6 * e)[0] - x) / 1e-6 for e in np.eye(2)], 2)
        step = np.stack(
            [
                np.linalg.lstsq(j, r, rcond=None)[0]
                for j, r in zip(jacobian, points - x, strict=True)
            ]
        )
        length = np.linalg.norm(step, axis=1, keepdims=True)
        c += step * np.minimum(1, 0.3 / np.maximum(length, 1e-30))
    x, carried = ends(c)
    far, found = np.linalg.norm(guess, axis=1), np.linalg.norm(c, axis=1)
    known = (np.linalg.norm(x - points, axis=1) < 1e-8) & (far < 0.8 * far.max()) & (far > 0)
    return c, carried, known & (np.abs(found - far) < 0.03 * np.maximum(far, 0.1))


def errors(lb: LaplaceBeltrami, solver: Any, axes: np.ndarray) -> list[str]:
    """Mean errors of transport and logarithm, ours and potpourri3d's."""
    points, source = lb.points.numpy(), 7
    normal = points[source] / axes**2
    normal /= np.linalg.norm(normal)
    frame = lb.frames[source].numpy()
    frame = np.linalg.qr(frame - np.outer(normal, normal @ frame))[0]
    ours = logarithmic_map(lb, source).numpy() @ (lb.frames[source].numpy().T @ frame)
    c, carried, known = exact(points, source, frame, ours, axes)
    moved = parallel_transport(lb, source, torch.from_numpy(frame[:, 0].copy())).numpy()
    results = [moved, ours]
    if solver is not None:
        one, two, _ = solver.get_tangent_frames()
        both = np.stack([one, two], 2)
        w = solver.transport_tangent_vector(source, list(frame[:, 0] @ both[source]))
        w = np.einsum("ink,ik->in", both, w)
        results.append(w / np.linalg.norm(w, axis=1, keepdims=True))
        results.append(solver.compute_log_map(source) @ (both[source].T @ frame))
    aims = [carried, c] * 2
    means = [
        np.linalg.norm(x - y, axis=1)[known].mean() for x, y in zip(results, aims, strict=False)
    ]
    return [f"{x:.1e}" for x in means] + ["–"] * (4 - len(means))


def seconds(function: Any) -> float:
    found = []
    for _ in range(3):
        start = time.perf_counter()
        function()
        found.append(time.perf_counter() - start)
    return median(found)


def eigenvalues() -> None:
    print(
        "\n| eigenvalues | points | torchlb, mesh | torchlb, cloud | usual |\n|:--|--:|--:|--:|--:|"
    )
    expected = [degree * (degree + 1) - 1 for degree in DEGREES]
    for count in (500, 2000):
        vertices, faces = Sphere().mesh(count)
        builds = LaplaceBeltrami.from_mesh(vertices, faces), LaplaceBeltrami.from_points(vertices)
        cells = [worst(lb.connection.eigenbasis(28).eigenvalues, expected) for lb in builds]
        cells.append(worst(usual(vertices.numpy(), faces.numpy()), expected))
        print(f"| sphere | {count} | " + " | ".join(f"{x:.1e}" for x in cells) + " |")
    lb = LaplaceBeltrami.from_mesh(*CliffordTorus().mesh(2000))
    flat = worst(lb.connection.eigenbasis(26).eigenvalues[2:], [2.0] * 8 + [4.0] * 8 + [8.0] * 8)
    print(f"| Clifford's torus | {lb.num_points} | {flat:.1e} | – | – |")


def hodge() -> None:
    print(
        "\n| surface | vertices | harmonic fields | ratio | Hodge parts, largest product |\n"
        "|:--|--:|--:|--:|--:|"
    )
    for name, mesh, count in (
        ("sphere", Sphere().mesh(5000), 0),
        ("torus", Torus().mesh(5000), 2),
        ("block with two holes", double_torus(3), 4),
        ("block with two holes", double_torus(4), 4),
    ):
        lb = LaplaceBeltrami.from_mesh(*mesh)
        values = lb.connection.hodge.eigenbasis(count + 2).eigenvalues
        x, y, z = lb.points.unbind(1)
        v = torch.stack([y * z - y, x.square() + x, x.sin()], 1)
        parts = hodge_decomposition(lb, v)
        three = [parts.gradient, parts.rotated, parts.harmonic]
        products = [
            float(lb.inner(three[i], three[j]).sum().abs()) for i, j in ((0, 1), (0, 2), (1, 2))
        ]
        ratio = f"{float(values[count] / values[count - 1]):.1e}" if count else "–"
        print(
            f"| {name} | {lb.num_points:,} | {count} | {ratio} | {max(products) / float(lb.inner(v, v).sum()):.1e} |"
        )


def transport() -> None:
    print(
        "\n| shape | points | transport | logarithm | potpourri3d: transport | logarithm |\n"
        "|:--|--:|--:|--:|--:|--:|"
    )
    for name, axes in (("sphere", np.ones(3)), ("ellipsoid", AXES)):
        for count in (2000, 8000):
            vertices, faces = Sphere().mesh(count)
            vertices = vertices * torch.from_numpy(axes)
            for kind in ("mesh", "cloud"):
                solver = None
                on_mesh = kind == "mesh"
                lb = (
                    LaplaceBeltrami.from_mesh(vertices, faces)
                    if on_mesh
                    else LaplaceBeltrami.from_points(vertices)
                )
                if installed("potpourri3d"):
                    import potpourri3d as pp3d

                    given = vertices.numpy(), faces.numpy()
                    solver = (
                        pp3d.MeshVectorHeatSolver(*given)
                        if on_mesh
                        else pp3d.PointCloudHeatSolver(given[0])
                    )
                print(
                    f"| {name}, {kind} | {count} | " + " | ".join(errors(lb, solver, axes)) + " |"
                )


def cost() -> None:
    vertices, faces = Torus().mesh(13000)
    lb = LaplaceBeltrami.from_mesh(vertices, faces)
    lb.connection.eigenbasis(2)
    build = seconds(lambda: LaplaceBeltrami.from_mesh(vertices, faces))

    def fields() -> None:
        del lb.cache
        _ = lb.connection

    def eigen(of: Any, k: int) -> None:
        of.modes = type(of.modes)(None, of.mass)
        of.eigenbasis(k)

    cells = [
        build,
        seconds(fields),
        seconds(lambda: eigen(lb.connection, 32)),
        seconds(lambda: eigen(lb, 64)),
    ]
    print(
        "\n| seconds, 13,000 vertices | build | connection | 32 eigenfields | 64 eigenfunctions |\n"
        "|:--|--:|--:|--:|--:|"
    )
    print("| one thread | " + " | ".join(f"{x:.2f}" for x in cells) + " |")


def main() -> None:
    torch.set_num_threads(1)
    print("\n".join(versions()))
    for table in (eigenvalues, hodge, transport, cost):
        table()


if __name__ == "__main__":
    main()
