"""Tangent fields: the connection and Hodge Laplacians, their flows and solves."""

import warnings

import numpy as np
import pytest
import torch
import trimesh

from torchlb import (
    DerivativeError,
    InputError,
    LaplaceBeltrami,
    Robin,
    heat_flow,
    implicit_step,
    parallel_transport,
    vector_heat_flow,
)
from torchlb.surfaces import CliffordTorus, Ellipsoid, Hemisphere, Sphere, Torus, UnitDisk

DEGREES = torch.tensor([degree for degree in range(1, 5) for _ in range(4 * degree + 2)][:28])


def error(connection, expected):
    values = connection.eigenbasis(len(expected)).eigenvalues[: len(expected)]
    return float((values / expected - 1).abs().max())


@pytest.fixture(scope="module")
def sphere():
    return LaplaceBeltrami.from_mesh(*Sphere().mesh(500))


@pytest.fixture(scope="module")
def bumpy():
    """An ellipsoid with points off it, on which nothing is symmetric."""
    torch.manual_seed(1)
    vertices, faces = Ellipsoid().mesh(150)
    return LaplaceBeltrami.from_mesh(vertices + 0.01 * torch.randn_like(vertices), faces)


def test_bochners_eigenvalues_on_the_sphere(sphere):
    """l(l + 1) − 1, 2(2l + 1) times, on a mesh and a cloud; and at the order of the pair."""
    expected = DEGREES * (DEGREES + 1) - 1
    assert error(sphere.connection, expected) < 2e-4
    finer = Sphere().mesh(2000)
    assert error(LaplaceBeltrami.from_mesh(*finer).connection, expected) < 1e-5
    assert error(LaplaceBeltrami.from_points(finer[0]).connection, expected) < 3e-5
    assert error(LaplaceBeltrami.from_cotangent(*finer).connection, expected) < 1e-2


def test_hodges_eigenvalues_on_the_sphere(sphere):
    """l(l + 1), since the curvature is 1."""
    assert error(sphere.connection.hodge, DEGREES * (DEGREES + 1)) < 5e-4


def test_a_torus_has_two_harmonic_fields_and_no_parallel_one():
    connection = LaplaceBeltrami.from_mesh(*Torus().mesh(1500)).connection
    values = connection.hodge.eigenbasis(4).eigenvalues
    assert values[1] < 1e-3 * values[2]
    assert connection.eigenbasis(1).eigenvalues[0] > 0.1


def test_fields_on_a_flat_torus_are_pairs_of_functions():
    """In R⁴: two parallel fields, and the eigenvalues of functions twice."""
    lb = LaplaceBeltrami.from_mesh(*CliffordTorus().mesh(1000))
    scalar = lb.eigenbasis(9).eigenvalues.repeat_interleave(2)
    values = lb.connection.eigenbasis(18).eigenvalues[:18]
    assert values[:2].max() < 1e-5
    assert (values[2:] / scalar[2:] - 1).abs().max() < 1e-3


@pytest.mark.parametrize("condition", ["neumann", "dirichlet", Robin(2.0)])
def test_fields_on_a_disk_are_pairs_of_functions(condition):
    vertices, faces = UnitDisk().mesh(300)
    vertices = torch.nn.functional.pad(vertices, (0, 3 - vertices.shape[1]))
    lb = LaplaceBeltrami.from_mesh(vertices, faces, condition=condition)
    scalar = lb.eigenbasis(6).eigenvalues[:6].repeat_interleave(2)
    values = lb.connection.eigenbasis(12).eigenvalues[:12]
    torch.testing.assert_close(values, scalar, rtol=1e-6, atol=1e-6)


def test_matrices_are_symmetric_and_positive_on_any_mesh():
    """A bad one: three sheets at an edge, a needle, a triangle of no area."""
    vertices, faces = Hemisphere().mesh(100)
    more = torch.cat([vertices, torch.tensor([[0.0, 0.0, 2.0], [0.5, 0.5, 1.5]])]).double()
    extra = torch.tensor([[0, 1, 100], [0, 1, 101], [2, 3, 3], [4, 100, 101]])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        lb = LaplaceBeltrami.from_mesh(more, torch.cat([faces, extra]))
    fields = lb.connection
    for one in (fields, fields.hodge):
        k, m = (one.to_scipy(name).toarray() for name in ("stiffness", "mass"))
        assert np.isfinite(k).all()
        assert (k == k.T).all()
        assert (m == m.T).all()
        assert np.linalg.eigvalsh(k)[0] > -1e-12 * abs(k).max()
        assert np.linalg.eigvalsh(m)[0] > 0
    assert (lb.to_scipy("connection") != fields.to_scipy("stiffness")).nnz == 0


