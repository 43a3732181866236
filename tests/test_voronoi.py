"""Voronoi cells in the tangent plane: areas and neighbours of lattices."""

import math

import pytest
import torch

from torchlb import LaplaceBeltrami
from torchlb.cloud.voronoi import cell_volume, natural_neighbors


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


def test_invalid_neighbours_do_not_count():
    coords = torch.cat([0.1 * torch.ones(1, 1, 2).double(), SQUARE], dim=1)
    valid = all_of(coords)
    valid[0, 0] = False
    torch.testing.assert_close(cell_volume(coords, valid), cell_volume(SQUARE, all_of(SQUARE)))
    assert not natural_neighbors(coords, valid)[0, 0]


@pytest.mark.parametrize(("coords", "count"), [(SQUARE, 4), (HEXAGONAL, 6), (LINE, 2), (CUBIC, 6)])
def test_natural_neighbours_of_a_lattice_are_the_nearest(coords, count):
    natural = natural_neighbors(coords, all_of(coords))[0]
    assert natural[:count].all()
    assert not natural[count:].any()


@pytest.mark.parametrize(("dim", "side"), [(2, 40), (3, 7)])
def test_an_open_cloud_ends_at_its_last_points(dim, side):
    """A grid in R⁴, undeclared: the area of a square and the volume of a cube, to rounding."""
    grid = torch.cartesian_prod(*[torch.linspace(0, 1, side, dtype=torch.float64)] * dim)
    points = torch.nn.functional.pad(grid, (0, 4 - dim))
    lb = LaplaceBeltrami.from_points(points, dim=dim)
    assert lb.mass.sum().item() == pytest.approx(1, rel=1e-12)
