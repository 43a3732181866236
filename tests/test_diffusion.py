"""Heat flow by every method against the dense exponential, its conservation laws, and its derivatives."""

import functools
import math
from typing import get_args

import numpy as np
import pytest
import torch
from scipy.linalg import eigh
from scipy.special import j0, j1, jn_zeros
from torch.autograd import gradcheck

from torchlb import Diffusion, InputError, LaplaceBeltrami, heat_flow, smooth
from torchlb.linalg.exponential import rational_coefficients
from torchlb.pde.heat import Method
from torchlb.surfaces import Circle, Sphere, Torus, UnitDisk

METHODS = get_args(Method)
every_method = pytest.mark.parametrize("method", METHODS)
KINDS = {
    "points": lambda: LaplaceBeltrami.from_points(Torus().points(300)),
    "random points": lambda: LaplaceBeltrami.from_points(Torus().random_points(300)),
    "mesh": lambda: LaplaceBeltrami.from_mesh(*Sphere().mesh(300)),
    "boundary": lambda: LaplaceBeltrami.from_mesh(*UnitDisk().mesh(300)),
    "cotangent": lambda: LaplaceBeltrami.from_cotangent(*Sphere().mesh(300)),
    "curve": lambda: LaplaceBeltrami.from_points(Circle().points(300)),
    "first order": lambda: LaplaceBeltrami.from_points(Torus().random_points(300), order=1),
}
KINDS = {name: functools.cache(build) for name, build in KINDS.items()}
every_builder = pytest.mark.parametrize("build", KINDS.values(), ids=KINDS.keys())


def rough(n, channels=3):
    return torch.randn(n, channels, dtype=torch.float64)


def mass(lb):
    return lb.mass_matrix.to_dense()


def norm(lb, f):
    """|f|_M of all channels together."""
    return float((f * (mass(lb) @ f)).sum().sqrt())


def generator(lb):
    """−M⁻¹K."""
    return -torch.linalg.solve(mass(lb), lb.stiffness.to_dense())


@functools.cache
def pencil(lb):
    """(λ, Φ) of KΦ = MΦΛ, all of them, densely."""
    found = eigh(lb.stiffness.to_dense().numpy(), mass(lb).numpy())
    return [torch.from_numpy(part) for part in found]


def exponential(lb, t, f):
    """e^{−tM⁻¹K}f."""
    values, phi = pencil(lb)
    return phi @ (torch.exp(-t * values)[:, None] * (phi.T @ (mass(lb) @ f)))


def test_the_dense_exponential_is_that_of_torch():
    """Pairs of K and M, of which all others here are made, against scaling and squaring."""
    lb, f = KINDS["random points"](), rough(300)
    expected = torch.matrix_exp(0.1 * generator(lb)) @ f
    torch.testing.assert_close(exponential(lb, 0.1, f), expected, rtol=0, atol=1e-11)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("sampling", ["points", "random_points"])
def test_rational_diffusion_is_the_dense_exponential_at_every_scale(sampling):
    """|y − e^{tL}f| ≤ 1e-7 |f| for t from h²/10 to 10/λ_1, all in one call; what spectral alone loses beside it."""
    lb = LaplaceBeltrami.from_points(getattr(Sphere(), sampling)(1000))
    h2, last = float(lb.mass.mean()), 10 / float(lb.eigenbasis(128).eigenvalues[1])
    times = torch.logspace(np.log10(h2 / 10), np.log10(last), 7).double()
    f = rough(1000, 7)
    exact = [exponential(lb, t, f[:, [i]]) for i, t in enumerate(times)]
    y, spectral = (heat_flow(lb, f, times, method=m) for m in ("rational", "spectral"))
    for i, expected in enumerate(exact):
        assert norm(lb, y[:, [i]] - expected) <= 1e-7 * norm(lb, f[:, [i]])
    assert norm(lb, spectral[:, [0]] - exact[0]) > 0.3 * norm(lb, f[:, [0]])


@every_builder
def test_rational_diffusion_on_every_kind_of_operator(build):
    """|y − e^{tL}f| ≤ 1.5e-7 |f| at a tolerance of 1e-7, one time after another."""
    lb, f = build(), rough(300)
    for t in (0.003, 0.4):
        expected = exponential(lb, t, f)
        assert norm(lb, heat_flow(lb, f, t) - expected) <= 1.5e-7 * norm(lb, f)


@every_method
@pytest.mark.parametrize("name", ["random points", "boundary", "cotangent", "curve"])
def test_a_stack_is_its_surfaces_and_their_channels(name, method):
    """(B, N, C), (N, C) and (N,)."""
    lb, f = KINDS[name](), torch.randn(2, 300, 2).double()
    times = torch.tensor([0.003, 0.4]).double()
    y = heat_flow(lb, f, times, method=method, k=40)
    one = heat_flow(lb, f[1], times, method=method, k=40)
    torch.testing.assert_close(one, y[1], rtol=0, atol=1e-6)
    alone = heat_flow(lb, f[1, :, 0], times[0], method=method, k=40)
    torch.testing.assert_close(alone, y[1, :, 0], rtol=0, atol=1e-6)


