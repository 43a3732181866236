"""u − t div(κ∇u) = f: exact solutions, derivatives in κ, and what κ may be."""

import pytest
import torch
from torch.autograd import gradcheck

from torchlb import InputError, LaplaceBeltrami, implicit_step, poisson_solve
from torchlb.galerkin.forms import Forms
from torchlb.pde.conduction import elements_of, with_conductivity
from torchlb.surfaces import Ellipsoid, Sphere, Torus, UnitDisk


def build(kind, n=80):
    vertices, faces = (UnitDisk() if kind == "dirichlet" else Sphere()).mesh(n)
    if kind == "cotangent":
        return LaplaceBeltrami.from_cotangent(vertices, faces)
    order, condition = (
        (5, None) if kind == "order 5" else (3, kind if kind == "dirichlet" else None)
    )
    return LaplaceBeltrami.from_mesh(vertices, faces, order=order, condition=condition or "neumann")


KINDS = ["mesh", "order 5", "cotangent", "dirichlet"]
every_kind = pytest.mark.parametrize("kind", KINDS)


def test_the_elements_are_those_of_the_operator_on_a_thin_shape():
    """κ = 1 is the plain solve, where fits must not take points of the other side either."""
    lb = LaplaceBeltrami.from_mesh(*Ellipsoid((1.0, 1.0, 0.1)).mesh(500))
    one, x = torch.ones(500, dtype=torch.float64), lb.points[:, 0]
    torch.testing.assert_close(poisson_solve(lb, x, conductivity=one), poisson_solve(lb, x))


@every_kind
@pytest.mark.parametrize("at", ["vertices", "faces"])
def test_a_constant_conductivity_is_a_factor_of_time(kind, at):
    lb = build(kind, 300)
    f = torch.randn(300, 2, dtype=torch.float64)
    kappa = torch.full((300 if at == "vertices" else len(lb.faces),), 0.3, dtype=torch.float64)
    times = torch.tensor([0.1, 2.0], dtype=torch.float64)
    exact = {"tolerance": 1e-13}
    u = implicit_step(lb, f, times, conductivity=kappa, **exact)
    expected = implicit_step(lb, f, 0.3 * times, **exact)
    torch.testing.assert_close(u, expected, rtol=0, atol=1e-8)
    u = poisson_solve(lb, f, conductivity=kappa, **exact)
    torch.testing.assert_close(u, poisson_solve(lb, f, **exact) / 0.3, rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("kind", "bound"), [("mesh", 2e-5), ("order 5", 1e-7), ("cotangent", 1e-2)]
)
def test_a_known_solution_on_the_sphere(kind, bound):
    """u = z, κ = e^{z}: div κ∇u = κ(−2z + 1 − z²); the prolonged logarithm keeps the order."""
    lb = build(kind, 1000)
    z = lb.points[:, 2]
    divergence = z.exp() * (1 - z.square() - 2 * z)
    u = implicit_step(lb, z - 0.5 * divergence, 0.5, conductivity=z.exp(), tolerance=1e-12)
    assert (u - z).norm() / z.norm() < bound
    u = poisson_solve(lb, -divergence, conductivity=z.exp(), tolerance=1e-12)
    assert (u - z).norm() / z.norm() < 3 * bound


@every_kind
def test_stiffness_is_symmetric_and_positive_for_any_conductivity(kind):
    """Rough over six decades; constants are in its kernel; linear elements are the cotangent's."""
    lb = build(kind)
    for count in (80, len(lb.faces)):
        kappa = (3 * torch.randn(count, dtype=torch.float64)).exp()
        crow, col, values = with_conductivity(lb, kappa).weak.pair
        dense = torch.sparse_csr_tensor(crow, col, values[0]).to_dense()
        scale = dense.abs().max()
        assert (dense - dense.T).abs().max() <= 1e-12 * scale
        assert dense.sum(1).abs().max() <= 1e-12 * scale
        assert torch.linalg.eigvalsh(dense).min() >= -1e-10 * scale
    flat = Forms.linear(lb.points, lb.faces)
    ones = torch.ones(80, dtype=torch.float64)
    upper = torch.from_numpy(flat.matrix(flat.conductivities(ones)).real.toarray())
    cotangent = LaplaceBeltrami.from_cotangent(lb.points, lb.faces).stiffness.to_dense()
    torch.testing.assert_close(upper + upper.triu(1).T, cotangent, rtol=0, atol=1e-10)


