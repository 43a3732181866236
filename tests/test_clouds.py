"""Curves and solids as clouds, and reconstructions of the user's (`torchlb.cloud.reconstruct`)."""

import warnings
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull, Delaunay

from test_simplices import cube, trefoil, worst
from torchlb import InputError, LaplaceBeltrami, heat_flow, operator_key, poisson_solve
from torchlb.cloud import Complex, reconstruct
from torchlb.linalg.csr import tensors_of
from torchlb.surfaces import CliffordTorus, Sphere

PI = np.pi


def chain(points, **given):
    """The segments of a cloud, as sorted pairs."""
    return {tuple(sorted(cell)) for cell in reconstruct(points, dim=1, **given).cells.tolist()}


def in_turn(*counts):
    """Segments of closed chains of so many points."""
    starts = np.cumsum([0, *counts])
    rings = [[*range(a, b), a] for a, b in pairwise(starts)]
    return {tuple(sorted(pair)) for ring in rings for pair in pairwise(ring)}


def circles(gap, angles):
    """Two unit circles that pass each other at so many mean spacings."""
    one, two = (np.stack([np.cos(a), np.sin(a)], 1) for a in angles)
    return np.concatenate([one, two + np.array([2 + gap * 2 * PI / len(one), 0])])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("count", [100, 400])
def test_random_points_of_a_knot_are_its_chain(count, seed):
    """And the operator that of its segments, to rounding."""
    order = np.random.default_rng(seed).permutation(count)
    t = np.sort(np.random.default_rng(seed).random(count)) * 2 * PI
    x, y = np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t)
    points = np.stack([x, y, -np.sin(3 * t)], 1)
    assert chain(points) == in_turn(count)
    number = np.arange(count)
    segments = np.argsort(order)[np.stack([number, (number + 1) % count], 1)]
    lb = LaplaceBeltrami.from_points(points[order], dim=1)
    mesh = LaplaceBeltrami.from_mesh(points[order], segments)
    assert (lb.source, lb._has_weak_form, lb.certificate) == ("points", True, None)
    torch.testing.assert_close(lb.eigenbasis(8).eigenvalues, mesh.eigenbasis(8).eigenvalues)
    torch.testing.assert_close(lb.mass, mesh.mass)


