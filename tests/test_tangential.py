"""Stars of tangent planes, made one complex: surfaces in R⁴ and beyond, and solids in R⁴."""

import math
from functools import cache

import numpy as np
import pytest
import torch

from torchlb import InputError, LaplaceBeltrami, heat_flow, implicit_step, poisson_solve
from torchlb.cloud.reconstruction import reconstruct
from torchlb.cloud.tangential import voronoi_shares
from torchlb.geometry.complex import edges_of
from torchlb.linalg.csr import tensors_of
from torchlb.surfaces import CliffordTorus, ThreeSphere

SHAPES = {
    "clifford": lambda: CliffordTorus().random_points(500),
    "clifford, fine": lambda: CliffordTorus().random_points(2000),
    "sphere, random": lambda: ThreeSphere().random_points(800),
    "sphere": lambda: ThreeSphere().points(800),
}
SURFACES = {"clifford": CliffordTorus(), "sphere": ThreeSphere()}


@cache
def built(name):
    points = SHAPES[name]()
    return LaplaceBeltrami.from_points(points, dim=2 if "clifford" in name else 3)


@pytest.mark.parametrize(
    ("name", "count", "bound"),
    [
        ("clifford", 25, 7e-3),
        ("clifford, fine", 25, 4e-4),
        ("sphere, random", 14, 1e-2),
        ("sphere", 14, 1.4e-3),
    ],
)
def test_eigenvalues(name, count, bound):
    """λ_1 to λ_24 of Clifford's torus, to λ_13 of S³: 3 four times, 8 nine times."""
    exact = SURFACES[name.split(",")[0]].eigenvalues(count)[1:]
    found = built(name).eigenbasis(count).eigenvalues[1:]
    assert (found / exact - 1).abs().max() < bound


@pytest.mark.parametrize("name", ["clifford", "clifford, fine"])
def test_triangles_of_a_torus_make_a_torus(name):
    """Every edge has two triangles, every point is in some, and χ = 0."""
    points = SHAPES[name]()
    faces = reconstruct(points, dim=2).cells.numpy()
    edges = edges_of(faces, len(points))
    assert (edges.uses == 2).all()
    assert len(np.unique(faces)) == len(points)
    assert len(points) - len(edges.keys) + len(faces) == 0


@pytest.mark.parametrize("ambient", [2, 3, 4, 7])
@pytest.mark.parametrize("dim", [2, 3])
def test_shares_of_the_corners_of_a_simplex_sum_to_one(dim, ambient):
    """With signs, where a circumcentre is outside; in any Rⁿ."""
    if ambient < dim:
        pytest.skip("no such simplex")
    corners = np.random.default_rng(0).standard_normal((40, dim + 1, ambient))
    shares = [voronoi_shares(np.roll(corners, k, axis=1)) for k in range(dim + 1)]
    np.testing.assert_allclose(np.sum(shares, 0), 1, atol=1e-9)
    assert ambient > dim or (np.array(shares) < 0).any()


def test_shares_are_those_of_voronoi_cells():
    """A third at the corners of an equilateral triangle, a fourth of a regular tetrahedron, none without area."""
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, math.sqrt(3) / 2, 0]])
    tetrahedron = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    for corners in (triangle, tetrahedron):
        assert voronoi_shares(corners[None])[0] == pytest.approx(1 / len(corners))
    assert voronoi_shares(np.array([[[0.0, 0], [1, 0], [2, 0]]])) == 0


@pytest.mark.parametrize(("name", "bound"), [("sphere", 2e-4), ("sphere, random", 7e-3)])
def test_the_volume_of_the_sphere(name, bound):
    """2π², though cells overlap, since each counts by its shares; all shares are between 0 and 1."""
    shares = reconstruct(SHAPES[name](), dim=3).shares
    assert ((shares > 0) & (shares <= 1)).all()
    assert (shares < 1).any()
    volume = float(built(name).mass.sum())
    assert volume == pytest.approx(2 * math.pi**2, rel=bound)
    assert (built(name).mass > 0).all()


@pytest.mark.parametrize(
    ("points", "dim"),
    [
        (CliffordTorus().random_points(300), 2),
        (ThreeSphere().random_points(300), 3),
    ],
    ids=["clifford", "sphere"],
)
def test_a_far_point_is_refused_by_name(points, dim):
    points = points.clone()
    points[17] = 9.0
    with pytest.raises(InputError, match=rf"no cell of dimension {dim} reaches 1 of 300 \(17\)"):
        LaplaceBeltrami.from_points(points, dim=dim)


@pytest.mark.parametrize("name", SURFACES)
def test_at_its_own_points_the_operator_is_itself(name):
    lb = built(name)
    again = lb.at(lb.points)
    for buffer in ("stencil.values", "mass", "weak.values", "frames"):
        one, other = tensors_of(lb)[buffer], tensors_of(again)[buffer]
        assert (other - one).abs().max() <= 1e-12 * one.abs().max(), buffer
    assert torch.equal(again.faces, lb.faces)


@pytest.mark.parametrize("name", SURFACES)
def test_solves_and_heat(name):
    """A coordinate is an eigenfunction: of 2 on Clifford's torus, of 3 on S³."""
    lb, t = built(name), 0.2
    value = float(SURFACES[name].eigenvalues(2)[1])
    z = lb.points[:, 2]
    z = z - lb.mass_matrix.to_dense().sum(0) @ z / lb.mass.sum()
    for found, exact in (
        (poisson_solve(lb, z), z / value),
        (implicit_step(lb, z, t), z / (1 + value * t)),
        (heat_flow(lb, z, t), math.exp(-value * t) * z),
        (heat_flow(lb, z, t, method="spectral", k=24), math.exp(-value * t) * z),
    ):
        assert (found - exact).norm() < 1.5e-3 * exact.norm()


@pytest.mark.parametrize("scale", [2.0**-50, 2.0**50])
def test_cells_do_not_depend_on_the_unit(scale):
    for name, dim in (("clifford", 2), ("sphere", 3)):
        points = SHAPES[name]()
        one, other = (reconstruct(s * points, dim=dim) for s in (1.0, scale))
        assert torch.equal(one.cells, other.cells)
        assert dim == 2 or torch.allclose(one.shares, other.shares, rtol=0, atol=1e-9)
