"""The weak pair of curves and solids: elements, nodes and assembly of dimension 1 and 3 (`method.md`, section 15)."""

from itertools import permutations

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull, Delaunay

from torchlb import LaplaceBeltrami, heat_flow, implicit_step, poisson_solve
from torchlb.galerkin.assembly import Elements, area_element, flat_metric, metric
from torchlb.galerkin.elements import facet_nodes, lattice, simplex, subsets
from torchlb.galerkin.nodes import lagrange_nodes
from torchlb.geometry.boundary import folded_sides
from torchlb.surfaces import Sphere, ThreeSphere

PI = torch.pi


def trefoil(count):
    """Points of a trefoil knot at equal steps of its parameter, its segments and its length."""

    def at(t):
        x, y = np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t)
        return np.stack([x, y, -np.sin(3 * t)], 1)

    fine = at(2 * np.pi * np.arange(2**18) / 2**18)
    length = np.linalg.norm(np.roll(fine, -1, 0) - fine, axis=1).sum()
    number = np.arange(count)
    return at(2 * np.pi * number / count), np.stack([number, (number + 1) % count], 1), length


def cube(count):
    """Points of a grid of `count` a side, and six tetrahedra for each of its cubes (Kuhn)."""
    line = np.linspace(0, 1, count)
    points = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)
    first = np.arange(count**3).reshape(count, count, count)[:-1, :-1, :-1].ravel()
    steps = count**2, count, 1
    ways = [np.cumsum([0, *(steps[axis] for axis in way)]) for way in permutations(range(3))]
    return points, np.concatenate([first[:, None] + way for way in ways])


def shell(count, layers):
    """Tetrahedra between spheres of radius ½ and 1: prisms over triangles, three for each."""
    vertices, faces = Sphere().mesh(count)
    vertices, faces = vertices.numpy(), np.sort(faces.numpy(), 1)
    points = np.concatenate([vertices * r for r in np.linspace(0.5, 1, layers + 1)])
    cells = []
    for k in range(layers):
        (a, b, c), (d, e, f) = (faces + k * count).T, (faces + (k + 1) * count).T
        cells += [np.stack(t, 1) for t in ((a, b, c, f), (a, b, e, f), (a, d, e, f))]
    return points, np.concatenate(cells)


def worst(lb, exact):
    found = lb.eigenbasis(len(exact)).eigenvalues.numpy()
    first = int(exact[0] == 0)
    return (np.abs(found - exact)[first:] / np.asarray(exact)[first:]).max()


@pytest.mark.parametrize("dim", [0, 1, 2, 3])
@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_elements_are_cardinal_and_their_rules_exact(dim, degree):
    """φ_i(x_j) = δ_ij, Σφ_i = 1, Σ∇φ_i = 0; ∫ λ_0^p = p! / (p + d)! for p ≤ 2r + 1, λ_0 a barycentric."""
    shape = simplex(dim, degree)
    assert (shape.values.sum(1) - 1).abs().max() < 1e-12
    assert (shape.gradients.sum(1)).abs().sum() < 1e-9
    first = shape.values @ lattice(dim, degree)[:, 0]
    for power in range(2 * degree + 2):
        exact = torch.arange(power + 1, power + dim + 1).double().reciprocal().prod()
        torch.testing.assert_close(shape.weights @ first**power, exact, rtol=1e-11, atol=0.0)