def test_media_scale_the_eigenvalues(bumpy):
    """−div(κ∇)/ρ, by numbers, by fields, and by tensors that are numbers times the identity."""
    plain = bumpy.connection.eigenbasis(6).eigenvalues
    scaled = bumpy.with_medium(conductivity=3.0, density=2.0, potential=1.0).connection
    torch.testing.assert_close(scaled.eigenbasis(6).eigenvalues, 1.5 * plain + 0.5)
    tensors = 3.0 * torch.eye(3, dtype=torch.float64).expand(bumpy.num_points, 3, 3)
    other = bumpy.with_medium(conductivity=tensors).connection
    torch.testing.assert_close(other.eigenbasis(6).eigenvalues, 3 * plain)
    with pytest.raises(InputError, match="number"):
        _ = other.hodge


def test_a_turned_shape_has_turned_flows(bumpy):
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))[0]
    v = torch.randn(bumpy.num_points, 3, 2, dtype=torch.float64)
    turned = LaplaceBeltrami.from_mesh(bumpy.points @ turn.T, bumpy.faces)
    there = vector_heat_flow(turned, torch.einsum("ab,ibc->iac", turn, v), 0.1)
    here = torch.einsum("ab,ibc->iac", turn, vector_heat_flow(bumpy, v, 0.1))
    torch.testing.assert_close(there, here, rtol=0, atol=1e-6)


def test_frames_do_not_matter(bumpy):
    """Another choice of tangent vectors turns components alone."""
    other, angle = bumpy._alias(), torch.linspace(0, 6, bumpy.num_points, dtype=torch.float64)
    turn = torch.stack([angle.cos(), angle.sin(), -angle.sin(), angle.cos()], 1).view(-1, 2, 2)
    other.frames, other._cache = bumpy.frames @ turn, None
    v = torch.randn(bumpy.num_points, 3, dtype=torch.float64)
    for flow in (vector_heat_flow, lambda lb, v, t: lb.connection.vectors(
        implicit_step(lb.connection, lb.connection.components(v), t)
    )):  # fmt: skip
        torch.testing.assert_close(flow(other, v, 0.2), flow(bumpy, v, 0.2), rtol=0, atol=1e-8)


def test_a_batch_has_the_fields_of_its_shapes(sphere, bumpy):
    batch = LaplaceBeltrami.batch([sphere, bumpy])
    values = batch.connection.eigenbasis(4).eigenvalues
    for own, shape in zip(values, (sphere, bumpy), strict=True):
        torch.testing.assert_close(own, shape.connection.eigenbasis(4).eigenvalues[:4])
    v = torch.randn(batch.num_points, 3, dtype=torch.float64)
    parts = v.split([sphere.num_points, bumpy.num_points])
    flows = [vector_heat_flow(s, x, 0.1) for s, x in zip((sphere, bumpy), parts, strict=True)]
    torch.testing.assert_close(vector_heat_flow(batch, v, 0.1), torch.cat(flows))


def test_float32_operators_have_float32_fields(sphere):
    narrow = sphere.float()
    assert narrow.connection.stiffness.dtype == torch.float32
    v = torch.linalg.cross(torch.tensor([[0.0, 0.0, 1.0]]), narrow.points)
    assert (
        vector_heat_flow(narrow, v, 0.5) - 0.5**0.5 * 0 - torch.tensor(-0.5).exp() * v
    ).abs().max() < 2e-3


def strip(count, fold):
    """A strip of length 2 and width 1, folded in the middle by an angle in degrees, and the field along it."""
    x, y = torch.linspace(-1, 1, 2 * count + 1).double(), torch.linspace(0, 1, count + 1).double()
    x, y = (z.flatten() for z in torch.meshgrid(x, y, indexing="ij"))
    angle = torch.tensor(fold).double().deg2rad()
    up = x.clamp_min(0) * angle.sin()
    points = torch.stack([torch.where(x > 0, x * angle.cos(), x), y, up], 1)
    first = (torch.arange(2 * count)[:, None] * (count + 1) + torch.arange(count)).flatten()
    faces = torch.stack([first, first + count + 1, first + 1], 1)
    others = torch.stack([first + 1, first + count + 1, first + count + 2], 1)
    beyond = torch.stack([angle.cos(), 0 * angle, angle.sin()])
    return points, torch.cat([faces, others]), x, beyond