@every_kind
@pytest.mark.parametrize("at", ["vertices", "faces"])
def test_derivatives_in_conductivity_data_and_time(kind, at):
    lb = build(kind, 40)
    count = 40 if at == "vertices" else len(lb.faces)
    kappa = torch.rand(count, dtype=torch.float64).add(0.5).requires_grad_()
    f = torch.randn(40, 2, dtype=torch.float64, requires_grad=True)
    t = torch.tensor([0.1, 0.3], dtype=torch.float64, requires_grad=True)
    data = {"boundary_values": 0.5} if kind == "dirichlet" else {}

    def step(kappa, f, t):
        return implicit_step(lb, f, t, conductivity=kappa, tolerance=1e-13, **data)

    def poisson(kappa, f):
        return poisson_solve(lb, f, conductivity=kappa, tolerance=1e-13, **data)

    assert gradcheck(step, (kappa, f, t), fast_mode=True)
    assert gradcheck(poisson, (kappa, f), fast_mode=True)


def test_as_many_vertices_as_faces_are_vertices():
    """κ = e^x on a grid of 12 points in 12 triangles, linear elements: its logarithm is linear in each."""
    x, y = (
        t.flatten() for t in torch.meshgrid(torch.arange(3.0), torch.arange(4.0), indexing="ij")
    )
    corner = torch.arange(8).view(2, 4)[:, :3].flatten()[:, None]
    faces = torch.cat([corner + torch.tensor([0, 4, 5]), corner + torch.tensor([0, 5, 1])])
    forms = Forms.linear(torch.stack([x, y, 0 * x], 1).double(), faces)
    kappa = x.double().exp()
    expected = (x.double()[faces] @ forms.element.values.T).exp()
    torch.testing.assert_close(forms.conductivities(kappa)[0], expected)


def test_elements_are_made_once():
    lb = build("mesh")
    assert elements_of(lb) is elements_of(lb)


def test_a_conductivity_is_learned():
    """κ = e^{c z} from one observed step, by gradient descent on c."""
    lb = build("mesh", 300)
    z = lb.points[:, 2]
    f = torch.stack([z, lb.points[:, 0]], 1)
    seen = implicit_step(lb, f, 0.5, conductivity=(0.7 * z).exp())
    c = torch.zeros((), dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([c], line_search_fn="strong_wolfe")

    def loss():
        optimizer.zero_grad()
        misfit = (implicit_step(lb, f, 0.5, conductivity=(c * z).exp()) - seen).square().sum()
        misfit.backward()
        return misfit

    optimizer.step(loss)
    assert abs(c.item() - 0.7) < 1e-4


def test_what_has_no_elements_or_cannot_be_a_conductivity_is_refused():
    lb, one = build("mesh"), torch.ones(80, dtype=torch.float64)
    for wrong, message in ((one[1:], "one of each vertex"), (0 * one, "finite, positive")):
        with pytest.raises(InputError, match=message):
            implicit_step(lb, one, 0.1, conductivity=wrong)
    batch = LaplaceBeltrami.batch([lb, build("mesh")])
    bare = LaplaceBeltrami.from_mesh(*Torus().mesh(80), weak_form=False)
    for other, remedy in ((batch, "unbatch"), (bare, "weak pair")):
        ones = torch.ones(other.num_points, dtype=torch.float64)
        with pytest.raises(InputError, match=remedy):
            poisson_solve(other, ones, conductivity=ones)


def test_a_cloud_conducts_as_its_surface_does():
    """κ = e^z at the points of a sphere, once as a cloud and once as the mesh through it: 1e-3 at 600 points."""
    points = Sphere().points(600)
    cloud = LaplaceBeltrami.from_points(points)
    mesh = LaplaceBeltrami.from_mesh(points, cloud.faces)
    x, z = points[:, 0], points[:, 2]
    for step in (implicit_step, lambda lb, f, t, **k: poisson_solve(lb, f, **k)):
        one, two = (step(lb, x, 0.3, conductivity=z.exp()) for lb in (cloud, mesh))
        assert (one - two).norm() < 1e-3 * two.norm()
