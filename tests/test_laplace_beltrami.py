"""One contract for every kind of operator, its invariances, and its accuracy at known figures."""

import copy
import io
import pickle

import igl
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from tolerances import TOLERANCE
from torchlb import LaplaceBeltrami
from torchlb.surfaces import (
    Circle,
    CliffordTorus,
    Ellipsoid,
    Sphere,
    Torus,
    deserno_points,
    smooth_function,
    spherical_harmonic,
)

BUILDERS = {
    "points": lambda n: LaplaceBeltrami.from_points(Torus().points(n)),
    "random points": lambda n: LaplaceBeltrami.from_points(Torus().random_points(n)),
    "mesh": lambda n: LaplaceBeltrami.from_mesh(*Sphere().mesh(n)),
    "normal projection": lambda n: LaplaceBeltrami.from_mesh(
        *Sphere().mesh(n), projection="normal"
    ),
    "polyharmonic": lambda n: LaplaceBeltrami.from_points(
        Sphere().points(n), weights="polyharmonic"
    ),
    "cotangent": lambda n: LaplaceBeltrami.from_cotangent(*Sphere().mesh(n)),
    "curve": lambda n: LaplaceBeltrami.from_points(Circle().points(n)),
    "surface in R^4": lambda n: LaplaceBeltrami.from_points(CliffordTorus().points(n), dim=2),
}
every_builder = pytest.mark.parametrize("build", BUILDERS.values(), ids=BUILDERS.keys())


def relative(error, exact):
    return float(error.norm() / exact.norm())


@every_builder
def test_contract(build):
    """L1 = 0 to rounding, mass positive, forward is the matrix, shapes of every product."""
    lb = build(200)
    n = lb.points.shape[1]
    matrix = lb.matrix.to_dense()
    assert matrix.sum(1).abs().max() <= 1e-12 * matrix.abs().max()
    assert lb.mass.min() > 0
    assert lb.frames.shape == (200, n, lb.dim)
    torch.testing.assert_close(lb(torch.eye(200).double()), matrix)
    f = torch.randn(2, 200, 3).double()
    assert lb(f).shape == (2, 200, 3)
    torch.testing.assert_close(lb(f)[1], lb(f[1]))
    torch.testing.assert_close(lb(f[1])[:, 2], lb(f[1, :, 2]))
    assert lb.gradient(f[0, :, 0]).shape == (200, n)
    assert lb.gradient(f[0]).shape == (200, n, 3)
    assert lb.gradient(f).shape == (2, 200, n, 3)
    torch.testing.assert_close(lb.gradient(f)[1, :, :, 0], lb.gradient(f[1, :, 0]))
    assert lb.divergence(lb.gradient(f[0])).shape == (200, 3)
    assert lb.divergence(lb.gradient(f[0, :, 0])).shape == (200,)
    assert lb.mean_curvature_normal().shape == (200, n)
    assert "200 points" in repr(lb)
    assert "200 points" in str(lb.report)


@every_builder
def test_forward_is_differentiable_twice(build):
    lb = build(40)
    f = torch.randn(40, 2, dtype=torch.float64, requires_grad=True)
    assert gradcheck(lb, f)
    assert gradgradcheck(lb, f)


@every_builder
def test_stored_and_read_back(build):
    """deepcopy, pickle, a state_dict through a file into an empty operator, and the module itself."""
    lb = build(200)
    f = torch.randn(200, 2).double()
    state, module = io.BytesIO(), io.BytesIO()
    torch.save(lb.state_dict(), state)
    torch.save(lb, module)
    empty = LaplaceBeltrami()
    empty.load_state_dict(torch.load(io.BytesIO(state.getvalue()), weights_only=True))
    whole = torch.load(io.BytesIO(module.getvalue()), weights_only=True)
    for other in (copy.deepcopy(lb), pickle.loads(pickle.dumps(lb)), empty, whole):
        assert torch.equal(other(f), lb(f))
        assert torch.equal(other.gradient(f), lb.gradient(f))
        assert repr(other) == repr(lb)
        assert other.certificate == lb.certificate
        g = f.clone().requires_grad_()
        other(g).sum().backward()
        assert g.grad.isfinite().all()


