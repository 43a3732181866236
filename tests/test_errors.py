"""Bad input is refused with a message that says what was expected, what came, where, and what to do."""

import re

import pytest
import torch

from torchlb import LaplaceBeltrami, StencilError, clean_mesh
from torchlb.surfaces import CliffordTorus, Sphere

POINTS = Sphere().points(100)
VERTICES, FACES = Sphere().mesh(60)
from_points, from_mesh = LaplaceBeltrami.from_points, LaplaceBeltrami.from_mesh


def changed(tensor, index, value):
    tensor = tensor.clone()
    tensor[index] = value
    return tensor


def refuses(build, *parts):
    """A ValueError that holds every part."""
    with pytest.raises(ValueError, match=re.escape(parts[0])) as caught:
        build()
    for part in parts:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("points", "parts"),
    [
        (changed(POINTS, (17, 1), torch.nan), ("points: 1 are NaN or infinite (17)",)),
        (changed(POINTS, slice(3, 5), torch.inf), ("2 are NaN or infinite (3, 4)", "repair")),
        (changed(POINTS, slice(20), torch.nan), ("20 are NaN", "0, 1, 2, 3, 4, 5, 6, 7, …")),
        (POINTS[:, 0], ("points: expected shape (N, n), got (100,)",)),
        (POINTS[None], ("points: expected shape (N, n), got (1, 100, 3)",)),
        (POINTS[:0], ("points: got none (shape (0, 3))",)),
        (POINTS[:, :0], ("points: got none (shape (100, 0))",)),
        (POINTS.to(torch.complex64), ("points: expected real numbers, got torch.complex64",)),
        (POINTS > 0, ("points: expected real numbers, got torch.bool",)),
        ("sphere", ("points: expected an (N, n) tensor or array, got <class 'str'>",)),
        (None, ("points: expected an (N, n) tensor or array",)),
        (object(), ("points: expected an (N, n) tensor or array",)),
        ([[1.0, 2.0], [3.0]], ("points: expected an (N, n) tensor or array, got <class 'list'>",)),
    ],
)
def test_points(points, parts):
    refuses(lambda: from_points(points), *parts)


def test_duplicates_are_named():
    points = changed(POINTS, 41, POINTS[7])
    refuses(lambda: from_points(points), "2 points share a place", "7, 41", "remove duplicates")
    points = changed(points, 80, POINTS[9])
    refuses(lambda: from_points(points), "4 points share a place", "7, 41 (all: 7, 9, 41, 80)")


@pytest.mark.parametrize(
    ("count", "order", "parts"),
    [
        (9, 3, ("9 points are fewer than the 15", "lower `order` to 1")),
        (14, 3, ("14 points are fewer than the 15", "lower `order` to 2")),
        (5, 1, ("5 points are fewer than the 6", "add points")),
        (1, 3, ("1 points are fewer than the 15", "add points")),
    ],
)
def test_fewer_points_than_a_stencil(count, order, parts):
    refuses(lambda: from_points(POINTS[:count], order=order), *parts)


@pytest.mark.parametrize("build", [from_points, lambda x, **o: from_mesh(VERTICES, FACES, **o)])
@pytest.mark.parametrize(
    ("options", "parts"),
    [
        ({"order": 0}, ("order: expected an integer ≥ 1, got 0",)),
        ({"order": -2}, ("order: expected an integer ≥ 1, got -2",)),
        ({"normal_order": -1}, ("normal_order: expected an integer ≥ 1", "got -1")),
        ({"projection": "flat"}, ("projection: expected one of ['tangent', 'normal'], got 'flat'",)),
        ({"weights": "mls"}, ("weights: expected one of", "polyharmonic", "got 'mls'")),
        ({"weights": "positive"}, ("weights: expected one of", "got 'positive'")),
        ({"num_neighbors": 14}, ("num_neighbors: order 3 in 2", "15 polynomials", "24", "got 14")),
    ],
)
def test_options(build, options, parts):
    refuses(lambda: build(POINTS, **options), *parts)


@pytest.mark.parametrize("dim", [0, -1, 4])
def test_dim_out_of_range(dim):
    refuses(lambda: from_points(POINTS, dim=dim), f"dim: expected 1 … 3 for points in R^3, got {dim}")


@pytest.mark.parametrize(
    ("normals", "parts"),
    [
        (POINTS[:50], ("normals: expected the shape of points (100, 3), got (50, 3)",)),
        (changed(POINTS, 5, 0), ("normals: 1 are zero (5)", "leave `normals` out")),
        (changed(POINTS, 5, torch.nan), ("normals: 1 are NaN or infinite (5)",)),
        ("up", ("normals: expected an (N, n) tensor or array",)),
    ],
)
def test_normals(normals, parts):
    refuses(lambda: from_points(POINTS, normals=normals), *parts)


