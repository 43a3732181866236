"""Voronoi cells in the tangent plane: areas of lattices, and the finite-volume rows over them."""

import math

import pytest
import torch

from tolerances import TOLERANCE
from torchlb import LaplaceBeltrami
from torchlb.cloud.voronoi import cell_laplacian, cell_volume, largest_gap, natural_neighbors


def lattice(basis, half=3):
    """Neighbours of 0 in the lattice of the rows of `basis`, nearest first, (1, K, d)."""
    axis = torch.arange(-half, half + 1, dtype=torch.float64)
    index = torch.cartesian_prod(*[axis] * len(basis)).view(-1, len(basis))
    nodes = index @ torch.tensor(basis, dtype=torch.float64)
    order = nodes.norm(dim=1).argsort(stable=True)
    return nodes[order][1:][None]


SQUARE = lattice([[1.0, 0], [0, 1]])
HEXAGONAL = lattice([[1.0, 0], [0.5, math.sqrt(3) / 2]])
LINE = lattice([[1.0]])
CUBIC = lattice([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]], half=2)


def all_of(coords):
    return torch.ones(coords.shape[:2], dtype=torch.bool)


def own_laplacian(coords, valid):
    return cell_laplacian(coords, valid, cell_volume(coords, valid))


def scattered(batch=20, size=40):
    """Uniform points around 0, so many that the cell is closed."""
    return torch.rand(batch, size, 2, dtype=torch.float64) * 2 - 1


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize(
    ("coords", "volume", "accuracy"),
    [
        (SQUARE, 1.0, 1e-3),
        (HEXAGONAL, math.sqrt(3) / 2, 1e-3),
        (LINE, 1.0, 1e-14),
        (CUBIC, 1.0, 2e-2),
    ],
    ids=["square", "hexagonal", "line", "cubic"],
)
def test_volume_of_a_lattice_cell(coords, volume, accuracy, scale):
    """1 for the square and the cubic lattice and the line, √3/2 for the hexagonal one, times s^d."""
    found = cell_volume(scale * coords, all_of(coords)) / scale ** coords.shape[-1]
    assert abs(found.item() / volume - 1) <= accuracy


def test_cells_of_the_plane_tile_it():
    """Mean area of the cells of a periodic cloud of 200 points in the unit square: 1/200."""
    points = torch.rand(200, 2, dtype=torch.float64)
    offset = (points[None] - points[:, None] + 0.5) % 1 - 0.5
    nearest = offset.norm(dim=-1).argsort(1)[:, 1:60]
    coords = offset.take_along_dim(nearest[..., None], dim=1)
    total = cell_volume(coords, all_of(coords)).sum()
    assert abs(total.item() - 1) < 5e-3


def test_boundary_points_have_half_a_cell():
    """On a straight boundary with outward conormal e₁ the inner half of the unit cell remains."""
    inside = SQUARE[:, SQUARE[0, :, 0] <= 0]
    outward = torch.tensor([[1.0, 0.0]], dtype=torch.float64)
    assert abs(cell_volume(inside, all_of(inside), outward).item() - 0.5) < 0.01


def test_invalid_neighbours_do_not_count():
    coords = torch.cat([0.1 * torch.ones(1, 1, 2).double(), SQUARE], dim=1)
    valid = all_of(coords)
    valid[0, 0] = False
    torch.testing.assert_close(cell_volume(coords, valid), cell_volume(SQUARE, all_of(SQUARE)))
    weights = own_laplacian(coords, valid)
    assert weights[0, 0] == 0
    torch.testing.assert_close(weights[:, 1:], own_laplacian(SQUARE, all_of(SQUARE)))


@pytest.mark.parametrize(("coords", "count"), [(SQUARE, 4), (HEXAGONAL, 6), (LINE, 2), (CUBIC, 6)])
def test_natural_neighbours_of_a_lattice_are_the_nearest(coords, count):
    natural = natural_neighbors(coords, all_of(coords))[0]
    assert natural[:count].all()
    assert not natural[count:].any()


