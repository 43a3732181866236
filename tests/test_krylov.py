"""Null vector and signs by Krylov methods: what the sparse factors say, and an operator as good in the end."""

from functools import partial

import numpy as np
import pytest
import torch
from scipy import sparse

from torchlb import LaplaceBeltrami
from torchlb.certified.certificate import check_certificate
from torchlb.certified.enforce import _feeding
from torchlb.certified.krylov import LowOrder, negative_directions
from torchlb.certified.null_vector import left_null_vector
from torchlb.surfaces import Hemisphere, Sphere, Torus, smooth_function

bare = partial(LaplaceBeltrami.from_points, weak_form=False)
certified = partial(bare, certify=True)


@pytest.fixture
def unfactored(monkeypatch):
    """Every operator is taken for one too large to factor, and a factorization is an error."""
    monkeypatch.setattr("torchlb.certified.krylov.LARGEST_FACTORED", 0)

    def refuse(*_):
        raise AssertionError("factored")

    monkeypatch.setattr("torchlb.certified.null_vector.factorized", refuse)


def two_scales():
    points = torch.cat([1e-5 * Sphere().random_points(500), Torus().random_points(400) + 9])
    return certified(points, order=3)


def random_cloud():
    return certified(Sphere().random_points(700))


def two_components():
    points = torch.cat([Sphere().random_points(400), Torus().points(400) + 6])
    return certified(points, order=2)


def with_outflow():
    return LaplaceBeltrami.from_mesh(*Hemisphere().mesh(500), condition="dirichlet")


@pytest.mark.parametrize("build", [random_cloud, two_components, two_scales, with_outflow])
def test_null_vector_and_verdict_are_those_of_the_factors(build, monkeypatch):
    lb = build()
    matrix, areas = lb.to_scipy(), lb.mass * (1 + 0.3 * torch.sin(torch.arange(lb.num_points)))
    outflow = build is with_outflow
    expected, verdict, _ = check_certificate(matrix, areas, outflow=outflow)
    monkeypatch.setattr("torchlb.certified.krylov.LARGEST_FACTORED", 0)
    mass, same_verdict, _ = check_certificate(matrix, areas, outflow=outflow)
    torch.testing.assert_close(mass, expected, rtol=1e-9, atol=0)
    assert verdict.holds
    assert (same_verdict.holds, same_verdict.components) == (True, verdict.components)


def test_what_the_factors_refuse_is_refused(monkeypatch):
    raw = bare(Sphere().random_points(700), order=1)
    step = certified(Sphere().random_points(700), order=1)
    matrix = raw.to_scipy()
    verdicts = [check_certificate(matrix, step.mass)[1]]
    monkeypatch.setattr("torchlb.certified.krylov.LARGEST_FACTORED", 0)
    verdicts.append(check_certificate(matrix, step.mass)[1])
    assert [v.holds for v in verdicts] == [False, False]
    assert verdicts[0].min_pi == pytest.approx(verdicts[1].min_pi, rel=1e-3)


@pytest.mark.parametrize("order", [1, 3])
@pytest.mark.usefixtures("unfactored")
def test_enforcement_ends_at_an_operator_as_good(order):
    points = Torus().random_points(900)
    lb = certified(points, order=order)
    assert lb.certificate.holds
    assert lb.certificate.rounds > 0
    assert lb.report.order_counts[order] >= 0.99 * 900
    weighted = lb.mass[:, None] * lb.matrix.to_dense()
    values = torch.linalg.eigvalsh((weighted + weighted.T) / 2)
    assert values.max() <= 1e-10 * values.abs().max()
    exact = Torus().laplacian(smooth_function, points)
    raw = bare(points, order=order)
    error, raw_error = ((op(smooth_function(points)) - exact).norm() for op in (lb, raw))
    assert error <= 1.6 * raw_error
    again = certified(points, order=order)
    assert torch.equal(again.stencil.values[0], lb.stencil.values[0])
    assert torch.equal(again.mass, lb.mass)


def graph_laplacian(count):
    """Of a grid on a torus: symmetric, positive but for its constants."""
    ring = sparse.diags_array([-1.0, 2.0, -1.0], offsets=[-1, 0, 1], shape=(count, count)).tolil()
    ring[0, -1] = ring[-1, 0] = -1.0
    eye = sparse.eye_array(count)
    return sparse.csr_array(sparse.kron(ring, eye) + sparse.kron(eye, ring))