@pytest.mark.parametrize(("count", "bound"), [(100, 1e-5), (200, 1e-6), (400, 1e-7)])
def test_eigenvalues_of_a_knot_by_its_points(count, bound):
    """(2πj/L)², each twice."""
    points, _, length = trefoil(count)
    exact = [(2 * PI * ((j + 1) // 2) / length) ** 2 for j in range(10)]
    assert worst(LaplaceBeltrami.from_points(points, dim=1), exact) < bound


def test_an_arc_is_open_and_a_random_circle_closed():
    """(πj/L)² of an arc of 300° of random points; gaps of random points on a circle are no ends."""
    rng = np.random.default_rng(0)
    t = np.sort(np.concatenate([[0, 1], rng.random(198)])) * 5 / 3 * PI
    lb = LaplaceBeltrami.from_points(np.stack([np.cos(t), np.sin(t)], 1))
    assert lb.boundary.nonzero()[:, 0].tolist() == [0, 199]
    assert worst(lb, (0.6 * np.arange(6)) ** 2) < 1e-3
    for _ in range(20):
        t = np.sort(rng.random(300)) * 2 * PI
        assert chain(np.stack([np.cos(t), np.sin(t)], 1)) == in_turn(300)


def test_points_on_a_line_and_in_more_dimensions():
    """(πj)² by points of R¹; the same segments wherever a curve lies."""
    x = torch.rand(60, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    x = torch.cat([torch.zeros(1, 1), torch.ones(1, 1), x]).double()
    lb = LaplaceBeltrami.from_points(x)
    assert worst(lb, (PI * np.arange(4)) ** 2) < 1e-2
    knot, _, _ = trefoil(80)
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((5, 3)))[0]
    assert chain(knot @ turn.T) == chain(knot) == in_turn(80)


@pytest.mark.parametrize("gap", [2, 3])
def test_curves_that_pass_each_other_stay_apart(gap):
    """At two mean spacings, evenly or randomly sampled: λ = l², twice each of two circles."""
    even = 2 * PI * np.arange(300) / 300
    rng = np.random.default_rng(6)
    for angles in ([even, even], np.sort(rng.random((2, 300))) * 2 * PI):
        points = circles(gap, angles)
        assert chain(points) == in_turn(300, 300)
        exact = np.repeat([0, 1, 1, 4, 4], 2)
        found = LaplaceBeltrami.from_points(points).eigenbasis(10).eigenvalues.numpy()
        np.testing.assert_allclose(found, exact, rtol=1e-4, atol=1e-9)


def test_open_curves_side_by_side_are_two():
    x = np.linspace(0, 1, 100)
    points = np.stack([np.tile(x, 2), np.repeat([0, 2 / 99], 100)], 1)
    assert len(chain(points)) == 198
    assert not chain(points) & {(0, 100), (99, 199)}


def test_what_is_doubtful_of_a_curve_is_told_with_its_place():
    """Crossings and close passes, gaps that are hardly any, noise; lone points are refused."""
    t = 2 * PI * (np.arange(200) + 0.3) / 200
    with pytest.warns(UserWarning, match=r"nearer to another part .* near \(0, -?0"):
        reconstruct(np.stack([np.sin(t), np.sin(2 * t) / 2], 1))
    t = 2 * PI * np.arange(100) / 104
    with pytest.warns(UserWarning, match="ends at gaps hardly longer than"):
        found = reconstruct(np.stack([np.cos(t), np.sin(t)], 1))
    assert len(found.cells) == 99
    with pytest.warns(UserWarning, match="50 are far closer to another"):
        LaplaceBeltrami.from_points(
            np.concatenate([part := np.stack([np.cos(t), np.sin(t)], 1)[:25], part + 1e-6]), dim=1
        )
    points = np.stack([np.linspace(0, 1, 50), np.zeros(50)], 1)
    with pytest.raises(InputError, match=r"1 \(50\) are farther from all others"):
        reconstruct(np.concatenate([points, [[0.5, 3.0]]]), dim=1)


def test_noisy_points_are_moved_onto_a_smooth_curve():
    """Noise of a tenth of the spacing: eigenvalues within 1 %, where segments through the points are off by 7 %."""
    rng = np.random.default_rng(4)
    t = np.sort(rng.random(400)) * 2 * PI
    points = np.stack([np.cos(t), np.sin(t)], 1)
    points += 0.1 * 2 * PI / 400 * rng.standard_normal(points.shape)
    with pytest.warns(UserWarning, match="lie beside the curve by 0.0016"):
        lb = LaplaceBeltrami.from_points(points)
    assert worst(lb, np.array([0, 1, 1, 4, 4])) < 1e-2
    number = np.arange(400)
    through = LaplaceBeltrami.from_mesh(points, np.stack([number, (number + 1) % 400], 1))
    assert worst(through, np.array([0, 1, 1, 4, 4])) > 5e-2


def test_declared_ends_are_ends():
    """A circle whose two neighbouring points are declared to be ends is an arc."""
    t = 2 * PI * np.arange(60) / 60
    points = np.stack([np.cos(t), np.sin(t)], 1)
    mask = torch.zeros(60, dtype=torch.bool)
    mask[[10, 11]] = True
    assert chain(points, boundary=mask) == in_turn(60) - {(10, 11)}
    lb = LaplaceBeltrami.from_points(points, boundary=mask, condition="dirichlet")
    assert worst(lb, (np.arange(1, 4) * 30 / 59) ** 2) < 1e-3
    with pytest.warns(UserWarning, match="holds nowhere"):
        LaplaceBeltrami.from_points(points, boundary="detect", condition="dirichlet")


def test_normals_of_plane_curves_face_out_or_as_given():
    t = 2 * PI * np.arange(80) / 80
    points = torch.from_numpy(np.stack([2 * np.cos(t), np.sin(t)], 1))
    assert ((LaplaceBeltrami.from_points(points).normals * points).sum(1) > 0).all()
    given = LaplaceBeltrami.from_points(points, normals=-points)
    assert ((given.normals * points).sum(1) < 0).all()


def ball(count):
    """Points of a grid in the unit ball and of its sphere."""
    width = (4 / 3 * PI / count) ** (1 / 3)
    line = np.arange(-1, 1 + width, width)
    grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)
    inside = grid[np.linalg.norm(grid, axis=1) < 1 - width / 2]
    return np.concatenate([Sphere().points(int(4 * PI / width**2)).numpy(), inside])


def test_a_cube_by_its_points():
    """π²(i² + j² + k²) with natural boundary, as of its tetrahedra; u = 0 at the sides, x³ by its values."""
    points, cells = cube(9)
    lb = LaplaceBeltrami.from_points(points, dim=3)
    assert lb.mass.sum().item() == pytest.approx(1.0, rel=1e-9)
    assert torch.equal(lb.boundary, ((lb.points == 0) | (lb.points == 1)).any(1))
    exact = PI**2 * np.sort(
        [i * i + j * j + k * k for i in range(3) for j in range(3) for k in range(3)]
    )
    of_mesh = worst(LaplaceBeltrami.from_mesh(points, cells), exact[:10])
    assert worst(lb, exact[:10]) < 1.5 * of_mesh < 2e-3
    held = LaplaceBeltrami.from_points(points, dim=3, boundary="detect", condition="dirichlet")
    x = torch.from_numpy(points)
    f = (PI * x).sin().prod(1)
    torch.testing.assert_close(poisson_solve(held, 3 * PI**2 * f), f, rtol=0.0, atol=3e-3)
    decay = np.exp(-3 * PI**2 * 0.02)
    torch.testing.assert_close(heat_flow(held, f, 0.02), decay * f, rtol=0.0, atol=3e-3)


def test_a_ball_by_its_points():
    """4π/3, 4π, and 2.0816² three times (the zero of j_1'), 3.3421² five times."""
    lb = LaplaceBeltrami.from_points(ball(800), dim=3)
    assert lb.mass.sum().item() == pytest.approx(4 / 3 * PI, rel=1e-3)
    assert lb.boundary_mass.values().sum().item() == pytest.approx(4 * PI, rel=2e-3)
    assert worst(lb, np.array([0, *[2.081576] * 3, *[3.342094] * 5]) ** 2) < 2e-3


def test_holes_and_notches_of_a_solid_stay_open():
    """A cube less a quarter, two cubes three spacings apart, a ball less a smaller one: volumes to half a layer."""
    points, _ = cube(13)
    ell = points[~(points[:, :2] > 0.5 + 1e-9).all(1)]
    volume = LaplaceBeltrami.from_points(ell, dim=3, order=1).mass.sum().item()
    assert 0.75 <= volume < 0.757
    six = cube(6)[0]
    two = LaplaceBeltrami.from_points(
        np.concatenate([six, six + np.array([1.6, 0, 0])]), dim=3, order=1
    )
    assert two.mass.sum().item() == pytest.approx(2.0)
    inner = Sphere().points(300).numpy() / 2
    points = np.concatenate([(p := ball(2000))[np.linalg.norm(p, axis=1) > 0.56], inner])
    lb = LaplaceBeltrami.from_points(points, dim=3, order=1)
    assert lb.mass.sum().item() == pytest.approx(7 / 6 * PI, rel=2e-2)
    assert lb.boundary_mass.values().sum().item() == pytest.approx(5 * PI, rel=3e-2)


def test_points_that_are_no_solid_are_refused():
    points = np.random.default_rng(0).random((40, 3))
    with pytest.raises(InputError, match="lie in a plane"):
        reconstruct(points * [1, 1, 0], dim=3)
    with pytest.raises(InputError, match=r"1 \(40\) are farther from all others"):
        reconstruct(np.concatenate([points, [[9.0, 9, 9]]]), dim=3)
    with pytest.raises(InputError, match="not 40 points of dimension 4 in R"):
        reconstruct(np.random.default_rng(0).random((40, 4)), dim=4)


def hull(points):
    """Triangles of the convex hull."""
    return ConvexHull(points).simplices


@pytest.mark.parametrize("wrapped", [False, True])
def test_another_reconstruction_is_put_in_by_its_name(wrapped):
    """The operator of a cloud by its convex hull is that of the hull as a mesh."""
    points = Sphere().points(300)

    def by_hull(given):
        cells = torch.from_numpy(hull(given)).long()
        return Complex(points=given, cells=cells) if wrapped else cells

    lb = LaplaceBeltrami.from_points(points, reconstruct=by_hull)
    mesh = LaplaceBeltrami.from_mesh(points, hull(points))
    for name in ("stencil.values", "weak.values", "mass", "faces"):
        assert torch.equal(tensors_of(lb)[name], tensors_of(mesh)[name]), name
    solid = LaplaceBeltrami.from_points(
        points / 2, reconstruct=lambda p: Delaunay(p).simplices, order=1
    )
    assert solid.dim == 3


def test_the_own_reconstruction_can_be_put_in():
    """Also of a surface, with its normals and stars; in the user's numbers; of one in R⁴ whose cells have no side."""
    clouds = (Sphere().points(300), 2), (trefoil(60)[0], 1), (CliffordTorus().points(300), 2)
    for cloud, dim in clouds:
        own = LaplaceBeltrami.from_points(cloud, dim=dim)
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            given = LaplaceBeltrami.from_points(
                cloud, reconstruct=lambda p, d=dim: reconstruct(p, d)
            )
        torch.testing.assert_close(given.eigenbasis(6).eigenvalues, own.eigenbasis(6).eigenvalues)
        assert (given.surface is None) == (own.surface is None)


def test_what_is_no_reconstruction_is_refused():
    points = Sphere().points(50)
    with pytest.raises(InputError, match="belong to no face"):
        LaplaceBeltrami.from_points(points, reconstruct=lambda _: [[0, 1, 2]])
    with pytest.raises(InputError, match="of dimension 1, got some of shape"):
        LaplaceBeltrami.from_points(points, dim=1, reconstruct=hull)
    with pytest.raises(InputError, match="reconstruct: a function has no name in a cache"):
        operator_key(points, reconstruct=hull)
