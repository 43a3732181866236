"""Every bad input is refused with what came, where, and what to do."""

import jaxtyping
import numpy as np
import pytest
import torch
import trimesh

import torchlb
from torchlb import LaplaceBeltrami, clean_mesh
from torchlb.surfaces import CliffordTorus, Sphere

POINTS = Sphere().points(100)
VERTICES, FACES = Sphere().mesh(100)


@pytest.fixture
def unchecked(monkeypatch):
    """Without the tests' own checks of types: as a user calls it."""
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)


def spoiled(index, value):
    points = POINTS.clone()
    points[index] = value
    return points


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (spoiled(17, float("nan")), "1 are NaN or infinite \\(17\\)"),
        (POINTS[0], "expected shape \\(N, n\\), got \\(3,\\)"),
        (torch.zeros(0, 3), "got none"),
        ("a file name", "expected an \\(N, n\\) tensor or array"),
        (POINTS > 0, "expected real numbers"),
        (spoiled(3, POINTS[5]), "such as 3, 5 .*remove duplicates"),
        (spoiled(3, POINTS[5] + 1e-14), "such as 3, 5 .*remove duplicates"),
        (POINTS * 1e160, "extend over .*rescale"),
        (POINTS * 1e-160, "extend over .*rescale"),
        (POINTS[:12], "12 points are fewer than the 15 .*lower `order` to 2"),
        (POINTS[:4], "4 points are fewer than the 15 .*add points"),
    ],
)
def test_bad_points(points, message):
    with pytest.raises(ValueError, match=message):
        LaplaceBeltrami.from_points(points)


@pytest.mark.parametrize(
    ("faces", "message"),
    [
        (FACES.double(), "expected integers"),
        (FACES[:, 0], "expected shape \\(F, 3\\)"),
        (FACES[:0], "got none; use LaplaceBeltrami.from_points"),
        (FACES + 1, "outside 0 … 99"),
        (FACES - 1, "outside 0 … 99"),
        (FACES[(FACES != 7).all(1)], "1 vertices \\(7\\) belong to no face.*clean_mesh"),
    ],
)
def test_bad_faces(faces, message):
    for build in (LaplaceBeltrami.from_mesh, LaplaceBeltrami.from_cotangent):
        with pytest.raises(ValueError, match=message):
            build(VERTICES, faces)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"projection": "orthogonal"}, "projection: expected one of"),
        ({"weights": "rbf"}, "weights: expected one of"),
        ({"order": 0}, "order: expected an integer ≥ 1"),
        ({"order": 2.5}, "order: expected an integer, got 2.5"),
        ({"order": "3"}, "order: expected an integer, got '3'"),
        ({"dim": 1.5}, "dim: expected an integer"),
        ({"normal_order": -1}, "normal_order"),
        ({"num_neighbors": 20.5}, "num_neighbors: expected an integer"),
        ({"num_neighbors": 101}, "num_neighbors: 101 are more than the 100 points"),
        ({"num_neighbors": 14}, "num_neighbors: order 3 in 2 dimensions has 15 polynomials"),
        ({"dim": 4}, "dim: expected 1 … 3"),
        ({"normals": POINTS[:50]}, "normals: expected the shape of points"),
        ({"normals": 0 * POINTS}, "normals: 100 are zero"),
    ],
)
def test_bad_options(options, message, unchecked):
    with pytest.raises(ValueError, match=message):
        LaplaceBeltrami.from_points(POINTS, **options)


def test_normals_are_for_hypersurfaces():
    points = CliffordTorus().points(100)
    with pytest.raises(ValueError, match="only hypersurfaces"):
        LaplaceBeltrami.from_points(points, dim=2, normals=points)


def test_cotangent_needs_triangles():
    with pytest.raises(ValueError, match="needs triangles"):
        LaplaceBeltrami.from_cotangent(VERTICES, FACES[:, :2])


def test_cotangent_needs_area():
    """A vertex in the middle of an edge, its only triangle flat: no area, or NaN."""
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 2, 0], [1, 1, 0]])
    with pytest.raises(ValueError, match=r"vertices \[3\] have no area"):
        LaplaceBeltrami.from_cotangent(vertices, torch.tensor([[0, 1, 2], [2, 1, 3]]))


def test_coincident_vertices_of_a_mesh_are_named():
    """Two triangles that share an edge only in place, as in an STL file."""
    cut = torch.cat([VERTICES, VERTICES[FACES[0]]])
    faces = FACES.clone()
    faces[0] = torch.arange(100, 103)
    with pytest.warns(UserWarning, match="6 share a place with another .*merge_vertices"):
        LaplaceBeltrami.from_mesh(cut, faces)


def test_a_wrong_dimension_is_suspected():
    with pytest.warns(UserWarning, match="manifold of dimension 3.*`dim`"):
        LaplaceBeltrami.from_points(CliffordTorus().points(200))


@pytest.mark.parametrize("dtype", [torch.bool, torch.int8, torch.int64, torch.float32])
def test_features_of_any_type_are_not_rounded(dtype, unchecked):
    lb = LaplaceBeltrami.from_points(POINTS)
    f = (3 * POINTS[:, 0]).to(dtype)
    torch.testing.assert_close(lb(f), lb(f.double()))


def test_arrays_are_no_features(unchecked):
    with pytest.raises(TypeError, match="as_tensor"):
        LaplaceBeltrami.from_points(POINTS)(POINTS.numpy())


@pytest.mark.parametrize("shape", [(99,), (99, 2), (2, 99, 2), (1, 1, 100, 2)])
def test_forward_refuses_wrong_sizes(shape):
    lb = LaplaceBeltrami.from_points(POINTS)
    with pytest.raises((ValueError, RuntimeError), match="N = 100"):
        lb(torch.zeros(shape).double())


def test_clean_mesh_is_the_remedy_that_the_error_names():
    faces = FACES[(FACES != 7).all(1)]
    vertices, faces, kept = clean_mesh(VERTICES, faces)
    assert len(vertices) == 99
    assert 7 not in kept.tolist()
    assert torch.equal(vertices, VERTICES[kept])
    assert LaplaceBeltrami.from_mesh(vertices, faces).num_points == 99


def test_numpy_arrays_and_int32_faces_are_welcome():
    lb = LaplaceBeltrami.from_mesh(VERTICES.numpy(), FACES.numpy().astype(np.int32))
    assert torch.equal(lb.values, LaplaceBeltrami.from_mesh(VERTICES, FACES).values)


def test_a_creased_mesh_falls_below_its_order_and_says_why():
    """A box has no tangent plane at its edges: every row is valid all the same, and the report names the reasons."""
    box = trimesh.creation.box().subdivide().subdivide().subdivide()
    lb = LaplaceBeltrami.from_mesh(np.array(box.vertices), np.array(box.faces), order=3)
    report = lb.report
    assert sum(report.order_counts.values()) == len(box.vertices)
    assert 0 < report.order_counts[3] < len(box.vertices)
    assert sum(report.reason_counts.values()) == int((report.order < 3).sum())
    assert "why below the requested order" in str(report)
    matrix = lb.matrix.to_dense()
    assert matrix.isfinite().all()
    assert (matrix.diagonal() < 0).all()
    assert lb.certificate.holds


def test_public_names():
    assert set(torchlb.__all__) <= set(dir(torchlb))
