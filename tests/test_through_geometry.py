"""Derivatives in the points, at frozen decisions, of what follows from the weak pair, and of rows of Δ and ∇."""

import functools
import gc
import weakref

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import Delaunay

from noise import noise
from torchlb import (
    DerivativeError,
    ImplicitDiffusion,
    LaplaceBeltrami,
    Robin,
    TorchlbWarning,
    geodesic_distance,
    heat_flow,
    heat_kernel_signature,
    implicit_step,
    poisson_solve,
)
from torchlb.surfaces import Ellipsoid, Hemisphere, Sphere, Torus, UnitDisk

H = 1e-6


def rough(points, faces=None, **options):
    """At points moved a little, so that no two neighbours are at the same distance, where the window has a kink."""
    points = torch.as_tensor(points) + 0.003 * noise(*points.shape)
    if faces is None:
        return LaplaceBeltrami.from_points(points, **options)
    return LaplaceBeltrami.from_mesh(points, faces, **options)


def trefoil():
    t = torch.arange(60, dtype=torch.float64) * torch.pi / 30
    x = [t.sin() + 2 * (2 * t).sin(), t.cos() - 2 * (2 * t).cos(), -(3 * t).sin()]
    return torch.stack(x, 1), torch.stack([torch.arange(60), (torch.arange(60) + 1) % 60], 1)


def cube():
    axis = np.linspace(0, 1, 6)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    points += 0.03 * np.random.default_rng(0).normal(size=points.shape)
    return points, Delaunay(points).simplices


def flat():
    """A triangulation whose rim has long triangles, which the cover of coarse triangles stands for."""
    grid = np.stack(np.meshgrid(np.arange(12.0), np.arange(12.0)), -1).reshape(-1, 2)
    points = grid + 0.2 * np.random.default_rng(1).normal(size=grid.shape)
    return points, Delaunay(points).simplices


def three_sheets():
    """Half-planes, a little curved, that share an edge of three faces a side."""
    grid = torch.cartesian_prod(torch.arange(9.0), torch.arange(5.0)).double()
    first = torch.arange(8 * 4) // 4 * 5 + torch.arange(8 * 4) % 4
    faces = torch.cat(
        [first[:, None] + torch.tensor([0, 5, 6]), first[:, None] + torch.tensor([0, 6, 1])]
    )
    points, every, start = [], [], 0
    for turn in range(3):
        angle = torch.tensor(2 * torch.pi * turn / 3 + 0.1 * turn)
        bend = 0.02 * grid[:, 1] ** 2
        points.append(
            torch.stack(
                [
                    grid[:, 0],
                    grid[:, 1] * angle.cos() - bend * angle.sin(),
                    grid[:, 1] * angle.sin() + bend * angle.cos(),
                ],
                1,
            )
        )
        every.append(faces + start)
        start += len(grid)
    points, faces = torch.cat(points), torch.cat(every)
    own = torch.arange(len(points))
    own[len(grid) :] = torch.where(
        grid[:, 1].repeat(2) == 0, torch.arange(len(grid)).repeat(2), own[len(grid) :]
    )
    kept, number = own[faces].unique(return_inverse=True)
    return points[kept], number


SHAPES = {
    "closed": lambda: rough(*Ellipsoid((1.0, 0.8, 0.6)).mesh(200)),
    "open": lambda: rough(*Hemisphere().mesh(150)),
    "held": lambda: rough(*Hemisphere().mesh(150), condition="dirichlet"),
    "robin": lambda: rough(*Hemisphere().mesh(150), condition=Robin(1.5)),
    "sheets": lambda: rough(*three_sheets()),
    "order 5": lambda: rough(*Torus().mesh(250), order=5),
    "cloud": lambda: rough(Sphere().points(200)),
    "curve": lambda: rough(*trefoil()),
    "solid": lambda: rough(*cube()),
    "held solid": lambda: rough(*cube(), condition="dirichlet"),
    "coarse": lambda: rough(*flat()),
}


@functools.cache
def built(name):
    return SHAPES[name]()


def slopes(lb, values):
    """Derivatives of values of `lb.at(points)` in a direction, by the chain rule and by differences."""
    way = noise(*lb.points.shape, seed=3)
    x = lb.points.clone().requires_grad_()
    here, ahead, behind = (lb.at(place) for place in (x, lb.points + H * way, lb.points - H * way))
    for value in values:
        (gradient,) = torch.autograd.grad(value(here), x, retain_graph=True)
        yield (gradient * way).sum(), (value(ahead) - value(behind)) / (2 * H)


