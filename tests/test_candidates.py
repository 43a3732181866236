"""The ladder: which rungs, in which order, and who takes which."""

from math import ceil

import pytest
import torch

from torchlb.fits.polynomials import num_monomials
from torchlb.geometry.candidates import (
    CHUNK_BYTES,
    SIZE_FACTORS,
    Candidate,
    chunks,
    list_candidates,
    walk_ladder,
)
from torchlb.geometry.neighbors import GraphBalls, nearest_graph, nearest_neighbors
from torchlb.surfaces import Sphere


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_rungs_go_by_degree_then_rule_then_size(dim):
    """K = ⌈factor · M⌉ with M = C(m + d, d), for the factors of the rule."""
    rungs = list_candidates(dim, [4, 3, 2], ["polyharmonic", "least_squares"])
    expected = [
        Candidate(degree, ceil(factor * num_monomials(dim, degree) - 1e-9), rule)
        for degree in (4, 3, 2)
        for rule in ("polyharmonic", "least_squares")
        for factor in SIZE_FACTORS[rule]
    ]
    assert rungs == expected
    assert all(rung.size >= num_monomials(dim, rung.degree) for rung in rungs)


def test_a_given_size_replaces_those_of_the_ladder():
    rungs = list_candidates(2, [4, 3], ["polyharmonic", "least_squares"], num_neighbors=31)
    assert [rung.size for rung in rungs] == [31] * 4
    assert [rung.degree for rung in rungs] == [4, 4, 3, 3]


@pytest.mark.parametrize("degree", [2, 9])
def test_chunks_cover_all_points_within_the_bound(degree):
    rungs = list_candidates(2, [degree])
    parts = chunks(100_000, rungs, 2)
    assert torch.equal(torch.cat(parts), torch.arange(100_000))
    entry = 8 * max(rung.size for rung in rungs) * num_monomials(2, degree)
    assert max(len(part) for part in parts) * entry <= max(CHUNK_BYTES, 64 * entry)


@pytest.fixture(scope="module")
def balls():
    points = Sphere().points(300)
    frames = Sphere().frames(points)
    return GraphBalls(points, nearest_graph(points, frames, nearest_neighbors(points, 24)), frames)


RUNGS = list_candidates(2, [2], ["least_squares"])


def walk(balls, centers, willing, start=None, rungs=RUNGS):
    """Who takes which rung (−1: none), if centre c passes from rung `willing[c]` on; and what was tried."""
    taken = torch.full((len(centers),), -1)
    tried = []

    def attempt(rows, index, rung):
        number = rungs.index(rung)
        assert index.shape == (len(rows), rung.size)
        assert torch.equal(index[:, 0], rows)
        tried.extend((number, int(row)) for row in rows)
        return willing[rows] <= number, rows

    for number, rows, result in walk_ladder(balls, centers, rungs, attempt, start):
        assert torch.equal(centers[rows], result)
        assert (taken[rows] == -1).all()
        taken[rows] = number
    return taken, tried


def test_every_centre_takes_the_first_rung_that_passes(balls):
    centers = torch.arange(3, 300, 7)
    willing = torch.randint(0, len(RUNGS), (300,))
    taken, tried = walk(balls, centers, willing)
    assert torch.equal(taken, willing[centers])
    # In order, each once, and none after it passed.
    assert sorted(tried) == sorted(
        (number, int(c)) for c in centers for number in range(int(willing[c]) + 1)
    )
    assert [number for number, _ in tried] == sorted(number for number, _ in tried)


def test_start_keeps_rows_off_the_rungs_before_their_own(balls):
    centers = torch.arange(20)
    start = torch.arange(20) % (len(RUNGS) + 1)
    taken, tried = walk(balls, centers, torch.zeros(300), start)
    assert torch.equal(taken, torch.where(start < len(RUNGS), start, -1))
    assert all(number >= start[row] for number, row in tried)


def test_who_passes_nowhere_does_not_appear(balls):
    taken, tried = walk(balls, torch.arange(10), torch.full((300,), 99))
    assert (taken == -1).all()
    assert len(tried) == 10 * len(RUNGS)


def test_rungs_larger_than_the_ball_are_not_tried():
    """A graph of two components of 150 points: 200 neighbours do not exist."""
    points = torch.cat([Sphere().points(150), Sphere().points(150) + 10])
    frames = Sphere().frames(points[:150]).repeat(2, 1, 1)
    graph = nearest_graph(points, frames, nearest_neighbors(points, 24))
    balls = GraphBalls(points, graph, frames)
    rungs = [Candidate(2, 200, "least_squares"), Candidate(2, 12, "least_squares")]
    taken, tried = walk(balls, torch.arange(300), torch.zeros(300), rungs=rungs)
    assert (taken == 1).all()
    assert {number for number, _ in tried} == {1}
