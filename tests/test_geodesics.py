"""Geodesic distance: over the given triangles, along curves, and over the surface through a cloud."""

import igl
import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import Delaunay

from torchlb import (
    InputError,
    LaplaceBeltrami,
    geodesic_distance,
    logarithmic_map,
    parallel_transport,
)
from torchlb.surfaces import Sphere, Torus, UnitDisk, limit_surface


def test_distances_are_those_over_the_given_triangles():
    """At the corners of a box, whose frames do not tell which neighbours follow each other around a corner."""
    box = trimesh.creation.box()
    lb = LaplaceBeltrami.from_cotangent(box.vertices, box.faces)
    every = np.arange(8)
    exact = igl.exact_geodesic(
        np.asarray(box.vertices), np.asarray(box.faces), every[:1], every[:0], every, every[:0]
    )
    distance = geodesic_distance(lb, 0)
    adjacent = torch.from_numpy(exact) <= 2**0.5 + 1e-9  # within a pair of triangles
    torch.testing.assert_close(distance[adjacent], torch.from_numpy(exact)[adjacent])
    assert int(adjacent.sum()) == 7


@pytest.mark.parametrize("build", ["mesh", "cloud", "stencil"])
def test_distances_on_a_sphere(build):
    vertices, faces = Sphere().mesh(1000)
    lb = {
        "mesh": lambda: LaplaceBeltrami.from_mesh(vertices, faces),
        "cloud": lambda: LaplaceBeltrami.from_points(vertices),
        "stencil": lambda: LaplaceBeltrami.from_mesh(vertices, faces, weak_form=False),
    }[build]()
    exact = torch.acos((vertices @ vertices[0]).clamp(-1, 1))
    assert (geodesic_distance(lb, 0) - exact).abs().mean() < 0.01 * exact.mean()


@pytest.mark.parametrize("source", [5, 11])
def test_behind_a_focus_distances_are_still_those_over_triangles(source):
    """Paths over a tip meet behind it; fronts were bent beyond that, to distances of 1e150."""
    control = trimesh.creation.icosphere(2)
    radius = np.random.default_rng(2).uniform(0.4, 1.6, (len(control.vertices), 1))
    corners = torch.from_numpy(control.vertices * radius)
    points, meshes = limit_surface(corners, torch.from_numpy(control.faces).long(), 3)
    lb, every = LaplaceBeltrami.from_mesh(points, meshes[3]), np.arange(len(points))
    one = every[source : source + 1]
    exact = igl.exact_geodesic(points.numpy(), meshes[3].numpy(), one, every[:0], every, every[:0])
    exact = torch.from_numpy(exact)
    assert (geodesic_distance(lb, source) - exact).abs().max() < 0.02 * exact.max()


def test_along_a_polygon():
    angle = 2 * torch.pi * torch.arange(40, dtype=torch.float64) / 40
    ends = torch.stack([torch.arange(40), (torch.arange(40) + 1) % 40], 1)
    lb = LaplaceBeltrami.from_mesh(torch.stack([angle.cos(), angle.sin()], 1), ends)
    side = 2 * torch.sin(torch.tensor(torch.pi / 40).double())
    steps = torch.minimum(torch.arange(40), 40 - torch.arange(40))
    torch.testing.assert_close(geodesic_distance(lb, 0), steps * side)


def test_each_source_has_a_column():
    """Those by themselves, to the bit: points, and parcels as masks or indices."""
    vertices, faces = Torus().mesh(500)
    lb = LaplaceBeltrami.from_cotangent(vertices, faces)
    parcels = [vertices[:, 0] > 1, [3, 5, 8], 7]
    for sources in ([0, 100, 450], torch.tensor([4, 9]), parcels, [12]):
        found = geodesic_distance(lb, sources, each=True)
        alone = torch.stack([geodesic_distance(lb, source) for source in sources], 1)
        assert torch.equal(found, alone)
    assert geodesic_distance(lb, range(500), each=True).diagonal().abs().max() == 0
    for wrong in ([], [[]], [500], torch.zeros(500, dtype=torch.bool), "all"):
        with pytest.raises(InputError, match="sources"):
            geodesic_distance(lb, wrong, each=True)


