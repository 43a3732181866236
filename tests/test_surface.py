"""A surface through a cloud: a manifold that faces out, with its own boundary; noise; and the weak pair on it."""

import warnings
from functools import cache

import numpy as np
import pytest
import torch
import trimesh

from torchlb import InputError, LaplaceBeltrami
from torchlb.cloud import doubts
from torchlb.cloud.doubts import warn_of_layers
from torchlb.cloud.manifold import boundary_loops, with_single_fans, wound_alike
from torchlb.cloud.surface import cloud_surface
from torchlb.geometry.complex import edges_of
from torchlb.surfaces import (
    Ellipsoid,
    Hemisphere,
    Sphere,
    StarShaped,
    Torus,
    UnitDisk,
    smooth_function,
)

CLOSED = {"sphere": Sphere(), "torus": Torus(), "ellipsoid": Ellipsoid(), "star": StarShaped()}


@cache
def cloud(name, kind, count=1500):
    return getattr(CLOSED[name], kind)(count)


@cache
def operator(name, kind, count=1500):
    return LaplaceBeltrami.from_points(cloud(name, kind, count))


@cache
def eigenvalues_of_a_fine_mesh(name):
    """λ_1 to λ_15."""
    mesh = CLOSED[name].mesh(4000)
    return LaplaceBeltrami.from_mesh(*mesh, order=5).eigenbasis(16).eigenvalues[1:]


@pytest.mark.parametrize("kind", ["points", "random_points"])
@pytest.mark.parametrize("name", CLOSED)
def test_closed_shapes_get_closed_surfaces(name, kind):
    """V − E + F = 2 − 2g, every edge has two faces that run along it in opposite directions, all points are reached."""
    points = cloud(name, kind)
    surface = cloud_surface(points)
    faces = surface.cells.numpy()
    edges = edges_of(faces, len(points))
    assert (edges.uses == 2).all()
    assert len(np.unique(faces)) == len(points)
    assert len(points) - len(edges.keys) + len(faces) == (0 if name == "torus" else 2)
    one, two = edges.twins
    assert (edges.ends[0][one] == edges.ends[1][two]).all()
    assert len(surface.stars) == 0
    assert surface.summary.components == 1
    assert surface.summary.noise == 0
    assert ((surface.normals * CLOSED[name].normals(points)).sum(1) > 0.9).all()


@pytest.mark.parametrize("kind", ["points", "random_points"])
@pytest.mark.parametrize("name", ["sphere", "torus"])
def test_eigenvalues_and_area_of_the_pair_of_a_cloud(name, kind):
    """λ_1 to λ_15 within 1e-3 (even: 1e-4) of those of a fine mesh."""
    shape, lb, exact = CLOSED[name], operator(name, kind), eigenvalues_of_a_fine_mesh(name)
    assert lb._has_weak_form
    assert lb.certificate is None
    error = (lb.eigenbasis(16).eigenvalues[1:] / exact - 1).abs().max()
    assert error < (1e-4 if kind == "points" else 1e-3)
    assert float(lb.mass.sum()) == pytest.approx(shape.area, rel=1e-3)


@pytest.mark.parametrize("shape", [Hemisphere(), UnitDisk()])
def test_a_boundary_stays_and_has_its_condition(shape):
    """Undeclared, declared or to be detected: the same points; Neumann eigenvalues within 1e-3, Dirichlet's too."""
    points = shape.points(1000)
    options = {} if points.shape[1] == 3 else {"dim": 2}
    mask = shape.boundary_mask(points)
    for boundary in (None, "detect", mask):
        lb = LaplaceBeltrami.from_points(points, boundary=boundary, **options)
        assert torch.equal(lb.boundary, mask)
        values = lb.eigenbasis(8).eigenvalues
        assert (values[1:] / shape.eigenvalues(8)[1:] - 1).abs().max() < 1e-3
        assert float(lb.mass.sum()) == pytest.approx(shape.area, rel=1e-3)
    held = LaplaceBeltrami.from_points(points, boundary=mask, condition="dirichlet", **options)
    exact = shape.eigenvalues(6, "dirichlet")
    assert (held.eigenbasis(6).eigenvalues / exact - 1).abs().max() < 1e-3


def test_a_hole_is_left_open_and_gaps_are_not():
    """A cap of radius 0.6 is missing of a random sphere: one loop, all around it."""
    points = Sphere().random_points(2000)
    points = points[points[:, 2] < np.cos(0.6)]
    surface = cloud_surface(points)
    (loop,) = boundary_loops(surface.cells.numpy(), len(points))
    assert (points[loop, 2] > np.cos(0.8)).all()
    area = 2 * np.pi * (1 + np.cos(0.6))
    assert float(LaplaceBeltrami.from_points(points).mass.sum()) == pytest.approx(area, rel=0.02)


