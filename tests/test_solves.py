"""Implicit steps and Poisson problems against dense algebra, exact solutions, and their own derivatives."""

import copy
import functools
import gc
import inspect
import pickle
import weakref

import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay
from torch.autograd import gradcheck

import torchlb
from torchlb import (
    DiffusionError,
    InputError,
    LaplaceBeltrami,
    heat_flow,
    implicit_step,
    poisson_solve,
)
from torchlb.linalg.conjugate_gradients import conjugate_gradients
from torchlb.linalg.exponential import _coefficients
from torchlb.operator import systems
from torchlb.pde.solves import potential
from torchlb.surfaces import CliffordTorus, Ellipsoid, Sphere, StarShaped, Torus, UnitDisk


def disk(n, condition):
    return LaplaceBeltrami.from_mesh(*UnitDisk().mesh(n), order=2, condition=condition)


BUILDERS = {
    "pair": lambda: LaplaceBeltrami.from_mesh(*Torus().mesh(80), order=2),
    "cotangent": lambda: LaplaceBeltrami.from_cotangent(*Sphere().mesh(60)),
    "four": lambda: LaplaceBeltrami.from_points(CliffordTorus().points(100), dim=2, order=2),
    "neumann": lambda: disk(80, "neumann"),
    "dirichlet": lambda: disk(80, "dirichlet"),
}
BUILDERS = {name: functools.cache(build) for name, build in BUILDERS.items()}
every_builder = pytest.mark.parametrize("build", BUILDERS.values(), ids=BUILDERS.keys())


def rough(lb, *shape, grad=False):
    return torch.randn(lb.num_points, *shape, dtype=torch.float64, requires_grad=grad)


def dense(lb):
    """K and M."""
    return lb.stiffness.to_dense(), lb.mass_matrix.to_dense()


def free(lb):
    return torch.ones(lb.num_points, dtype=torch.bool) if lb.fixed is None else ~lb.fixed


@every_builder
def test_implicit_step_is_dense_algebra(build):
    """(M + tK)u = Mf with the rows and columns of Dirichlet points taken out, for (N,), (N, C), (B, N, C)."""
    lb = build()
    f, times, inside = (
        torch.randn(2, lb.num_points, 2).double(),
        torch.tensor([0.05, 2.0]),
        free(lb),
    )
    u = implicit_step(lb, f, times)
    stiffness, mass = dense(lb)
    for c, t in enumerate(times.double()):
        expected = torch.zeros_like(f[..., c])
        matrix = (mass + t * stiffness)[inside][:, inside]
        expected[:, inside] = torch.linalg.solve(matrix, (mass @ f[..., c].T)[inside]).T
        torch.testing.assert_close(u[..., c], expected, rtol=0, atol=1e-8)
    torch.testing.assert_close(implicit_step(lb, f[1], times), u[1], rtol=0, atol=1e-8)
    alone = implicit_step(lb, f[1, :, 0], 0.05)
    torch.testing.assert_close(alone, u[1, :, 0], rtol=0, atol=1e-8)


@every_builder
def test_poisson_problem_is_solved(build):
    """Ku = M(f − mean f), and u has mean zero, where no point is fixed."""
    lb = build()
    f, (stiffness, mass), inside = rough(lb), dense(lb), free(lb)
    u = poisson_solve(lb, f)
    weights = mass.sum(0)
    if lb.fixed is None:
        assert abs(weights @ u) < 1e-10
        f = f - (weights @ f) / weights.sum()
    else:
        assert (u[lb.fixed] == 0).all()
    torch.testing.assert_close((stiffness @ u)[inside], (mass @ f)[inside], rtol=0, atol=1e-7)


@pytest.mark.parametrize("name", ["pair", "cotangent"])
def test_eigenfunctions_are_scaled(name):
    """(1 − tΔ)⁻¹φ = φ/(1 + tλ) and −Δ⁻¹φ = φ/λ, with the eigenvectors of dense (K, M)."""
    lb = BUILDERS[name]()
    stiffness, mass = dense(lb)
    lower = torch.linalg.cholesky(mass)
    inverse = torch.linalg.inv(lower)
    values, vectors = torch.linalg.eigh(inverse @ stiffness @ inverse.T)
    values, phi = values[1:8], (inverse.T @ vectors)[:, 1:8]
    torch.testing.assert_close(implicit_step(lb, phi, 0.3), phi / (1 + 0.3 * values))
    torch.testing.assert_close(poisson_solve(lb, phi), phi / values)


