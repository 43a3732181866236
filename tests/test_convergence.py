"""Rates: slope of the relative l2 error of Δf against h, and a bound on the finest error."""

import numpy as np
import pytest
import torch

from torchlb import LaplaceBeltrami
from torchlb.surfaces import (
    Circle,
    CliffordTorus,
    Ellipsoid,
    SpaceCurve,
    Sphere,
    StarShaped,
    ThreeSphere,
    Torus,
    smooth_function,
)

SURFACES = [Sphere(), Ellipsoid(), Torus(), StarShaped()]
name = lambda surface: type(surface).__name__  # noqa: E731


def slope_and_error(surface, sizes, sampling="points", **options):
    """Observed order over the given sizes, and the error at the finest."""
    errors = []
    for n in sizes:
        points = getattr(surface, sampling)(n)
        exact = surface.laplacian(smooth_function, points)
        lb = LaplaceBeltrami.from_points(points, dim=surface.dim, certify=False, **options)
        errors.append(float((lb(smooth_function(points)) - exact).norm() / exact.norm()))
    return -surface.dim * np.polyfit(np.log(sizes), np.log(errors), 1)[0], errors[-1]


@pytest.mark.slow
@pytest.mark.parametrize("surface", SURFACES, ids=name)
@pytest.mark.parametrize("projection", ["tangent", "normal"])
@pytest.mark.parametrize(
    ("order", "bound"), [(1, 2e-2), (2, 3e-2), (3, 2e-3), (4, 3e-3), (5, 7e-4)]
)
def test_order_on_evenly_spread_points(surface, projection, order, bound):
    slope, finest = slope_and_error(
        surface, [2000, 2800, 4000, 5600, 8000], order=order, projection=projection
    )
    assert slope >= order - 0.3
    assert finest <= bound


@pytest.mark.slow
@pytest.mark.parametrize("surface", [Sphere(), Torus()], ids=name)
@pytest.mark.parametrize("order", [1, 3, 5])
def test_order_on_random_points(surface, order):
    slope, _ = slope_and_error(surface, [2000, 4000, 8000, 16000], "random_points", order=order)
    assert slope >= order - 0.5


@pytest.mark.parametrize(
    ("surface", "sizes"),
    [
        (Circle(), [100, 150, 200, 300]),
        (SpaceCurve(), [200, 300, 400, 600]),
        (CliffordTorus(), [1000, 1500, 2000, 3000]),
        pytest.param(ThreeSphere(), [2000, 4000, 8000, 12000], marks=pytest.mark.slow),
    ],
    ids=["circle", "curve", "Clifford torus", "S3"],
)
@pytest.mark.parametrize("order", [1, 3])
def test_order_in_other_dimensions(surface, sizes, order):
    slope, _ = slope_and_error(surface, sizes, order=order)
    assert slope >= order - 0.3


@pytest.mark.slow
@pytest.mark.parametrize("normal_order", [1, 2, 3, 5])
def test_the_two_terms_of_the_theorem(normal_order):
    """With p = 4 the error is O(h^p + h^q): order q below p (even q superconverge), p from there on."""
    slope, _ = slope_and_error(
        Torus(), [2000, 4000, 8000], order=4, normal_order=normal_order, projection="normal"
    )
    assert slope >= min(4, normal_order) - 0.4


def test_the_notes_closing_claim():
    """p = q = 2 with the note's projection beats the cotangent formula on the same mesh, where that has converged."""
    surface = Sphere()
    vertices, faces = surface.mesh(4000)
    exact = surface.laplacian(smooth_function, vertices)
    f = smooth_function(vertices)
    note = LaplaceBeltrami.from_mesh(
        vertices, faces, order=2, normal_order=2, projection="normal", certify=False
    )
    cotangent = LaplaceBeltrami.from_cotangent(vertices, faces)
    assert (note(f) - exact).norm() < 0.5 * (cotangent(f) - exact).norm()


def sheets(n):
    """Two parallel sheets two spacings apart, n evenly spread points in each."""
    k = torch.arange(n).double()
    step = torch.tensor([0.7548776662466927, 0.5698402909980532]).double()
    top, bottom = (0.5 + k[:, None] * step) % 1, (0.87 + k[:, None] * step) % 1
    gap = torch.full((n, 1), 2 / n**0.5).double()
    return torch.cat([torch.cat([top, gap], 1), torch.cat([bottom, 0 * gap], 1)])


@pytest.mark.parametrize("order", [1, 3])
def test_no_stencil_crosses_between_sheets(order):
    points = sheets(1000)
    lb = LaplaceBeltrami.from_points(points, order=order, certify=False)
    row = torch.arange(2000).repeat_interleave(lb.crow.diff())
    assert ((row < 1000) == (lb.col < 1000)).all()


@pytest.mark.parametrize("order", [1, 3])
def test_thin_closed_surface(order):
    """0.2 thick, 2 wide: no row in the flat part reaches the other side, and the error stays below 0.8."""
    surface = Ellipsoid((1.0, 1.0, 0.1))
    points = surface.points(1000)
    lb = LaplaceBeltrami.from_points(points, order=order, certify=False)
    exact = surface.laplacian(smooth_function, points)
    assert (lb(smooth_function(points)) - exact).norm() < 0.8 * exact.norm()
    flat = points[:, :2].norm(dim=1) < 0.8
    row = torch.arange(1000).repeat_interleave(lb.crow.diff())
    inside = flat[row] & flat[lb.col]
    assert (points[row, 2] * points[lb.col, 2] > 0)[inside].all()