def test_a_band_with_one_side_stays_one_band():
    """Möbius: one component, one boundary loop, Euler characteristic 0, and a seam that no turning of faces removes."""
    u = torch.linspace(0, 2 * torch.pi, 61)[:-1].double().repeat_interleave(9)
    v = torch.linspace(-0.3, 0.3, 9).double().repeat(60)
    ring = 1 + v * (u / 2).cos()
    points = torch.stack([ring * u.cos(), ring * u.sin(), v * (u / 2).sin()], 1)
    surface = cloud_surface(points)
    faces = surface.cells.numpy()
    edges = edges_of(faces, len(points))
    assert surface.summary.components == surface.summary.boundary_loops == 1
    assert len(points) - len(edges.keys) + len(faces) == 0
    assert wound_alike(points.numpy(), faces)[1].any()


def test_a_band_of_random_points_is_not_torn_at_its_seam():
    """Möbius, as wide as its radius: χ = 0, one boundary loop, no points apart that are neighbours."""
    generator = torch.Generator().manual_seed(4)
    u, v = torch.rand(2, 2500, generator=generator).double()
    u, v = 2 * torch.pi * u, v - 0.5
    ring = 1 + v * (u / 2).cos()
    points = torch.stack([ring * u.cos(), ring * u.sin(), v * (u / 2).sin()], 1)
    surface = cloud_surface(points)
    assert euler(surface.cells.numpy()) == 0
    assert surface.summary.boundary_loops == 1
    assert surface.summary.contacts == 0


@pytest.mark.parametrize("ratio", [30, 100])
def test_a_sudden_change_of_density_is_no_boundary(ratio):
    """A sphere, its cap z > 0.3 many times as dense as the rest; the half of it with x > 0 has its own boundary."""
    generator = torch.Generator().manual_seed(ratio)
    points = torch.nn.functional.normalize(torch.randn(20000, 3, generator=generator).double())
    chance = torch.rand(len(points), generator=generator)
    points = points[chance < torch.where(points[:, 2] > 0.3, 0.3, 0.3 / ratio)]
    assert euler(cloud_surface(points).cells.numpy()) == 2
    half = cloud_surface(points[points[:, 0] > 0])
    assert half.summary.boundary_loops == euler(half.cells.numpy()) == 1


def test_spheres_apart_stay_apart_and_an_outlier_joins_nothing():
    points = Sphere().points(600)
    two = torch.cat([points, points + torch.tensor([2.4, 0.0, 0.0])])
    assert cloud_surface(two).summary.components == 2
    lb = LaplaceBeltrami.from_points(torch.cat([two, torch.tensor([[1.2, 0.0, 1.0]]).double()]))
    assert (lb.surface.components, lb.surface.lone) == (2, 1)
    assert (lb.mass > 0).all()
    assert "lone points: 1" in str(lb.report)
    exact = torch.tensor([0, 0, 2, 2, 2, 2, 2, 2]).double()
    torch.testing.assert_close(lb.eigenbasis(8).eigenvalues, exact, rtol=1e-2, atol=1e-6)
    assert float(lb.mass.sum()) == pytest.approx(8 * np.pi, rel=5e-3)


