"""Stencil weights: exact on polynomials, optimal among the exact ones, and known where stencils are classical."""

import numpy as np
import pytest
import torch
from torch.func import hessian, jacrev

from tolerances import TOLERANCE
from torchlb.fits.polynomials import functionals, monomials, num_monomials
from torchlb.fits.rules import WEIGHT_RULES, polyharmonic_weights, reference
from torchlb.fits.weights import (
    Weights,
    centered_fit,
    least_squares_weights,
    window,
)
from torchlb.geometry.fit_search import is_regular
from torchlb.linalg.precision import NEGLIGIBLE

CASES = [(1, 2), (1, 5), (2, 2), (2, 3), (2, 6), (3, 2), (3, 4), (4, 3)]
RULES = {"least_squares": least_squares_weights, "polyharmonic": polyharmonic_weights}


def close(actual, expected, scale=1.0):
    torch.testing.assert_close(actual / scale, expected / scale, **TOLERANCE[torch.float64])


def cloud(dim, degree, batch=3, factor=3.0):
    """Random neighbours in the unit ball, `factor` times as many as polynomials."""
    size = int(factor * num_monomials(dim, degree)) + 2
    direction = torch.randn(batch, size, dim, dtype=torch.float64)
    radius = torch.rand(batch, size, 1, dtype=torch.float64) ** (1 / dim)
    return direction / direction.norm(dim=-1, keepdim=True) * radius


def grid(half, step=1.0):
    """The neighbours of 0 in the square lattice {−half, …, half}²·step."""
    axis = torch.arange(-half, half + 1, dtype=torch.float64) * step
    nodes = torch.cartesian_prod(axis, axis)
    return nodes[nodes.norm(dim=1) > 0][None]


def polynomial(dim, degree):
    """A random polynomial of the degree, its constant included."""
    coefficients = torch.randn(num_monomials(dim, degree), dtype=torch.float64)

    def value(y):
        return coefficients[0] + monomials(y, degree) @ coefficients[1:]

    return value


def refused(weights):
    """Whether rank is missing, and acceptance sees it without a test of its own: by the moments, or by growth."""
    growth = weights.radius**2 * weights.laplacian.abs().sum(1)
    missed = ~((weights.residual <= NEGLIGIBLE) & (growth < 1e3))
    return bool((missed & ~(weights.condition < 1e10)).all())


def applied(weights, f, coords):
    """Σ_j w_j f(y_j), the centre first."""
    nodes = torch.cat([torch.zeros_like(coords[:, :1]), coords], dim=1)
    return torch.einsum("bk...,bk->b...", weights, f(nodes))


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize(("dim", "degree"), CASES)
def test_derivatives_of_polynomials_are_exact(dim, degree, rule):
    """Δ and gradient at the centre of a random polynomial of degree m, to rounding."""
    coords, f = cloud(dim, degree), polynomial(dim, degree)
    weights = RULES[rule](coords, degree)
    zero = torch.zeros(dim, dtype=torch.float64)
    slope, second = jacrev(f)(zero), hessian(f)(zero)
    scale = weights.laplacian.abs().sum(1).max()
    close(applied(weights.laplacian, f, coords), second.trace().expand(3), scale)
    close(applied(weights.gradient, f, coords), slope.expand(3, dim), scale)
    assert (weights.condition < 1e10).all()
    # On clustered random nodes splines have weights of 1e4 and more, and their rounding; those are never accepted.
    assert weights.residual.max() < (1e-8 if rule == "polyharmonic" else 1e-11)


@pytest.mark.parametrize("dim", [1, 2, 3, 4])
def test_degree_one_has_gradients_only(dim):
    coords, f = cloud(dim, 1), polynomial(dim, 1)
    weights = least_squares_weights(coords, 1)
    close(applied(weights.gradient, f, coords), jacrev(f)(coords[0, 0]).expand(3, dim))
    assert (weights.laplacian == 0).all()


