"""Rates: slope of the relative l2 error of Δf against h, and a bound on the finest error."""

import numpy as np
import pytest

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
        surface, [4000, 8000, 16000], order=order, projection=projection
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