@every_builder
def test_no_time_no_step(build):
    lb = build()
    f = rough(lb, 2) * free(lb)[:, None]
    torch.testing.assert_close(implicit_step(lb, f, 0.0), f, rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", ["pair", "cotangent", "neumann", "dirichlet"])
def test_a_very_long_step_leaves_the_mean_and_a_poisson_problem(name):
    """Where M has long been lost in the rounding of M + tK."""
    lb, time = BUILDERS[name](), 1e15
    f = rough(lb, 2)
    one = free(lb).double()[:, None].expand_as(f)
    mean = lb.inner(one, f) / lb.inner(one, one) if lb.fixed is None else 0 * f
    rest = time * (implicit_step(lb, f, time) - mean)
    assert rest.abs().max() < 10 * poisson_solve(lb, f).abs().max() + 1e-14 * time
    torch.testing.assert_close(heat_flow(lb, f, time), mean.expand_as(f), rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", ["pair", "cotangent", "neumann"])
def test_constants_and_mass_stay_to_rounding(name):
    lb = BUILDERS[name]()
    f, weights = rough(lb, 3), lb.mass_matrix.to_dense().sum(0)
    one = torch.ones_like(f)
    torch.testing.assert_close(implicit_step(lb, one, 0.7), one, rtol=0, atol=1e-13)
    assert (weights @ (implicit_step(lb, f, 0.7) - f)).abs().max() < 1e-13 * weights.sum()


def test_a_fine_curve_is_inverted_to_rounding():
    """−u'' = u − mean u on two circles of 4,000 points each, for cos θ and sin θ + 1."""
    theta = torch.arange(4000, dtype=torch.float64) * torch.pi / 2000
    circle = torch.stack([theta.cos(), theta.sin()], dim=1)
    lb = LaplaceBeltrami.from_points(torch.cat([circle, circle + 5]))
    f = torch.cat([circle[:, 0], circle[:, 1] + 1])
    expected = torch.cat([circle[:, 0], circle[:, 1]])
    torch.testing.assert_close(poisson_solve(lb, f), expected, rtol=0, atol=1e-7)


@every_builder
def test_derivatives_in_f_and_t(build):
    lb = build()
    f, t = rough(lb, 2, grad=True), torch.tensor([0.1, 0.3]).double().requires_grad_()
    exact = {"tolerance": 1e-13}
    assert gradcheck(lambda f, t: implicit_step(lb, f, t, **exact), (f, t), fast_mode=True)
    assert gradcheck(lambda f: poisson_solve(lb, f, **exact), f, fast_mode=True)


@pytest.mark.parametrize(("name", "data"), [("dirichlet", "boundary_values"), ("neumann", "flux")])
def test_derivatives_in_the_data_of_a_boundary(name, data):
    lb = BUILDERS[name]()
    f, g = rough(lb, grad=True), rough(lb, grad=True)
    t = torch.tensor(0.2, dtype=torch.float64, requires_grad=True)

    def step(f, t, g):
        return implicit_step(lb, f, t, tolerance=1e-13, **{data: g})

    def poisson(f, g):
        return poisson_solve(lb, f, tolerance=1e-13, **{data: g})

    assert gradcheck(step, (f, t, g), fast_mode=True)
    assert gradcheck(poisson, (f, g), fast_mode=True)


def problem(vertices):
    """U on the disk, −Δu, and ∂_ν u at the rim."""
    x, y, _ = vertices.T
    u = torch.cos(2 * x + 1) * torch.sin(3 * y) + x**3
    slope_x = -2 * torch.sin(2 * x + 1) * torch.sin(3 * y) + 3 * x**2
    slope_y = 3 * torch.cos(2 * x + 1) * torch.cos(3 * y)
    return u, 13 * torch.cos(2 * x + 1) * torch.sin(3 * y) - 6 * x, slope_x * x + slope_y * y


@pytest.mark.parametrize(("condition", "data"), [("dirichlet", 0), ("neumann", 2)])
def test_data_of_a_boundary_enter_with_the_order(condition, data):
    """|u − u_h| ≤ 1e-3 |u| at 500 points and falls like h³ at least, for given values and for given fluxes."""
    errors = []
    for n in (500, 2000):
        vertices, faces = UnitDisk().mesh(n)
        lb = LaplaceBeltrami.from_mesh(vertices, faces, condition=condition)
        exact = problem(vertices)
        given = {("boundary_values", "", "flux")[data]: exact[data]}
        mass = lb.mass_matrix.to_dense().sum(0)
        u = exact[0] if lb.fixed is not None else exact[0] - (mass @ exact[0]) / mass.sum()
        error = poisson_solve(lb, exact[1], **given) - u
        step = (
            implicit_step(
                lb, u + 0.3 * exact[1], 0.3, **(given | ({} if data else {"boundary_values": u}))
            )
            - u
        )
        errors.append([float(e.norm() / u.norm()) for e in (error, step)])
    coarse, fine = torch.tensor(errors)
    assert (coarse < 1e-3).all()
    assert (fine < coarse / 8).all()


def test_second_derivatives_in_media_are_an_error():
    """And not half of what they should be."""
    lb = BUILDERS["cotangent"]()
    t = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    x, kappa = (lb.points[:, 0].exp().clone().requires_grad_() for _ in range(2))
    step = implicit_step(lb, x, t, conductivity=kappa).pow(2).sum()
    for slope in torch.autograd.grad(step, (x, t, kappa), create_graph=True):
        with pytest.raises(RuntimeError, match="differentiable once"):
            slope.sum().backward(retain_graph=True)

    def of_medium(s):
        return implicit_step(lb, x.detach(), 0.1, conductivity=kappa.detach() * s).pow(2).sum()

    with pytest.raises(RuntimeError, match="differentiable once"):
        torch.autograd.functional.hessian(of_medium, t)
    with pytest.raises(RuntimeError, match="jvp goes back twice"):
        torch.autograd.functional.jvp(of_medium, t.detach(), torch.ones_like(t))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("condition", ["neumann", "dirichlet"])
def test_second_derivatives_of_solves_and_flows(condition):
    """In f and t, with boundary data; the derivative in a direction is the solution for it."""
    lb = disk(40, condition)
    data = {"boundary_values": 0.5} if condition == "dirichlet" else {"flux": 0.3}
    f = torch.randn(40, 2, dtype=torch.float64, requires_grad=True)
    t = torch.tensor([0.1, 0.3], dtype=torch.float64, requires_grad=True)

    def step(f, t):
        return implicit_step(lb, f, t, tolerance=1e-13, **data)

    def squared(f):
        return poisson_solve(lb, f, tolerance=1e-13, **data).square()

    assert torch.autograd.gradgradcheck(step, (f, t), fast_mode=True)

    def flow(f, t):
        return heat_flow(lb, f, t, tolerance=1e-11)

    assert torch.autograd.gradgradcheck(squared, (f,), fast_mode=True)
    assert torch.autograd.gradgradcheck(flow, (f, t), fast_mode=True)
    way = torch.randn(40, dtype=torch.float64)
    _, along = torch.autograd.functional.jvp(
        lambda g: implicit_step(lb, g, 0.1), lb.points[:, 0].clone(), way
    )
    torch.testing.assert_close(along, implicit_step(lb, way, 0.1), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("transposed", [False, True])
def test_derivatives_of_a_flow_where_it_starts(transposed):
    """∂_t e^{tL}x = Lx and ∂²_t e^{tL}x = L²x at t = 0, L = −M⁻¹K, and of its adjoint."""
    lb = disk(40, "neumann")
    k, m = (lb.to_scipy(name).toarray() for name in ("stiffness", "mass"))
    operator = -torch.from_numpy(np.linalg.solve(m, k))
    x = torch.randn(40, dtype=torch.float64)
    zero = torch.zeros((), dtype=torch.float64, requires_grad=True)
    if transposed:
        value = (heat_flow(lb, x.requires_grad_(), zero, tolerance=1e-13) * x.detach()).sum()
        value = torch.autograd.grad(value, x, create_graph=True)[0] @ lb.points[:, 0]
        once, twice = (
            x.detach() @ operator @ lb.points[:, 0] for operator in (operator, operator @ operator)
        )
    else:
        value = lb.points[:, 0] @ heat_flow(lb, x, zero, tolerance=1e-13)
        once, twice = (
            lb.points[:, 0] @ operator @ x for operator in (operator, operator @ operator)
        )
    (first,) = torch.autograd.grad(value, zero, create_graph=True)
    (second,) = torch.autograd.grad(first, zero)
    torch.testing.assert_close(first.detach(), once, rtol=1e-8, atol=0)
    torch.testing.assert_close(second, twice, rtol=1e-8, atol=0)


@pytest.mark.parametrize("solve", [implicit_step, heat_flow])
def test_what_is_not_finite_is_named_as_that(solve):
    """Not as triangles that are degenerate, after a thousand steps."""
    lb = BUILDERS["pair"]()
    f = lb.points[:, 0].clone()
    f[3] = torch.nan
    with pytest.raises(InputError, match=r"NaN or infinity at 1 of .* points \(3\)"):
        solve(lb, f, 0.1)


def test_boundary_data_count_at_their_points_alone():
    """What stands elsewhere may be anything."""
    lb = BUILDERS["dirichlet"]()
    given = torch.where(lb.fixed, 1.0, torch.nan).double()
    u = poisson_solve(lb, torch.zeros_like(given), boundary_values=given)
    torch.testing.assert_close(u, torch.ones_like(u))


def test_a_flux_counts_where_it_comes_to_a_free_point():
    """x³ − 3xy² + x on the disk, held at x < 0; the flux is not known inside, nor at x < −0.6."""
    vertices, faces = UnitDisk().mesh(500)
    x, y, _ = vertices.T
    rim = x.square() + y.square() > 1 - 1e-9
    lb = LaplaceBeltrami.from_mesh(vertices, faces, condition="dirichlet", boundary=rim & (x < 0))
    u = x**3 - 3 * x * y**2 + x
    flux = torch.where(rim & (x > -0.6), 3 * u - 2 * x, torch.nan)
    found = poisson_solve(lb, 0 * x, boundary_values=u, flux=flux)
    torch.testing.assert_close(found, u, rtol=0, atol=1e-4)


def test_given_values_are_taken_at_the_boundary():
    lb = BUILDERS["dirichlet"]()
    given = rough(lb)
    for u in (
        implicit_step(lb, rough(lb), 0.1, boundary_values=given),
        poisson_solve(lb, rough(lb), boundary_values=given),
    ):
        torch.testing.assert_close(u[lb.fixed], given[lb.fixed])


def test_a_number_is_the_same_at_all_the_boundary():
    """Harmonic with u = 3 at the rim: u = 3."""
    lb = BUILDERS["dirichlet"]()
    u = poisson_solve(lb, torch.zeros(lb.num_points), boundary_values=3.0)
    torch.testing.assert_close(u, torch.full_like(u, 3.0))


@pytest.mark.parametrize("names", [("pair", "cotangent"), ("dirichlet", "neumann")])
def test_a_batch_is_its_shapes(names):
    shapes = [BUILDERS[name]() for name in names]
    f = torch.cat([rough(lb, 2) for lb in shapes])
    lb = LaplaceBeltrami.batch(shapes)
    parts = list(zip(shapes, f.split([s.num_points for s in shapes]), strict=True))
    for solve in (lambda s, x: implicit_step(s, x, 0.2), poisson_solve):
        alone = torch.cat([solve(s, x) for s, x in parts])
        torch.testing.assert_close(solve(lb, f), alone, rtol=0, atol=1e-8)


def test_means_of_components_are_taken_off_one_by_one():
    """Ku = M(f − mean of the component), and u has mean zero on each."""
    vertices, faces = Sphere().mesh(60)
    two = LaplaceBeltrami.from_mesh(
        torch.cat([vertices, vertices + 5]), torch.cat([faces, faces + 60]), order=2
    )
    f = rough(two)
    one = LaplaceBeltrami.from_mesh(vertices, faces, order=2)
    alone = [poisson_solve(one, part) for part in f.split(60)]
    torch.testing.assert_close(poisson_solve(two, f), torch.cat(alone), rtol=0, atol=1e-8)


@every_builder
def test_types(build):
    """Solved in float64 whatever the type of f, which the result has."""
    lb = build()
    f = rough(lb, 2)
    u = implicit_step(lb, f, 0.1)
    for dtype, close in ((torch.float32, 1e-6), (torch.float16, 1e-2)):
        single = implicit_step(lb, f.to(dtype), 0.1)
        assert single.dtype == dtype
        torch.testing.assert_close(single.double(), u, rtol=0, atol=close)


def test_an_operator_that_has_solved_travels():
    """Factors are outside of the module: copies, pickles and states are as before; they go with the operator."""
    lb = LaplaceBeltrami.from_cotangent(*Sphere().mesh(60))
    f, before = rough(lb), set(lb.state_dict())
    u = implicit_step(lb, f, 0.1)
    for other in (copy.deepcopy(lb), pickle.loads(pickle.dumps(lb))):
        torch.testing.assert_close(implicit_step(other, f, 0.1), u)
    assert set(lb.state_dict()) == before
    assert lb.cache.system is not None
    lb.weak.values = lb.weak.values.clone()
    assert lb.cache.system is None
    implicit_step(lb, f, 0.1)
    held = weakref.ref(systems.pair_system(lb))
    del lb
    gc.collect()
    assert held() is None


def test_factors_may_be_let_go():
    lb = BUILDERS["cotangent"]()
    f = rough(lb)
    u, system = implicit_step(lb, f, 0.1), systems.pair_system(lb)
    assert systems.pair_system(lb) is system
    del lb.cache
    assert systems.pair_system(lb) is not system
    torch.testing.assert_close(implicit_step(lb, f, 0.1), u)


def test_factors_are_kept_in_bounds():
    lb = BUILDERS["cotangent"]()
    f = rough(lb)
    for t in range(1, 2 * systems.KEPT):
        implicit_step(lb, f, float(t))
    assert len(systems.pair_system(lb).factors) == systems.KEPT


def test_conjugate_gradients_take_few_steps_in_any_state():
    """At most 60 steps to 1e-10 with the linear factor, whatever the time, and for a Poisson problem."""
    lb = LaplaceBeltrami.from_mesh(*Torus().mesh(1000))
    f = rough(lb, 4)
    for t in (float(lb.mass.mean()), 1.0, 1e3):
        implicit_step(lb, f, t)
        assert systems.pair_system(lb).steps <= 60
    poisson_solve(lb, f)
    assert systems.pair_system(lb).steps <= 60


def test_conjugate_gradients_give_up_with_advice():
    matrix = torch.diag(torch.logspace(0, 12, 50, dtype=torch.float64))
    with pytest.raises(DiffusionError, match=r"after 20 steps.*degenerate"):
        conjugate_gradients(
            lambda x: matrix @ x, torch.ones(50, 1).double(), lambda r: r, max_steps=20
        )


def test_columns_have_steps_of_their_own():
    """One column is solved at once, a zero one at the start, the third takes longer."""
    matrix = torch.diag(torch.arange(1.0, 6.0, dtype=torch.float64))
    b = torch.stack([torch.eye(5)[0], torch.zeros(5), torch.ones(5)], 1).double()
    x, steps = conjugate_gradients(lambda v: matrix @ v, b, lambda r: r)
    torch.testing.assert_close(matrix @ x, b)
    assert steps == 5


def test_compiled_code_may_solve():
    lb = BUILDERS["cotangent"]()
    f = rough(lb, grad=True)
    compiled = torch.compile(
        lambda x: implicit_step(lb, 2 * x, 0.1).square().sum(), backend="eager"
    )
    (expected,) = torch.autograd.grad(implicit_step(lb, 2 * f, 0.1).square().sum(), f)
    torch.testing.assert_close(torch.autograd.grad(compiled(f), f)[0], expected)


@pytest.mark.parametrize("t", [-1.0, float("inf"), float("nan"), torch.ones(3)])
def test_times_that_cannot_be(t):
    lb = BUILDERS["cotangent"]()
    with pytest.raises(InputError, match="t: expected"):
        implicit_step(lb, rough(lb, 2), t)


@pytest.mark.parametrize(
    ("name", "data", "message"),
    [
        ("pair", {"flux": 1.0}, "the shape is closed"),
        ("neumann", {"boundary_values": 1.0}, "condition='dirichlet'"),
        ("pair", {"boundary_values": 1.0}, "the shape is closed"),
        ("dirichlet", {"flux": 1.0}, "holds along the whole boundary"),
        ("dirichlet", {"boundary_values": torch.ones(7)}, "expected the shape of f"),
    ],
)
def test_data_that_cannot_be(name, data, message):
    lb = BUILDERS[name]()
    for solve in (
        lambda: implicit_step(lb, rough(lb), 0.1, **data),
        lambda: poisson_solve(lb, rough(lb), **data),
    ):
        with pytest.raises(InputError, match=message):
            solve()


@pytest.mark.parametrize("tolerance", [-1.0, 0.0, 2.0, float("nan")])
def test_tolerances_that_cannot_be(tolerance):
    lb = BUILDERS["cotangent"]()
    for solve in (
        lambda: implicit_step(lb, rough(lb), 0.1, tolerance=tolerance),
        lambda: poisson_solve(lb, rough(lb), tolerance=tolerance),
        lambda: heat_flow(lb, rough(lb), 0.1, tolerance=tolerance),
        lambda: lb.eigenbasis(5, tolerance=tolerance),
    ):
        with pytest.raises(InputError, match="tolerance: expected a number between 0 and 1"):
            solve()


@pytest.mark.parametrize("ratio", [5.0, 20.0, 50.0])
def test_a_series_has_few_terms_to_any_tolerance(ratio):
    """Rounding of coefficients is no term."""
    coefficients, _ = _coefficients(ratio, 1e-13)
    assert np.count_nonzero(coefficients) < 60


def test_features_of_another_shape():
    lb = BUILDERS["cotangent"]()
    for solve in (
        lambda: implicit_step(lb, torch.ones(7), 0.1),
        lambda: poisson_solve(lb, torch.ones(7)),
    ):
        with pytest.raises(InputError, match="N = 60"):
            solve()


@pytest.mark.parametrize("surface", [Ellipsoid(), StarShaped()], ids=["ellipsoid", "star"])
def test_pairs_in_single_precision_keep_a_cholesky_factor(surface):
    """Rounded, rows of K do not sum to zero, and constants would make K + εM indefinite."""
    for build in (LaplaceBeltrami.from_cotangent, LaplaceBeltrami.from_mesh):
        lb = build(*surface.mesh(300)).float()
        assert all(systems.pair_system(lb).factor(t).is_cholesky for t in (None, 1e6))


def dense_step(lb, f, times):
    """(M + tK)⁻¹Mf of every column, by dense algebra on the stored matrices."""
    stiffness, mass = (m.to_dense().double() for m in (lb.stiffness, lb.mass_matrix))
    columns = [
        torch.linalg.solve(mass + t * stiffness, mass @ c) for t, c in zip(times, f.T, strict=True)
    ]
    return torch.stack(columns, dim=1)


@pytest.mark.parametrize("scale", [1e-25, 1.0, 1e25])
def test_shapes_in_any_units_are_solved(scale):
    """u of a shape s times as large, for times s² as long, is the same."""
    vertices, faces = Torus().mesh(120)
    one, other = (LaplaceBeltrami.from_mesh(s * vertices, faces, order=2) for s in (1.0, scale))
    f, times = rough(one, 4), torch.tensor([1e-4, 0.3, 0.01, 0.3], dtype=torch.float64)
    for tolerance in (1e-10, 1e-5):
        found = implicit_step(other, f, scale**2 * times, tolerance=tolerance)
        error = found - implicit_step(one, f, times)
        assert error.abs().max() <= 10 * tolerance * f.abs().max()
    flowed = heat_flow(other, f, 0.1 * scale**2) - heat_flow(one, f, 0.1)
    assert flowed.abs().max() <= 1e-6 * f.abs().max()


def test_times_over_many_decades_share_few_factors():
    """From none at all to ten thousand; in any order."""
    lb = LaplaceBeltrami.from_mesh(*Torus().mesh(120), order=2)
    times = torch.cat([torch.zeros(1), torch.logspace(-9, 4, 11), torch.zeros(1)]).double()[
        torch.randperm(13)
    ]
    f = rough(lb, 13)
    torch.testing.assert_close(
        implicit_step(lb, f, times), dense_step(lb, f, times), rtol=0, atol=1e-8
    )
    assert len(systems.pair_system(lb).factors) <= systems.KEPT


def test_operators_in_single_precision_are_solved_in_double():
    """To what their own matrices, which are rounded, say."""
    lb = LaplaceBeltrami.from_mesh(*Torus().mesh(120), order=2).float()
    f, times = rough(lb, 3).double(), torch.tensor([0.01, 0.1, 1.0], dtype=torch.float64)
    torch.testing.assert_close(
        implicit_step(lb, f, times, tolerance=1e-13), dense_step(lb, f, times), rtol=0, atol=1e-7
    )


def test_no_columns_are_no_problem():
    lb = LaplaceBeltrami.from_mesh(*Torus().mesh(120), order=2)
    f = rough(lb, 3)
    for empty in (f[:, :0], f.expand(2, -1, -1)[:0]):
        assert implicit_step(lb, empty, 0.1).shape == empty.shape
        assert poisson_solve(lb, empty).shape == empty.shape


@pytest.mark.parametrize("kind", [torch.int64, torch.bool, torch.uint8])
def test_integers_and_masks_are_functions(kind):
    """In the type of the operator, not truncated to their own."""
    lb = BUILDERS["pair"]()
    f = (lb.points[:, 2] > 0).to(kind)
    for solve in (
        lambda f: implicit_step(lb, f, 0.1),
        lambda f: poisson_solve(lb, f),
        lambda f: heat_flow(lb, f, 0.1),
        lambda f: lb.eigenbasis(10).to_basis(f[:, None]),
    ):
        assert torch.equal(solve(f), solve(f.double()))


def test_complex_functions_are_refused():
    lb = BUILDERS["pair"]()
    with pytest.raises(InputError, match="real f"):
        poisson_solve(lb, torch.complex(lb.mass, lb.mass))


def test_swapped_arguments_are_named(unchecked):
    """By every public function whose first argument is the operator."""
    lb, functions = LaplaceBeltrami.from_mesh(*Sphere().mesh(60), order=1), 0
    for function in vars(torchlb).values():
        if not (inspect.isfunction(function) and "lb" in inspect.signature(function).parameters):
            continue
        parameters = inspect.signature(function).parameters.values()
        rest = [0.1 for p in list(parameters)[2:] if p.default is p.empty]
        with pytest.raises(TypeError, match="expected an operator, got a Tensor"):
            function(lb.mass, lb, *rest)
        functions += 1
    assert functions >= 10


def test_without_a_pair_there_are_no_solves():
    lb = LaplaceBeltrami.from_points(Sphere().points(80), order=2, weak_form=False)
    f = rough(lb)
    for solve in (
        lambda: implicit_step(lb, f, 0.1),
        lambda: poisson_solve(lb, f),
        lambda: heat_flow(lb, f, 0.1),
        lambda: lb.eigenbasis(5),
    ):
        with pytest.raises(InputError, match="no weak pair, as it was built with weak_form=False"):
            solve()


def test_poisson_sources_have_the_same_weights_in_every_medium():
    """Also where the mass of the vertices has linear rows, as in solids: a cosine was off by a third."""

    def cube(side):
        points = torch.cartesian_prod(*[torch.linspace(0, 1, side).double()] * 3)
        return points, LaplaceBeltrami.from_mesh(points, Delaunay(points).simplices)

    points, lb = cube(7)
    source = (torch.pi * points[:, :1]).cos()

    def features(source, lb):
        return potential(lb, None, source, tolerance=1e-10)

    found = features(source, lb)
    torch.testing.assert_close(features(source, lb.with_medium(density=1.0)), found)
    batch = LaplaceBeltrami.batch([lb, cube(5)[1].with_medium(density=2.0)])
    both = features(torch.cat([source, source[:125]]), batch)
    torch.testing.assert_close(both[: len(points)], found)
    assert (found * torch.pi**2 - source).norm() < 0.06 * source.norm()