@pytest.mark.parametrize("build", [LaplaceBeltrami.from_mesh, LaplaceBeltrami.from_cotangent])
def test_distance_and_logarithm_are_accurate_to_second_order(build):
    """Of the sphere, beyond its equator; noise of a hundredth of the spacing leaves them of that size."""
    found = []
    for count, noise in ((400, 0.0), (1600, 0.0), (1600, 0.01)):
        vertices, faces = Sphere().mesh(count)
        torch.manual_seed(0)
        moved = vertices + noise * (4 * torch.pi / count) ** 0.5 * torch.randn_like(vertices)
        lb, source = build(moved, faces), vertices[0]
        cosine = (vertices @ source).clamp(-1, 1)
        angle = cosine.acos()
        away = torch.nn.functional.normalize(vertices - cosine[:, None] * source, dim=1)
        x, near = logarithmic_map(lb, 0), (angle < 2.5) & (angle > 0)
        radius = (geodesic_distance(lb, 0) - angle).abs()[near].mean()
        frame = torch.linalg.qr(lb.frames[0] - torch.outer(source, source @ lb.frames[0]))[0]
        turn = lb.frames[0].T @ frame
        place = (x @ turn - angle[:, None] * (away @ frame)).norm(dim=1)[near].mean()
        found.append((float(radius), float(place)))
    for one, two, noisy in zip(*found, strict=True):
        assert two < 1e-2
        assert one > 3 * two
        assert noisy < 4 * two


@pytest.mark.parametrize("mesh", [UnitDisk().mesh(800), "random"])
def test_no_triangle_has_a_shorter_path(mesh):
    """Distances in the plane are a fixed point: from the plane of no edge jk is a point nearer to the source."""
    vertices, faces = _disk_of_random_points(500) if mesh == "random" else mesh
    distance = geodesic_distance(LaplaceBeltrami.from_cotangent(vertices, faces), 0).numpy()
    points, faces = np.asarray(vertices), np.asarray(faces)
    for turn in range(3):
        i, j, k = np.roll(faces, turn, axis=1).T
        base, left, right = (
            np.linalg.norm(points[a] - points[b], axis=1) for a, b in ((j, k), (i, j), (i, k))
        )
        place = (left**2 - right**2 + base**2) / (2 * base)
        corner = place + 1j * np.sqrt(left**2 - place**2)
        along = (distance[j] ** 2 - distance[k] ** 2 + base**2) / (2 * base)
        depth = distance[j] ** 2 - along**2
        source = along - 1j * np.sqrt(np.maximum(depth, 0))
        straight = corner - source
        crossing = source.real - straight.real * source.imag / straight.imag
        met = (depth > 0) & (crossing >= 0) & (crossing <= base)
        assert met.sum() > len(faces) / 4
        assert (np.abs(straight) - distance[i])[met].min() > -1e-6 * base.mean()
        assert (distance[j] + left - distance[i]).min() > -1e-6 * base.mean()


@pytest.mark.parametrize("sources", [[], 300, [-1], torch.zeros(300, dtype=torch.bool)])
def test_sources_that_are_none(sources):
    lb = LaplaceBeltrami.from_cotangent(*Sphere().mesh(300))
    with pytest.raises(InputError, match="sources"):
        geodesic_distance(lb, sources)


def _disk_of_random_points(count):
    points = np.random.default_rng(0).uniform(-1, 1, (2 * count, 2))
    points = points[(points**2).sum(1) < 0.98][:count]
    angle = 2 * np.pi * np.arange(150) / 150
    points = np.concatenate([points, np.stack([np.cos(angle), np.sin(angle)], 1)])
    return torch.from_numpy(np.pad(points, ((0, 0), (0, 1)))), Delaunay(points).simplices


@pytest.mark.parametrize("mesh", [UnitDisk().mesh(500), UnitDisk().mesh(2000), "random"])
def test_distance_from_the_rim_of_a_disk(mesh):
    """That to the nearest vertex of the rim, never less; 1 − r, as far as the rim's spacing resolves it."""
    vertices, faces = _disk_of_random_points(2000) if mesh == "random" else mesh
    lb, radius = LaplaceBeltrami.from_cotangent(vertices, faces), vertices.norm(dim=1)
    rim = radius > 1 - 1e-9
    distance = geodesic_distance(lb, rim)
    exact, inside = torch.cdist(vertices, vertices[rim]).amin(1), radius < 0.95
    assert (distance / exact - 1)[inside].abs().mean() < 4e-3
    assert (distance / exact)[inside].min() > 1 - 1e-9
    assert (distance / (1 - radius) - 1)[inside].abs().mean() < 0.015