@pytest.mark.parametrize("rule", WEIGHT_RULES)
@pytest.mark.parametrize("dim", [1, 2, 3])
def test_weights_sum_to_zero(dim, rule):
    """Σ_j w_j = 0, the centre included, for every functional."""
    weights = WEIGHT_RULES[rule](cloud(dim, 3, factor=4), 3)
    for part in (weights.gradient, weights.laplacian):
        assert (part.sum(1).abs() / part.abs().sum(1)).max() < 1e-12


def test_three_points_of_a_line():
    """[1, −2, 1] / h² and [−1, 0, 1] / 2h; five points at degree 4 give [−1, 16, −30, 16, −1] / 12h²."""
    h = 0.1
    three = h * torch.tensor([[[-1.0], [1]]], dtype=torch.float64)
    weights = least_squares_weights(three, 2)
    close(h**2 * weights.laplacian, torch.tensor([[-2.0, 1, 1]], dtype=torch.float64))
    close(h * weights.gradient[..., 0], torch.tensor([[0.0, -0.5, 0.5]], dtype=torch.float64))
    five = h * torch.tensor([[[-2.0], [-1], [1], [2]]], dtype=torch.float64)
    expected = torch.tensor([[-30.0, -1, 16, 16, -1]], dtype=torch.float64) / 12
    close(h**2 * least_squares_weights(five, 4).laplacian, expected)


def test_nine_points_of_a_square_lattice():
    """The 3 × 3 stencils consistent to degree 3 are [a, 1 − 2a, a; …] / h²; the window chooses 0 < a < 1/2."""
    h = 0.5
    coords = grid(1, h)
    weights = h**2 * least_squares_weights(coords, 2).laplacian[0]
    corner = coords[0].abs().sum(1) > 1.5 * h
    a = weights[1:][corner]
    close(a, a[:1].expand(4))
    close(weights[1:][~corner], (1 - 2 * a[:1]).expand(4))
    close(weights[:1], 4 * a[:1] - 4)
    assert 0 < a[0] < 0.5


def test_five_points_of_a_square_lattice():
    """[1, 1, −4, 1, 1] / h², forced by one corner more, whose own weight Σ w xy = 0 makes zero."""
    h = 0.5
    cross = h * torch.tensor([[1.0, 0], [-1, 0], [0, 1], [0, -1], [1, 1]], dtype=torch.float64)
    weights = h**2 * least_squares_weights(cross[None], 2).laplacian[0]
    close(weights, torch.tensor([-4.0, 1, 1, 1, 1, 0], dtype=torch.float64))


def test_a_cross_without_corners_is_reported():
    """y₁y₂ vanishes on all its eight points."""
    unit = torch.tensor([[1.0, 0], [-1, 0], [0, 1], [0, -1]], dtype=torch.float64)
    assert refused(least_squares_weights(torch.cat([unit, 2 * unit])[None], 2))


@pytest.mark.parametrize(("off", "passes"), [(0.0, False), (1e-17, False), (1e-2, True)])
def test_a_cross_but_for_rounding_is_refused(off, passes):
    """The fit's derivatives are those of a quotient of roundings, whatever its values between the points are."""
    unit = torch.tensor([[1.0, off], [-1, off], [off, 1], [off, -1]], dtype=torch.float64)
    fit = centered_fit(torch.cat([unit, 2 * unit])[None], 2)
    assert is_regular(fit, unit[None] / 2, 2).item() == passes


@pytest.mark.parametrize("rule", WEIGHT_RULES)
@pytest.mark.parametrize("scale", [1e-6, 1e-3, 1e3, 1e6])
def test_scaling(scale, rule):
    """y → s y: Δ scales by s⁻², the gradient by s⁻¹, the radius by s; the numbers of quality do not move."""
    coords = cloud(2, 3, factor=4)
    one, other = (WEIGHT_RULES[rule](c, 3) for c in (coords, scale * coords))
    # The saddle system of the spline has a condition of about 1e7; least squares has next to none.
    tolerance = 1e-5 if rule == "polyharmonic" else 1e-12
    for name, power in (("laplacian", 2), ("gradient", 1), ("radius", -1)):
        a, b = getattr(one, name), getattr(other, name) * scale**power
        assert (a - b).abs().max() <= tolerance * a.abs().max()
    close(other.condition, one.condition, one.condition)


