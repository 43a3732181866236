"""Neighbourhoods: natural neighbours, graphs, and neighborhoods that stay on their own sheet."""

import itertools
import math

import numpy as np
import pytest
import torch
from scipy.sparse import csgraph

from torchlb.cloud.frames import cloud_frames
from torchlb.cloud.voronoi import nearest_graph
from torchlb.geometry.compatibility import compatible
from torchlb.geometry.frames import mesh_frames
from torchlb.geometry.neighbors import GraphNeighborhoods, mesh_graph, nearest_neighbors
from torchlb.surfaces import Ellipsoid, Sphere, Torus


def flat(points):
    """Points of the plane in R³, with their common frame."""
    points = torch.nn.functional.pad(points, (0, 3 - points.shape[1]))
    frame = torch.eye(3, dtype=torch.float64)[:, :2]
    return points, frame.expand(len(points), 3, 2).contiguous()


def square_grid(size):
    axis = torch.arange(size, dtype=torch.float64)
    return torch.cartesian_prod(axis, axis)


def cloud_balls(points, dim=2):
    """What a cloud is given: graph and neighborhoods on initial frames."""
    candidates = nearest_neighbors(points, 24)
    frames = cloud_frames(points, candidates, dim)
    graph = nearest_graph(points, frames, candidates)
    return GraphNeighborhoods(points, graph, frames)


def real_pairs(index, count):
    """(centre's row, point) of all that is not padding."""
    real = torch.arange(index.shape[1]) < count[:, None]
    return real.nonzero()[:, 0], index[real]


@pytest.mark.parametrize("dim", [1, 2, 3, 4])
def test_nearest_neighbors_are_those_of_all_distances(dim):
    points = torch.rand(80, dim, dtype=torch.float64)
    index = nearest_neighbors(points, 9)
    assert torch.equal(index, torch.cdist(points, points).argsort(1)[:, :9])
    assert torch.equal(index[:, 0], torch.arange(80))


def test_admission_by_angle_and_by_height():
    """Planes 59° apart are admitted and 61° are not; a height of 0.49 of the distance is and 0.51 is not."""

    def verdict(angle, height):
        tilted = [[math.cos(angle), 0], [0, 1], [math.sin(angle), 0]]
        frames = torch.tensor([[[1.0, 0], [0, 1], [0, 0]], tilted], dtype=torch.float64)
        place = [0.0, math.sqrt(1 - height**2), height]
        points = torch.tensor([[0.0, 0, 0], place], dtype=torch.float64)
        return compatible(points, frames, torch.tensor([0]), torch.tensor([1])).item()

    degree = math.pi / 180
    assert verdict(0.0, 0.0)
    assert verdict(59 * degree, 0.0)
    assert not verdict(61 * degree, 0.0)
    assert verdict(119 * degree, 0.0) is False
    assert verdict(180 * degree, 0.0)  # the other orientation of the same plane
    assert verdict(0.0, 0.49)
    assert not verdict(0.0, 0.51)
    assert not verdict(0.0, -0.51)


def test_admission_does_not_depend_on_the_choice_of_frames():
    """E → E Q with Q orthogonal spans the same plane; in dimensions 1, 2 and 3 of R⁴."""
    for dim in (1, 2, 3):
        points = torch.randn(60, 4, dtype=torch.float64)
        points[:, dim:] *= 0.3
        frames = torch.linalg.qr(torch.eye(4)[:, :dim] + 0.3 * torch.randn(60, 4, dim).double())[0]
        turn = torch.linalg.qr(torch.randn(60, dim, dim, dtype=torch.float64))[0]
        centers, others = torch.triu_indices(60, 60, 1)
        expected = compatible(points, frames, centers, others)
        assert torch.equal(compatible(points, frames @ turn, centers, others), expected)
        assert 0 < expected.sum() < len(expected)


