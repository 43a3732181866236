"""Points are built in the order of a k-d tree: neither results nor messages show it."""

import math

import pytest
import torch

from torchlb import LaplaceBeltrami, implicit_step
from torchlb.errors import InputError, first_few, renumbered
from torchlb.geometry.numbering import Numbering
from torchlb.linalg.sparse import to_scipy
from torchlb.stencils.rows import matrix_rows
from torchlb.surfaces import Hemisphere, Sphere, UnitDisk


def test_near_points_are_near_in_the_order_of_the_tree():
    """The mean step from one point to the next: 0.52 for points at random in a unit square, a few spacings then."""
    points = torch.rand(2000, 2, dtype=torch.float64)
    numbering = Numbering.along_tree(points)
    along = numbering.sorted(points).diff(dim=0).norm(dim=1)
    assert along.mean() < 0.1 * points.diff(dim=0).norm(dim=1).mean()
    assert numbering.restored(numbering.sorted(points)).equal(points)


def test_faces_keep_their_corners():
    vertices, faces = Sphere().mesh(300)
    numbering = Numbering.along_tree(vertices)
    found, order = numbering.faces(faces)
    assert numbering.given[found].equal(faces[order])
    assert (found.amin(1).diff() >= 0).all()


def test_rows_are_restored_with_ascending_columns():
    vertices, faces = Sphere().mesh(200)
    lb = LaplaceBeltrami.from_mesh(vertices, faces)
    entries = lb.stencil.col.long(), lb.stencil.values[0], lb.stencil.values[0] != 0
    rows = matrix_rows(lb.stencil.crow.diff(), *entries, vertices, lb.frames, torch.arange(200))
    numbering = Numbering(order := torch.randperm(200), order.argsort())
    found = rows.restored(numbering)
    dense = to_scipy(found.crow, found.col, found.laplacian, lb.shape).toarray()
    given = order.numpy()
    expected = to_scipy(lb.stencil.crow, lb.stencil.col, lb.stencil.values[0], lb.shape).toarray()
    assert (dense[given][:, given] == expected).all()
    row = torch.arange(200).repeat_interleave(found.length)
    assert ((row * 200 + found.col).diff() > 0).all()


def test_every_tensor_has_the_users_numbers():
    """Where rows, frames, masses and both pairs belong to the point that they are stored for."""
    vertices, faces = UnitDisk().mesh(500)
    shuffle = torch.randperm(500)
    lb = LaplaceBeltrami.from_mesh(vertices[shuffle], shuffle.argsort()[faces])
    x = lb.points[:, :2]
    inside = x.norm(dim=1) < 0.6
    assert lb(x.square())[inside].allclose(torch.full((1,), 2.0).double(), atol=1e-8)
    assert (lb.boundary == (x.norm(dim=1) > 1 - 1e-9)).all()
    assert lb.mass.sum() == pytest.approx(lb.mass_matrix.to_dense().sum().item(), rel=1e-12)
    flux = lb.stiffness @ x  # ∫ ∇x·∇φ is that of the boundary alone
    assert flux[inside].abs().max() < 1e-10
    length = lb.boundary_mass.to_dense().sum(1)
    assert (length[~lb.boundary].abs() < 1e-12).all()
    assert length[lb.boundary].sum() == pytest.approx(2 * torch.pi, rel=1e-4)


def circle(order):
    angle = torch.rand(150, generator=torch.Generator().manual_seed(0)).double() * math.tau
    points = torch.stack([angle.cos(), angle.sin()], 1)
    return LaplaceBeltrami.from_points(points[order], dim=1)


def cloud(order):
    points = Sphere().random_points(400)
    return LaplaceBeltrami.from_points(points[order], normals=-points[order])


def hemisphere(order, condition="dirichlet"):
    vertices, faces = Hemisphere().mesh(400)
    return LaplaceBeltrami.from_mesh(vertices[order], order.argsort()[faces], condition=condition)


@pytest.mark.parametrize(("build", "count"), [(circle, 150), (cloud, 400), (hemisphere, 400)])
def test_the_order_of_the_points_does_not_matter(build, count):
    """Rows, certificate, pair, frames, masses, surface and report are those of the same points."""
    order = torch.randperm(count, generator=torch.Generator().manual_seed(1))
    one, two = build(torch.arange(count)), build(order)
    for name in ("matrix", *(["stiffness", "mass_matrix"] if one._has_weak_form else [])):
        given, shuffled = (getattr(lb, name).to_dense() for lb in (one, two))
        torch.testing.assert_close(given[order][:, order], shuffled, rtol=1e-12, atol=1e-12)
    for name in ("mass", "frames", "normals", "boundary", "fixed"):
        given, shuffled = getattr(one, name), getattr(two, name)
        assert (given is None) is (shuffled is None)
        assert given is None or given[order].equal(shuffled)
    assert one.report.order[order].equal(two.report.order)
    if one.faces is not None:
        faces = [faces.sort(1).values.tolist() for faces in (one.faces, order[two.faces])]
        assert sorted(faces[0]) == sorted(faces[1])


def test_a_conductivity_has_the_users_numbers():
    """That of the vertices and that of the faces, also where these are shuffled."""
    order = torch.randperm(400, generator=torch.Generator().manual_seed(1))
    one = hemisphere(torch.arange(400), "neumann")
    two = hemisphere(order, "neumann")
    f, kappa = one.points[:, 0], 1 + one.points[:, 1].square()
    of_faces = kappa[one.faces].mean(1)
    for given, shuffled in ((kappa, kappa[order]), (of_faces, of_faces)):
        u = implicit_step(one, f, 0.1, conductivity=given)
        v = implicit_step(two, f[order], 0.1, conductivity=shuffled)
        torch.testing.assert_close(u[order], v)


def test_messages_name_points_as_the_user_does():
    with renumbered(torch.tensor([7, 5, 3])):
        assert first_few(torch.tensor([0, 2])) == "3, 7"
    assert first_few(torch.tensor([0, 2])) == "0, 2"


def test_a_mask_with_points_inside_names_them():
    vertices, faces = UnitDisk().mesh(400)
    mask = vertices.norm(dim=1) > 1 - 1e-9
    astray = int((~mask).nonzero()[7])
    mask[astray] = True
    with pytest.raises(InputError, match=rf"got 1 inside \({astray}\)"):
        LaplaceBeltrami.from_mesh(vertices, faces, boundary=mask)