@pytest.mark.parametrize("name", SHAPES)
def test_the_gradient_is_that_of_differences(name):
    """Of wᵀKu, wᵀMu, ∫f, solves, Σ log λ_k and a filter; eigenpairs are solved anew at both ends."""
    lb = built(name)
    assert (name == "coarse") == bool(lb.plan.pair.curving.coarse.any())
    w, u = noise(2, lb.num_points, 3, seed=1)

    def forms(matrix):
        return lambda moved: (w * moved.product(matrix, u)).sum()

    def logarithms(moved):
        values = moved.eigenbasis(8, tolerance=1e-11).eigenvalues
        return values[values > 1e-6].log().sum()

    k = 7 if name == "curve" else 8  # whole eigenspaces of the circle

    def spectral(moved):
        moved.eigenbasis(k, tolerance=1e-13)
        return (w * heat_flow(moved, u, 0.1, method="spectral", k=k)).sum()

    values = [forms("stiffness"), forms("mass"), lambda moved: (w[:, 0] * moved.mass).sum()]
    values += [
        lambda moved: (w * implicit_step(moved, u, 0.1, tolerance=1e-12)).sum(),
        lambda moved: (w * poisson_solve(moved, u, tolerance=1e-12)).sum(),
    ]
    if name in ("open", "robin", "solid"):
        data = {"flux": noise(lb.num_points, 3, seed=4), "tolerance": 1e-12}
        values += [
            forms("boundary_mass"),
            lambda moved: (w * implicit_step(moved, u, 0.1, **data)).sum(),
        ]
    for ours, theirs in slopes(lb, (*values, logarithms, spectral)):
        assert abs(ours - theirs) < 2e-4 * abs(theirs) + 1e-6, (ours, theirs)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("name", [name for name in SHAPES if name != "held solid"])  # rows: "held"
def test_rows_have_the_gradient_of_differences(name):
    """Of Δf, ∇f, ∇²f, the mean-curvature vector, normals and projectors, with low-order rows among them."""
    lb = built(name)
    n = lb.points.shape[1]
    w, u = noise(2, lb.num_points, 2, seed=1)
    v = noise(n, seed=2)

    def projected(moved):
        return (v @ moved.frames).square().sum(1)

    values = (
        lambda moved: (w * moved(u)).sum(),
        lambda moved: (w[:, 0] * (moved.matrix @ u)[:, 0]).sum(),
        lambda moved: (w * (v @ moved.gradient(u))).sum(),
        lambda moved: (w * moved.hessian(u).diagonal(dim1=1, dim2=2).sum(-1)).sum(),
        lambda moved: moved.mean_curvature_normal().square().sum(),
        lambda moved: (w[:, 0] * moved.divergence(moved.points)).sum(),
        lambda moved: (w[:, 0] * projected(moved)).sum(),
        lambda moved: (moved.normals @ v * w[: len(moved.normals), 0]).sum(),
    )
    for ours, theirs in slopes(lb, [value for value in values if value(lb) != 0]):
        assert abs(ours - theirs) < 2e-4 * abs(theirs) + 1e-6, (ours, theirs)


@pytest.mark.parametrize("name", ["closed", "cloud", "curve"])
def test_scaling_turning_and_moving(name):
    """λ falls as size^−2, so gradient · x = −2 Σ 1 of Σ log λ; no force, no torque."""
    lb = built(name)
    x = lb.points.clone().requires_grad_()
    values = lb.at(x).eigenbasis(11, tolerance=1e-11).eigenvalues[1:]
    (g,) = torch.autograd.grad(values.log().sum(), x)
    assert abs((g * x).sum() + 20) < 1e-7
    assert g.sum(0).abs().max() < 1e-8 * g.abs().sum()
    torque = torch.linalg.cross(x.detach(), g).sum(0)
    assert torque.abs().max() < 1e-8 * g.abs().sum()


@pytest.mark.usefixtures("unchecked")
def test_descent_makes_an_ellipsoid_round():
    """1/λ_1 + 1/λ_2 + 1/λ_3 ≥ 3A/8π, with equality on the round sphere (Hersch 1970), over axes of an ellipsoid."""
    lb = built("closed")
    stretch = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([stretch], max_iter=15, line_search_fn="strong_wolfe")

    def loss():
        optimizer.zero_grad()
        moved = lb.at(lb.points * stretch.exp())
        value = (1 / moved.eigenbasis(4).eigenvalues[1:]).sum() / moved.mass.sum()
        value.backward()
        return value

    optimizer.step(loss)
    axes = (torch.tensor([1.0, 0.8, 0.6]) * stretch.detach().exp()).double()
    assert axes.max() / axes.min() < 1.02
    assert float(loss().detach()) == pytest.approx(3 / (8 * torch.pi), rel=1e-2)