def test_mesh_graph_has_the_edges_of_the_faces():
    """Of triangles, segments and tetrahedra; symmetric, 0/1, without loops."""
    vertices, faces = Torus().mesh(300)
    graph = mesh_graph(faces, len(vertices))
    edges = {pair for face in faces.tolist() for pair in itertools.permutations(face, 2)}
    assert {(int(i), int(j)) for i, j in zip(*graph.nonzero(), strict=True)} == edges
    assert set(graph.data.tolist()) == {1.0}
    assert mesh_graph(torch.tensor([[0, 1], [1, 2]]), 4).nnz == 4
    assert mesh_graph(torch.tensor([[0, 1, 2, 3]]), 4).nnz == 12


def test_graph_of_a_grid_has_its_eight_neighbours():
    """2^{d+1} = 8 nearest and the natural ones: away from the rim, whose points reach inward, the king's moves."""
    points, frames = flat(square_grid(9))
    graph = nearest_graph(points, frames, nearest_neighbors(points, 24)).toarray()
    offset = (points[:, None] - points).abs().amax(-1)
    inside = ((points[:, :2] - 4).abs() < 2).all(1).numpy()
    expected = ((offset > 0) & (offset <= 1)).numpy()
    assert (graph[inside].astype(bool) == expected[inside]).all()
    assert (graph == graph.T).all()
    assert (graph.diagonal() == 0).all()


def test_graph_of_a_line_joins_the_two_nearest_on_each_side():
    """2^{d+1} = 4 for curves."""
    t = torch.arange(20, dtype=torch.float64)
    points = torch.stack([t, 0 * t], 1)
    frames = torch.tensor([[[1.0], [0.0]]], dtype=torch.float64).expand(20, 2, 1)
    graph = nearest_graph(points, frames, nearest_neighbors(points, 12)).toarray()
    apart = (t[:, None] - t).abs().numpy()
    inside = slice(5, 15)
    assert (graph[inside].astype(bool) == ((apart > 0) & (apart <= 2))[inside]).all()


def test_natural_neighbours_bridge_a_void():
    """A dense cluster beside its only distant neighbours: the eight nearest alone would not reach them."""
    cluster = 0.1 * square_grid(4)
    far = torch.tensor([[0.72, 0.15], [-0.4, 0.2], [0.15, 0.7], [0.2, -0.4]], dtype=torch.float64)
    points, frames = flat(torch.cat([cluster, far]))
    graph = nearest_graph(points, frames, nearest_neighbors(points, 20))
    assert csgraph.connected_components(graph)[0] == 1


@pytest.mark.parametrize(
    "surface", [Sphere(), Torus(), Ellipsoid()], ids=["sphere", "torus", "ellipsoid"]
)
@pytest.mark.parametrize("sampling", ["points", "random_points"])
def test_graph_of_a_cloud_is_connected_and_symmetric(surface, sampling):
    graph = cloud_balls(getattr(surface, sampling)(1000)).graph
    assert csgraph.connected_components(graph)[0] == 1
    assert abs(graph - graph.T).nnz == 0


@pytest.mark.parametrize("kind", ["cloud", "mesh"])
def test_balls_of_a_well_sampled_sphere_are_nearest_neighbours(kind):
    """K = 24 of 2000 points: the same sets nearly everywhere, in the same order."""
    points, faces = Sphere().mesh(2000)
    frames = mesh_frames(points, faces)
    neighborhoods = GraphNeighborhoods(points, mesh_graph(faces, 2000), frames)
    neighborhoods = cloud_balls(points) if kind == "cloud" else neighborhoods
    index, count = neighborhoods(torch.arange(2000), 24)
    assert (count == 24).all()
    assert (index == nearest_neighbors(points, 24)).all(1).double().mean() > 0.99


def test_balls_start_at_the_centre_and_ascend_without_repetition():
    points = Torus().random_points(800)
    centers = torch.randperm(800)[:100]
    index, count = cloud_balls(points)(centers, 40)
    assert torch.equal(index[:, 0], centers)
    distance = (points[index] - points[centers, None]).norm(dim=-1)
    for row, number in enumerate(count.tolist()):
        assert len(set(index[row, :number].tolist())) == number
        assert (distance[row, :number].diff() >= 0).all()