@every_builder
def test_spectral_diffusion_is_its_formula(build):
    """Φ e^{−λt} ΦᵀMf."""
    lb, f = build(), rough(300)
    basis = lb.eigenbasis(30)
    phi = basis.eigenvectors
    expected = phi @ (torch.exp(-basis.eigenvalues * 0.1)[:, None] * (phi.T @ (mass(lb) @ f)))
    torch.testing.assert_close(heat_flow(lb, f, 0.1, method="spectral", k=30), expected)


@pytest.mark.usefixtures("unchecked")
@every_method
@pytest.mark.parametrize("name", ["points", "random points", "mesh", "cotangent"])
def test_heat_is_conserved_and_energy_never_grows(name, method):
    """1ᵀMu = 1ᵀMf to 1e-12; |u(t)|_M falls with t, and is at most |f|_M."""
    lb, f = KINDS[name](), rough(300)
    before, share = norm(lb, f), mass(lb).sum(0)
    for t in 10.0 ** torch.arange(-5, 3):
        u = heat_flow(lb, f, t, method=method, k=40)
        lost = share @ (u - f)
        assert lost.abs().max() <= 1e-12 * (share @ f.abs()).max()
        assert norm(lb, u) <= before * (1 + 1e-7)
        before = norm(lb, u)


@every_method
def test_no_time_no_diffusion_and_long_times_leave_the_mean(method):
    lb, f = KINDS["points"](), rough(300)
    mean = (mass(lb).sum(0) @ f) / mass(lb).sum()
    last = heat_flow(lb, f, 60.0, method=method, k=40)
    torch.testing.assert_close(last, mean.expand(300, 3), rtol=0, atol=1e-5)
    if method != "spectral":
        torch.testing.assert_close(heat_flow(lb, f, 0.0, method=method, k=40), f)


@pytest.mark.usefixtures("unchecked")
@every_method
@pytest.mark.parametrize("name", ["random points", "cotangent"])
def test_derivatives_in_the_features_and_in_the_times(name, method):
    lb = KINDS[name]()
    f = torch.randn(2, 300, 2).double()
    weights = torch.randn(2, 300, 2).double()
    times = torch.tensor([0.01, 0.2], dtype=torch.float64, requires_grad=True)
    scale = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)

    def total(t, s):
        y = heat_flow(lb, s * f + (1 - s) * weights, t, method=method, k=30, tolerance=1e-11)
        return (weights * y).sum((0, 1))

    assert gradcheck(total, (times, scale), eps=1e-5, atol=1e-4)


@pytest.mark.usefixtures("unchecked")
@every_method
def test_derivative_in_features_of_random_directions(method):
    lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(30), order=1)
    f = torch.randn(30, 2, dtype=torch.float64, requires_grad=True)
    times = torch.tensor([0.02, 0.5], dtype=torch.float64)

    def flow(x):
        return heat_flow(lb, x, times, method=method, k=10)

    assert gradcheck(flow, f, eps=1e-2, atol=1e-6, fast_mode=True)


@pytest.mark.usefixtures("unchecked")
def test_time_derivative_is_the_laplacian():
    """∂_t u = −M⁻¹Ku of u = e^{tΔ}f."""
    lb, f = KINDS["random points"](), rough(300, 1)
    t = torch.tensor(0.1, dtype=torch.float64, requires_grad=True)
    u = heat_flow(lb, f, t, tolerance=1e-12)
    (slope,) = torch.autograd.grad((u * f).sum(), t)
    expected = ((generator(lb) @ u.detach()) * f).sum()
    torch.testing.assert_close(slope, expected, rtol=1e-7, atol=1e-9)


def test_rational_series_on_the_half_line():
    """Σ c_k(t/γ) T_k(2/(1 + γλ) − 1) = e^{−tλ} over fourteen decades of γλ, with its derivative in t/γ."""
    ratios = np.array([5.0, 20.0, 50.0])
    c, slope = rational_coefficients(ratios, 1e-8)
    x = np.logspace(-7, 7, 200)[:, None]
    vectors = np.cos(np.arange(len(c)) * np.arccos(2 / (1 + x) - 1))
    np.testing.assert_allclose(vectors @ c, np.exp(-ratios * x), atol=1e-8)
    np.testing.assert_allclose(vectors @ slope, -x * np.exp(-ratios * x), atol=1e-8)


