"""Plan and evaluate: what is decided once says at the same points what was built, at others what has moved."""

import copy
import math
import warnings
from functools import cache

import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay

from torchlb import LaplaceBeltrami, implicit_step, load_operator, save_operator
from torchlb.cloud import reconstruct
from torchlb.errors import InputError
from torchlb.linalg.csr import tensors_of
from torchlb.operator.plan import evaluate
from torchlb.surfaces import (
    CliffordTorus,
    Ellipsoid,
    Hemisphere,
    SpaceCurve,
    Sphere,
    ThreeSphere,
    Torus,
    UnitDisk,
)


def grid(n):
    axes = [torch.linspace(0, 1, n, dtype=torch.float64)] * 3
    points = torch.cartesian_prod(*axes)
    inside = ((points > 0) & (points < 1)).all(1, keepdim=True)
    noise = torch.rand(points.shape, generator=torch.Generator().manual_seed(0)).double()
    return points + 0.3 / n * (noise - 0.5) * inside


def tetrahedra(n):
    points = grid(n)
    return points, torch.from_numpy(Delaunay(points.numpy()).simplices).long()


def noisy_sphere():
    vertices, faces = Sphere().mesh(400)
    noise = torch.randn(vertices.shape, generator=torch.Generator().manual_seed(1)).double()
    return vertices + 0.05 * noise, faces


def random_square():
    """Long triangles along the boundary, which the cover stands for."""
    points = np.random.default_rng(0).random((200, 2))
    faces = torch.from_numpy(Delaunay(points).simplices).long()
    return torch.nn.functional.pad(torch.from_numpy(points), (0, 1)), faces


def knot():
    points = SpaceCurve().points(100)
    return points, torch.stack([torch.arange(100), (torch.arange(100) + 1) % 100], 1)


MESHES = {
    "sphere": lambda: LaplaceBeltrami.from_mesh(*Sphere().mesh(300)),
    "order 1": lambda: LaplaceBeltrami.from_mesh(*UnitDisk().mesh(300), order=1),
    "order 5": lambda: LaplaceBeltrami.from_mesh(*Hemisphere().mesh(500), order=5),
    "held": lambda: LaplaceBeltrami.from_mesh(*Hemisphere().mesh(300), condition="dirichlet"),
    "along normals": lambda: LaplaceBeltrami.from_mesh(*Torus().mesh(400), projection="normal"),
    "splines": lambda: LaplaceBeltrami.from_mesh(*Torus().mesh(400), weights="polyharmonic"),
    "noise": lambda: LaplaceBeltrami.from_mesh(*noisy_sphere()),
    "long triangles": lambda: LaplaceBeltrami.from_mesh(*random_square()),
    "curve": lambda: LaplaceBeltrami.from_mesh(*knot()),
    "solid": lambda: LaplaceBeltrami.from_mesh(*tetrahedra(6)),
    "solid, held": lambda: LaplaceBeltrami.from_mesh(*tetrahedra(6), condition="dirichlet"),
    "cloud": lambda: LaplaceBeltrami.from_points(Ellipsoid().points(400)),
    "cloud in R⁴": lambda: LaplaceBeltrami.from_points(CliffordTorus().points(400), dim=2),
    "three-sphere": lambda: LaplaceBeltrami.from_points(ThreeSphere().points(300)),
    "curve of points": lambda: LaplaceBeltrami.from_points(SpaceCurve().points(100), dim=1),
    "cloud of a disk": lambda: LaplaceBeltrami.from_points(UnitDisk().points(300)),
}
built = cache(lambda name: MESHES[name]())