def test_float32_and_a_graph_before_the_points():
    lb = built("closed")
    scale = torch.tensor(1.1, requires_grad=True)
    moved = lb.at(lb.points.float() * scale)
    values = moved.eigenbasis(5).eigenvalues[1:]
    (g,) = torch.autograd.grad(values.sum(), scale)
    assert g.dtype == torch.float32
    assert abs(g + 2 * values.sum() / 1.1) < 1e-3 * values.sum()


def test_what_has_no_derivative_raises_and_nothing_is_zero_in_silence(unchecked):
    lb = built("closed")
    x = lb.points.clone().requires_grad_()
    moved, f = lb.at(x), noise(lb.num_points, 2)
    layer = ImplicitDiffusion(2).double()
    for value in (
        moved.stiffness @ f,
        geodesic_distance(moved, 0),
        layer(f, moved),
    ):
        with pytest.raises(DerivativeError, match="no derivative in the points"):
            value.sum().backward()
    g = f.clone().requires_grad_()
    (expected,) = torch.autograd.grad(heat_flow(lb, g, 0.1).square().sum(), g)
    (found,) = torch.autograd.grad(heat_flow(moved, g, 0.1).square().sum(), g)
    torch.testing.assert_close(found, expected)
    vertices, faces = Hemisphere().mesh(100)
    with pytest.raises(DerivativeError, match="without a weak pair"):
        LaplaceBeltrami.from_mesh(vertices.requires_grad_(), faces, weak_form=False)


@pytest.mark.parametrize("parameter", [False, True])
def test_builders_carry_gradients(parameter):
    """As `at` does: the same gradient, with no parameter that the module did not have."""
    lb = built("cloud")
    x, y = (lb.points.clone().requires_grad_() for _ in range(2))
    x = torch.nn.Parameter(x.detach()) if parameter else x
    made = LaplaceBeltrami.from_points(x)
    assert list(made.parameters()) == []
    gradients = [
        torch.autograd.grad(other.eigenbasis(6, tolerance=1e-11).eigenvalues[1:].log().sum(), z)[0]
        for other, z in ((made, x), (lb.at(y), y))
    ]
    torch.testing.assert_close(*gradients, rtol=1e-6, atol=1e-8)
    with torch.no_grad():
        assert not LaplaceBeltrami.from_points(x).points.requires_grad


def test_a_batch_has_the_gradients_of_its_shapes():
    """Of masses, eigenvalues, signatures, products and solves; a copy, which does not know its shapes, raises."""
    x = built("closed").points.clone().requires_grad_()
    single, f = built("closed").at(x), noise(400, 1)
    batch = LaplaceBeltrami.batch([single, built("closed")])
    for value in (
        lambda lb: lb.mass[:200].sum(),
        lambda lb: lb.eigenbasis(4).eigenvalues.view(-1)[:4].sum(),
        lambda lb: heat_kernel_signature(lb, k=6)[:200].square().sum(),
        lambda lb: lb.product("mass", f[: lb.num_points])[:200].square().sum(),
        lambda lb: implicit_step(lb, f[: lb.num_points], 0.1)[:200].square().sum(),
    ):
        pair = value(batch), value(single)
        torch.testing.assert_close(*pair, rtol=1e-6, atol=1e-8)
        grads = [torch.autograd.grad(v, x, retain_graph=True)[0] for v in pair]
        torch.testing.assert_close(*grads, rtol=1e-4, atol=1e-6)
    with pytest.raises(DerivativeError, match="does not know the shapes"):
        batch.float().eigenbasis(3)


def test_cells_without_area_do_no_harm():
    """A T-junction closed by a triangle of three points on a line; a point with no other cell is an error."""
    vertices, faces = Ellipsoid((1.0, 0.8, 0.6)).mesh(200)
    a, b, c = faces[0].tolist()
    middle = (vertices[a] + vertices[b]) / 2
    more = torch.tensor([[a, 200, c], [200, b, c], [a, b, 200]])
    x = torch.cat([vertices, middle[None]]).requires_grad_()
    lb = LaplaceBeltrami.from_mesh(x, torch.cat([faces[1:], more]))
    values = lb.eigenbasis(8, tolerance=1e-11).eigenvalues[1:]
    (g,) = torch.autograd.grad(values.log().sum(), x)
    assert abs((g * x).sum() + 14) < 1e-6
    x = torch.cat([vertices, vertices[:1]]).requires_grad_()
    corner = faces[(faces == 0).any(1)][0].max()
    lone = torch.stack([torch.tensor(0), torch.tensor(200), corner])
    lb = LaplaceBeltrami.from_mesh(x, torch.cat([faces, lone[None]]))
    with pytest.raises(DerivativeError, match=r"the derivative at .* is not finite"):
        lb.eigenbasis(4).eigenvalues.sum().backward()