def test_lattices_have_their_classical_laplacians():
    """[1, 1, −4, 1, 1] / h² on squares, 2/3 (six neighbours) / h² on hexagons, [1, −2, 1] / h² on a line."""
    for coords, count, weight in ((SQUARE, 4, 1.0), (HEXAGONAL, 6, 2 / 3), (LINE, 2, 1.0)):
        weights = own_laplacian(coords, all_of(coords))[0]
        torch.testing.assert_close(
            weights[:count], torch.full((count,), weight).double(), rtol=1e-3, atol=0
        )
        assert (weights[count:] == 0).all()


def test_weights_of_a_scattered_cloud():
    """M-matrix: w ≥ 0; trace Σ w |y|² = 2d = 4; linear exactness Σ w y = 0, since the faces of a cell close."""
    coords = scattered()
    weights = own_laplacian(coords, all_of(coords))
    assert (weights >= 0).all()
    square = coords.square().sum(-1)
    trace = (weights * square).sum(1)
    # The area is a mean over directions, good to a few per cent in a thin cell; the faces are exact.
    torch.testing.assert_close(trace, torch.full_like(trace, 4.0), rtol=5e-2, atol=0)
    drift = (weights[..., None] * coords).sum(1).norm(dim=1)
    # A neighbour that shows less than 3° of the cell may be missed, which leaves the cell ajar.
    assert (drift / (weights * square.sqrt()).sum(1)).max() < 0.1
    assert drift.median() < 1e-10 * weights.max()


@pytest.mark.parametrize("coords", [LINE, CUBIC], ids=["line", "cubic"])
def test_trace_is_exact_in_other_dimensions(coords):
    """Σ w |y|² = 2d by the shares of the cell, which sum to one."""
    weights = own_laplacian(coords, all_of(coords))
    trace = (weights * coords.square().sum(-1)).sum()
    torch.testing.assert_close(trace.item(), 2.0 * coords.shape[-1], **TOLERANCE[torch.float64])


def test_a_point_without_a_closed_face_stays_joined():
    """Neighbours on one side only: some positive weight remains, and all are finite."""
    coords = torch.tensor([[[1.0, 0.0], [2.0, 0.0]]], dtype=torch.float64)
    weights = own_laplacian(coords, all_of(coords))
    assert weights.isfinite().all()
    assert (weights >= 0).all()
    assert weights.sum() > 0


def test_largest_gap_of_a_fan():
    """k even directions leave 2π/k open; those of an angle a leave 2π − a."""
    for k in (3, 4, 7):
        angle = 2 * math.pi * torch.arange(k, dtype=torch.float64) / k + 0.3
        fan = torch.stack([angle.cos(), angle.sin()], 1)[None]
        assert abs(largest_gap(fan, all_of(fan)).item() - 2 * math.pi / k) < 1e-12
        half = torch.stack([(angle / 2).cos(), (angle / 2).sin()], 1)[None]
        opened = 2 * math.pi - (k - 1) * math.pi / k
        assert abs(largest_gap(half, all_of(half)).item() - opened) < 1e-12


@pytest.mark.parametrize(("dim", "side", "excess"), [(2, 40, 0.05), (3, 11, 0.45)])
def test_an_open_cloud_ends_about_at_its_last_points(dim, side, excess):
    """A grid in R⁴, undeclared: 5 % too much of a square, 42 % of a cube, of whose 1,331 points 602 are on its rim."""
    grid = torch.cartesian_prod(*[torch.linspace(0, 1, side, dtype=torch.float64)] * dim)
    points = torch.nn.functional.pad(grid, (0, 4 - dim))
    lb = LaplaceBeltrami.from_points(points, dim=dim, certify=False)
    assert 0 < lb.mass.sum().item() - 1 < excess