def test_facets_share_their_nodes():
    """Of two tetrahedra at a triangle, the nodes of it are the same places, and numbered once."""
    points = torch.rand(5, 3, dtype=torch.float64)
    nodes = lagrange_nodes(torch.tensor([[3, 0, 2, 1], [1, 4, 3, 2]]), 5, 4)
    places = torch.cat([points, torch.einsum("xv,xvn->xn", nodes.shares, points[nodes.corners])])
    for cell, elements in zip(nodes.cells, nodes.elements, strict=True):
        torch.testing.assert_close(places[elements], lattice(3, 4) @ points[cell])
    assert len(places.unique(dim=0)) == len(places) == 5 + 9 * 3 + 7 * 3 + 2
    local = facet_nodes(3, 4)
    assert (lattice(3, 4)[local[0]][:, 3] == 0).all()
    assert torch.equal(lattice(3, 4)[local[0]][:, :3], lattice(2, 4))


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_linear_functions_have_their_energy_and_mass(dim):
    """xᵀKx = |∇x|² |T| and 1ᵀMx = |T| x̄ for linear functions x on a simplex T in R⁴."""
    corners = torch.rand(1, dim + 1, 4, dtype=torch.float64)
    shape, edges = simplex(dim, 2), corners[0, 1:] - corners[0, :1]
    places = (lattice(dim, 2) @ corners)[0]
    g = metric(places, torch.arange(len(places))[None], shape)
    ends = torch.tensor(subsets(dim, 2))
    lengths = (corners[:, ends[:, 1]] - corners[:, ends[:, 0]]).norm(dim=2)
    torch.testing.assert_close(flat_metric(lengths)[:, None].expand_as(g), g)
    size = (edges @ edges.T).det().sqrt()
    torch.testing.assert_close(area_element(g), size.expand_as(area_element(g)))
    block = (
        Elements(torch.arange(len(places))[None], g, shape).matrices().blocks.view(len(places), -1)
    )
    x = places[:, 0]
    slope = torch.linalg.lstsq(edges.T, torch.eye(4, dtype=torch.float64)[:, :1]).solution
    square = (edges.T @ slope).square().sum()
    torch.testing.assert_close(x @ block.real @ x, square * shape.weights.sum() * size)
    total = block.imag.sum(0) @ x
    torch.testing.assert_close(total, corners[0, :, 0].mean() * shape.weights.sum() * size)


