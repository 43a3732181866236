"""Rates: slope of the relative l2 error of Δf against h, and a bound on the finest error."""

from functools import cache

import numpy as np
import pytest

from torchlb import LaplaceBeltrami
from torchlb.cloud import reconstruct
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

SIZES = (1500, 2200, 3200, 4800)
OF_THE_STAR = (2000, 3000, 4500, 7000)  # the finest alone resolves its arms
BOUNDS = {  # on the error at the finest size
    "tangent": {1: 6e-3, 2: 6e-3, 3: 3e-4, 4: 4e-4, 5: 6e-5},
    "normal": {2: 2e-2, 3: 2e-3, 5: 6e-4},
}
pytestmark = pytest.mark.usefixtures("unchecked")
name = lambda surface: type(surface).__name__  # noqa: E731


@cache
def sample(surface, n, kind):
    """Points of a surface, what connects them, a function there, and its exact Laplacian: for all orders the same."""
    points = getattr(surface, kind)(n)
    exact = surface.laplacian(smooth_function, points)
    return points, reconstruct(points, surface.dim), smooth_function(points), exact


def slope_and_error(surface, sizes, kind="points", **options):
    """Observed order over the given sizes, and the error at the finest."""
    errors = []
    for n in sizes:
        points, found, f, exact = sample(surface, n, kind)
        lb = LaplaceBeltrami.from_points(
            points, reconstruct=lambda _, found=found: found, weak_form=False, **options
        )
        errors.append(float((lb(f) - exact).norm() / exact.norm()))
    return -surface.dim * np.polyfit(np.log(sizes), np.log(errors), 1)[0], errors[-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("surface", "projection", "orders"),
    [
        (Sphere(), "tangent", (1, 3, 5)),
        (Ellipsoid(), "tangent", (1, 3, 5)),
        (Torus(), "tangent", (1, 2, 3, 4, 5)),
        (StarShaped(), "tangent", (1, 2, 3, 4, 5)),
        (Sphere(), "normal", (2, 3, 5)),
        (Torus(), "normal", (2, 3, 5)),
    ],
)
def test_order_on_evenly_spread_points(surface, projection, orders):
    sizes, slack = (OF_THE_STAR, 0.45) if isinstance(surface, StarShaped) else (SIZES, 0.3)
    found = {p: slope_and_error(surface, sizes, order=p, projection=projection) for p in orders}
    bounds = BOUNDS[projection]
    wrong = {p: (slope, e) for p, (slope, e) in found.items() if slope < p - slack or e > bounds[p]}
    assert not wrong


@pytest.mark.slow
@pytest.mark.parametrize("surface", [Sphere(), Torus()], ids=name)
def test_order_on_random_points(surface):
    for order, bound in {1: 5e-2, 3: 8e-4, 5: 6e-5}.items():
        sizes = [1000, 2000, 4000, 8000]
        slope, finest = slope_and_error(surface, sizes, "random_points", order=order)
        assert slope >= order - 0.5
        assert finest <= bound


@pytest.mark.parametrize(
    ("surface", "sizes", "bounds"),
    [
        (Circle(), [100, 150, 200, 300], (5e-3, 1e-5)),
        (SpaceCurve(), [200, 300, 400, 600], (6e-3, 3e-5)),
        (CliffordTorus(), [1000, 1500, 2000, 3000], (1e-2, 4e-4)),
        pytest.param(ThreeSphere(), [1000, 1500, 2200, 3200], (3e-2, 2e-3), marks=pytest.mark.slow),
    ],
    ids=["circle", "curve", "Clifford torus", "S3"],
)
def test_order_in_other_dimensions(surface, sizes, bounds):
    for order, bound in zip((1, 3), bounds, strict=True):
        slope, finest = slope_and_error(surface, sizes, order=order)
        assert slope >= order - 0.3
        assert finest <= bound


@pytest.mark.slow
def test_the_two_terms_of_the_theorem():
    """With p = 4 the error is O(h^p + h^q): order q below p (even q superconverge), p from there on."""
    options = {"order": 4, "projection": "normal"}
    slopes = {
        q: slope_and_error(Torus(), SIZES, normal_order=q, **options)[0] for q in (1, 2, 3, 5)
    }
    assert all(slope >= min(4, q) - 0.4 for q, slope in slopes.items()), slopes


def test_the_notes_closing_claim():
    """p = q = 2 with the note's projection beats the cotangent formula on the same mesh, where that has converged."""
    surface = Sphere()
    vertices, faces = surface.mesh(4000)
    exact = surface.laplacian(smooth_function, vertices)
    f = smooth_function(vertices)
    note = LaplaceBeltrami.from_mesh(vertices, faces, order=2, normal_order=2, projection="normal")
    cotangent = LaplaceBeltrami.from_cotangent(vertices, faces)
    assert (note(f) - exact).norm() < 0.5 * (cotangent(f) - exact).norm()
