"""Tangent frames of order q, both projections, and orientation."""

from functools import cache

import numpy as np
import pytest
import torch
import trimesh

from tolerances import TOLERANCE
from torchlb import LaplaceBeltrami
from torchlb.cloud.frames import cloud_frames
from torchlb.cloud.voronoi import nearest_graph
from torchlb.geometry.fit_search import FitSearch
from torchlb.geometry.frames import (
    PROJECTIONS,
    complete_frames,
    local_offsets,
    mesh_frames,
    normals_of_frames,
    vertex_normals,
)
from torchlb.geometry.neighbors import GraphNeighborhoods, nearest_neighbors
from torchlb.surfaces import (
    CliffordTorus,
    Ellipsoid,
    SpaceCurve,
    Sphere,
    StarShaped,
    ThreeSphere,
    Torus,
    limit_surface,
)

MANIFOLDS = [Sphere(), Torus(), CliffordTorus(), ThreeSphere(), SpaceCurve()]
HYPERSURFACES = [Sphere(), Ellipsoid(), StarShaped(), Torus()]
points_of = cache(lambda surface, n: surface.points(n))


def each(cases):
    return pytest.mark.parametrize("surface", cases, ids=lambda case: type(case).__name__)


def close(actual, expected):
    torch.testing.assert_close(actual, expected, **TOLERANCE[torch.float64])


def initial_and_balls(surface, points):
    candidates = nearest_neighbors(points, 64 if surface.dim == 3 else 24)
    initial = cloud_frames(points, candidates, surface.dim)
    return initial, GraphNeighborhoods(points, nearest_graph(points, initial, candidates), initial)


def refined(surface, points, degree):
    _, neighborhoods = initial_and_balls(surface, points)
    search = FitSearch(neighborhoods, degree)
    search.refine(torch.arange(len(points)))
    plan, fits = search.finish()
    return fits.frames, plan.order


def tilt(frames, exact):
    """Sine of the largest angle between the planes at every point: ‖(I − E Eᵀ) exact‖₂."""
    return torch.linalg.matrix_norm(exact - frames @ (frames.mT @ exact), 2)


def slope_of(sizes, errors, dim=2):
    return -dim * np.polyfit(np.log(sizes), np.log(errors), 1)[0]


@each(MANIFOLDS)
def test_frames_are_orthonormal(surface):
    """EᵀE = I for initial, refined and exact frames in every dimension."""
    points = points_of(surface, 400)
    eye = torch.eye(surface.dim, dtype=torch.float64)
    frames, order = refined(surface, points, 3)
    for found in (initial_and_balls(surface, points)[0], frames):
        assert found.shape == (400, surface.ambient_dim, surface.dim)
        close(found.mT @ found, eye.expand(400, -1, -1))
    assert (order == 3).double().mean() > 0.95


@pytest.mark.parametrize("surface", [Sphere(), Ellipsoid()], ids=["sphere", "ellipsoid"])
@pytest.mark.parametrize(("q", "bound"), [(1, 4e-2), (2, 5e-3), (3, 1e-3), (4, 2e-4)])
def test_frames_have_order_q(surface, q, bound):
    """rms tilt = O(h^q): slope ≥ q − 0.3 over N = 500 … 4000, and a bound at the finest."""
    sizes, errors = [500, 1000, 2000, 4000], []
    for n in sizes:
        points = points_of(surface, n)
        frames, order = refined(surface, points, q)
        assert (order == q).double().mean() > 0.98
        errors.append(float(tilt(frames, surface.frames(points)).square().mean().sqrt()))
    assert slope_of(sizes, errors) >= q - 0.3
    assert errors[-1] <= bound


@pytest.mark.parametrize(
    ("surface", "factor"),
    [(CliffordTorus(), 5), (SpaceCurve(), 5), (ThreeSphere(), 2)],
    ids=lambda case: type(case).__name__,
)
def test_frames_in_other_codimensions_and_dimensions(surface, factor):
    """Degree 3 fits of 2000 points beat the initial frames: fivefold, on the coarser S³ (h = 0.2) twofold."""
    points = points_of(surface, 2000)
    exact = surface.frames(points)
    initial, _ = initial_and_balls(surface, points)
    frames, _ = refined(surface, points, 3)
    assert tilt(frames, exact).norm() < tilt(initial, exact).norm() / factor