@pytest.mark.parametrize("rule", RULES)
def test_rotations_of_the_plane_do_not_move_the_laplacian(rule):
    coords = cloud(2, 4)
    c, s = np.cos(0.7), np.sin(0.7)
    turned = coords @ torch.tensor([[c, -s], [s, c]])
    one, other = (RULES[rule](x, 4).laplacian for x in (coords, turned))
    # The saddle system of the spline has a condition of about 1e10 on random nodes.
    tolerance = 1e-6 if rule == "polyharmonic" else 1e-10
    assert (other - one).abs().max() <= tolerance * one.abs().max()


@pytest.mark.parametrize(("dim", "degree"), [(1, 4), (2, 2), (2, 4), (3, 2)])
def test_weights_minimise_the_centre_constrained_problem(dim, degree):
    """min Σ_{j≠i} w²/ω under Σ w y^α = Δy^α(0): the dense KKT system [2/ω V; Vᵀ 0] has the same solution."""
    coords = cloud(dim, degree, batch=1)
    scaled = coords[0] / coords[0].norm(dim=1).max()
    v, omega = monomials(scaled, degree), window(scaled.norm(dim=1))
    size, columns = v.shape
    kkt = torch.zeros(size + columns, size + columns, dtype=torch.float64)
    kkt[:size, :size] = (2 / omega).diag()
    kkt[:size, size:], kkt[size:, :size] = v, v.T
    zero = torch.zeros(dim, dtype=torch.float64)
    right = torch.zeros(size + columns, dtype=torch.float64)
    right[size:] = hessian(lambda y: monomials(y, degree))(zero).diagonal(dim1=1, dim2=2).sum(-1)
    expected = torch.linalg.solve(kkt, right)[:size]
    weights = least_squares_weights(coords, degree)
    found = weights.laplacian[0] * weights.radius**2
    close(found[1:], expected, expected.abs().max())
    close(found[0], -expected.sum(), expected.abs().max())


@pytest.mark.parametrize(("dim", "degree"), [(2, 3), (2, 4), (3, 3)])
def test_polyharmonic_weights_are_derivatives_of_the_interpolant(dim, degree):
    """s(y) = Σ c_j |y − y_j|^(2m+3) + polynomial with s(y_j) = f_j, Σ c_j y_j^α = 0: w·f = Δs(0), by autograd."""
    coords = cloud(dim, degree, batch=1)
    nodes = torch.cat([torch.zeros(1, dim).double(), coords[0]])
    nodes = nodes / nodes.norm(dim=1).max()
    f = torch.randn(len(nodes), dtype=torch.float64)
    kernel = torch.cdist(nodes, nodes) ** (2 * degree + 3)
    v = torch.cat([torch.ones(len(nodes), 1).double(), monomials(nodes, degree)], 1)
    size, columns = v.shape
    system = torch.zeros(size + columns, size + columns, dtype=torch.float64)
    system[:size, :size], system[:size, size:], system[size:, :size] = kernel, v, v.T
    right = torch.cat([f, torch.zeros(columns).double()])
    c, b = torch.linalg.solve(system, right).split([size, columns])

    def spline(y):
        square = (y - nodes).square().sum(1)
        return (c * square.pow(degree + 1.5)).sum() + b[0] + monomials(y, degree) @ b[1:]

    # Not at 0 itself, where the root of autograd is singular: the derivative of an odd power there is 0.
    here = torch.full((dim,), 1e-7, dtype=torch.float64)
    expected = hessian(spline)(here).trace()
    weights = polyharmonic_weights(coords, degree)
    found = weights.laplacian[0] @ f * weights.radius[0] ** 2
    assert abs(found - expected) <= 1e-4 * weights.laplacian.abs().sum() * weights.radius[0] ** 2