@pytest.mark.filterwarnings("ignore:.*low-order rows")
@pytest.mark.parametrize("name", MESHES)
def test_at_the_same_points_it_is_the_operator(name):
    """Every matrix, the mass, frames, normals, the report, to 1e-12 of the largest entry; order 5, splines to more."""
    lb, bound = built(name), {"splines": 1e-10, "order 5": 2e-12}.get(name, 1e-12)
    again = lb.at(lb.points)
    for key, ours in tensors_of(lb).items():
        if key.startswith("modes."):  # another test may have solved for them
            continue
        theirs = tensors_of(again)[key]
        assert ours.shape == theirs.shape, key
        if ours.is_floating_point() and ours.numel():
            scale = ours.abs().nan_to_num()
            scale = scale.amax(-1, keepdim=True) if key.endswith(".values") else scale.max()
            scale = scale.clamp_min(1e-300).expand(ours.shape)[~(ours.isnan() & theirs.isnan())]
            gap = (ours - theirs).abs()[~(ours.isnan() & theirs.isnan())] / scale
            assert gap.numel() == 0 or gap.max() < bound, key
        else:
            assert torch.equal(ours, theirs), key


@pytest.mark.parametrize("name", ["sphere", "held", "curve", "solid", "cloud"])
def test_a_shape_that_is_turned_scaled_and_moved(name):
    """λ falls by the square of the scale; the plan is the same."""
    lb = built(name)
    turn, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))
    moved = lb.at(1.7 * lb.points @ turn + 0.3)
    ours, theirs = (operator.eigenbasis(6).eigenvalues for operator in (lb, moved))
    torch.testing.assert_close(theirs[1:] * 1.7**2, ours[1:], rtol=1e-8, atol=0)
    if name != "curve":
        torch.testing.assert_close(
            moved.mass / lb.mass, lb.mass * 0 + 1.7**lb.dim, rtol=1e-8, atol=0
        )
    assert moved.plan is lb.plan


def test_a_sphere_becomes_an_ellipsoid():
    """As accurate as the operator that is built on the ellipsoid: eigenvalues within 1e-4 of each other."""
    lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(1500))
    axes = torch.tensor([1.0, 1.15, 0.9], dtype=torch.float64)
    moved, anew = lb.at(lb.points * axes), LaplaceBeltrami.from_mesh(lb.points * axes, lb.faces)
    values = [operator.eigenbasis(12).eigenvalues[1:] for operator in (moved, anew)]
    torch.testing.assert_close(*values, rtol=1e-4, atol=0)
    f = moved.points[:, 0].square()
    assert (moved(f) - anew(f)).abs().max() < 0.02 * anew(f).abs().max()


def test_a_curve_that_is_stretched_is_differentiated_by_its_length():
    """Of a circle that becomes twice as large λ is a quarter; of one that is turned over it stays."""
    angle = 2 * math.pi * torch.arange(60, dtype=torch.float64) / 60
    circle = torch.stack([angle.cos(), angle.sin()], 1)
    segments = torch.stack([torch.arange(60), (torch.arange(60) + 1) % 60], 1)
    lb = LaplaceBeltrami.from_mesh(circle, segments)
    for points, factor in ((2 * circle, 0.25), (circle.flip(1), 1.0)):
        values = lb.at(points).eigenbasis(5).eigenvalues
        torch.testing.assert_close(
            values[1:], factor * lb.eigenbasis(5).eigenvalues[1:], rtol=1e-9, atol=0
        )


def test_a_plan_has_no_unit_of_length():
    """Made of points a million times as large it says the same."""
    vertices, faces = Torus().mesh(300)
    one, two = (LaplaceBeltrami.from_mesh(s * vertices, faces) for s in (1.0, 2.0**20))
    again = evaluate(two.plan, one.points)
    torch.testing.assert_close(
        again["stencil"].values[0], one.stencil.values[0], rtol=1e-9, atol=1e-9
    )


def test_copies_and_files_keep_the_plan(tmp_path):
    lb = built("held")
    loaded = LaplaceBeltrami()
    loaded.load_state_dict(lb.state_dict())
    for other in (copy.deepcopy(lb), loaded):
        again = other.at(lb.points)
        torch.testing.assert_close(again.weak.values, lb.weak.values)
        torch.testing.assert_close(again.stencil.values[0], lb.stencil.values[0])