def test_floating_type_is_that_of_the_input():
    points = Sphere().points(300)
    single = LaplaceBeltrami.from_points(points.float())
    double = LaplaceBeltrami.from_points(points.float().double())
    assert single.values.dtype == torch.float32
    torch.testing.assert_close(single.values, double.values.float())
    assert single(torch.randn(300, 2)).dtype == torch.float32
    assert single.double()(torch.randn(300, 2).double()).dtype == torch.float64


@pytest.mark.parametrize("projection", ["tangent", "normal"])
def test_rigid_motion_scale_and_permutation(projection):
    """Δ is invariant under motions, of degree −2 in the scale, and equivariant under permutations."""
    points = Ellipsoid().points(300)
    f = smooth_function(points)
    lb = LaplaceBeltrami.from_points(points, order=3, projection=projection)
    reference = lb(f)
    rotation, _ = torch.linalg.qr(torch.randn(3, 3).double())
    shuffle = torch.randperm(300)
    variants = [(points @ rotation.T + torch.tensor([3.0, -1, 2]).double(), f, reference)]
    variants += [(s * points, f, reference / s**2) for s in (1e-3, 1e3)]
    variants += [(points[shuffle], f[shuffle], reference[shuffle])]
    for moved, values, expected in variants:
        other = LaplaceBeltrami.from_points(moved, order=3, projection=projection)
        assert relative(other(values) - expected, expected) < 1e-9
    twice = LaplaceBeltrami.from_points(2 * points, order=3, projection=projection)
    torch.testing.assert_close(twice.mass, 4 * lb.mass, **TOLERANCE[torch.float64])
    torch.testing.assert_close(2 * twice.gradient(f), lb.gradient(f), rtol=1e-8, atol=1e-8)


def test_cotangent_is_libigls():
    vertices, faces = Ellipsoid().mesh(500)
    lb = LaplaceBeltrami.from_cotangent(vertices, faces)
    weak = igl.cotmatrix(vertices.numpy(), faces.numpy()).toarray()
    mass = igl.massmatrix(vertices.numpy(), faces.numpy()).diagonal()
    torch.testing.assert_close(lb.mass, torch.from_numpy(mass))
    torch.testing.assert_close(
        lb.mass[:, None] * lb.matrix.to_dense(), torch.from_numpy(weak), rtol=1e-12, atol=1e-12
    )


@pytest.mark.parametrize("build", [LaplaceBeltrami.from_mesh, None], ids=["mesh", "points"])
def test_derivatives_against_the_exact_ones(build):
    """∇f, div ∇f = Δf, and Δx = −2x on the unit sphere."""
    surface = Sphere()
    vertices, faces = surface.mesh(2000)
    lb = build(vertices, faces) if build else LaplaceBeltrami.from_points(vertices)
    f, exact = smooth_function(vertices), surface.laplacian(smooth_function, vertices)
    slope = surface.gradient(smooth_function, vertices)
    assert relative(lb.gradient(f) - slope, slope) < 1e-4
    assert relative(lb.divergence(slope) - exact, exact) < 1e-3
    assert (lb.mean_curvature_normal() + 2 * vertices).abs().max() < 1e-3
    assert ((lb.normals * vertices).sum(1) > 0.99).all()


@pytest.mark.parametrize(
    ("projection", "order", "bound"),
    [("tangent", 3, 5.2e-5), ("tangent", 5, 6.7e-7), ("normal", 3, 4e-4), ("normal", 5, 2.4e-5)],
)
def test_error_on_the_sphere(projection, order, bound):
    surface = Sphere()
    points = surface.points(4070)
    lb = LaplaceBeltrami.from_points(points, order=order, projection=projection)
    exact = surface.laplacian(smooth_function, points)
    assert relative(lb(smooth_function(points)) - exact, exact) <= bound


@pytest.mark.parametrize(
    ("projection", "order", "bound"),
    [("tangent", 3, 6e-5), ("tangent", 5, 2e-7), ("normal", 5, 2e-5)],
)
def test_error_on_deserno_nodes(projection, order, bound):
    """ΔY = −30 Y for the spherical harmonic Y_5^4, N = 8038."""
    points = deserno_points(8000)
    y = spherical_harmonic(5, 4)(points)
    lb = LaplaceBeltrami.from_points(points, order=order, projection=projection, certify=False)
    assert relative(lb(y) + 30 * y, 30 * y) <= bound
