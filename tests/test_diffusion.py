"""Heat flow by every method against the dense exponential, its conservation laws, and its derivatives."""

import copy
import functools
import math
from typing import get_args

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from builders import stencil_of_cloud, stencil_of_mesh
from torchlb import Diffusion, DiffusionError, InputError, LaplaceBeltrami, heat_flow
from torchlb.linalg.exponential import chebyshev_coefficients, hyperbola
from torchlb.linalg.spectral_bounds import Bounds
from torchlb.pde.heat import Method, checked_method
from torchlb.surfaces import Circle, Sphere, Torus, UnitDisk

METHODS = get_args(Method)
EXACT = ["deflated", "chebyshev", "contour"]
every_method = pytest.mark.parametrize("method", METHODS)
exact_method = pytest.mark.parametrize("method", EXACT)
BUILDERS = {
    "points": lambda: stencil_of_cloud(Torus().points(300)),
    "random points": lambda: stencil_of_cloud(Torus().random_points(300)),
    "mesh": lambda: stencil_of_mesh(*Sphere().mesh(300)),
    "boundary": lambda: stencil_of_mesh(*UnitDisk().mesh(300)),
    "cotangent": lambda: LaplaceBeltrami.from_cotangent(*Sphere().mesh(300)),
    "curve": lambda: stencil_of_cloud(Circle().points(300)),
    "first order": lambda: stencil_of_cloud(Torus().random_points(600), order=1),
    "not certified": lambda: stencil_of_cloud(Sphere().points(300), certify=False),
}
BUILDERS = {name: functools.cache(build) for name, build in BUILDERS.items()}
KINDS = {name: build for name, build in BUILDERS.items() if name != "first order"}
every_builder = pytest.mark.parametrize("build", KINDS.values(), ids=KINDS.keys())


def rough(n, channels=3):
    return torch.randn(n, channels, dtype=torch.float64)


def norm(lb, f):
    """|f|_π of all channels together."""
    return float((lb.mass[:, None] * f**2).sum().sqrt())


@pytest.mark.parametrize("sampling", ["points", "random_points"])
def test_deflated_diffusion_is_the_dense_exponential_at_every_scale(sampling):
    """|y − e^{tL}f| ≤ 1e-6 |f| for t from h²/10 to 10/λ_1, all in one call; what spectral alone loses beside it."""
    lb = stencil_of_cloud(getattr(Sphere(), sampling)(1000))
    h2, last = float(lb.mass.mean()), 10 / float(lb.eigenbasis(128).eigenvalues[1])
    times = torch.logspace(np.log10(h2 / 10), np.log10(last), 7).double()
    f = rough(1000, 7)
    exact = [torch.matrix_exp(t * lb.matrix.to_dense()) @ f[:, [i]] for i, t in enumerate(times)]
    y, spectral = (heat_flow(lb, f, times, method=m) for m in ("deflated", "spectral"))
    for i, expected in enumerate(exact):
        assert norm(lb, y[:, [i]] - expected) <= 1e-6 * norm(lb, f[:, [i]])
    assert norm(lb, spectral[:, [0]] - exact[0]) > 0.3 * norm(lb, f[:, [0]])


@every_builder
@exact_method
def test_every_method_on_every_kind_of_operator(build, method):
    """|y − e^{tL}f| ≤ 1e-6 |f| for (N,), (N, C) and (B, N, C)."""
    lb = build()
    f = torch.randn(2, 300, 2).double()
    times = torch.tensor([0.003, 0.4]).double()
    y = heat_flow(lb, f, times, method=method, k=40)
    for c, t in enumerate(times):
        expected = torch.matrix_exp(t * lb.matrix.to_dense()) @ f[..., c].T
        assert norm(lb, y[..., c].T - expected) <= 1e-6 * norm(lb, f[..., c].T)
    torch.testing.assert_close(heat_flow(lb, f[1], times, method=method, k=40), y[1])
    alone = heat_flow(lb, f[1, :, 0], times[0], method=method, k=40)
    torch.testing.assert_close(alone, y[1, :, 0], rtol=0, atol=1e-6)


