"""Whole shapes with known eigenvalues, which `_damages.py` damages and `reliability.py` keeps its score of."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import robust_laplacian
import torch
import trimesh
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import eigsh
from scipy.spatial import Delaunay

from torchlb.surfaces import (
    Ellipsoid,
    Hemisphere,
    Sphere,
    StarShaped,
    Surface,
    Torus,
    UnitDisk,
    limit_surface,
)

PAIRS = 20
FINE = 12000  # vertices of the meshes that stand for a smooth surface
Mesh = tuple[np.ndarray, np.ndarray]  # vertices (N, 3), faces (F, 3)


def eigenvalues(vertices: np.ndarray, faces: np.ndarray, refine: int = 0) -> np.ndarray:
    """The first of the mesh as a polyhedron: linear elements on intrinsic Delaunay triangles of its refinement."""
    for _ in range(refine):
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    stiffness, mass = robust_laplacian.mesh_laplacian(np.asarray(vertices), np.asarray(faces))
    return lowest(sparse.csc_array(stiffness), sparse.csc_array(mass))[0]


def lowest(stiffness: sparse.csc_array, mass: sparse.csc_array) -> tuple[np.ndarray, np.ndarray]:
    """The first eigenpairs by ARPACK; the shift goes with the area, as a user's does who knows his unit of length."""
    values, vectors = eigsh(stiffness, PAIRS, mass, sigma=-0.1 / mass.sum())
    order = values.argsort()
    return values[order], vectors[:, order]


def components(vertices: np.ndarray, faces: np.ndarray) -> int:
    ends = np.concatenate([faces[:, :2], faces[:, 1:]]).T
    graph = sparse.coo_array((np.ones(ends.shape[1]), tuple(ends)), (len(vertices), len(vertices)))
    return connected_components(graph, directed=False)[0]


# Whole shapes


def of_surface(surface: Surface, count: int, *, even: bool = True) -> Mesh:
    points = surface.points(count) if even else surface.random_points(count)
    return points.numpy(), surface.triangulate(points).numpy()


def values_of(surface: Surface) -> np.ndarray:
    """Exact eigenvalues, or those of a fine mesh."""
    if isinstance(surface, (Sphere, Hemisphere, UnitDisk)):
        return surface.eigenvalues(PAIRS).numpy()
    return eigenvalues(*of_surface(surface, FINE))


def grid(rows: int, columns: int, *, twist: bool = False) -> Mesh:
    """A closed strip of the unit square in long triangles: (row, column) is vertex row · columns + column."""
    row, column = np.divmod(np.arange((rows - 1) * columns), columns)
    after = (column + 1) % columns
    near, far = row, row + 1
    if twist:  # the last column meets the first upside down
        last = column == columns - 1
        near_after, far_after = (
            np.where(last, rows - 1 - near, near),
            np.where(last, rows - 1 - far, far),
        )
    else:
        near_after, far_after = near, far
    a, b = near * columns + column, near_after * columns + after
    c, d = far_after * columns + after, far * columns + column
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    return np.stack(np.divmod(np.arange(rows * columns), columns), 1) / [rows - 1, columns], faces


def moebius() -> Mesh:
    (across, along), faces = grid(17, 90, twist=True)[0].T, grid(17, 90, twist=True)[1]
    turn, width = 2 * np.pi * along, across - 0.5
    radius = 1 + width * np.cos(turn / 2)
    return np.stack(
        [radius * np.cos(turn), radius * np.sin(turn), width * np.sin(turn / 2)], 1
    ), faces


def tube() -> Mesh:
    (along, around), faces = grid(101, 20)[0].T, grid(101, 20)[1]
    turn = 2 * np.pi * around
    return np.stack([0.4 * np.cos(turn), 0.4 * np.sin(turn), 2 * along], 1), faces