def test_a_point_comes_before_those_that_coincide_with_it():
    points, faces = Sphere().mesh(300)
    around = faces[(faces < 20).any(1)]
    graph = mesh_graph(torch.cat([faces, torch.where(around < 20, around + 300, around)]), 320)
    frames = mesh_frames(points, faces)
    points, frames = torch.cat([points, points[:20]]), torch.cat([frames, frames[:20]])
    index, _ = GraphNeighborhoods(points, graph, frames)(torch.arange(320), 20)
    assert torch.equal(index[:, 0], torch.arange(320))
    nearest = nearest_neighbors(points, 9)
    assert torch.equal(nearest[:, 0], torch.arange(320))
    assert all(len(set(row)) == 9 for row in nearest.tolist())
    crowd = nearest_neighbors(torch.zeros(6, 2), 4)
    assert torch.equal(crowd[:, 0], torch.arange(6))
    assert all(len(set(row)) == 4 for row in crowd.tolist())


def test_everything_in_a_ball_is_compatible():
    points = Ellipsoid((1.0, 1.0, 0.1)).points(800)
    neighborhoods = cloud_balls(points)
    index, count = neighborhoods(torch.arange(800), 30)
    row, others = real_pairs(index, count)
    apart = others != row
    assert compatible(points, neighborhoods.frames, row[apart], others[apart]).all()


def test_short_rows_are_padded_by_their_centre():
    """Components of 12 points among 40 asked for, 3 × 4 squares each."""
    points, frames = flat(torch.cat([square_grid(4)[:12], square_grid(4)[:12] + 100]))
    distance = torch.cdist(points, points)
    i, j = (distance < 1.01 * distance[distance > 0].min()).nonzero(as_tuple=True)
    graph = mesh_graph(torch.stack([i, j], 1), 24)
    index, count = GraphNeighborhoods(points, graph, frames)(torch.tensor([0, 5, 20]), 40)
    assert index.shape == (3, 40)
    assert count.tolist() == [12, 12, 12]
    assert (index[:, 12:] == torch.tensor([[0], [5], [20]])).all()
    assert {int(j) for j in index[2]} == set(range(12, 24))


def test_an_isolated_point_is_alone():
    points, frames = flat(square_grid(2))
    index, count = GraphNeighborhoods(points, mesh_graph(torch.tensor([[0, 1]]), 4), frames)(
        torch.tensor([3]), 5
    )
    assert count.tolist() == [1]
    assert (index == 3).all()


@pytest.mark.parametrize("size", [6, 24, 60])
def test_no_ball_crosses_between_parallel_sheets(size):
    """Two sheets 2h apart, n = 900 each, h = 1/√n: the plain ball of 24 mixes them, k-hop ones do not."""
    n = 900
    step = torch.tensor([0.7548776662466927, 0.5698402909980532], dtype=torch.float64)
    sheet = (0.5 + torch.arange(n, dtype=torch.float64)[:, None] * step) % 1
    other = (sheet + 0.37) % 1
    height = torch.tensor([0.0, 2 / math.sqrt(n)]).double().repeat_interleave(n)
    points = torch.cat([torch.cat([sheet, other]), height[:, None]], 1)
    neighborhoods = cloud_balls(points)
    index, count = neighborhoods(torch.arange(2 * n), size)
    row, others = real_pairs(index, count)
    assert torch.equal(row < n, others < n)
    plain = nearest_neighbors(points, 24)
    assert ((plain < n) != (plain[:, :1] < n)).any(1).double().mean() > 0.5


def test_balls_do_not_depend_on_the_chunk():
    points = Sphere().random_points(300)
    neighborhoods = cloud_balls(points)
    index, count = neighborhoods(torch.arange(300), 20)
    one = [neighborhoods(torch.tensor([c]), 20) for c in range(0, 300, 30)]
    assert torch.equal(torch.cat([i for i, _ in one]), index[::30])
    assert torch.equal(torch.cat([c for _, c in one]), count[::30])
    assert np.isfinite(index.numpy()).all()