@pytest.mark.parametrize(
    ("order", "rate", "finest"), [(1, 3.5, 3e-7), (3, 3.5, 1.5e-7), (5, 6.0, 2e-9)]
)
def test_eigenvalues_of_a_knot(order, rate, finest):
    """(2πj/L)², each twice; errors of order 2r at least."""
    errors, counts = [], [100, 150, 200, 400]
    for count in counts:
        points, segments, length = trefoil(count)
        exact = [(2 * np.pi * ((j + 1) // 2) / length) ** 2 for j in range(10)]
        errors.append(worst(LaplaceBeltrami.from_mesh(points, segments, order=order), exact))
    slope = np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert -slope > rate, errors
    assert errors[-1] < finest


def test_corners_and_crossings_of_curves():
    """Square outline: (2πj/4)², each twice. Three arms of length one: (π/2)² twice, π², 9(π/2)² twice."""
    side = np.linspace(0, 1, 20, endpoint=False)
    rest = np.zeros_like(side)
    outline = [(side, rest), (1 + rest, side), (1 - side, 1 + rest), (rest, 1 - side)]
    number = np.arange(80)
    points = np.concatenate([np.stack(part, 1) for part in outline])
    lb = LaplaceBeltrami.from_mesh(points, np.stack([number, (number + 1) % 80], 1))
    assert lb.mass.sum().item() == pytest.approx(4.0)
    assert worst(lb, [0, *((np.pi * j / 2) ** 2 for j in (1, 1, 2, 2))]) < 3e-3
    arm, turns = np.linspace(0, 1, 41), 2 * np.pi * np.arange(3) / 3
    points = np.concatenate([[[0, 0]], *(arm[1:, None] * [np.cos(a), np.sin(a)] for a in turns)])
    ends = [np.r_[0, np.arange(40 * k + 1, 40 * k + 41)] for k in range(3)]
    segments = np.concatenate([np.stack([e[:-1], e[1:]], 1) for e in ends])
    lb = LaplaceBeltrami.from_mesh(points, segments)
    quarter = np.array([0, 1, 1, 4, 9, 9]) * np.pi**2 / 4
    assert worst(lb, quarter) < 2e-3


@pytest.mark.parametrize("turn", [PI / 18, PI / 2])
def test_crossings_of_curves_are_of_high_order(turn):
    """Two lines that cross: (π/2)² three times, then π²; derivatives jump there, and no fit reaches over it."""
    errors, counts = [], [11, 21, 41]
    for count in counts:
        arm = np.linspace(0, 1, count)[1:]
        ways = [np.array([np.cos(a), np.sin(a)]) for a in (0, PI, turn, PI + turn)]
        points = np.concatenate([[[0.0, 0.0]], *(arm[:, None] * way for way in ways)])
        number = np.arange(1, len(points)).reshape(4, -1)
        ends = np.concatenate([np.zeros((4, 1), dtype=int), number], 1)
        lb = LaplaceBeltrami.from_mesh(
            points, np.stack([ends[:, :-1], ends[:, 1:]], 2).reshape(-1, 2)
        )
        assert lb.mass.sum().item() == pytest.approx(4.0, rel=1e-9)
        errors.append(worst(lb, [0, *[PI**2 / 4] * 3, PI**2]))
    assert errors[-1] < 5e-5
    assert -np.polyfit(np.log(counts), np.log(errors), 1)[0] > 2.5


def test_a_curved_wall_of_one_cell_is_no_worse_than_linear_elements():
    """Of a tube of radius 1, where they are off by 2 %: two layers of points nearly satisfy a quadratic."""
    around, along, wall = 48, 24, 0.1
    turn, height = np.meshgrid(2 * PI * np.arange(around) / around, np.linspace(0, 2, along))
    radius = np.stack([np.cos(turn), np.sin(turn)], -1).reshape(-1, 2)
    layers = [np.c_[r * radius, height.ravel()] for r in (1 - wall / 2, 1 + wall / 2)]
    row, column = np.divmod(np.arange((along - 1) * around), around)
    a, b = row * around + column, row * around + (column + 1) % around
    faces = np.sort(np.concatenate([np.c_[a, b, b + around], np.c_[a, b + around, a + around]]), 1)
    (a, b, c), (d, e, f) = faces.T, (faces + around * along).T
    cells = [np.stack(t, 1) for t in ((a, b, c, f), (a, b, e, f), (a, d, e, f))]
    lb = LaplaceBeltrami.from_mesh(np.concatenate(layers), np.concatenate(cells))
    values = lb.eigenbasis(12).eigenvalues
    exact = np.sort([k * k + (PI * j / 2) ** 2 for k in range(-4, 5) for j in range(5)])[:12]
    assert np.abs(values.numpy()[1:] / exact[1:] - 1).max() < 0.05


def test_an_interval_with_data_at_its_ends():
    """u = x³ solves −u'' = −6x with its values, or with the flux 3 at x = 1; e^{−4π²t} sin 2πx."""
    x = torch.linspace(0, 1, 61, dtype=torch.float64) ** 1.3
    segments = torch.stack([torch.arange(60), torch.arange(1, 61)], 1)
    lb = LaplaceBeltrami.from_mesh(x[:, None], segments, condition="dirichlet")
    u = poisson_solve(lb, -6 * x, boundary_values=x**3)
    torch.testing.assert_close(u, x**3, rtol=0.0, atol=1e-5)
    wave = (2 * PI * x).sin()
    torch.testing.assert_close(
        heat_flow(lb, wave, 0.02), np.exp(-0.08 * PI**2) * wave, rtol=0.0, atol=2e-5
    )
    mask = x == 0
    lb = LaplaceBeltrami.from_mesh(x[:, None], segments, condition="dirichlet", boundary=mask)
    u = poisson_solve(lb, -6 * x, boundary_values=0.0, flux=3 * x)
    torch.testing.assert_close(u, x**3, rtol=0.0, atol=1e-5)
    torch.testing.assert_close(lb.boundary_mass.to_dense().sum(), torch.tensor(2.0).double())


@pytest.mark.parametrize(("count", "bound"), [(8, 5e-3), (12, 4e-4)])
def test_eigenvalues_of_a_cube(count, bound):
    """π²(i² + j² + k²) with natural boundary; volume and surface are exact."""
    lb = LaplaceBeltrami.from_mesh(*cube(count))
    squares = [i * i + j * j + k * k for i in range(4) for j in range(4) for k in range(4)]
    assert worst(lb, np.pi**2 * np.sort(squares)[:12]) < bound
    assert lb.mass.sum().item() == pytest.approx(1.0, rel=1e-12)
    assert lb.boundary_mass.values().sum().item() == pytest.approx(6.0, rel=1e-12)


def test_a_cube_with_values_at_its_sides():
    """−Δu = 3π² Π sin πx_i with u = 0, (1 − tΔ)u of the same, and a harmonic function by its values."""
    points, cells = cube(9)
    x = torch.from_numpy(points)
    lb = LaplaceBeltrami.from_mesh(points, cells, condition="dirichlet")
    f = (PI * x).sin().prod(1)
    torch.testing.assert_close(poisson_solve(lb, 3 * PI**2 * f), f, rtol=0.0, atol=3e-3)
    step = implicit_step(lb, f, 0.1)
    torch.testing.assert_close(step, f / (1 + 0.3 * PI**2), rtol=0.0, atol=3e-3)
    harmonic = x[:, 0] * x[:, 1] - x[:, 2]
    u = poisson_solve(lb, 0 * f, boundary_values=harmonic)
    torch.testing.assert_close(u, harmonic, rtol=0.0, atol=1e-3)


def test_the_boundary_of_a_solid_is_curved():
    """A shell ½ < r < 1: volume 7π/6, surface 5π, λ_1 = 4π² with u = 0 at both spheres, xy by its values."""
    points, cells = shell(300, 4)
    lb = LaplaceBeltrami.from_mesh(points, cells, condition="dirichlet")
    assert lb.mass.sum().item() == pytest.approx(7 * np.pi / 6, rel=1e-3)
    assert lb.boundary_mass.values().sum().item() == pytest.approx(5 * np.pi, rel=1e-3)
    assert worst(lb, [4 * np.pi**2]) < 3e-3
    x = torch.from_numpy(points)
    harmonic = x[:, 0] * x[:, 1]
    u = poisson_solve(lb, 0 * harmonic, boundary_values=harmonic)
    torch.testing.assert_close(u, harmonic, rtol=0.0, atol=3e-4)


def test_eigenvalues_of_the_three_sphere():
    """l(l + 2), (l + 1)² times, of tetrahedra in R⁴."""
    points = ThreeSphere().points(800).numpy()
    lb = LaplaceBeltrami.from_mesh(points, ConvexHull(points).simplices)
    assert worst(lb, np.array([0, *[3] * 4, *[8] * 7])) < 5e-4


def test_tetrahedra_without_volume_count_for_nothing():
    """Delaunay tetrahedra of a grid have slivers of four points of a square; the cube stays one."""
    points, _ = cube(7)
    cells = Delaunay(points).simplices
    with pytest.warns(UserWarning, match="tetrahedra have no volume"):
        lb = LaplaceBeltrami.from_mesh(points, cells)
    assert lb.mass.sum().item() == pytest.approx(1.0, rel=1e-9)
    assert worst(lb, np.pi**2 * np.array([0, 1, 1, 1, 2, 2, 2, 3])) < 3e-2


def test_slivers_that_were_removed_are_missed():
    """Without those of a perturbed grid the solid has a boundary within, 15 instead of 6 in area; cubes have none."""
    points, own = cube(7)
    inner = ((points > 0) & (points < 1)) * np.random.default_rng(0).normal(size=points.shape)
    cells = Delaunay(points + 1e-4 * inner).simplices
    volume = np.abs(np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]]))
    assert len(folded_sides(torch.from_numpy(points), torch.from_numpy(own))) == 0
    with pytest.warns(UserWarning, match=r"lie on one another.*Keep the slivers"):
        lb = LaplaceBeltrami.from_mesh(points, cells[volume > 1e-9])
    assert lb.boundary_mass.values().sum().item() > 15
    with pytest.warns(UserWarning, match="have no volume"):
        lb = LaplaceBeltrami.from_mesh(points, cells)
    assert lb.boundary_mass.values().sum().item() == pytest.approx(6.0, rel=1e-6)


@pytest.mark.parametrize("shape", [lambda: trefoil(60)[:2], lambda: cube(5)])
def test_a_conductivity_of_one_is_none(shape):
    points, cells = shape()
    lb = LaplaceBeltrami.from_mesh(points, cells, condition="dirichlet")
    f = torch.from_numpy(points[:, 0])
    kappa = torch.ones(len(points), dtype=torch.float64)
    one = implicit_step(lb, f, 0.1, conductivity=kappa)
    torch.testing.assert_close(one, implicit_step(lb, f, 0.1), rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("unit", [2.0**-20, 2.0**20])
def test_eigenvalues_scale_with_the_unit(unit):
    """λ ~ 1/ℓ², for curves and solids, too; powers of two leave ties between neighbours as they are."""
    for points, cells in (trefoil(60)[:2], cube(5)):
        values = LaplaceBeltrami.from_mesh(points, cells).eigenbasis(6).eigenvalues
        scaled = LaplaceBeltrami.from_mesh(unit * points, cells).eigenbasis(6).eigenvalues
        torch.testing.assert_close(scaled * unit**2, values, rtol=1e-6, atol=1e-9)