def test_a_file_decides_at_the_points_of_the_build(tmp_path):
    """This disk decides otherwise at points that are rounded to float32; also where it has moved, and in a batch."""
    lb = LaplaceBeltrami.from_points(UnitDisk().points(400))
    for own in (lb.float(), lb.at(1.1 * lb.points)):
        for shape in (own, LaplaceBeltrami.batch([own, own])):
            save_operator(shape, tmp_path / "disk.npz")
            loaded = load_operator(tmp_path / "disk.npz")
            assert torch.equal(loaded.connection.weak.values, shape.connection.weak.values)
            assert loaded.connection.weak.values.dtype == torch.float32


def test_a_plan_that_was_let_go_is_missed():
    lb = LaplaceBeltrami.from_mesh(*Torus().mesh(200))
    del lb.plan
    assert not any("plan" in name for name in lb.state_dict())
    with pytest.raises(InputError, match="let go"):
        lb.at(lb.points)


def test_a_plan_of_another_version_says_so(monkeypatch):
    lb, loaded = built("sphere"), LaplaceBeltrami()
    monkeypatch.setattr("torchlb.operator.plan.__version__", "0.0")
    loaded.load_state_dict(lb.state_dict())
    monkeypatch.undo()
    with pytest.raises(InputError, match=r"made by torchlb 0\.0"):
        loaded.at(lb.points)


def test_what_has_no_plan_says_so():
    lb = built("sphere")
    with pytest.raises(InputError, match="as the operator has"):
        lb.at(lb.points[1:])
    batch = LaplaceBeltrami.batch([lb, lb])
    cotangent = LaplaceBeltrami.from_cotangent(lb.points, lb.faces)
    for other in (batch, cotangent):
        with pytest.raises(InputError, match="plan: "):
            other.at(other.points)


def test_a_certificate_is_of_its_points_alone():
    lb = built("sphere")
    certified = LaplaceBeltrami.from_mesh(lb.points, lb.faces, certify=True)
    with pytest.raises(InputError, match="certificate"):
        certified.at(certified.points)
    f, kappa = lb.points[:, 0], 1 + lb.points[:, 1] ** 2
    ours, theirs = (implicit_step(one, f, 0.1, conductivity=kappa) for one in (lb, certified))
    torch.testing.assert_close(theirs, ours)


def test_a_noisy_cloud_stays_as_smooth_as_it_was():
    """What its points are moved by turns and scales with them."""
    points = Sphere().points(800)
    noise = torch.randn(points.shape, generator=torch.Generator().manual_seed(2)).double()
    lb = LaplaceBeltrami.from_points(points + 0.03 * noise)
    assert lb.surface.noise > 0.02
    torch.testing.assert_close(lb.at(lb.points).weak.values, lb.weak.values, rtol=0, atol=1e-12)
    turn, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))
    ours, theirs = (b.eigenbasis(6).eigenvalues[1:] for b in (lb, lb.at(2 * lb.points @ turn + 1)))
    torch.testing.assert_close(4 * theirs, ours, rtol=1e-9, atol=0)


def test_a_noisy_curve_has_no_plan_of_its_noise():
    angle = 2 * math.pi * torch.arange(200, dtype=torch.float64) / 200
    circle = torch.stack([angle.cos(), angle.sin()], 1)
    noise = torch.randn(circle.shape, generator=torch.Generator().manual_seed(3)).double()
    lb = LaplaceBeltrami.from_points(circle + 4e-3 * noise)
    with pytest.raises(InputError, match="put elsewhere"):
        lb.at(lb.points)


def own_cells(points):
    """What a user's function may find."""
    noise = torch.randn(points.shape, generator=torch.Generator().manual_seed(0)).double()
    return reconstruct(points + 0.02 * noise)