def test_distance_from_an_arc():
    """Half of the rim: a fan around each end, a converging front before it."""
    vertices, faces = UnitDisk().mesh(2000)
    radius = vertices.norm(dim=1)
    arc = (radius > 1 - 1e-9) & (vertices[:, 0] > 0)
    exact = torch.where(
        vertices[:, 0] > 0, 1 - radius, torch.cdist(vertices, vertices[arc]).amin(1)
    )
    distance = geodesic_distance(LaplaceBeltrami.from_cotangent(vertices, faces), arc)
    assert (distance - exact).abs().mean() < 0.005 * exact.mean()


@pytest.mark.parametrize("surface", [Sphere(), Torus(), "random", "cloud"])
def test_distance_to_several_points_is_the_least_of_those_to_each(surface):
    if surface == "random":
        lb = LaplaceBeltrami.from_cotangent(*_disk_of_random_points(1000))
    elif surface == "cloud":
        lb = LaplaceBeltrami.from_points(Sphere().points(1000))
    else:
        lb = LaplaceBeltrami.from_cotangent(*surface.mesh(1000))
    sources = range(10, 1000, 66)
    least = torch.stack([geodesic_distance(lb, source) for source in sources]).amin(0)
    distance = geodesic_distance(lb, sources)
    assert (distance - least).abs().mean() < 2e-3 * least.mean()


def test_distance_from_a_region():
    """Half a torus: exact distances on the polyhedron from its vertices."""
    vertices, faces = Torus().mesh(1000)
    inside = vertices[:, 0] > 0
    every, none = np.arange(len(vertices)), np.zeros(0, dtype=int)
    sources = inside.nonzero()[:, 0].numpy()
    exact = igl.exact_geodesic(vertices.numpy(), faces.numpy(), sources, none, every, none)
    distance = geodesic_distance(LaplaceBeltrami.from_cotangent(vertices, faces), inside)
    assert (distance[inside] == 0).all()
    assert np.abs(distance.numpy() - exact).mean() < 0.01 * exact.mean()


@pytest.mark.parametrize("build", ["mesh", "cloud"])
def test_every_point_has_normal_coordinates(build):
    """On a rough sheet, where paths cross edges between vertices that are both farther from the source.

    Some noisy points are joined to the surface by edges alone.
    """
    if build == "mesh":
        points, faces = _disk_of_random_points(300)
        rough = np.random.default_rng(1).normal(scale=0.15, size=len(points))
        lb = LaplaceBeltrami.from_cotangent(np.column_stack([points, rough]), faces)
    else:
        points = Torus().random_points(300, 1)
        noise = torch.randn(points.shape, generator=torch.Generator().manual_seed(1)).double()
        lb = LaplaceBeltrami.from_points(points + 0.04 * noise)
        assert len(lb.faces.unique()) < 300
    sources = list(range(0, 300, 3))
    x = torch.as_tensor(logarithmic_map(lb, sources))
    assert x.isfinite().all()
    distance = torch.as_tensor(geodesic_distance(lb, sources, each=True))
    torch.testing.assert_close(x.norm(dim=1), distance, rtol=0, atol=1e-9)
    moved = parallel_transport(lb, 0, torch.as_tensor(lb.frames)[0, :, 0])
    assert (moved.norm(dim=1) - 1).abs().max() < 1e-9


def test_paths_of_a_batch_stay_on_its_meshes():
    """Over a ridge of long triangles, where the edges of the linear pair are chords; in a batch with a cloud, too."""
    along = 4.0 * torch.arange(6).double()
    half = torch.full((5,), 0.5).double()
    ridge = torch.stack([along, 0 * along, 0 * along], 1)
    wings = [torch.stack([along[:5] + 2, side * half, half], 1) for side in (1, -1)]
    one = torch.arange(5)
    faces = [torch.stack([one, one + 1, one + 6], 1), torch.stack([one + 1, one, one + 11], 1)]
    lb = LaplaceBeltrami.from_mesh(torch.cat([ridge, *wings]), torch.cat(faces), order=1)
    expected = geodesic_distance(lb, 6)
    assert abs(expected[11] - 2**0.5) < 1e-3
    cloud = LaplaceBeltrami.from_points(Sphere().points(100))
    for batch in ([lb], [lb, cloud]):
        found = geodesic_distance(LaplaceBeltrami.batch(batch), 6)
        torch.testing.assert_close(found[:16], expected)
    batch = LaplaceBeltrami.batch([lb, cloud])
    torch.testing.assert_close(geodesic_distance(batch, 16)[16:], geodesic_distance(cloud, 0))
