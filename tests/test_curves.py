"""Curves: polygons with corners and crossings, and clouds of random points."""

import numpy as np
import pytest
import torch

from torchlb import InputError, LaplaceBeltrami, geodesic_distance

PI = torch.pi


def square(side):
    """Vertices of a square's outline, `side` segments a side, and the segments."""
    s = np.linspace(0, 1, side, endpoint=False)
    sides = [(s, 0 * s), (1 + 0 * s, s), (1 - s, 1 + 0 * s), (0 * s, 1 - s)]
    number = np.arange(4 * side)
    return np.vstack([np.c_[x, y] for x, y in sides]), np.c_[number, (number + 1) % (4 * side)]


def test_an_outline_with_corners_is_one_closed_curve():
    """λ = (2πj/4)², each twice; tangents turn by a right angle at four points."""
    lb = LaplaceBeltrami.from_mesh(*square(20))
    torch.testing.assert_close(lb.mass.sum().item(), 4.0)
    exact = torch.tensor([0, 1, 1, 2, 2]).double().square() * (PI / 2) ** 2
    torch.testing.assert_close(lb.eigenbasis(5).eigenvalues, exact, rtol=1e-2, atol=1e-9)


def test_what_flows_into_a_crossing_flows_out_of_it():
    """Three arms of length one: λ = (π/2)² twice, where the crossing stays, and π²."""
    x, y = np.linspace(0, 1, 41), np.linspace(0, 1, 41)[1:]
    turns = [0, 2 * PI / 3, 4 * PI / 3]
    points = np.vstack([np.c_[x, 0 * x], *(np.c_[y * np.cos(a), y * np.sin(a)] for a in turns[1:])])
    arms = [np.r_[0, np.arange(41 + 40 * k, 81 + 40 * k)] for k in range(2)]
    arms = [np.arange(41), *arms]
    segments = np.vstack([np.c_[arm[:-1], arm[1:]] for arm in arms])
    lb = LaplaceBeltrami.from_mesh(points, segments)
    exact = torch.tensor([0, 1 / 4, 1 / 4, 1]).double() * PI**2
    torch.testing.assert_close(lb.eigenbasis(4).eigenvalues, exact, rtol=3e-2, atol=1e-9)
    assert geodesic_distance(lb, 40).max() < 2 + 1e-9


def test_segments_without_length_are_refused():
    with pytest.raises(InputError, match=r"1 segments \(1\) have no length"):
        LaplaceBeltrami.from_mesh(
            torch.tensor([[0.0], [1], [1], [2], [3], [4], [5]]),
            torch.tensor([[0, 1], [1, 2], [2, 3], [3, 4], [4, 5], [5, 6]]),
            order=1,
        )


@pytest.mark.parametrize("seed", range(4))
def test_random_points_of_a_circle_are_one_curve(seed):
    """With gaps of seven and more mean spacings, beside which the nearest points are on one side."""
    angle = np.random.default_rng(seed).random(400) * 2 * PI
    lb = LaplaceBeltrami.from_points(np.c_[np.cos(angle), np.sin(angle)])
    exact = torch.tensor([0, 1, 1, 4, 4]).double()
    torch.testing.assert_close(lb.eigenbasis(5).eigenvalues, exact, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("points", [50, 200])
def test_an_open_curve_ends_at_its_last_points(points):
    """Of a parabola as points alone, whose ends are not declared, masses sum to its length."""
    x = np.linspace(0, 1, points)
    curve = np.c_[x, x**2]
    lb = LaplaceBeltrami.from_points(curve, dim=1)
    length = np.sqrt(5) / 2 + np.arcsinh(2) / 4
    assert lb.mass.sum().item() == pytest.approx(length, rel=1e-7)