@every_builder
def test_spectral_diffusion_is_its_formula(build):
    """Φ e^{−λt} Φᵀ(πf)."""
    lb, f = build(), rough(300)
    basis = lb.eigenbasis(30)
    phi = basis.eigenvectors
    expected = phi @ (
        torch.exp(-basis.eigenvalues * 0.1)[:, None] * (phi.T @ (lb.mass[:, None] * f))
    )
    torch.testing.assert_close(heat_flow(lb, f, 0.1, method="spectral", k=30), expected)


@every_method
@pytest.mark.parametrize("name", ["points", "random points", "mesh", "cotangent"])
def test_heat_is_conserved_and_energy_never_grows(name, method):
    """Σ π u = Σ π f to 1e-12; |u(t)|_π falls with t, and is at most |f|_π."""
    lb, f = BUILDERS[name](), rough(300)
    before = norm(lb, f)
    for t in 10.0 ** torch.arange(-5, 3):
        u = heat_flow(lb, f, t, method=method, k=40)
        lost = lb.mass @ (u - f)
        assert lost.abs().max() <= 1e-12 * (lb.mass @ f.abs()).max()
        assert norm(lb, u) <= before * (1 + 1e-7)
        before = norm(lb, u)


@every_method
def test_no_time_no_diffusion_and_long_times_leave_the_mean(method):
    lb, f = BUILDERS["points"](), rough(300)
    mean = (lb.mass @ f) / lb.mass.sum()
    last = heat_flow(lb, f, 60.0, method=method, k=40)
    torch.testing.assert_close(last, mean.expand(300, 3), rtol=0, atol=1e-5)
    start = f if method != "spectral" else None
    if start is not None:
        torch.testing.assert_close(heat_flow(lb, f, 0.0, method=method, k=40), start)


@every_method
@pytest.mark.parametrize("name", ["random points", "cotangent"])
def test_derivatives_in_the_features_and_in_the_times(name, method):
    lb = BUILDERS[name]()
    f = torch.randn(2, 300, 2).double()
    weights = torch.randn(2, 300, 2).double()
    times = torch.tensor([0.01, 0.2], dtype=torch.float64, requires_grad=True)
    scale = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)

    def total(t, s):
        y = heat_flow(lb, s * f + (1 - s) * weights, t, method=method, k=30, tolerance=1e-11)
        return (weights * y).sum((0, 1))

    assert gradcheck(total, (times, scale), eps=1e-5, atol=1e-4)


@exact_method
def test_derivative_in_every_entry_of_the_features(method):
    lb = stencil_of_cloud(Torus().random_points(30), order=1)
    f = torch.randn(30, 2, dtype=torch.float64, requires_grad=True)
    times = torch.tensor([0.02, 0.5], dtype=torch.float64)
    assert gradcheck(lambda x: heat_flow(lb, x, times, method=method, k=10), f, eps=1e-2, atol=1e-6)