def test_outliers_change_nothing():
    """A hundredth of the points anywhere around a torus: area and eigenvalues 1 to 8 within 3 %; nothing is said."""
    points, generator = cloud("torus", "points", 2000), torch.Generator().manual_seed(3)
    far = 2 * (2 * torch.rand(20, 3, generator=generator).double() - 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        lb = LaplaceBeltrami.from_points(torch.cat([points, far]))
    assert lb.surface.lone >= 12
    assert float(lb.mass.sum()) == pytest.approx(Torus().area, rel=0.03)
    exact = operator("torus", "points", 2000).eigenbasis(9).eigenvalues[1:]
    torch.testing.assert_close(lb.eigenbasis(9).eigenvalues[1:], exact, rtol=0.03, atol=0.0)


def test_outliers_side_by_side_change_nothing():
    """Each of two in mid-air has the other among its neighbours, which then leave the surface, too."""
    points = Ellipsoid((1.0, 0.8, 0.15)).points(2000)
    pair = torch.tensor([[1.2, 0.0, 0.35], [1.2, 0.15, 0.35]]).double()
    lb = LaplaceBeltrami.from_points(torch.cat([points, pair]))
    assert lb.surface.lone == 2
    exact = LaplaceBeltrami.from_points(points).eigenbasis(20).eigenvalues
    torch.testing.assert_close(lb.eigenbasis(20).eigenvalues, exact, rtol=1e-2, atol=1e-6)


def test_points_of_a_circle_are_no_surface():
    turn = 2 * np.pi * np.arange(60) / 60
    with pytest.raises(InputError, match=r"no surface goes through the 60.*dim=1"):
        LaplaceBeltrami.from_points(np.c_[np.cos(turn), np.sin(turn), 0 * turn])


def test_a_single_point_of_the_mask_inside_is_told():
    """One of 190 held at zero in the middle of a hemisphere raises its first eigenvalue by 9 %."""
    points = Hemisphere().points(1000)
    rim = points[:, 2] < 1e-9
    inside = int((points[:, 2] - 0.5).abs().argmin())
    with pytest.warns(UserWarning, match=rf"boundary: 1 of its points \({inside}\) lie inside"):
        LaplaceBeltrami.from_points(
            points, condition="dirichlet", boundary=rim.index_fill(0, torch.tensor(inside), True)
        )


@pytest.mark.parametrize("x", [1.3, 2.0])
def test_an_outlier_past_the_end_of_a_limb_changes_nothing(x):
    """It lies in the plane of its neighbours, as far from them as five and more of their spacings; λ fell by 70 %."""
    points = Ellipsoid((1.0, 0.2, 0.05)).points(1000)
    lb = LaplaceBeltrami.from_points(torch.cat([points, torch.tensor([[x, 0.0, 0.0]]).double()]))
    assert lb.surface.lone == 1
    exact = LaplaceBeltrami.from_points(points).eigenbasis(8).eigenvalues
    torch.testing.assert_close(lb.eigenbasis(8).eigenvalues, exact, rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize("seed", [2, 9])
def test_outliers_that_lie_in_one_plane_by_chance_are_found(seed):
    """Of sixty around a torus, of which nine are nearly in a plane here and there, the area is 2 % off at most."""
    points, generator = Torus().points(2000), torch.Generator().manual_seed(seed)
    far = 3 * (2 * torch.rand(60, 3, generator=generator).double() - 1)
    surface = cloud_surface(torch.cat([points, far]))
    away = torch.cdist(far, points).amin(1) > 0.3
    assert surface.lone[2000:][away].all()
    assert not surface.lone[:2000].any()
    lb = LaplaceBeltrami.from_points(torch.cat([points, far]))
    assert float(lb.mass.sum()) == pytest.approx(Torus().area, rel=0.02)


@pytest.mark.parametrize("seed", [0, 4])
def test_a_surface_ends_at_its_outermost_points_where_they_are_sparse(seed):
    """Of a hemisphere with 50 times as many points at one end, the triangles seen from its axis have the right area."""
    points = Hemisphere().random_points(24000, seed)
    along = (points[:, 0] + 1) / 2
    chance = torch.rand(len(points), generator=torch.Generator().manual_seed(seed))
    points = points[chance < 50.0**-along][:2000]
    lb, mesh = (
        LaplaceBeltrami.from_points(points),
        LaplaceBeltrami.from_mesh(points, Hemisphere().triangulate(points)),
    )
    assert float(lb.mass.sum() / mesh.mass.sum()) == pytest.approx(1, abs=0.01)
    right, found = mesh.eigenbasis(20).eigenvalues[1:], lb.eigenbasis(20).eigenvalues[1:]
    torch.testing.assert_close(found, right, rtol=0.05, atol=0.0)


@pytest.mark.parametrize("seed", [3, 4])
def test_outliers_far_away_change_nothing(seed):
    """A fiftieth of the points in a box ten times as wide as the torus; they held most of the area."""
    points, generator = Torus().points(1000), torch.Generator().manual_seed(seed)
    far = 20 * (2 * torch.rand(20, 3, generator=generator).double() - 1)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        lb = LaplaceBeltrami.from_points(torch.cat([points, far]), order=2)
    assert lb.surface.lone == 20
    assert float(lb.mass.sum()) == pytest.approx(Torus().area, rel=1e-3)
    exact = LaplaceBeltrami.from_points(points, order=2).eigenbasis(6).eigenvalues
    torch.testing.assert_close(lb.eigenbasis(6).eigenvalues, exact, rtol=1e-2, atol=1e-6)


def depth_image(share):
    """A ball of radius 0.5 at distance 2 before a wall at 3, and a share of the pixels at its edge in between."""
    rng = np.random.default_rng(1)
    u, v = np.meshgrid((np.arange(80) - 40) / 60, (np.arange(60) - 30) / 60)
    ray = np.stack([u, v, np.ones_like(u)], -1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    near = 2 * ray[..., 2]
    inside = near**2 - 3.75
    depth = np.where(inside > 0, near - np.sqrt(np.maximum(inside, 0)), 3 / ray[..., 2])
    edge = (np.abs(np.sqrt(np.maximum(4 - near**2, 0)) - 0.5) < 0.04) & (
        rng.random(u.shape) < share
    )
    return (ray * np.where(edge, 2 + rng.random(u.shape), depth)[..., None]).reshape(-1, 3)


def test_flying_pixels_are_told_and_clean_depth_images_are_not():
    """Ball and wall are two parts: as many eigenvalues are zero, or a warning names the place between them."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        lb = LaplaceBeltrami.from_points(depth_image(0), order=1)
    assert lb.surface.components == 2
    assert float(lb.mass.sum()) == pytest.approx(10.7, rel=0.02)
    with pytest.warns(UserWarning, match=r"may join what only touches .*\.") as caught:
        LaplaceBeltrami.from_points(depth_image(0.2), order=1)
    assert "most of them near (" in str(caught[0].message)


@pytest.mark.parametrize("gap", [3, 4, 7])
def test_open_sheets_that_are_joined_are_told(gap):
    """Two squares of 1,600 random points, so many spacings apart, have two zero eigenvalues, or a warning."""
    rng = np.random.default_rng(0)
    one, two = (np.c_[rng.random((1600, 2)), np.full(1600, h)] for h in (0, gap / 40))
    with pytest.warns(UserWarning, match="wall up a gap between parts"):
        LaplaceBeltrami.from_points(np.r_[one, two], order=1)


@pytest.mark.parametrize("seed", range(3))
def test_handles_through_a_thin_wall_are_told(seed):
    """Random points of a cup, whose wall is 1.6 spacings thick: χ is 2, or a warning names the place."""
    profile = [(0, 0), (1, 0), (1, 2), (0.86, 2), (0.86, 0.14), (0, 0.14)]
    cup = trimesh.creation.revolve(np.array(profile), sections=64)
    points = np.array(trimesh.sample.sample_surface(cup, 3000, seed=seed)[0])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        lb = LaplaceBeltrami.from_points(points, order=1)
    told = any("may join what only touches" in str(warning.message) for warning in caught)
    assert told or euler(lb.faces.numpy()) == 2


def test_change_by_the_middle_of_a_strip_is_its_share_of_energy(monkeypatch):
    """Modes cos(kπx) of a strip; of k² ∫ sin²(kπx) the part from a to b has b − a − (sin 2kπb − sin 2kπa)/2kπ."""
    start, end = 0.45, 0.55
    x = torch.linspace(0, 1, 161).double()
    points = torch.cartesian_prod(x, x[:10], torch.zeros(1).double())

    def within(surface, faces):
        middle = surface.points.numpy()[faces, 0].mean(1)
        return (middle > start) & (middle < end)

    monkeypatch.setattr(doubts, "in_doubt", within)
    change, _ = doubts.spectral_change(cloud_surface(points))
    turn = 2 * np.pi * np.arange(1, 11)
    rest = 1 - (end - start) + (np.sin(turn * end) - np.sin(turn * start)) / turn
    assert change == pytest.approx(1 - rest.min() / rest.max(), rel=0.1)


@pytest.mark.parametrize("seed", range(2))
def test_noise_on_a_box_that_leaves_its_eigenvalues_is_not_warned_of(seed):
    """Edges across creases are steep where there is noise; λ_1 of 1 × 1.4 × 2 stays, and nothing is said."""
    box = trimesh.creation.box((1, 1.4, 2))
    points, face = trimesh.sample.sample_surface(box, 2000, seed=seed)
    height = 0.2 * (box.area / 2000) ** 0.5 * np.random.default_rng(seed).normal(size=(2000, 1))
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        LaplaceBeltrami.from_points(points + height * box.face_normals[face], order=1)


@pytest.mark.parametrize("shape", [Sphere(), Torus(), Hemisphere()])
def test_random_clouds_of_smooth_shapes_are_not_warned_of(shape):
    rng = np.random.default_rng(5)
    points = shape.points(2000) if isinstance(shape, Hemisphere) else shape.random_points(2000)
    spacing = float((shape.area / 2000) ** 0.5)
    for noise in (0.0, 0.2):
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            moved = points + noise * spacing * torch.from_numpy(rng.normal(size=points.shape))
            LaplaceBeltrami.from_points(moved, order=1)


@pytest.mark.parametrize("rows", [20, 24])
def test_a_grid_wider_one_way_than_the_other_is_not_warned_of(rows):
    """The vertices of a torus, two to six times as far apart around its axis as around its tube; λ_1 within 1 %."""
    u, v = (2 * np.pi * torch.arange(n).double() / n for n in (rows, 48))
    u, v = torch.cartesian_prod(u, v).unbind(1)
    across = 1 + 0.5 * v.cos()
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        lb = LaplaceBeltrami.from_points(
            torch.stack([across * u.cos(), across * u.sin(), 0.5 * v.sin()], 1)
        )
    fine = operator("torus", "points", 2000)
    found, right = (float(each.eigenbasis(9).eigenvalues[1]) for each in (lb, fine))
    assert found == pytest.approx(right, rel=1e-2)


@pytest.mark.parametrize("size", [20, 24, 30])
def test_rings_far_apart_are_one_tube(size):
    """A capsule by rings up to six spacings apart: closed, of its area but for the chords, facing out."""
    axis = torch.tensor([0.0, 0.0, 1.0]).double()

    def ring(radius, height, twist=0.0):
        angle = 2 * torch.pi * torch.arange(size).double() / size + twist
        flat = torch.stack([angle.cos(), angle.sin(), torch.zeros_like(angle)], 1)
        return radius * flat + height * axis

    rings = [ring(1, height, 0.3 * k) for k, height in enumerate(np.linspace(0, 8, 7))]
    for end, side in ((0.0, -1.0), (8.0, 1.0)):
        for tilt in (0.4, 0.8, 1.2):
            rings.append(ring(np.cos(tilt), end + side * np.sin(tilt)))
        rings.append(((end + side) * axis)[None])
    points = torch.cat(rings)
    surface = cloud_surface(points)
    edges = edges_of(surface.cells.numpy(), len(points))
    assert (edges.uses == 2).all()
    assert len(points) - len(edges.keys) + len(surface.cells) == 2
    assert surface.summary.contacts == 0
    out = points - points[:, 2:].clamp(0, 8) * axis
    assert ((surface.normals * out).sum(1) > 0.9).all()
    a, b, c = points[surface.cells].unbind(1)
    area = float(torch.linalg.cross(b - a, c - a).norm(dim=1).sum() / 2)
    assert area == pytest.approx(2 * np.pi * 8 + 4 * np.pi, rel=0.02)


def test_circles_of_latitude_are_one_sphere():
    """A quarter of the points on rings much closer in them than to the next one; four on a circle everywhere.

    In any order: of 30 points on the circle around a pole, one layer of triangles is taken.
    """
    polar = torch.pi * (torch.arange(30).double() + 0.5) / 30
    angle = 2 * torch.pi * torch.arange(30).double() / 30
    polar, angle = (t.flatten() for t in torch.meshgrid(polar, angle, indexing="ij"))
    points = torch.stack([polar.sin() * angle.cos(), polar.sin() * angle.sin(), polar.cos()], 1)
    for seed in (40, 85, 101):
        order = torch.randperm(len(points), generator=torch.Generator().manual_seed(seed))
        found = cloud_surface(points[order])
        assert (len(found.cells), found.summary.boundary_loops) == (2 * len(points) - 4, 0)
    lb = LaplaceBeltrami.from_points(points)
    assert len(lb.faces) == 2 * len(points) - 4
    assert (edges_of(lb.faces.numpy(), len(points)).uses == 2).all()
    values = lb.eigenbasis(9).eigenvalues
    expected = torch.tensor([0.0, 2, 2, 2, 6, 6, 6, 6, 6], dtype=values.dtype)
    torch.testing.assert_close(values, expected, rtol=1e-3, atol=1e-9)


def test_subdivided_faces_of_a_box_are_its_surface():
    """Flat sides where many points are on one circle or sphere."""
    box = trimesh.creation.box().subdivide().subdivide().subdivide().subdivide()
    lb = LaplaceBeltrami.from_points(torch.tensor(box.vertices.copy()))
    assert float(lb.mass.sum()) == pytest.approx(6, rel=0.02)
    values = lb.eigenbasis(4).eigenvalues
    assert ((values[1:] - 4.16).abs() < 0.2).all()


def test_walls_of_cavities_face_into_them():
    """Four spheres, three of them one in the other: normals out of the solid, so the second has them inward."""
    sphere, shift = Sphere(), torch.tensor([3.0, 0.0, 0.0]).double()
    points = torch.cat([sphere.points(1500), 0.6 * sphere.points(700), 0.3 * sphere.points(300)])
    points = torch.cat([points, 0.2 * sphere.points(200) + shift])
    away = points - shift * (torch.arange(2700) >= 2500)[:, None]
    side = ((cloud_surface(points).normals * away).sum(1) > 0).long()
    assert [sorted(set(part.tolist())) for part in side.split([1500, 700, 300, 200])] == [
        [1],
        [0],
        [1],
        [1],
    ]


@pytest.mark.parametrize("kind", ["points", "random_points"])
@pytest.mark.parametrize("shape", [Sphere(), Torus(), Hemisphere()])
def test_normals_point_out(shape, kind):
    """All of them; those of an open shape to one side."""
    points = getattr(shape, kind)(1000)
    found = (cloud_surface(points).normals * shape.normals(points)).sum(1)
    if shape.__class__ is Hemisphere:
        found = found * found.mean().sign()  # out, or up
    assert (found > 0).all()


def row_of_ellipsoids(size, apart, seed):
    """Three of so many random points each, their centres `apart`; and their normals, of any length."""
    points = torch.randn(3 * size, 3, generator=torch.Generator().manual_seed(seed)).double()
    points = points / points.norm(dim=1, keepdim=True)
    axes = torch.tensor([1.0, 1.0, 1.5], dtype=torch.float64)
    places = points * axes
    places[:, 0] += apart * (torch.arange(3 * size) % 3)
    return places, points / axes


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("size", [60, 100])
def test_what_touches_does_not_turn_the_other(seed, size):
    """Three ellipsoids of random points in a row: 5 % of the normals on the wrong side at most, by a tree a half."""
    points, normals = row_of_ellipsoids(size, 2.0, seed)
    wrong = (cloud_surface(points).normals * normals).sum(1) < 0
    assert wrong.double().mean() <= 0.05


@pytest.mark.parametrize("waves", [3.0, 6.0, 20.0])
def test_an_open_surface_has_two_sides_of_its_own(waves):
    """A sheet that bends both ways has all its normals on one side, though its convex hull is on both; and no gap."""
    points = torch.rand(3000, 3, generator=torch.Generator().manual_seed(0)).double()
    points[:, 2] = 0.1 * (waves * points[:, 0]).sin()
    slope = 0.1 * waves * (waves * points[:, :1]).cos()
    normals = torch.cat([-slope, 0 * slope, torch.ones_like(slope)], 1)
    surface = cloud_surface(points)
    assert ((surface.normals * normals).sum(1) > 0).double().mean() > 0.99
    assert surface.summary.reached >= 2999
    assert surface.summary.boundary_loops == 1
    assert euler(surface.cells.numpy()) == 1


def euler(faces):
    edges = edges_of(faces, int(faces.max()) + 1)
    return len(np.unique(faces)) - len(edges.keys) + len(faces)


@pytest.mark.parametrize("seed", range(3))
def test_bodies_that_nearly_touch_are_closed_each_for_itself(seed):
    """Three ellipsoids of random points in a row, a third of a spacing apart: no wall and no handle between them."""
    surface = cloud_surface(row_of_ellipsoids(1000, 2.03, seed)[0])
    assert surface.summary.reached == 3000
    assert surface.summary.boundary_loops == 0
    assert euler(surface.cells.numpy()) >= 4


@pytest.mark.parametrize(("radius", "seed"), [(0.05, 3), (0.06, 0), (0.08, 1)])
def test_a_mouth_between_lips_that_touch_stays_open(radius, seed):
    """A bag in a sphere, joined to it by a neck as narrow as the spacing: one piece, without local stars."""
    rng = np.random.default_rng(seed)
    sphere, bag = (x / np.linalg.norm(x, axis=1)[:, None] for x in rng.normal(size=(2, 1470, 3)))
    bag = 0.6 * bag[:529] + [0, 0, 0.3]
    parts = [x[(np.hypot(x[:, 0], x[:, 1]) > radius) | (x[:, 2] < 0.5)] for x in (sphere, bag)]
    turn, height = 2 * np.pi * rng.random(8), 0.9 + 0.1 * rng.random(8)
    neck = np.stack([radius * np.cos(turn), radius * np.sin(turn), height], 1)
    surface = cloud_surface(torch.from_numpy(np.concatenate([*parts, neck])))
    assert surface.summary.components == 1
    assert surface.summary.stars == 0


def test_normals_that_are_given_keep_their_side():
    """That of most of them, which the faces have, too; 200 that face the other way are turned."""
    points = Sphere().points(1000)
    given = torch.where(points[:, 2:] > 0.6, points, -points)
    with pytest.warns(UserWarning, match="200 face the other way"):
        surface = cloud_surface(points, normals=given)
    assert ((surface.normals * -points).sum(1) > 0.9).all()
    a, b, c = points[surface.cells].unbind(1)
    assert ((torch.linalg.cross(b - a, c - a) * a).sum(1) < 0).all()


def test_where_sheets_touch_is_said():
    """Two spheres a third of a spacing apart: one component, and a place between them; the same in a warning."""
    points = Sphere().points(1000)
    gap = torch.tensor([2.0 + 0.33 * (4 * np.pi / 1000) ** 0.5, 0.0, 0.0]).double()
    pair = torch.cat([points, points + gap]) @ torch.linalg.qr(torch.eye(3).double())[0]
    summary = cloud_surface(pair).summary
    assert summary.components == 1
    assert summary.contacts > 0
    assert torch.tensor(summary.places[0]).numpy() == pytest.approx(pair.mean(0).numpy(), abs=0.1)
    assert "nearest to one of another sheet" in str(summary)
    assert cloud_surface(points).summary.contacts == 0


def test_each_place_where_sheets_touch_is_said_once():
    """A row of five spheres: the four places between them, none in pieces."""
    points = Sphere().points(1000)
    gap = 2.0 + 0.33 * (4 * np.pi / 1000) ** 0.5
    row = torch.cat([points + torch.tensor([k * gap, 0.0, 0.0]) for k in range(5)])
    places = np.array(cloud_surface(row).summary.places)
    assert len(places) == 4
    assert np.sort(places[:, 0]) == pytest.approx(gap * np.array([0.5, 1.5, 2.5, 3.5]), abs=0.1)


@pytest.mark.parametrize("name", ["sphere", "torus"])
def test_noise_is_seen_and_smoothed(name):
    """10 % of the spacing: σ within a factor of 1.5, eigenvalues 1 to 8 within 1 %, the area too; points stay."""
    shape, points = CLOSED[name], cloud(name, "points")
    share = 0.1 * float((shape.area / len(points)) ** 0.5)
    noise = torch.randn(points.shape, generator=torch.Generator().manual_seed(1)).double()
    noisy = points + share * noise
    lb = LaplaceBeltrami.from_points(noisy)
    assert share / 1.5 < lb.surface.noise < 1.5 * share
    assert torch.equal(lb.points, noisy)
    exact = operator(name, "points").eigenbasis(9).eigenvalues[1:]
    assert (lb.eigenbasis(9).eigenvalues[1:] / exact - 1).abs().max() < 0.01
    assert float(lb.mass.sum()) == pytest.approx(shape.area, rel=0.01)


def test_half_the_spacing_of_noise_is_named():
    points = cloud("sphere", "points")
    noise = torch.randn(points.shape, generator=torch.Generator().manual_seed(1)).double()
    with pytest.warns(UserWarning, match=r"too coarse or noisy .* \(\d+, "):
        lb = LaplaceBeltrami.from_points(points + 0.05 * noise)
    assert (lb.mass > 0).all()
    stiffness, mass = (m.to_dense() for m in (lb.stiffness, lb.mass_matrix))
    assert torch.equal(stiffness, stiffness.mT)
    assert torch.linalg.eigvalsh(mass)[0] > 0


def test_faces_are_there_and_travel():
    """Of the surface through a cloud, of a mesh as given; through batches and states."""
    lb = operator("torus", "random_points")
    vertices, faces = Sphere().mesh(200)
    mesh = LaplaceBeltrami.from_mesh(vertices, faces)
    assert torch.equal(mesh.faces, faces)
    assert mesh.surface is None
    batch = LaplaceBeltrami.batch([lb, mesh])
    assert torch.equal(batch.faces, torch.cat([lb.faces, faces + lb.num_points]))
    first, second = batch.unbatch()
    assert torch.equal(first.faces, lb.faces)
    assert first.surface == lb.surface
    assert torch.equal(second.faces, faces)
    other = LaplaceBeltrami()
    other.load_state_dict(lb.state_dict())
    assert torch.equal(other.faces, lb.faces)
    assert other.surface == lb.surface


def test_the_surface_turns_with_the_points_and_follows_the_unit():
    points = cloud("star", "random_points")
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(2)).double())[
        0
    ]
    turn = turn * turn.det()

    def corners(surface):
        return {tuple(sorted(face)) for face in surface.cells.tolist()}

    plain = corners(cloud_surface(points))
    assert corners(cloud_surface(1024 * points @ turn.T)) == plain


def test_coplanar_points_and_those_on_a_line():
    side = torch.linspace(0, 1, 20).double()
    flat = torch.nn.functional.pad(torch.cartesian_prod(side, side), (0, 1))
    lb = LaplaceBeltrami.from_points(flat @ torch.linalg.qr(torch.randn(3, 3).double())[0])
    assert float(lb.mass.sum()) == pytest.approx(1.0)
    assert lb.eigenbasis(3).eigenvalues[1:] == pytest.approx(np.pi**2, rel=1e-3)
    with pytest.raises(InputError, match="on a line"):
        LaplaceBeltrami.from_points(flat[:20])


def test_a_fan_for_each_point():
    """Two triangles that touch in a point are two fans; the larger one stays."""
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [0, 4, 5]])
    assert with_single_fans(faces, 6).tolist() == faces[:3].tolist()


def test_fans_that_vanish_leave_the_others():
    """Round a ring of five points each has two fans of which one goes, until none is left but the face beside them."""
    one = [[i, (i + 1) % 5, 5 + i] for i in range(5)]
    two = [[i, 5 + i, (i + 2) % 5] for i in range(5)]
    faces = np.array([*one, *two, [10, 11, 12]])
    assert with_single_fans(faces, 13).tolist() == [[10, 11, 12]]
    generator = np.random.default_rng(0)
    for count in range(6, 14):  # random ones, beside what leaves all fans in each round
        soup = np.unique(np.sort(generator.integers(0, count, (3 * count, 3)), axis=1), axis=0)
        soup = soup[(np.diff(soup, axis=1) > 0).all(1)]
        left = with_single_fans(soup, count)
        assert len(with_single_fans(left, count)) == len(left)


def grid_of(rows, columns):
    """A lattice of the unit square in a plane of R³."""
    x, y = np.meshgrid(np.linspace(0, 1, columns), np.linspace(0, 1, rows))
    return np.c_[x.ravel(), y.ravel(), 0 * x.ravel()]


def test_rings_of_a_scan_are_one_surface():
    """A sphere by 100 meridians and 48 circles of latitude, whose nearest points near a pole lie on one ring."""
    theta, phi = np.meshgrid(
        np.linspace(0, np.pi, 50)[1:-1], np.linspace(0, 2 * np.pi, 100, endpoint=False)
    )
    points = np.c_[
        (np.sin(theta) * np.cos(phi)).ravel(),
        (np.sin(theta) * np.sin(phi)).ravel(),
        np.cos(theta).ravel(),
    ]
    lb = LaplaceBeltrami.from_points(np.r_[points, [[0, 0, 1], [0, 0, -1]]])
    exact = torch.tensor([0, 2, 2, 2, 6]).double()
    torch.testing.assert_close(lb.eigenbasis(5).eigenvalues, exact, rtol=1e-3, atol=1e-9)


def test_rings_far_denser_than_apart_are_one_sphere():
    """16 circles of 200 points, up to 64 times as far apart as those, and none at the poles: χ = 2."""
    polar = torch.pi * (torch.arange(16).double() + 0.5) / 16
    angle = 2 * torch.pi * torch.arange(200).double() / 200
    t, phi = (x.flatten() for x in torch.meshgrid(polar, angle, indexing="ij"))
    points = torch.stack([t.sin() * phi.cos(), t.sin() * phi.sin(), t.cos()], 1)
    surface = cloud_surface(points)
    assert euler(surface.cells.numpy()) == 2
    assert surface.summary.reached == len(points)
    assert surface.summary.components == 1


def test_rings_in_a_plane_have_the_normal_of_the_plane():
    """Eight times denser along one direction: eigenvalues are those of the square."""
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    lb = LaplaceBeltrami.from_points(grid_of(20, 160) @ turn.T)
    torch.testing.assert_close(
        (lb.normals @ torch.from_numpy(turn[:, 2])).abs(),
        torch.ones(3200).double(),
        rtol=1e-9,
        atol=0.0,
    )
    exact = np.pi**2 * torch.tensor([0, 1, 1, 2]).double()
    torch.testing.assert_close(lb.eigenbasis(4).eigenvalues, exact, rtol=1e-3, atol=1e-9)


def test_walls_between_parts_are_told():
    """Two plates five spacings apart are closed to a box; one plate alone is not warned of."""
    plate = grid_of(30, 30)
    with pytest.warns(UserWarning, match="wall up a gap"):
        LaplaceBeltrami.from_points(np.vstack([plate, plate + np.array([0, 0, 5 / 29])]), order=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        LaplaceBeltrami.from_points(plate, order=1)


def test_a_declared_boundary_that_was_closed_is_told():
    """A hole of four spacings with its rim in the mask."""
    points = grid_of(30, 30)
    distance = np.hypot(points[:, 0] - 0.5, points[:, 1] - 0.5) * 29
    points, distance = points[distance > 1.6], distance[distance > 1.6]
    edge = (points[:, :2] < 1e-9).any(1) | (points[:, :2] > 1 - 1e-9).any(1)
    with pytest.warns(UserWarning, match="lie inside the shape"):
        LaplaceBeltrami.from_points(
            points, order=1, boundary=torch.from_numpy(edge | (distance < 2.6))
        )


def test_values_at_lone_points_are_in_no_other_row():
    """Δf and ∇f of the surface are those without the points in mid-air, whatever f is there."""
    points = Torus().points(1000)
    stray = 2.0 * torch.tensor([[1, 0, 1], [-1, 0, 1], [0, 1, -1], [0, -1, -1], [0, 0, 1]]).double()
    f = smooth_function(points)
    alone, with_stray = (
        LaplaceBeltrami.from_points(points),
        LaplaceBeltrami.from_points(torch.cat([points, stray])),
    )
    assert with_stray.surface.lone == 5
    everywhere = torch.cat([f, torch.full((5,), 1e3, dtype=torch.float64)])
    torch.testing.assert_close(with_stray(everywhere)[:1000], alone(f), rtol=0.0, atol=1e-2)


def _plate(thickness, bent, seed):
    """900 points on either side of a plate, even or at random, its thickness in spacings."""
    generator = np.random.default_rng(seed)
    x, y = (np.stack(np.meshgrid(np.arange(30), np.arange(30))).reshape(2, -1) + 0.5) / 30
    sides = [np.stack([x, y], 1)] * 2 if seed == 0 else list(generator.random((2, 900, 2)))
    flat = np.concatenate(
        [np.c_[side, np.full(900, z)] for side, z in zip(sides, (0, thickness / 30), strict=True)]
    )
    flat[:, 2] += bent * flat[:, 0] ** 2
    return torch.from_numpy(flat)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("thickness", [0.3, 0.8, 1.2])
def test_a_thin_plate_is_told(thickness, seed):
    for bent in (0, 0.5):
        with pytest.warns(UserWarning, match="in two layers about a spacing apart or closer"):
            warn_of_layers(_plate(thickness, bent, seed))


def test_a_thin_shell_is_told_by_the_operator():
    inner = Sphere().random_points(600, seed=1) * (1 - 0.5 * (4 * np.pi / 600) ** 0.5)
    with pytest.warns(UserWarning, match="two layers"):
        LaplaceBeltrami.from_points(torch.cat([Sphere().random_points(600), inner]))


@pytest.mark.parametrize("noise", [0, 0.1, 0.3, 0.5])  # of the spacing
@pytest.mark.parametrize("name", CLOSED)
def test_noise_is_not_taken_for_two_layers(name, noise):
    """A symmetric law with one mode has a kurtosis of 9/5 or more, the normal law 3."""
    warnings.simplefilter("error")
    for kind in ("points", "random_points"):
        points = cloud(name, kind)
        spacing = (4 * np.pi / len(points)) ** 0.5
        shift = torch.randn(points.shape, generator=torch.Generator().manual_seed(3)).double()
        warn_of_layers(points + noise * spacing * shift)
    for gap in (3, 6):
        warn_of_layers(_plate(gap, 0, 1))