@pytest.mark.parametrize("rule", RULES)
def test_collinear_neighbours_are_reported(rule):
    """Points of a line do not determine y₂: the rank falls short and nothing is raised."""
    t = torch.linspace(-1, 1, 24, dtype=torch.float64)
    coords = torch.stack([t, 2 * t], dim=1)[None]
    assert refused(RULES[rule](coords, 2))


def test_neighbours_on_a_circle():
    """At degree 2 they are 4 / (12 ρ²) each, the mean value property; y₁³ + y₁y₂² − y₁ = 0 there ends degree 3."""
    angle = 2 * torch.pi * torch.arange(12, dtype=torch.float64) / 12
    coords = 0.1 * torch.stack([angle.cos(), angle.sin()], 1)[None]
    expected = torch.full((12,), 1 / 3, dtype=torch.float64)
    close(least_squares_weights(coords, 2).laplacian[0, 1:] * 0.01, expected)
    assert refused(least_squares_weights(coords, 3))


@pytest.mark.parametrize("rule", WEIGHT_RULES)
def test_residual_of_heights_is_what_polynomials_leave_of_the_heights(rule):
    """Zero for heights of degree ≤ m; for noise of deviation σ about σ over the distances; of no unit."""
    degree, sigma = 2, 1e-3
    coords = cloud(2, degree, batch=100, factor=4)
    smooth = torch.stack([coords[..., 0] * coords[..., 1], coords.square().sum(-1)], -1)
    noise = sigma * torch.randn_like(smooth)
    assert (WEIGHT_RULES[rule](coords, degree, heights=smooth).height_residual <= 1e-12).all()
    found = WEIGHT_RULES[rule](coords, degree, heights=smooth + noise).height_residual
    assert (found > sigma).all()  # the distances are below 1
    assert (found < 10 * sigma).all()
    scaled = WEIGHT_RULES[rule](7 * coords, degree, heights=7 * (smooth + noise)).height_residual
    torch.testing.assert_close(scaled, found)
    assert (WEIGHT_RULES[rule](coords, degree).height_residual == 0).all()


def test_left_out_neighbours_have_no_weight():
    coords = cloud(2, 2)
    keep = torch.rand(coords.shape[:2]) < 0.8
    fit = centered_fit(coords, 2, keep)
    weights = functionals(2, 2)[:, 2] @ fit.coefficients / fit.radius.square()[:, None]
    assert (weights[~keep] == 0).all()
    f = polynomial(2, 2)
    exact, change = hessian(f)(torch.zeros(2).double()).trace(), f(coords) - f(0 * coords)
    close((weights * change).sum(1), exact.expand(3), weights.abs().max())


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_flux_data_stand_in_for_moments(degree):
    """A polynomial with ∂_ν f = 0 at the boundary points of the stencil has the exact Δ from values alone.

    Boundary y₁ = 0 with ν = −e₁, f even in y₁; all neighbours lie on y₁ ≥ 0 and the centre on it or off it.
    """
    for offset in (0.0, 0.3):
        coords = cloud(2, degree)
        coords[..., 0] = coords[..., 0].abs() - offset
        coords[:, :6, 0] = -offset
        flux = torch.zeros(3, coords.shape[1] + 1, 2, dtype=torch.float64)
        flux[:, 1:7, 0] = -1
        if offset == 0:
            flux[:, 0, 0] = -1
        weights = least_squares_weights(coords, degree, flux=flux)

        def even(y, offset=offset):
            x = y[..., 0] + offset
            return (x**2 * (1.5 if degree < 4 else 1.5 + x**2)) + y[..., 1] ** 2 - 2 * y[..., 1]

        exact = hessian(even)(torch.zeros(2, dtype=torch.float64)).trace()
        scale = weights.laplacian.abs().sum(1).max()
        close(applied(weights.laplacian, even, coords), exact.expand(3), scale)


