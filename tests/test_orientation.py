"""Consistent normals, and which points of a thin shape lie on different sides."""

import math

import pytest
import torch

from tolerances import TOLERANCE
from torchlb.cloud.frames import cloud_frames, mended_normals, nearest_pairs
from torchlb.geometry.compatibility import thin_sides
from torchlb.geometry.complex import consistently_wound
from torchlb.geometry.frames import complete_frames, normals_of_frames, vertex_normals
from torchlb.geometry.neighbors import nearest_neighbors
from torchlb.surfaces import Ellipsoid, Sphere, StarShaped, Torus


def close(actual, expected):
    torch.testing.assert_close(actual, expected, **TOLERANCE[torch.float64])


def nearest(points):
    return nearest_neighbors(points, 24)


def scrambled(normals):
    return normals * torch.randint(0, 2, (len(normals), 1)).mul(2).sub(1)


@pytest.mark.parametrize("surface", [Sphere(), Torus(), Ellipsoid(), StarShaped()])
@pytest.mark.parametrize("sampling", ["points", "random_points"])
def test_normals_of_a_cloud_are_turned_outward(surface, sampling):
    """Estimated normals with random signs: all end on the outer side, none changes but in sign."""
    points = getattr(surface, sampling)(1000)
    frames = cloud_frames(points, nearest(points), 2)
    normals = scrambled(normals_of_frames(frames))
    oriented = mended_normals(points, normals, nearest(points))[0]
    assert ((oriented * surface.normals(points)).sum(1) > 0).all()
    close(oriented.abs(), normals.abs())


def test_every_component_is_turned_outward_by_itself():
    points = torch.cat([Sphere().points(300), 2 * Sphere().points(300, seed=1) + 5])
    exact = torch.cat([points[:300], (points[300:] - 5) / 2])
    close(mended_normals(points, scrambled(exact), nearest(points))[0], exact)


@pytest.mark.parametrize("gap", [1.5, 2.0])
def test_the_two_sides_of_a_slab_face_away_from_each_other(gap):
    """Two parallel sheets, `gap` spacings apart."""
    axis = torch.arange(20, dtype=torch.float64)
    lower = torch.cartesian_prod(axis, axis, torch.zeros(1, dtype=torch.float64))
    upper = lower + torch.tensor([0.4, 0.3, gap], dtype=torch.float64)
    exact = torch.zeros(800, 3, dtype=torch.float64)
    exact[:400, 2], exact[400:, 2] = -1.0, 1.0
    points = torch.cat([lower, upper])
    oriented = mended_normals(points, scrambled(exact), nearest(points))[0]
    close(oriented, exact)
    sides = thin_sides(points, oriented, nearest(points))
    close(sides, exact)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(
    ("surface", "count"), [(Torus(), 60), (Torus(), 1000), (Ellipsoid(), 500), (StarShaped(), 800)]
)
def test_a_consistent_field_keeps_its_side_and_a_minority_is_turned(surface, count, side):
    """None of the signs is wrong, single ones, three in ten, or all of a quarter of the surface."""
    points = surface.random_points(count)
    exact = side * surface.normals(points)
    generator = torch.manual_seed(0)
    share = torch.rand(count, generator=generator)
    above = points[:, 2] > points[:, 2].quantile(0.75)
    for wrong in (share < 0, share < 0.02, share < 0.1, above) + (
        (share < 0.3,) if count > 99 else ()
    ):
        given = torch.where(wrong[:, None], -exact, exact)
        mended, random = mended_normals(points, given, nearest(points))
        close(mended, exact)
        assert not random.any()


@pytest.mark.parametrize("gap", [0.05, 0.5, 1.5])
@pytest.mark.parametrize("sides", [(-1, 1), (1, 1)])
def test_sides_that_a_user_gives_to_two_sheets_stay(gap, sides):
    """A thin slab, also where it is thinner than the spacing, or two sheets that both face up."""
    axis = torch.arange(20, dtype=torch.float64)
    lower = torch.cartesian_prod(axis, axis, torch.zeros(1, dtype=torch.float64))
    points = torch.cat([lower, lower + torch.tensor([0.4, 0.3, gap], dtype=torch.float64)])
    exact = torch.zeros(800, 3, dtype=torch.float64)
    exact[:400, 2], exact[400:, 2] = sides
    close(mended_normals(points, exact, nearest(points))[0], exact)


def test_normals_towards_a_camera_face_out():
    """It sees half of a sphere from outside; with the other half they have no side."""
    points = Sphere().points(1000)
    seen = torch.where(points[:, :1] > 0, points, -points)
    mended, even = mended_normals(points, seen, nearest(points))
    assert even.all()
    close(mended, points)


def test_random_signs_are_told_and_face_out():
    """Of one of two spheres; the other faces in, as it is given."""
    sphere = Sphere().points(300)
    points, normals = torch.cat([sphere, sphere + 5]), torch.cat([scrambled(sphere), -sphere])
    mended, random = mended_normals(points, normals, nearest(points))
    assert random.tolist() == [True] * 300 + [False] * 300
    close(mended, torch.cat([sphere, -sphere]))


def test_nothing_is_thin_on_a_resolved_surface():
    points = Torus().points(1000)
    assert not thin_sides(points, Torus().normals(points), nearest(points)).any()


def test_a_strip_with_one_side_is_not_thin():
    """A Möbius strip: no consistent normals, and none needed."""
    turn, across = torch.meshgrid(
        torch.arange(120, dtype=torch.float64) * math.tau / 120,
        torch.linspace(-0.3, 0.3, 13, dtype=torch.float64),
        indexing="ij",
    )
    reach = 1 + across * (turn / 2).cos()
    points = torch.stack(
        [reach * turn.cos(), reach * turn.sin(), across * (turn / 2).sin()], -1
    ).view(-1, 3)
    frames = cloud_frames(points, nearest(points), 2)
    oriented = mended_normals(points, normals_of_frames(frames), nearest(points))[0]
    assert not thin_sides(points, oriented, nearest(points)).any()


def test_pairs_come_once_each():
    points = Sphere().random_points(200)
    i, j = nearest_pairs(nearest(points))
    assert (i < j).all()
    assert len(torch.unique(torch.stack([i, j], 1), dim=0)) == len(i)


def test_one_flipped_face_spoils_the_winding():
    vertices, faces = Sphere().mesh(200)
    assert consistently_wound(faces)
    assert ((vertex_normals(vertices, faces) * vertices).sum(1) > 0).all()
    faces[7] = faces[7].flip(0)
    assert not consistently_wound(faces)


def test_given_normals_of_any_sign_are_oriented():
    """complete_frames of a normal and of its opposite span the same plane, so the signs come out the same."""
    points = Ellipsoid().points(500)
    exact = Ellipsoid().normals(points)
    normals = normals_of_frames(complete_frames(scrambled(exact)))
    close(mended_normals(points, normals, nearest(points))[0], exact)