def test_rows_lowered_for_a_positive_mass_are_decided_at_the_points():
    """Of the moved shape the mass wants other rows lowered; its gradient has these."""
    torch.manual_seed(2)
    lb = LaplaceBeltrami.from_mesh(*Hemisphere().mesh(120))
    base = lb.points + 0.003 * torch.randn_like(lb.points)
    way, weight = torch.randn_like(base), torch.randn_like(lb.mass)
    assert len(lb.at(base).plan.pair.lowered) > len(lb.plan.pair.lowered)
    x = base.clone().requires_grad_()
    (g,) = torch.autograd.grad((weight * lb.at(x).mass).sum(), x)
    ends = [float((weight * lb.at(base + s * 1e-6 * way).mass).sum()) for s in (1, -1)]
    assert float((g * way).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-6)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("time", [4.0, 4.2])
def test_derivatives_of_long_flows_of_modes_do_not_underflow(time):
    """Of e^{−2t/r²}x on spheres, by modes whose e^{−λt} float32 has no digits for."""
    x, faces = Sphere().mesh(1000)
    moved = LaplaceBeltrami.from_mesh(x.clone().requires_grad_(), faces)
    warmth = (x * heat_flow(moved, x, time, method="spectral", k=25)).sum()
    (g,) = torch.autograd.grad(warmth, moved.points)
    torch.testing.assert_close((g * x).sum(), 4 * time * warmth, rtol=1e-3, atol=0.0)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("shape", ["sphere", "icosphere", "disk"])
def test_functions_of_equal_eigenvalues_have_derivatives(shape):
    """Signatures and flows by whole eigenspaces, against differences, in points and in the density."""
    count = 6 if shape == "disk" else 9  # the next eigenvalue is 0.6 or more away
    if shape == "icosphere":  # eigenvalues agree to rounding
        found = trimesh.creation.icosphere(2)
        points, faces = torch.tensor(found.vertices), torch.tensor(found.faces)
    else:
        points, faces = (Sphere() if shape == "sphere" else UnitDisk()).mesh(300)
    lb = LaplaceBeltrami.from_mesh(points, faces)
    x, y, way = points[:, 0], points[:, 1], points * (points[:, :1] * points[:, 1:2] + 0.3)
    density = 1 + 0.3 * x * y

    def losses(lb):
        basis = lb.eigenbasis(count, tolerance=1e-11)
        warmth = (-0.2 * basis.eigenvalues).exp()
        yield (warmth * basis.eigenvectors.square() * (x * y + x)[:, None]).sum()
        yield (
            y * basis.from_basis(warmth[:, None] * basis.to_basis(x[:, None] + y[:, None]))[:, 0]
        ).sum()

    leaf, field = points.clone().requires_grad_(), torch.ones_like(x).requires_grad_()
    for variable, along, at in (
        (leaf, way, lambda s: lb.at(points + s * way)),
        (field, density, lambda s: lb.with_medium(density=1 + s * density)),
    ):
        here = lb.at(leaf) if variable is leaf else lb.with_medium(density=field)
        pairs = zip(losses(at(1e-4)), losses(at(-1e-4)), strict=True)
        for loss, (up, down) in zip(losses(here), pairs, strict=True):
            (g,) = torch.autograd.grad(loss, variable, retain_graph=True)
            expected = float(up - down) / 2e-4
            assert float((g * along).sum()) == pytest.approx(expected, rel=2e-4, abs=1e-6)


def test_close_eigenvalues_in_float32_are_told():
    found = trimesh.creation.icosphere(2)
    points = torch.tensor(found.vertices).float().requires_grad_()
    moved = LaplaceBeltrami.from_mesh(points, torch.tensor(found.faces))
    with pytest.warns(TorchlbWarning, match="agree with others to the rounding of torch.float32"):
        moved.eigenbasis(4).eigenvectors.square().sum().backward()


def test_operators_at_points_with_gradients_are_let_go(unchecked):
    lb = built("closed")
    moved = lb.at(lb.points.clone().requires_grad_())
    moved(moved.points.detach()).sum().backward()
    kept = weakref.ref(moved)
    del moved
    gc.collect()
    assert kept() is None


@pytest.mark.usefixtures("unchecked")
def test_tensor_conductivities_have_the_gradient_of_differences_in_the_points():
    lb = rough(*Ellipsoid().mesh(150))
    points, way = lb.points, noise(*lb.points.shape)
    a = torch.eye(3).double() * (1 + points[:, :1, None].square())

    def loss(points):
        return lb.at(points).with_medium(a).eigenbasis(5, tolerance=1e-11).eigenvalues[1:].sum()

    x = points.clone().requires_grad_()
    (g,) = torch.autograd.grad(loss(x), x)
    expected = float(loss(points + H * way) - loss(points - H * way)) / (2 * H)
    assert float((g * way).sum()) == pytest.approx(expected, rel=1e-5)