@each([Sphere(), Torus()])
def test_frames_of_a_mesh_ignore_the_orientation_of_its_faces(surface):
    """Turning all triangles leaves the projectors E Eᵀ as they were; turning every other one leaves planes as near."""
    vertices, faces = surface.mesh(500)
    some = faces.clone()
    some[::2] = some[::2, [1, 0, 2]]
    one, all_, other = (mesh_frames(vertices, f) for f in (faces, faces[:, [1, 0, 2]], some))
    close(one @ one.mT, all_ @ all_.mT)
    for frames in (one, other):
        close(frames.mT @ frames, torch.eye(2, dtype=torch.float64).expand(500, -1, -1))
        assert tilt(frames, surface.frames(vertices)).max() < 0.3


@pytest.mark.parametrize("height", [1.0, 2.0, 8.0])
def test_frames_at_the_tip_of_a_cone_are_across_its_axis(height):
    """Of a pyramid and of a roof, whose faces may be farther from that plane than from others."""
    angle = 2 * torch.pi * torch.arange(12, dtype=torch.float64) / 12
    rim = torch.stack([angle.cos(), angle.sin(), 0 * angle], 1)
    points = torch.cat([rim, rim.new_tensor([[0.0, 0.0, height]])])
    number = torch.arange(12)
    faces = torch.stack([number, (number + 1) % 12, torch.full_like(number, 12)], 1)
    assert mesh_frames(points, faces)[12, 2].abs().max() < 1e-12
    for build in (LaplaceBeltrami.from_cotangent, LaplaceBeltrami.from_mesh):
        below = torch.cat([points, -points[12:]])
        both = torch.cat([faces, torch.where(faces == 12, 13, faces)[:, [1, 0, 2]]])
        assert build(below, both).normals[12, 2] > 1 - 1e-12
    roof = torch.tensor([[-1.0, 0.0], [0.0, height], [1.0, 0.0]], dtype=torch.float64)
    segments = torch.tensor([[0, 1], [1, 2]])
    assert mesh_frames(roof, segments)[1, 1].abs() < 1e-12


def test_unresolved_places_are_no_worse_than_linear_elements():
    """∇f and the normals of a limit surface that its mesh resolves in part, beside those of the cotangent operator."""
    control = trimesh.creation.icosphere(subdivisions=2)
    radius = np.random.default_rng(0).uniform(0.5, 1.5, (len(control.vertices), 1))
    corners = torch.from_numpy(control.vertices * radius)
    points, meshes = limit_surface(corners, torch.from_numpy(np.array(control.faces)), 4)
    faces = meshes[1]
    vertices = points[: int(faces.max()) + 1]
    exact = vertex_normals(points, meshes[4])[: len(vertices)]
    f, slope = vertices[:, 0].sin() * vertices[:, 1], torch.zeros_like(vertices)
    slope[:, 0], slope[:, 1] = vertices[:, 0].cos() * vertices[:, 1], vertices[:, 0].sin()
    slope -= (slope * exact).sum(1, keepdim=True) * exact
    off = []
    for build in (LaplaceBeltrami.from_mesh, LaplaceBeltrami.from_cotangent):
        lb = build(vertices, faces)
        off.append([(lb.gradient(f) - slope).norm(), (lb.normals - exact).norm()])
    (gradient, normal), (of_cotangent, its_normal) = off
    assert gradient < 1.1 * of_cotangent
    assert normal < 1.1 * its_normal