@pytest.mark.usefixtures("unchecked")
def test_a_surface_with_slivers_does_not_blow_up():
    """Squeezed triangles: R/λ_1 in the hundreds of thousands."""
    vertices, faces = Sphere().mesh(600)
    squeezed = torch.where(
        vertices[:, 2:] > 0.3, 0.3 + 0.02 * (vertices[:, 2:] - 0.3), vertices[:, 2:]
    )
    lb = LaplaceBeltrami.from_mesh(torch.cat([vertices[:, :2], squeezed], dim=1), faces)
    f = rough(600)
    for t in (0.01, 1.0, 10.0):
        exact = exponential(lb, t, f)
        assert norm(lb, heat_flow(lb, f, t) - exact) <= 1e-7 * norm(lb, f)


def test_learned_times_stay_positive_and_are_learned():
    """A flow for t = 0.2 is found from t = 0.01, by unconstrained minimisation."""
    lb = KINDS["points"]()
    f = rough(300, 2)
    target = heat_flow(lb, f, torch.tensor([0.2, 0.05]), method="spectral", k=40)
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


def test_what_cannot_work_is_said(unchecked):
    lb = KINDS["points"]()
    f = rough(300)
    with pytest.raises(InputError, match=r"expected one of \['rational'.*got 'implicit'"):
        heat_flow(lb, f, 0.1, method="implicit")
    for time in (-1.0, math.inf, math.nan):
        with pytest.raises(InputError, match="finite times of at least 0"):
            heat_flow(lb, f, time)
    with pytest.raises(ValueError, match="N = 300"):
        heat_flow(lb, f[:100], 1.0)
    with pytest.raises(ValueError, match="expected 2 channels"):
        Diffusion(2)(f, lb)
    bare = LaplaceBeltrami.from_mesh(*Sphere().mesh(100), weak_form=False)
    for method in METHODS:
        with pytest.raises(InputError, match="no weak pair"):
            heat_flow(bare, rough(100), 1.0, method=method)


@pytest.mark.usefixtures("unchecked")
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


@pytest.mark.usefixtures("unchecked")
def test_derivatives_where_a_dirichlet_condition_holds_and_f_does_not_vanish():
    """The flow starts from the closest function that does, which values there have a part in."""
    lb = LaplaceBeltrami.from_mesh(*UnitDisk().mesh(200), condition="dirichlet")
    f, w = (torch.randn(200, generator=torch.Generator().manual_seed(s)).double() for s in (0, 1))
    f.requires_grad_()
    time = torch.tensor(0.03, dtype=torch.float64, requires_grad=True)
    flow = heat_flow(lb, f, time, tolerance=1e-11)
    of_f, slope = torch.autograd.grad(w @ flow, (f, time))
    step = 1e-5
    before, after = (heat_flow(lb, f, 0.03 + s, tolerance=1e-12) for s in (-step, step))
    torch.testing.assert_close(slope, w @ (after - before) / (2 * step), rtol=1e-5, atol=0.0)
    with torch.no_grad():
        boundary = torch.where(lb.fixed, f, 0.0)
        change = heat_flow(lb, f, time, tolerance=1e-11) - heat_flow(
            lb, f - boundary, time, tolerance=1e-11
        )
    torch.testing.assert_close(of_f @ boundary, w @ change, rtol=1e-6, atol=0.0)
    assert (of_f[lb.fixed] != 0).all()


def test_a_time_may_be_an_integer(unchecked):
    assert Diffusion(3, init_time=1).time.eq(1.0).all()


@pytest.mark.parametrize("time", [0.0, -1.0, math.nan])
def test_learned_times_start_above_zero(time):
    with pytest.raises(InputError, match="init_time"):
        Diffusion(3, init_time=time)


def test_smoothing_within_a_mask_is_zero_where_a_condition_holds_it():
    lb = LaplaceBeltrami.from_mesh(*UnitDisk().mesh(200), condition="dirichlet")
    mask = lb.points[:, 0] > 0
    found = smooth(lb, torch.ones(200).double(), 0.5, mask=mask)
    assert found[mask].isfinite().all()
    assert (found[mask & lb.boundary] == 0).all()
    assert found[~mask].isnan().all()


@pytest.mark.parametrize("method", ["rational", "spectral"])
def test_heat_leaves_a_disk_through_a_cold_boundary(method):
    """Of one everywhere: 2 Σ_k J₀(j_k r) e^{−j_k² t} / (j_k J₁(j_k)), and its derivative in what is at the boundary."""
    lb = LaplaceBeltrami.from_mesh(*UnitDisk().mesh(500), condition="dirichlet")
    roots, r = torch.from_numpy(jn_zeros(0, 20)), lb.points.norm(dim=1)[:, None]
    exact = (2 * j0(roots * r) * torch.exp(-0.2 * roots**2) / (roots * j1(roots))).sum(1)
    ones = torch.ones(500, dtype=torch.float64, requires_grad=True)
    found = heat_flow(lb, ones, 0.2, method=method)
    assert (found - exact).abs().max() < 2e-5
    (slope,) = torch.autograd.grad(found.sum(), ones)
    assert (slope[lb.fixed] != 0).all()
    torch.testing.assert_close(slope @ ones.detach(), found.detach().sum())