@pytest.mark.parametrize("depth", [1e-1, 1e-4, 1e-7])
def test_a_shallow_negative_eigenvalue_is_found(depth):
    """One pair's weight is so negative that a single eigenvalue falls below zero, by about `depth` of the radius."""
    grid = graph_laplacian(30)
    pair = np.zeros(900)
    pair[400], pair[431] = 1.0, -1.0
    effective = pair @ np.linalg.pinv(grid.toarray()) @ pair
    edge = sparse.csr_array(np.outer(pair, pair))
    positive = sparse.csr_array(grid - (1 / effective - depth) * edge)
    assert negative_directions(positive).shape == (900, 0)
    matrix = sparse.csr_array(grid - (1 / effective + 8 * depth) * edge)
    lowest = np.linalg.eigvalsh(matrix.toarray())[0]
    assert lowest < 0
    found = negative_directions(matrix)
    assert found.shape[1] >= 1
    rayleigh = ((found * (matrix @ found)).sum(0) / (found**2).sum(0)).min()
    assert 1.001 * lowest <= rayleigh <= 0.3 * lowest


@pytest.mark.parametrize("weight", [1e8, 1e16])
def test_a_light_part_is_seen_beside_a_heavy_one(weight):
    """The residual would vanish if the preconditioner left out what is small beside its heaviest entry."""
    pair = np.zeros(100)
    pair[44], pair[66] = 1.0, -1.0
    grid = sparse.csr_array(graph_laplacian(10) - 3 * np.outer(pair, pair))
    heavy = sparse.coo_array([[weight]])
    lowest = np.linalg.eigvalsh(grid.toarray())[0]
    assert lowest < -1
    found = negative_directions(sparse.csr_array(sparse.block_diag([heavy, grid])))[1:]
    assert found.shape[1] >= 1
    rayleigh = ((found * (grid @ found)).sum(0) / (found**2).sum(0)).min()
    assert 1.001 * lowest <= rayleigh <= 0.3 * lowest


def test_every_place_where_a_direction_fails_is_marked():
    """Two places on a path, one a twentieth as high: its peak is marked, not what loses in sum."""
    path = sparse.csr_array(sparse.diags_array([1.0, 1.0, 1.0], offsets=[-1, 0, 1], shape=(12, 12)))
    feed = np.zeros((12, 1))
    feed[1:4, 0] = [0.05, 1.0, 0.05]
    feed[6:9, 0] = [-0.01, 0.05, -0.01]
    feed[10:, 0] = [0.05, -0.2]
    assert np.flatnonzero(_feeding(path, feed, peaks=True)).tolist() == [2, 7]
    assert np.flatnonzero(_feeding(path, feed, peaks=False)).tolist() == [2]


def test_noise_has_the_low_order_matrix_as_covariance():
    """Σ over many edges of g² w (e_i − e_j)(e_i − e_j)ᵀ, so the mean of bᵀW⁻¹b is the number of points."""
    grid = graph_laplacian(40)
    low = LowOrder(sparse.csr_array(-grid), np.full(1600, 0.5))
    b = low.noise()
    assert b @ sparse.linalg.spsolve(low.matrix.tocsc(), b) == pytest.approx(1600, rel=0.1)
    np.testing.assert_allclose(low.matrix.toarray(), grid.toarray() + 0.5 * np.eye(1600), atol=1e-7)
    once = low.inverse.matvec(b)
    exact = sparse.linalg.spsolve(low.matrix.tocsc(), b)
    assert np.linalg.norm(once - exact) < 0.5 * np.linalg.norm(exact)


def test_factors_step_in_where_krylov_methods_do_not_converge(monkeypatch):
    lb = certified(Sphere().random_points(400))
    expected = left_null_vector(lb.to_scipy(), lb.mass)[0]
    monkeypatch.setattr("torchlb.certified.krylov.LARGEST_FACTORED", 0)
    monkeypatch.setattr("torchlb.certified.krylov.ROUNDS", 1)
    monkeypatch.setattr("torchlb.certified.krylov.STEPS", 3)
    areas = lb.mass * torch.linspace(0.5, 1.5, 400)
    with pytest.warns(UserWarning, match="did not converge on 400 points.*certify=False"):
        mass, verdict, _ = check_certificate(lb.to_scipy(), areas)
    torch.testing.assert_close(mass / mass.sum(), expected / expected.sum(), rtol=1e-9, atol=0)
    assert verdict.holds