@exact_method
def test_time_derivative_is_the_laplacian(method):
    """∂_t e^{tΔ}f = Δ e^{tΔ}f."""
    lb, f = BUILDERS["random points"](), rough(300, 1)
    t = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    u = heat_flow(lb, f, t, method=method, k=40, tolerance=1e-12)
    (slope,) = torch.autograd.grad((u * f).sum(), t)
    torch.testing.assert_close(slope, (lb(u.detach()) * f).sum(), rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("height", [0.0, 0.1, 0.4])
def test_chebyshev_series_in_the_ellipse(height):
    """Σ c_k r^{−k} T_k((z + a)/d) = e^{tz} on the ellipse around −a that touches 0, with its derivative in t."""
    radius, times = 50.0, np.array([0.0, 1e-3, 0.1, 3.0])
    c, slope, d, r = chebyshev_coefficients(times, radius, height * radius / 2, 1e-10)
    angle = np.linspace(0, 2 * np.pi, 50)[:, None]
    z = radius / 2 * (np.cos(angle) - 1 + 1j * height * np.sin(angle))
    w = np.arccosh((z + radius / 2) / d + 0j)
    k = np.arange(len(c))
    vectors = (np.exp(k * (w - np.log(r))) + np.exp(-k * (w + np.log(r)))) / 2
    np.testing.assert_allclose(vectors @ c, np.exp(times * z), atol=1e-9)
    np.testing.assert_allclose(vectors @ slope, z * np.exp(times * z), atol=1e-7)


@pytest.mark.parametrize("spread", [1.0, 10.0])
def test_contour_sum_in_the_sector(spread):
    """Re Σ w e^{τz}/(z + x) = e^{−τx} within 20° of the axis, over fourteen decades of x."""
    z, w = hyperbola(spread, 1e-8)
    for angle in (0.0, 20.0):
        x = np.logspace(-7, 7, 200) * np.exp(1j * np.radians(angle))
        for tau in (1 / spread, 0.5 * (1 + 1 / spread), 1.0):
            terms = (w * np.exp(tau * z))[:, None] / (z[:, None] + x)
            below = (w * np.exp(tau * z))[:, None] / (z[:, None] + x.conj())
            total = (terms + below.conj()).sum(0) / 2
            assert np.abs(total - np.exp(-tau * x)).max() < 1e-7


@pytest.mark.parametrize("name", ["random points", "first order", "cotangent", "curve"])
def test_ellipse_holds_the_spectrum(name):
    """|1 + 2z/R|² + |Im z/b|² ≤ 1 for every eigenvalue z, b = 0 for a symmetric operator."""
    lb = BUILDERS[name]()
    radius, height = lb.spectral_bounds
    values = torch.linalg.eigvals(lb.matrix.to_dense())
    if name == "cotangent":
        assert height == 0
        assert values.abs().max() <= radius <= 1.25 * values.abs().max()
        return
    assert values.abs().max() <= radius <= 1.1 * values.abs().max()
    across = (1 - (1 + 2 * values.real / radius) ** 2).clamp_min(1e-9).sqrt()
    assert (values.imag.abs() <= height * across + 1e-6 * radius).all()


def test_a_surface_with_slivers_does_not_blow_up():
    """Squeezed triangles: R/λ_1 in the thousands, and eigenvalues far off the axis near 0."""
    vertices, faces = Sphere().mesh(600)
    squeezed = torch.where(
        vertices[:, 2:] > 0.3, 0.3 + 0.02 * (vertices[:, 2:] - 0.3), vertices[:, 2:]
    )
    lb = stencil_of_mesh(torch.cat([vertices[:, :2], squeezed], dim=1), faces)
    f = rough(600)
    for t in (0.01, 1.0, 10.0):
        exact = heat_flow(lb, f, t, method="contour")
        for method in ("deflated", "chebyshev"):
            assert norm(lb, heat_flow(lb, f, t, method=method, k=30) - exact) <= 1e-6 * norm(lb, f)


def test_deflated_diffusion_takes_any_spectral_radius(monkeypatch):
    """Where the series would be too long the contour sum stands in, with the same values and derivatives."""
    lb = stencil_of_cloud(Torus().random_points(500))
    f = rough(500)
    results = []
    for products in (5_000, 10):
        monkeypatch.setattr("torchlb.linalg.exponential.PRODUCTS", products)
        x, t = f.clone().requires_grad_(), torch.tensor(0.01, dtype=f.dtype, requires_grad=True)
        y = heat_flow(lb, x, t, k=30)
        results.append([y, *torch.autograd.grad((y**3).sum(), [x, t])])
        single = heat_flow(lb, f, 0.01, k=30).float()
        assert norm(lb, single - y.detach()) <= 1e-6 * norm(lb, f)
    for one, other in zip(*results, strict=True):
        assert (one - other).norm() <= 1e-5 * one.norm()


def test_former_names_of_methods_are_taken_with_a_warning():
    for former, method in (("full", "deflated"), ("rational", "contour")):
        with pytest.warns(DeprecationWarning, match=f"'{former}' is called '{method}' now"):
            assert checked_method(former) == method


def test_learned_times_stay_positive_and_are_learned():
    """A flow for t = 0.2 is found from t = 0.01, by unconstrained minimisation."""
    lb = BUILDERS["points"]()
    f = rough(300, 2)
    target = heat_flow(lb, f, torch.tensor([0.2, 0.05]))
    layer = Diffusion(2, k=40).double()
    optimizer = torch.optim.LBFGS(layer.parameters(), max_iter=60, line_search_fn="strong_wolfe")

    def loss():
        optimizer.zero_grad()
        value = (layer(f, lb) - target).square().sum()
        value.backward()
        return value

    optimizer.step(loss)
    torch.testing.assert_close(layer.time, torch.tensor([0.2, 0.05]).double(), rtol=1e-3, atol=0)
    with torch.no_grad():
        layer.raw_time.fill_(-3.0)
    assert (layer.time > 0).all()


def test_what_cannot_work_is_said():
    lb = BUILDERS["points"]()
    f = rough(300)
    with pytest.raises(InputError, match=r"expected one of \('deflated'.*got 'implicit'"):
        checked_method("implicit")
    for time in (-1.0, math.inf, math.nan):
        with pytest.raises(InputError, match="finite times of at least 0"):
            heat_flow(lb, f, time)
    with pytest.raises(ValueError, match="N = 300"):
        heat_flow(lb, f[:100], 1.0)
    with pytest.raises(ValueError, match="expected 2 channels"):
        Diffusion(2)(f, lb)
    with pytest.raises(DiffusionError, match=r"takes .* products"):
        heat_flow(lb, f, 1e9, method="chebyshev")
    unknown = copy.deepcopy(lb)
    unknown.set_bounds(Bounds(float(lb.spectral_bounds.radius), None))
    with pytest.raises(DiffusionError, match=r"no ellipse.*use method='contour'"):
        heat_flow(unknown, f, 0.1, method="chebyshev")
    torch.testing.assert_close(
        heat_flow(unknown, f, 0.1, k=40), heat_flow(lb, f, 0.1, k=40), rtol=0, atol=1e-6
    )
    two = torch.cat([Sphere().points(200), Sphere().points(200) + 5])
    with pytest.raises(DiffusionError, match="ask for another k"):
        heat_flow(stencil_of_cloud(two), rough(400), 1.0, k=1)


@pytest.mark.parametrize("condition", ["neumann", "dirichlet"])
def test_the_derivative_in_the_time_at_zero_is_that_from_above(condition):
    """d/dt⟨w, e^{−tM⁻¹K}f⟩ at t = 0, by solves with M; and what a Dirichlet condition holds is zero from the start."""
    lb = LaplaceBeltrami.from_mesh(*UnitDisk().mesh(200), condition=condition)
    f, w = (torch.randn(200, generator=torch.Generator().manual_seed(s)).double() for s in (0, 1))
    time = torch.zeros((), dtype=torch.float64, requires_grad=True)
    start = heat_flow(lb, f, time)
    (slope,) = torch.autograd.grad(w @ start, time)
    step = 1e-9
    after = heat_flow(lb, f, step, tolerance=1e-13)
    torch.testing.assert_close(slope, w @ (after - start.detach()) / step, rtol=1e-3, atol=0.0)
    if condition == "dirichlet":
        assert not start[lb.fixed].any()


def test_derivatives_where_a_dirichlet_condition_holds_and_f_does_not_vanish():
    """Values there count for nothing: not in ∂/∂t, and ∂/∂f is zero at these points."""
    lb = LaplaceBeltrami.from_mesh(*UnitDisk().mesh(200), condition="dirichlet")
    f, w = (torch.randn(200, generator=torch.Generator().manual_seed(s)).double() for s in (0, 1))
    f.requires_grad_()
    time = torch.tensor(0.03, dtype=torch.float64, requires_grad=True)
    flow = heat_flow(lb, f, time, tolerance=1e-11)
    of_f, slope = torch.autograd.grad(w @ flow, (f, time))
    step = 1e-5
    before, after = (heat_flow(lb, f, 0.03 + s, tolerance=1e-12) for s in (-step, step))
    torch.testing.assert_close(slope, w @ (after - before) / (2 * step), rtol=1e-5, atol=0.0)
    assert not of_f[lb.fixed].any()


@pytest.mark.parametrize("time", [0.0, -1.0, math.nan])
def test_learned_times_start_above_zero(time):
    with pytest.raises(InputError, match="init_time"):
        Diffusion(3, init_time=time)