@pytest.mark.filterwarnings("ignore:points")
@pytest.mark.parametrize(
    ("points", "options"),
    [
        (Sphere().points(300), {"reconstruct": own_cells}),
        (Torus().random_points(1500), {"normals": Torus().random_points(1500)}),
    ],
    ids=["reconstruct", "normals"],
)
def test_a_copy_knows_what_was_given_beside_the_points(points, options, tmp_path):
    """Normals and cells of the user: copies and files move as the operator does."""
    lb = LaplaceBeltrami.from_points(points, **options)
    save_operator(lb, tmp_path / "cloud.npz")
    moved = lb.at(1.1 * lb.points).weak.values
    for other in (copy.deepcopy(lb), load_operator(tmp_path / "cloud.npz")):
        assert torch.equal(other.at(1.1 * lb.points).weak.values, moved)


@pytest.mark.parametrize(
    "points", [Sphere().points(300), Torus().random_points(1500), CliffordTorus().points(400)]
)
def test_a_copy_of_a_cloud_has_the_same_cells(points):
    lb = LaplaceBeltrami.from_points(points, dim=2)
    f, kappa = lb.points[:, 0], torch.ones(len(points), dtype=torch.float64)
    expected = implicit_step(lb, f, 0.1)
    for other in (lb, copy.deepcopy(lb)):
        found = implicit_step(other, f, 0.1, conductivity=kappa)
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-9)
    assert copy.deepcopy(lb).plan.faces.equal(lb.faces)


def test_a_rounded_copy_decides_at_the_points_of_the_build():
    """So it has the same triangles in the same order, and one κ of each face is that of the same face."""
    lb = LaplaceBeltrami.from_points(Torus().random_points(2000)).float()
    other, f = copy.deepcopy(lb), lb.points[:, 0]
    kappa = torch.rand(len(lb.faces)).double() + 0.1
    ours, theirs = (implicit_step(one, f, 0.1, conductivity=kappa) for one in (lb, other))
    assert other.plan.faces.equal(lb.faces)
    assert torch.equal(other.plan.order, lb.plan.order)
    torch.testing.assert_close(theirs, ours, rtol=0, atol=2e-5)


def test_points_that_moved_too_far_are_told():
    """Against the plan's points, also step by step; a uniform scale is none; cells inside out are an error."""
    vertices, faces = Sphere().mesh(200)
    lb, far = LaplaceBeltrami.from_mesh(vertices, faces), vertices.clone()
    far[7] += 2 * vertices[7]
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "at: ")
        near = lb.at(1.5 * vertices).at(5 * vertices)
        with pytest.raises(UserWarning, match=r"at: \d+ points \(.*7"):
            lb.at(far)
    halfway = vertices.clone()
    halfway[7] *= 2
    moved = near.at(halfway)
    with pytest.warns(UserWarning, match="grew or shrank"):
        moved.at(far)
    with pytest.warns(UserWarning, match="grew or shrank"):
        moved.with_medium(2.0).at(far)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for step in (1.0, 1.1, 1.2):  # each kind once for a line, whatever the numbers
            moved.at(step * far)
    assert told is not None
    kinds = [str(each.message).partition(")")[2] for each in told]
    assert 1 <= len(kinds) == len(set(kinds)) <= 2
    flat, triangles = UnitDisk().mesh(100)
    lb = LaplaceBeltrami.from_mesh(flat[:, :2], triangles)
    folded = flat[:, :2].clone()
    folded[0] = 1.1 * folded[5] - 0.1 * folded[0]
    with pytest.raises(InputError, match="inside out"):
        lb.at(folded)
    assert lb.at(flat[:, :2].flip(1)).num_points == 100  # a mirror image


def test_points_that_moved_too_far_have_flat_triangles_and_no_nan():
    """Fits that were decided elsewhere diverge, which put nodes at 1e37 and NaN into the mass of a body."""
    vertices, faces = Sphere().mesh(300)
    lb, generator = LaplaceBeltrami.from_mesh(vertices, faces), torch.manual_seed(0)
    moved = vertices + 0.1 * torch.randn(vertices.shape, generator=generator).double()
    with pytest.warns(UserWarning, match=r"at: \d+ points .* which are flat there instead"):
        mass = lb.at(moved).mass
    corners = moved[faces]
    sides = corners[:, 1:] - corners[:, :1]
    area = torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=1).sum() / 2
    assert 0.9 * area < mass.sum() < 1.5 * area