def test_normals_need_a_hypersurface():
    points = CliffordTorus().points(50)
    refuses(
        lambda: from_points(points, dim=2, order=1, normals=points),
        "normals: only hypersurfaces have them, not dim=2 in R^4",
    )


@pytest.mark.parametrize("build", [from_mesh, LaplaceBeltrami.from_cotangent])
@pytest.mark.parametrize(
    ("faces", "parts"),
    [
        (FACES.double(), ("faces: expected integers, got torch.float64",)),
        (FACES > 3, ("faces: expected integers, got torch.bool",)),
        (FACES[0], ("faces: expected shape (F, 3)", "got (3,)")),
        (FACES.repeat(1, 2), ("faces: expected shape (F, 3)", "(F, 4) tetrahedra), got (116, 6)")),
        (FACES[:0], ("faces: got none; use LaplaceBeltrami.from_points",)),
        (changed(FACES, (4, 1), 60), ("faces: 1 of them (4)", "outside 0 … 59", "face 4 is")),
        (changed(FACES, (4, 1), -1), ("faces: 1 of them (4)", "outside 0 … 59")),
        ("faces", ("faces",)),
        (None, ("faces",)),
    ],
)
def test_faces(build, faces, parts):
    refuses(lambda: build(VERTICES, faces), *parts)


def test_bad_vertices_are_called_so():
    refuses(lambda: from_mesh(VERTICES[0], FACES), "vertices: expected shape (N, n), got (3,)")
    bad = changed(VERTICES, (9, 0), torch.nan)
    refuses(lambda: from_mesh(bad, FACES), "vertices: 1 are NaN or infinite (9)")


def test_unreferenced_vertices_and_the_remedy_that_the_message_offers():
    """Of 62 vertices 0 and 61 are in no face, one face repeats a corner; `clean_mesh` drops them and it works."""
    far = torch.full((1, 3), 9.0, dtype=torch.float64)
    vertices = torch.cat([far, VERTICES, far + 1])
    faces = torch.cat([FACES + 1, torch.tensor([[61, 61, 1]])])
    refuses(lambda: from_mesh(vertices, faces), "2 vertices (0, 61)", "torchlb.clean_mesh")
    cleaned, renumbered, kept = clean_mesh(vertices, faces)
    assert torch.equal(cleaned, VERTICES)
    assert torch.equal(renumbered, FACES)
    assert torch.equal(kept, torch.arange(1, 61))
    expected = from_mesh(VERTICES, FACES)
    torch.testing.assert_close(from_mesh(cleaned, renumbered).values, expected.values)


def test_faces_that_repeat_a_corner_are_left_out():
    faces = torch.cat([FACES, torch.tensor([[5, 5, 9], [7, 7, 7]])])
    expected = from_mesh(VERTICES, FACES)
    assert torch.equal(from_mesh(VERTICES, faces).values, expected.values)


def test_the_cotangent_operator_needs_triangles_and_area():
    index = torch.arange(60)
    segments = torch.stack([index, (index + 1) % 60], 1)
    refuses(lambda: LaplaceBeltrami.from_cotangent(VERTICES, segments), "needs triangles")
    flat = torch.cat([VERTICES, VERTICES[:1], VERTICES[:1] * 1.0])
    faces = torch.cat([FACES, torch.tensor([[0, 60, 61]])])
    refuses(lambda: LaplaceBeltrami.from_cotangent(flat, faces), "[60, 61] have no area", "from_mesh")


def test_a_point_on_its_own_is_an_error_or_a_valid_row():
    """Never silent: a finite row that sums to zero, or a StencilError that names the point."""
    points = torch.cat([POINTS, torch.full((1, 3), 50.0, dtype=torch.float64)])
    try:
        lb = from_points(points, certify=False)
    except StencilError as error:
        assert "100" in str(error)
    else:
        row = lb.matrix.to_dense()[100]
        assert row.isfinite().all()
        assert abs(row.sum()) <= 1e-12 * row.abs().max()
        assert lb.report.order[100] == 0


@pytest.mark.parametrize("shape", [(99,), (99, 2), (100, 99, 2), (1, 1, 100, 2), (100, 2, 3)])
def test_features_of_another_size(shape):
    lb = from_points(POINTS, order=1)
    with pytest.raises((RuntimeError, ValueError), match="expected f of shape"):
        lb(torch.zeros(shape))


@pytest.mark.parametrize("shape", [(100,), (99, 3), (100, 2), (2, 100, 3)])
def test_fields_of_another_size(shape):
    lb = from_points(POINTS, order=1)
    with pytest.raises((RuntimeError, ValueError), match="expected a field of shape"):
        lb.divergence(torch.zeros(shape))