def test_frames_of_a_polyline_and_of_a_flat_mesh():
    """Segments of a circle give its tangents to first order; a flat mesh its plane exactly."""
    angle = 2 * torch.pi * torch.arange(100, dtype=torch.float64) / 100
    circle = torch.stack([angle.cos(), angle.sin()], 1)
    faces = torch.stack([torch.arange(100), (torch.arange(100) + 1) % 100], 1)
    tangent = torch.stack([-angle.sin(), angle.cos()], 1)[..., None]
    assert tilt(mesh_frames(circle, faces), tangent).max() < 1e-12  # symmetric: exact
    plane = torch.cat([torch.rand(4, 2).double(), torch.zeros(4, 1).double()], 1)
    frames = mesh_frames(plane, torch.tensor([[0, 1, 2], [1, 2, 3]]))
    assert frames[:, 2].abs().max() < 1e-14


@each(HYPERSURFACES)
def test_vertex_normals_point_outward(surface):
    vertices, faces = surface.mesh(1000)
    assert ((vertex_normals(vertices, faces) * surface.normals(vertices)).sum(1) > 0.8).all()


@pytest.mark.parametrize("n", [2, 3, 4])
def test_frames_of_normals_and_back(n):
    """[E, ν] is orthogonal and right-handed; `complete_frames` takes normals of any length."""
    normals = 3 * torch.randn(50, n, dtype=torch.float64)
    frames = complete_frames(normals)
    close((frames.mT @ normals[..., None])[..., 0], torch.zeros(50, n - 1).double())
    back = normals_of_frames(frames)
    basis = torch.cat([frames, back[..., None]], -1)
    close(basis.mT @ basis, torch.eye(n).double().expand(50, n, n))
    close(torch.linalg.det(basis), torch.ones(50).double())


@pytest.mark.parametrize("projection", PROJECTIONS)
@each([Sphere(), Torus(), CliffordTorus(), ThreeSphere(), SpaceCurve()])
def test_offsets_are_the_vectors_themselves_in_a_flat_space(surface, projection):
    """With one common frame for all points both projections are Eᵀe."""
    points = surface.points(60)
    frames = surface.frames(points)[:1].expand(60, -1, -1)
    index = nearest_neighbors(points, 8)
    found = local_offsets(points, frames, index, projection)
    close(found, (points[index[:, 1:]] - points[:, None]) @ frames[0])


@each(HYPERSURFACES)
def test_normal_projection_is_the_formula_of_the_note_with_a_minus(surface):
    """e − n_k (e·n_i)/(n_k·n_i), in the frame of i, whatever the signs of the two normals."""
    points = points_of(surface, 500)
    frames, normals = surface.frames(points), surface.normals(points)
    normals = normals * torch.randint(0, 2, (500, 1)).mul(2).sub(1)
    index = nearest_neighbors(points, 12)
    e, n_k, n_i = points[index[:, 1:]] - points[:, None], normals[index[:, 1:]], normals[:, None]
    ratio = (e * n_i).sum(-1, keepdim=True) / (n_k * n_i).sum(-1, keepdim=True)
    projected = e - n_k * ratio
    assert (projected * n_i).sum(-1).abs().max() < 1e-12
    found = local_offsets(points, frames, index, "normal")
    close(found, projected @ frames)


@each([Sphere(), Ellipsoid(), Torus(), SpaceCurve()])
def test_both_projections_agree_to_third_order(surface):
    """max |y_t − y_n| = O(h³): slope ≥ 2.7 over four sizes; at the nearest eight neighbours, with exact frames."""
    sizes, apart, spacing = [500, 1000, 2000, 4000], [], []
    for n in sizes:
        points = points_of(surface, n)
        index = nearest_neighbors(points, 9)[::10]
        frames = surface.frames(points)
        y_t, y_n = (local_offsets(points, frames, index, p) for p in PROJECTIONS)
        apart.append(float((y_t - y_n).norm(dim=-1).square().mean().sqrt()))
        spacing.append(float((points[index[:, 1:]] - points[index[:, :1]]).norm(dim=-1).mean()))
    assert slope_of(sizes, apart, surface.dim) >= 2.7
    assert apart[-1] <= 5 * spacing[-1] ** 3
