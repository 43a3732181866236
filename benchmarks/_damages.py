"""Damages of meshes and clouds, as real files have them, and the cases that `reliability.py` keeps its score of.

A damage takes a generator of random numbers, a mesh and the faces that it strikes, and returns a mesh. Faces are struck
alone, all over the shape; in a band, a slab across it; or in a cluster, a patch of it. Vertices that no face has any
more are left out, so that an operator can be built of every shape here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from typing import NamedTuple

import numpy as np
import torch
import trimesh
from _shapes import Mesh, cortices, values_of, whole
from scipy.spatial import KDTree

from torchlb.surfaces import Ellipsoid, Hemisphere, Sphere, StarShaped, Surface, Torus, UnitDisk

WHERE = ["alone", "band", "cluster"]
Damage = Callable[[np.random.Generator, np.ndarray, np.ndarray, np.ndarray], Mesh]
CloudDamage = Callable[[np.random.Generator, np.ndarray, np.ndarray], tuple[np.ndarray, Mesh]]
Take = Callable[[str, int], bool]


class Case(NamedTuple):
    """A damaged shape, the eigenvalues of the whole one, and the mesh that has those of the damaged polyhedron."""

    name: str
    kind: str
    points: np.ndarray
    faces: np.ndarray | None  # None of a cloud
    known: np.ndarray | None  # None of a mesh of which no whole one is known
    own: Mesh | None  # None where the damage changes nothing


# What is struck


def struck(
    random: np.random.Generator, vertices: np.ndarray, faces: np.ndarray, where: str
) -> np.ndarray:
    """Indices of faces, in a random order: 1 % alone, or 6 % in a band or cluster."""
    middle = vertices[faces].mean(1)
    direction = random.normal(size=3)
    if where == "alone":
        return random.permutation(len(faces))[: max(3, len(faces) // 100)]
    one = middle[random.integers(len(faces))]
    distance = (
        np.abs((middle - one) @ direction)
        if where == "band"
        else np.linalg.norm(middle - one, axis=1)
    )
    return random.permutation(distance.argsort()[: len(faces) * 6 // 100])


def spacing(vertices: np.ndarray, faces: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1)))


def normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return np.array(trimesh.Trimesh(vertices, faces, process=False).vertex_normals)


def split(
    vertices: np.ndarray, faces: np.ndarray, chosen: np.ndarray, shares: np.ndarray, both: bool
) -> Mesh:
    """The first side of every chosen face split at a share of it; with `both`, the faces across as well."""
    points, result = list(vertices), [list(face) for face in faces]
    of_edge: dict[tuple[int, int], list[int]] = {}
    for number, face in enumerate(faces.tolist()):
        for i in range(3):
            of_edge.setdefault((min(face[i], face[i - 1]), max(face[i], face[i - 1])), []).append(
                number
            )
    busy: set[int] = set()
    for number, share in zip(chosen.tolist(), shares, strict=True):
        a, b = faces[number, :2].tolist()
        around = of_edge[min(a, b), max(a, b)]
        if busy & set(around):
            continue
        busy |= set(around)
        points.append((1 - share) * vertices[a] + share * vertices[b])
        new = len(points) - 1
        for one in around if both else [number]:
            face = faces[one].tolist()
            result[one] = [new if v == a else v for v in face]
            result.append([new if v == b else v for v in face])
    return np.array(points), np.array(result)


# Damages


def needles(random, vertices, faces, chosen):
    return split(vertices, faces, chosen, 10 ** random.uniform(-6, -2, len(chosen)), both=True)


def no_length(random, vertices, faces, chosen):
    return split(vertices, faces, chosen, np.zeros(len(chosen)), both=True)


def t_junctions(random, vertices, faces, chosen):
    return split(vertices, faces, chosen, np.full(len(chosen), 0.5), both=False)


def poked(vertices, faces, chosen, heights):
    """Every chosen face in three, by a point a share of its height above the middle of its first side."""
    a, b, c = faces[chosen].T
    h = heights[:, None]
    points = (1 - h) / 2 * (vertices[a] + vertices[b]) + h * vertices[c]
    new = len(vertices) + np.arange(len(chosen))
    parts = [np.stack(part, 1) for part in ((a, b, new), (b, c, new), (c, a, new))]
    return np.concatenate([vertices, points]), np.concatenate([np.delete(faces, chosen, 0), *parts])


def caps(random, vertices, faces, chosen):
    return poked(vertices, faces, chosen, 10 ** random.uniform(-8, -2, len(chosen)))


def no_area(random, vertices, faces, chosen):
    return poked(vertices, faces, chosen, np.zeros(len(chosen)))


def folds(random, vertices, faces, chosen):
    corner = faces[chosen, 0]
    across = vertices[faces[chosen, 1]] + vertices[faces[chosen, 2]]
    moved = vertices.copy()
    moved[corner] += random.uniform(1.1, 1.6, (len(chosen), 1)) * (across / 2 - vertices[corner])
    return moved, faces


def twice(random, vertices, faces, chosen):
    half = len(chosen) // 2
    return vertices, np.concatenate([faces, faces[chosen[:half]], faces[chosen[half:], ::-1]])


def missing(random, vertices, faces, chosen):
    return vertices, np.delete(faces, chosen[: len(chosen) * 2 // 3], 0)


def hole(random, vertices, faces, chosen):
    """Without the chosen faces, all: of a cluster, since those alone are `missing`."""
    return vertices, np.delete(faces, chosen, 0)


def spikes(random, vertices, faces, chosen):
    """Self-intersections, as one triangle goes through others."""
    corner = np.unique(faces[chosen, 0])
    height = spacing(vertices, faces) * random.normal(size=(len(corner), 1))
    moved = vertices.copy()
    moved[corner] += height * normals(vertices, faces)[corner]
    return moved, faces


def fins(random, vertices, faces, chosen):
    """Triangles that stand on an edge of two others: no manifold there."""
    a, b = faces[chosen, 0], faces[chosen, 1]
    height = spacing(vertices, faces) * random.uniform(0.2, 1, (len(chosen), 1))
    tips = (vertices[a] + vertices[b]) / 2 + height * normals(vertices, faces)[a]
    stand = np.stack([a, b, len(vertices) + np.arange(len(chosen))], 1)
    return np.concatenate([vertices, tips]), np.concatenate([faces, stand])


def unmerged(random, vertices, faces, chosen):
    """Chosen faces with vertices of their own."""
    used, own = np.unique(faces[chosen], return_inverse=True)
    cut = faces.copy()
    cut[chosen] = len(vertices) + own.reshape(-1, 3)
    return np.concatenate([vertices, vertices[used]]), cut


def specks(random, vertices, faces, chosen):
    """Small tetrahedra that float above the surface."""
    tetrahedron = (
        spacing(vertices, faces) / 3 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    )
    sides = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    for corner in faces[chosen[:3], 0]:
        at = vertices[corner] + 2 * spacing(vertices, faces) * normals(vertices, faces)[corner]
        faces = np.concatenate([faces, len(vertices) + sides])
        vertices = np.concatenate([vertices, at + tetrahedron])
    return vertices, faces


def wound(random, vertices, faces, chosen):
    turned = faces.copy()
    turned[chosen] = turned[chosen, ::-1]
    return vertices, turned


def noise(random, vertices, faces, chosen):
    return vertices + 0.1 * spacing(vertices, faces) * random.normal(size=vertices.shape), faces


def few_digits(random, vertices, faces, chosen):
    """Coordinates of ten bits."""
    step = np.ptp(vertices) / 1024
    return step * np.round(vertices / step), faces


def far_float32(random, vertices, faces, chosen):
    return (vertices + 100 * np.ptp(vertices)).astype(np.float32).astype(float), faces


def large(random, vertices, faces, chosen):
    return 1e6 * vertices, faces


def small(random, vertices, faces, chosen):
    return (1e-6 * vertices).astype(np.float32).astype(float), faces


def mixed(random, vertices, faces, chosen):
    """Several of them, one after the other, elsewhere each."""
    for damage in random.permutation([needles, caps, folds, twice, missing, t_junctions, fins])[:4]:
        where = str(random.choice(["alone", "band", "cluster"]))
        part = struck(random, vertices, faces, where)
        vertices, faces = damage(random, vertices, faces, part[: max(3, len(part) // 3)])
    return vertices, faces


LOCAL: dict[str, Damage] = {
    "needles": needles,
    "caps": caps,
    "edges of no length": no_length,
    "faces of no area": no_area,
    "folds": folds,
    "faces twice": twice,
    "faces missing": missing,
    "T-junctions": t_junctions,
    "spikes": spikes,
    "fins": fins,
    "patches not merged": unmerged,
    "faces wound against others": wound,
    "mixed": mixed,
}
GLOBAL: dict[str, Damage] = {
    "none": lambda random, vertices, faces, chosen: (vertices, faces),
    "a hole": hole,
    "specks": specks,
    "noise of 10 %": noise,
    "coordinates of ten bits": few_digits,
    "float32, far from 0": far_float32,
    "1e6 times as large": large,
    "1e-6 times as large": small,
}
SCALES = {"1e6 times as large": 1e6, "1e-6 times as large": 1e-6}
SAME = {"none", "needles", "caps", "edges of no length", "faces of no area"}
SAME |= {"faces wound against others", *SCALES}


def meshes(seed: int, take: Take) -> Iterator[Case]:
    """Every whole shape with every damage, and what packages ship, of which `take(name, number)` are wanted.

    Numbers run across shapes and damages, so that every fifth of them has some of every shape and of every damage.
    """
    for place, (name, mesh, values) in enumerate(whole()):
        known = None
        for turn, (kind, damage) in enumerate((GLOBAL | LOCAL).items()):
            where = WHERE[(place + turn) % 3] if kind in LOCAL else "cluster"
            title = f"{name}: {kind}" + (f", {where}" if kind in LOCAL else "")
            if not take(title, place + 2 * turn):
                continue
            known = values() if known is None else known
            random = np.random.default_rng([seed, place, turn])
            vertices, faces = used(*damage(random, *mesh, struck(random, *mesh, where)))
            own = None if kind in SAME else (vertices, faces)
            yield Case(title, kind, vertices, faces, known / SCALES.get(kind, 1) ** 2, own)
    for number, (name, mesh) in enumerate(cortices()):
        if take(name, number):
            yield Case(name, "as shipped", *used(*mesh), None, used(*mesh))


def used(vertices: np.ndarray, faces: np.ndarray) -> Mesh:
    kept, renumbered = np.unique(faces, return_inverse=True)
    return vertices[kept], renumbered.reshape(-1, 3)


# Clouds: a damage returns points, and the mesh that stands for them


def alike(change: Callable[[np.ndarray], np.ndarray]) -> CloudDamage:
    return lambda random, points, faces: (change(points), (change(points), faces))


def outliers(random, points, faces):
    """Eight points off the surface."""
    away = points[random.integers(len(points), size=8)] * random.uniform(1.2, 1.5, (8, 1))
    away[:, 2] += np.where(away[:, 2] < 0, -0.3, 0.3)
    return np.concatenate([points, away]), (points, faces)


def without_cluster(random, points, faces):
    middle = points[random.integers(len(points))]
    kept = np.linalg.norm(points - middle, axis=1).argsort()[len(points) // 20 :]
    kept.sort()
    inside = faces[np.isin(faces, kept).all(1)]
    return points[kept], used(points, inside)


def noisy(share: float) -> CloudDamage:
    def moved(random, points, faces):
        found = KDTree(points).query(points, 7)[0][:, 1:]
        points = points + share * np.median(found) * random.normal(size=points.shape)
        return points, (points, faces)

    return moved


def doubled(random, points, faces):
    again = points[random.permutation(len(points))[: len(points) // 50]]
    again = again + 1e-6 * random.normal(size=again.shape)
    return np.concatenate([points, again]), (points, faces)


CLOUDS: dict[str, CloudDamage] = {
    "none": alike(lambda points: points),
    "outliers": outliers,
    "a hole": without_cluster,
    "noise of 1 %": noisy(0.01),
    "noise of 5 %": noisy(0.05),
    "noise of 15 %": noisy(0.15),
    "near duplicates": doubled,
    "float32": alike(lambda points: points.astype(np.float32).astype(float)),
    "1e6 times as large": alike(lambda points: 1e6 * points),
    "1e-6 times as large": alike(lambda points: 1e-6 * points),
}


def uneven(surface: Surface, count: int, seed: int) -> torch.Tensor:
    """Random points, at one end fifty times as many in an area as at the other."""
    points = surface.random_points(12 * count, seed)
    along = points[:, 0] - points[:, 0].min()
    chance = torch.rand(len(points), generator=torch.Generator().manual_seed(seed))
    return points[chance < 50.0 ** -(along / along.max())][:count]


def clouds(seed: int, take: Take) -> Iterator[Case]:
    """Samples of the surfaces, even, random and uneven, with the damages of a cloud, of which as in `meshes`."""
    slim, lens = Ellipsoid((1.0, 0.7, 0.5)), Ellipsoid((1.0, 0.8, 0.15))
    surfaces = {"sphere": Sphere(), "torus": Torus(), "ellipsoid": slim, "lens": lens}
    surfaces |= {"star": StarShaped(), "hemisphere": Hemisphere(), "disk": UnitDisk()}
    for place, (name, surface) in enumerate(surfaces.items()):
        known = None
        samples = {"even": surface.points, "random": surface.random_points}
        samples["1:50"] = partial(uneven, surface)
        for turn, (sample, kind) in enumerate(product(samples, CLOUDS)):
            title = f"{name}, {sample}: {kind}"
            mild = kind in ("none", "outliers", "noise of 5 %")
            if (sample == "1:50" and not mild) or not take(title, place + 2 * turn):
                continue
            known = values_of(surface) if known is None else known
            points = samples[sample](2000, seed=seed)
            random = np.random.default_rng([seed, place, turn])
            faces = surface.triangulate(points).numpy()
            moved, own = CLOUDS[kind](random, points.numpy(), faces)
            yield Case(title, kind, moved, None, known / SCALES.get(kind, 1) ** 2, own)
