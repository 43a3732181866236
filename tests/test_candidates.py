"""Candidate neighbourhoods: which, in which order, and who takes which."""

from math import ceil

import pytest
import torch

from torchlb.cloud.voronoi import nearest_graph
from torchlb.fits.polynomials import num_monomials
from torchlb.fits.rules import SIZE_FACTORS
from torchlb.geometry.candidates import (
    Candidate,
    Search,
    list_candidates,
)
from torchlb.geometry.neighbors import GraphNeighborhoods, nearest_neighbors
from torchlb.stencils.assemble import stencil_candidates
from torchlb.surfaces import Sphere


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_candidates_go_by_degree_then_rule_then_size(dim):
    """K = ⌈factor · M⌉ with M = C(m + d, d), for the factors of the rule."""
    candidates = list_candidates(dim, [4, 3, 2], ["polyharmonic", "least_squares"])
    expected = [
        Candidate(degree, ceil(factor * num_monomials(dim, degree) - 1e-9), rule, factor)
        for degree in (4, 3, 2)
        for rule in ("polyharmonic", "least_squares")
        for factor in SIZE_FACTORS[rule]
    ]
    assert candidates == expected
    assert all(candidate.size >= num_monomials(dim, candidate.degree) for candidate in candidates)


def test_a_given_size_replaces_the_listed_ones():
    candidates = list_candidates(2, [4, 3], ["polyharmonic", "least_squares"], num_neighbors=31)
    assert [candidate.size for candidate in candidates] == [31] * 4
    assert [candidate.degree for candidate in candidates] == [4, 4, 3, 3]


@pytest.fixture(scope="module")
def neighborhoods():
    points = Sphere().points(300)
    frames = Sphere().frames(points)
    return GraphNeighborhoods(
        points, nearest_graph(points, frames, nearest_neighbors(points, 24)), frames
    )


CANDIDATES = [Candidate(m, size, "least_squares") for m in (3, 2) for size in (16, 20, 30, 50)]


def found(neighborhoods, centers, willing, start=None, candidates=CANDIDATES, rejects=None):
    """Who settles on which candidate (−1: none), if centre c does from `willing[c]` on; and what was tried."""
    taken = torch.full((len(centers),), -1)
    tried = []
    search = Search(neighborhoods, centers, candidates, start)
    for number, rows, index in search:
        assert index.shape == (len(rows), candidates[number].size)
        assert torch.equal(index[:, 0], centers[rows])
        assert (taken[rows] == -1).all()
        tried.extend((number, int(c)) for c in centers[rows])
        passed = rows[willing[centers[rows]] <= number]
        taken[passed] = number
        search.settle(passed)
        if rejects is not None:
            search.reject_degree(rows[rejects[centers[rows]] & (taken[rows] < 0)], number)
    return taken, tried


def test_every_centre_takes_the_first_candidate_that_passes(neighborhoods):
    centers = torch.arange(3, 300, 7)
    willing = torch.randint(0, len(CANDIDATES), (300,))
    taken, tried = found(neighborhoods, centers, willing)
    assert torch.equal(taken, willing[centers])
    # In order, each once, and none after it passed.
    assert sorted(tried) == sorted(
        (number, int(c)) for c in centers for number in range(int(willing[c]) + 1)
    )
    assert [number for number, _ in tried] == sorted(number for number, _ in tried)


def test_pieces_cover_all_centres_within_the_bound(neighborhoods, monkeypatch):
    entry = 8 * CANDIDATES[0].size * num_monomials(2, CANDIDATES[0].degree)
    monkeypatch.setattr("torchlb.linalg.precision.BYTES", 100 * entry)
    pieces = list(Search(neighborhoods, torch.arange(300), CANDIDATES[:1]))
    assert torch.equal(torch.cat([rows for _, rows, _ in pieces]), torch.arange(300))
    assert [len(rows) for _, rows, _ in pieces] == [100, 100, 100]


def test_start_keeps_rows_off_the_candidates_before_their_own(neighborhoods):
    centers = torch.arange(20)
    start = torch.arange(20) % (len(CANDIDATES) + 1)
    taken, tried = found(neighborhoods, centers, torch.zeros(300), start)
    assert torch.equal(taken, torch.where(start < len(CANDIDATES), start, -1))
    assert all(number >= start[row] for number, row in tried)


def test_who_rejects_a_degree_goes_on_with_the_next(neighborhoods):
    """Four sizes of two degrees: after the first of degree 3 come those of degree 2, and after that nothing."""
    rejects = torch.arange(300) % 2 == 0
    taken, tried = found(neighborhoods, torch.arange(10), torch.full((300,), 99), rejects=rejects)
    assert (taken == -1).all()
    assert [number for number, center in tried if center == 4] == [0, 4]
    assert [number for number, center in tried if center == 5] == list(range(8))


def test_candidates_of_a_row():
    """Degrees p + 1, then even ones; on a mesh degree 2 at order 1 only; splines first."""

    def degrees(order, on_mesh, weights="least_squares"):
        listed = stencil_candidates(2, order, weights, 100, on_mesh=on_mesh)
        return [(c.degree, c.rule[0]) for c in listed]

    assert degrees(5, on_mesh=True) == [(6, "l"), (4, "l")]
    assert degrees(4, on_mesh=False) == [(5, "l"), (4, "l"), (2, "l")]
    assert degrees(1, on_mesh=True) == [(2, "l")]
    assert degrees(3, on_mesh=True, weights="polyharmonic") == [(4, "p"), (4, "l")]


def test_who_passes_nowhere_does_not_appear(neighborhoods):
    taken, tried = found(neighborhoods, torch.arange(10), torch.full((300,), 99))
    assert (taken == -1).all()
    assert len(tried) == 10 * len(CANDIDATES)


def test_candidates_larger_than_the_ball_are_not_tried():
    """A graph of two components of 150 points: 200 neighbours do not exist."""
    points = torch.cat([Sphere().points(150), Sphere().points(150) + 10])
    frames = Sphere().frames(points[:150]).repeat(2, 1, 1)
    graph = nearest_graph(points, frames, nearest_neighbors(points, 24))
    neighborhoods = GraphNeighborhoods(points, graph, frames)
    candidates = [Candidate(2, 200, "least_squares"), Candidate(2, 12, "least_squares")]
    taken, tried = found(neighborhoods, torch.arange(300), torch.zeros(300), candidates=candidates)
    assert (taken == 1).all()
    assert {number for number, _ in tried} == {1}
