"""Thin shapes: no stencil reaches through to the other side, though it is nearer than many a neighbour."""

import math
from functools import cache

import pytest
import torch

from torchlb import LaplaceBeltrami
from torchlb.surfaces import Ellipsoid, smooth_function

SIZE = 1500  # points of each sheet


def low_discrepancy():
    """The additive sequence of Roberts, shifted between the sheets."""
    step = torch.tensor([0.7548776662466927, 0.5698402909980532], dtype=torch.float64)
    index = torch.arange(SIZE, dtype=torch.float64)[:, None]
    return (0.5 + index * step) % 1, (0.87 + index * step) % 1


def jittered():
    """A grid of spacing h, each point moved by up to 0.3 h."""
    side = round(math.sqrt(SIZE))
    axis = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    grid = torch.cartesian_prod(axis, axis)
    return tuple(grid + 0.6 / side * (torch.rand(len(grid), 2).double() - 0.5) for _ in range(2))


def aligned():
    """The same grid twice, point above point."""
    side = round(math.sqrt(SIZE))
    axis = (torch.arange(side, dtype=torch.float64) + 0.5) / side
    return (torch.cartesian_prod(axis, axis),) * 2


def crossings(lb, side, rows):
    """Entries of rows of the matrix between the two sides."""
    row = torch.arange(lb.num_points).repeat_interleave(lb.stencil.crow.diff())
    return int(((side[row] != side[lb.stencil.col]) & rows[row]).sum())


@pytest.mark.parametrize("order", [1, 3])
@pytest.mark.parametrize("sampling", [low_discrepancy, jittered, aligned])
def test_no_row_crosses_between_two_sheets(sampling, order):
    """Gap 2h, h = 1/√n: rows stay on their own sheet, but near the rims, between which the gap is one of the cloud."""
    sheets = sampling()
    count = len(sheets[0])
    height = torch.tensor([0.0, 2 / math.sqrt(count)], dtype=torch.float64)
    points = torch.cat([torch.cat(sheets), height.repeat_interleave(count)[:, None]], 1)
    lb = LaplaceBeltrami.from_points(points, order=order)
    inside = ((points[:, :2] - 0.5).abs() < 0.35).all(1)
    assert crossings(lb, torch.arange(2 * count) >= count, inside) == 0
    # Most rows there are of the order that was asked for.
    assert (lb.report.order[inside] == order).double().mean() > 0.95


@cache
def lens():
    """2 wide and 0.2 thick, 1000 points: some 3 spacings from side to side in the middle."""
    surface = Ellipsoid((1.0, 1.0, 0.1))
    return surface, *surface.mesh(1000)


@pytest.mark.parametrize("order", [1, 3])
@pytest.mark.parametrize("kind", ["points", "mesh"])
def test_thin_closed_surface(kind, order):
    """Rows of |xy| < 0.75 have no entry on the other side, and Δf is off by less than 0.85 (relative l2).

    Farther out the lens is thinner than 1.6 spacings, and its rim has no side.
    """
    surface, points, faces = lens()
    if kind == "points":
        lb = LaplaceBeltrami.from_points(points, order=order)
    else:
        lb = LaplaceBeltrami.from_mesh(points, faces, order=order)
    exact = surface.laplacian(smooth_function, points)
    assert (lb(smooth_function(points)) - exact).norm() < 0.85 * exact.norm()
    row = torch.arange(1000).repeat_interleave(lb.stencil.crow.diff())
    inside = (points[:, :2].norm(dim=1) < 0.75)[row]
    across = points[row, 2].sign() != points[lb.stencil.col, 2].sign()
    assert not (inside & across).any()


@pytest.mark.parametrize("scale", [2.0**-24, 2.0**24])
def test_sides_do_not_depend_on_the_unit(scale):
    """A lens given in micrometres has the rows of the one in metres."""
    _, points, faces = lens()
    one, other = (LaplaceBeltrami.from_mesh(s * points, faces) for s in (1.0, scale))
    assert torch.equal(other.stencil.col, one.stencil.col)
    assert torch.equal(other.stencil.values[0] * scale**2, one.stencil.values[0])


@pytest.mark.parametrize("order", [1, 3])
def test_thin_closed_surface_is_stable(order):
    _, points, _ = lens()
    lb = LaplaceBeltrami.from_points(points, order=order, certify=True)
    assert lb.certificate.holds
    assert (lb.mass > 0).all()