def square() -> Mesh:
    flat = np.random.default_rng(0).random((1500, 2))
    return np.column_stack([flat, np.zeros(len(flat))]), Delaunay(flat).simplices.astype(np.int64)


def limbs(level: int) -> Mesh:
    """A body with limbs: the limit surface of an icosphere with some vertices pulled out."""
    control = trimesh.creation.icosphere(1)
    vertices = torch.from_numpy(np.array(control.vertices))
    vertices[::4] *= 1.9
    points, faces = limit_surface(vertices, torch.from_numpy(np.array(control.faces)), level)
    return points.numpy(), faces[level].numpy()


def subdivided(mesh: trimesh.Trimesh, longest: float) -> Mesh:
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, longest)
    merged = trimesh.Trimesh(vertices, faces)
    return np.array(merged.vertices), np.array(merged.faces)


def cortices() -> Iterator[tuple[str, Mesh]]:
    """The surfaces of the cortex that nilearn ships, with as many vertices as the other shapes."""
    found = importlib.util.find_spec("nilearn")
    if found is None or found.origin is None:
        return
    import igl
    from nilearn.surface import load_surf_mesh

    folder = Path(found.origin).parent / "datasets/data/fsaverage5"
    for path in sorted(folder.glob("*_*.gii.gz")):
        if path.name.split("_")[0] in ("pial", "white", "infl", "sphere", "flat"):
            mesh = load_surf_mesh(path)
            vertices, faces = mesh.coordinates.astype(float), mesh.faces.astype(np.int64)
            yield f"{path.name.split('.')[0]}, whole", (vertices, faces)
            fewer = igl.decimate(vertices, faces, 4000)
            yield f"{path.name.split('.')[0]}, decimated", fewer[:2]


def whole() -> Iterator[tuple[str, Mesh, Callable[[], np.ndarray]]]:
    """(name, mesh, eigenvalues): exact ones, or those of a fine mesh of a smooth surface, or of the polyhedron."""

    def known(surface: Surface) -> Callable[[], np.ndarray]:
        return lambda: values_of(surface)

    def refined(mesh: Mesh) -> Callable[[], np.ndarray]:
        return lambda: eigenvalues(*mesh, refine=2)

    icosphere, uv = trimesh.creation.icosphere(4), trimesh.creation.uv_sphere(count=[30, 48])
    spheres = {"icosphere": icosphere, "sphere of meridians": uv}
    for name, sphere in spheres.items():
        yield name, (np.array(sphere.vertices), np.array(sphere.faces)), known(Sphere())
    torus, slim, lens = Torus(), Ellipsoid((1.0, 0.7, 0.5)), Ellipsoid((1.0, 0.8, 0.15))
    surfaces = {"sphere": (Sphere(), 1500), "torus": (torus, 2000), "lens": (lens, 2000)}
    surfaces |= {"star": (StarShaped(), 1500), "hemisphere": (Hemisphere(), 1200)}
    for name, (surface, count) in (surfaces | {"disk": (UnitDisk(), 1200)}).items():
        yield name, of_surface(surface, count), known(surface)
    for name, surface in ("sphere, random", Sphere()), ("ellipsoid, random", slim):
        yield name, of_surface(surface, 2000, even=False), known(surface)
    yield "square, random", (flat := square()), refined(flat)
    yield "body with limbs", limbs(3), lambda: eigenvalues(*limbs(5))
    yield "cube", (cube := subdivided(trimesh.creation.box(), 0.1)), refined(cube)
    cylinder = trimesh.creation.cylinder(0.5, 1.5, sections=32)
    yield "cylinder", (sharp := subdivided(cylinder, 0.15)), refined(sharp)
    yield "tube of long triangles", (long := tube()), refined(long)
    yield "Möbius strip", (strip := moebius()), refined(strip)
    for name, mesh in cortices():
        if name == "pial_left, decimated":
            yield "cortex", mesh, lambda mesh=mesh: eigenvalues(*mesh, refine=1)