SHAPES = {
    "closed": lambda: LaplaceBeltrami.from_mesh(*Ellipsoid().mesh(60)),
    "held": lambda: LaplaceBeltrami.from_mesh(*Hemisphere().mesh(70), condition="dirichlet"),
    "cloud": lambda: LaplaceBeltrami.from_points(Sphere().mesh(80)[0]),
    "folded": lambda: LaplaceBeltrami.from_mesh(*strip(4, 80.0)[:2]),
}


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("kind", SHAPES)
def test_derivatives_in_points_and_medium_are_those_of_differences(kind):
    lb = SHAPES[kind]()
    torch.manual_seed(2)
    lb = lb.at(lb.points + 0.003 * torch.randn_like(lb.points))
    way, v = torch.randn_like(lb.points), torch.randn_like(lb.points)
    kappa, slope = (0.1 * torch.randn_like(lb.mass) for _ in range(2))

    def values(points, field):
        there = lb.at(points).with_medium(conductivity=field.exp())
        fields = there.connection
        step = implicit_step(fields, fields.components(v), 0.1, tolerance=1e-12)
        flowed = heat_flow(fields, fields.components(v), 0.05, tolerance=1e-12)
        found = fields.eigenbasis(6, tolerance=1e-12).eigenvalues[:6].log().sum()
        return torch.stack(
            [found, (fields.vectors(step) * v).sum(), (fields.vectors(flowed) * v).sum()]
        )

    x, field = lb.points.clone().requires_grad_(), kappa.clone().requires_grad_()
    size = 1e-6
    ends = [values(lb.points + s * size * way, kappa + s * size * slope) for s in (1, -1)]
    expected = (ends[0] - ends[1]) / (2 * size)
    for value, number in zip(values(x, field), expected, strict=True):
        one, other = torch.autograd.grad(value, (x, field), retain_graph=True)
        found = float((one * way).sum() + (other * slope).sum())
        assert found == pytest.approx(float(number), rel=1e-4)


def test_the_gradient_of_eigenvalues_scales_and_has_no_force(bumpy):
    """Eigenvalues are homogeneous of degree −2, and do not feel where the shape stands."""
    x = bumpy.points.clone().requires_grad_()
    total = bumpy.at(x).connection.eigenbasis(10).eigenvalues[:10].log().sum()
    (g,) = torch.autograd.grad(total, x)
    assert float((g * x).sum()) == pytest.approx(-20, abs=1e-10)
    torque = torch.linalg.cross(x.detach(), g).sum(0)
    assert g.sum(0).norm() < 1e-10 * g.norm()
    assert torque.norm() < 1e-10 * g.norm()


def test_what_has_no_derivative_says_so(bumpy):
    x = bumpy.points.clone().requires_grad_()
    with pytest.raises(DerivativeError):
        bumpy.at(x).connection.hodge.eigenbasis(3).eigenvalues.sum().backward()


def test_bad_input_is_refused(bumpy):
    fields = bumpy.connection
    with pytest.raises(InputError, match="field of shape"):
        fields.components(torch.zeros(3, 3))
    with pytest.raises(InputError, match="weak pair"):
        _ = LaplaceBeltrami.from_mesh(*Sphere().mesh(60), weak_form=False).connection
    with pytest.raises(InputError, match="with_medium"):
        implicit_step(fields, fields.mass, 0.1, conductivity=fields.mass)


@pytest.mark.parametrize("fold", [45.0, 60.0, 90.0, 120.0, 160.0])
def test_a_fold_is_no_wall(fold):
    """A folded strip is isometric to a flat one: heat takes a vector along it across the fold, to five degrees."""
    points, faces, x, beyond = strip(16, fold)
    lb = LaplaceBeltrami.from_mesh(points, faces)
    source = int((points - torch.tensor([-0.5, 0.5, 0.0])).norm(dim=1).argmin())
    v = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    found = parallel_transport(lb, source, v, method="heat")[x > 0.2]
    cosine = found @ beyond / found.norm(dim=1)
    assert cosine.min() > torch.tensor(5.0).deg2rad().cos()


@pytest.mark.parametrize("cotangent", [False, True])
def test_fields_of_a_cube_come_in_pairs(cotangent):
    """As a quarter turn commutes with both Laplacians; Hodge's are those of functions."""
    cube = trimesh.creation.box().subdivide().subdivide().subdivide()
    vertices, faces = torch.tensor(cube.vertices), torch.tensor(cube.faces)
    build = LaplaceBeltrami.from_cotangent if cotangent else LaplaceBeltrami.from_mesh
    lb = build(vertices, faces)
    for fields in (lb.connection, lb.connection.hodge):
        pairs = fields.eigenbasis(6).eigenvalues[:6].view(3, 2)
        assert (pairs.diff(dim=1).abs() < 0.15 * pairs[:, 1:]).all()
    functions = lb.eigenbasis(4).eigenvalues[1:4]
    assert (pairs.mean(1) / functions - 1).abs().max() < 0.15
