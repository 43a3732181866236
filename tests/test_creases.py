"""Where points stand steeply over the frame, or in one place: gradients of coordinates, and meshes that build."""

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from torchlb import LaplaceBeltrami
from torchlb.fits.rules import WEIGHT_RULES
from torchlb.fits.weights import least_squares_weights
from torchlb.geometry.thresholds import SLIGHT
from torchlb.linalg.precision import NEGLIGIBLE
from torchlb.stencils.rows import to_tangent_vectors

LONGEST = (1 + 2 * SLIGHT) ** 0.5  # of JJᵀ no entry is further from 1 where rows stay as they are
QUIET = pytest.mark.filterwarnings("ignore::UserWarning")


def roof(slope, n=21):
    """Two squares that meet in a ridge."""
    u, v = np.meshgrid(np.linspace(-1, 1, n), np.linspace(0, 2, n), indexing="ij")
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (x.ravel() for x in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    return np.stack([u, v, -slope * abs(u)], -1).reshape(-1, 3) @ turn, faces


def spikes():
    """A ball of random triangles, some of whose vertices are five times as far out."""
    random = np.random.default_rng(1)
    vertices = random.normal(size=(300, 3))
    vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
    faces = ConvexHull(vertices).simplices
    vertices[:15] *= 5
    return vertices, faces


def soup():
    """Triangles of random points, of which many share an edge."""
    random = np.random.default_rng(2)
    faces = np.array([random.choice(60, 3, replace=False) for _ in range(150)])
    used, faces = np.unique(faces, return_inverse=True)
    return random.normal(size=(len(used), 3)), faces.reshape(-1, 3)


def pole(count):
    """A flat cone whose tip is one vertex for each of its triangles."""
    angle = 2 * np.pi * np.arange(count) / count
    rim = np.stack([np.cos(angle), np.sin(angle), np.full(count, -0.2)], 1)
    i = np.arange(count)
    faces = np.stack([i, count + i, count + (i + 1) % count], 1)
    return np.concatenate([np.zeros((count, 3)), rim]), faces


def longest_gradient(lb):
    """max |∇x_c| over the points, and over all directions c of space."""
    return torch.linalg.matrix_norm(lb.local_gradient(lb.points), 2).max()


@QUIET
@pytest.mark.parametrize(
    ("shape", "options"),
    [
        (roof(1.5), {}),
        (roof(2.2), {}),
        (roof(2.2), {"projection": "normal"}),
        (spikes(), {}),
        (spikes(), {"order": 1, "condition": None}),
        (soup(), {}),
        (pole(24), {}),
    ],
)
def test_the_gradient_of_a_coordinate_is_hardly_longer_than_one(shape, options):
    """|∇x_c| = |EEᵀe_c| ≤ 1 on any surface, so in creases, on spikes and where nothing is smooth."""
    assert longest_gradient(LaplaceBeltrami.from_mesh(*shape, **options)) <= LONGEST


@QUIET
def test_so_it_is_of_the_cotangent_and_of_a_cloud():
    """The same on clouds and for the rows of given matrices."""
    vertices, faces = spikes()
    assert longest_gradient(LaplaceBeltrami.from_cotangent(vertices, faces)) <= LONGEST
    assert longest_gradient(LaplaceBeltrami.from_points(roof(2.2)[0])) <= LONGEST


def test_derivatives_over_a_tilted_frame_make_the_gradient():
    """x(y) = Xy, f = c·x: f_y = Xᵀc, and Eᵀ∇f = EᵀX(XᵀX)⁻¹Xᵀc, for coordinates straight down and others."""
    torch.manual_seed(0)
    tangents = torch.randn(5, 3, 2, dtype=torch.float64)
    frames = torch.linalg.qr(torch.randn(5, 3, 2, dtype=torch.float64))[0]
    direction = torch.randn(5, 3, 1, dtype=torch.float64)
    basis = torch.linalg.qr(tangents)[0]
    exact = frames.mT @ basis @ basis.mT @ direction
    found = to_tangent_vectors(tangents.mT, frames) @ (tangents.mT @ direction)
    torch.testing.assert_close(found, exact)


@QUIET
@pytest.mark.parametrize("weights", ["least_squares", "polyharmonic"])
@pytest.mark.parametrize(("count", "order"), [(24, 1), (24, 5), (100, 1), (100, 4)])
def test_a_pole_of_one_vertex_a_triangle_builds(count, order, weights):
    """All neighbours of a tip may lie where it lies: no stencil is made of them, and no error of torch."""
    lb = LaplaceBeltrami.from_mesh(*pole(count), order=order, weights=weights)
    assert lb.stencil.values[0].isfinite().all()
    assert longest_gradient(lb) <= LONGEST


def test_data_do_not_hide_that_neighbours_lie_in_one_place():
    """Coordinates 0 with conormals: nothing is known across, and the residual says so."""
    coords = torch.zeros(1, 12, 2, dtype=torch.float64)
    angle = torch.arange(13, dtype=torch.float64)
    flux = torch.stack([angle.cos(), angle.sin()], 1)[None]
    assert not least_squares_weights(coords, 2, flux=flux).residual.item() <= NEGLIGIBLE


def test_splines_through_coincident_points_are_refused():
    """Weights of nodes that are the same but for rounding may have any size and cancel: the residual tells."""
    torch.manual_seed(0)
    coords = torch.randn(500, 30, 2, dtype=torch.float64)
    coords[:, -1] = coords[:, 0] * (1 + 3e-16)
    weights = WEIGHT_RULES["polyharmonic"](coords, 4)
    growth = weights.radius * weights.gradient.abs().sum(1).amax(1)
    assert growth[weights.residual <= NEGLIGIBLE].max() < 1e10
    assert growth.nan_to_num().max() > 1e14