def test_data_of_a_robin_condition_stand_in_for_moments():
    """f = x² + x + 1/a has ∂_ν f + a f = 0 on x = 0 with ν = −e_x, and Δf = 2 from values alone; Σ w is not zero."""
    a = 1.5
    coords = cloud(2, 3)
    coords[..., 0] = coords[..., 0].abs()
    coords[:, :6, 0] = 0
    flux = torch.zeros(3, coords.shape[1] + 1, 2, dtype=torch.float64)
    flux[:, :7, 0] = -1
    weights = least_squares_weights(coords, 3, flux=flux, share=a)

    def f(y):
        return y[..., 0] ** 2 + y[..., 0] + 1 / a

    scale = weights.laplacian.abs().sum(1).max()
    close(applied(weights.laplacian, f, coords), torch.full((3,), 2.0).double(), scale)
    assert (weights.laplacian.sum(1).abs() > 1e-3 * scale).all()


def test_condition_is_that_of_the_column_scaled_system():
    coords = cloud(2, 3, batch=1)
    weights = least_squares_weights(coords, 3)
    scaled = coords[0] / weights.radius
    system = window(scaled.norm(dim=1)).sqrt()[:, None] * monomials(scaled, 3)
    expected = torch.linalg.pinv(system / system.norm(dim=0)).norm()
    close(weights.condition[0], expected, expected)


def test_reference_is_what_even_neighbours_give():
    """ρ² Σ|w| and Σ|w_j|/|w_i| over many points of a Sobol sequence in the ball are within 10 % of the lattice's."""
    cube = 2 * torch.quasirandom.SobolEngine(2).draw(4096).double() - 1
    ball = cube[cube.norm(dim=1) <= 1][1:]
    for degree in (2, 4, 6):
        weights = least_squares_weights(ball[None, : 20 * num_monomials(2, degree)], degree)
        center, others = weights.laplacian[0, 0].abs(), weights.laplacian[0, 1:].abs().sum()
        growth, ratio = reference(2, degree)
        assert abs(weights.radius.item() ** 2 * (center + others) / growth - 1) < 0.1
        assert abs(others / center / ratio - 1) < 0.1


def test_reference_of_splines_and_of_one_sided_stencils_is_larger():
    """Splines grow about fourfold; with Neumann data 1, 3, 7 and 13 times at degrees 2, 4, 6, 8; more with d."""
    inside = [reference(2, m).growth for m in (2, 4, 6, 8)]
    edge = [reference(2, m, one_sided=True).growth for m in (2, 4, 6, 8)]
    splines = [reference(2, m, "polyharmonic").growth for m in (2, 4, 6)]
    assert [round(e / g) for e, g in zip(edge, inside, strict=True)] == [1, 3, 7, 13]
    assert all(3.5 < s / g < 4.7 for s, g in zip(splines, inside, strict=False))
    assert reference(1, 2).growth < reference(2, 2).growth < reference(3, 2).growth


def test_weights_can_be_picked_and_stacked():
    weights = least_squares_weights(cloud(2, 2), 2)
    again = Weights.stack([weights[torch.tensor([2])], weights[torch.tensor([0, 1])]])
    assert torch.equal(again.laplacian, weights.laplacian[[2, 0, 1]])
    assert torch.equal(again.condition, weights.condition[[2, 0, 1]])


def test_window_decreases_from_one_to_zero():
    """ω(r) = (1 − (r/1.1)²)⁴, 0 beyond 1.1."""
    r = torch.linspace(0, 2, 201, dtype=torch.float64)
    omega = window(r)
    close(omega[100], torch.tensor((1 - 1 / 1.21) ** 4).double())
    assert (omega.diff() <= 0).all()
    assert (omega[r > 1.1] == 0).all()
