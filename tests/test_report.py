"""The report counts every point, and says why a point is below the order that was asked for."""

from functools import cache

import pytest
import torch
import trimesh

from torchlb import LaplaceBeltrami
from torchlb.fits.rules import reference
from torchlb.stencils.assemble import Stencils, assemble
from torchlb.stencils.options import Options
from torchlb.stencils.rows import Reason
from torchlb.stencils.shape import mesh_shape
from torchlb.surfaces import Sphere, Torus


@cache
def cube():
    """The unit cube with 386 vertices and its sharp edges, and the operator at order 3."""
    mesh = trimesh.creation.box()
    for _ in range(3):
        mesh = mesh.subdivide()
    vertices, faces = torch.tensor(mesh.vertices), torch.tensor(mesh.faces)
    options = {"order": 3, "weak_form": False, "certify": True}
    lb = LaplaceBeltrami.from_mesh(vertices.double(), faces.long(), **options)
    return vertices.double(), lb


@cache
def sphere():
    return LaplaceBeltrami.from_points(Sphere().points(500), order=3)


def edges_near(vertices):
    """How many of the three coordinates are within 0.01 of the rim: 1 in a face, 2 on an edge, 3 at a corner."""
    return ((vertices.abs() - 0.5).abs() < 0.01).sum(1)


def test_counts_add_up():
    for lb in (sphere(), cube()[1]):
        report = lb.report
        assert sum(report.order_counts.values()) == lb.num_points
        assert list(report.order_counts) == [3, 2, 1, 0]
        below = int((report.order < 3).sum())
        assert sum(report.reason_counts.values()) == below
        assert set(report.reason_counts) <= {reason.text for reason in Reason if reason}
        assert torch.equal(report.reason > 0, report.order < 3)


def test_a_smooth_cloud_reaches_the_order_everywhere():
    report = sphere().report
    assert report.order_counts == {3: 500, 2: 0, 1: 0, 0: 0}
    assert report.reason_counts == {}
    assert (report.normal_order == 4).all()


def test_numbers_are_those_of_the_matrix():
    """Entries of each row, Σ_{j≠i}|w| / |w_ii|, and ρ² Σ|w| with ρ in the tangent plane."""
    lb = sphere()
    matrix, report = lb.matrix.to_dense(), lb.report
    assert torch.equal(report.num_neighbors, lb.stencil.crow.diff())
    center = matrix.diagonal().abs()
    total = matrix.abs().sum(1)
    torch.testing.assert_close(report.off_diagonal_ratio, (total - center) / center)
    offset = torch.einsum("ijn,ind->ijd", lb.points - lb.points[:, None], lb.frames)
    radius = (offset.norm(dim=-1) * (matrix != 0)).amax(1)
    torch.testing.assert_close(report.growth, radius**2 * total)
    assert (report.growth <= 3 * reference(2, 4).growth).all()
    assert (report.condition >= 1).all()


def test_the_summary_has_the_counts_and_reports_compare():
    """Numbers of the same report; two reports are compared by identity, and shown as they are printed."""
    report = cube()[1].report
    numbers = report.summary
    assert numbers["points"] == len(report.order)
    assert numbers["at_requested_order"] == report.order_counts[3]
    assert numbers["low_order"] == report.order_counts[0]
    assert numbers["max_growth"] == report.growth[report.order > 0].max()
    assert numbers["reference_growth"] == reference(2, 4).growth
    assert report == report
    assert report != cube()[1].report
    assert repr(report) == str(report)


def test_half_the_rows_at_low_order_are_named():
    """For a cloud with the wrong dimension as for a mesh of noise: the share, the reason, the remedy."""
    with pytest.warns(
        UserWarning, match=r"% of the points have only low-order rows.*pass its dimension"
    ):
        LaplaceBeltrami.from_points(torch.randn(300, 3).double(), order=3)
    vertices, faces = Sphere().mesh(300)
    noisy = vertices + 0.05 * torch.randn_like(vertices)
    with pytest.warns(UserWarning, match=r"% of the points have only low-order rows.*finer mesh"):
        LaplaceBeltrami.from_mesh(noisy, faces, order=3)


def test_it_prints_a_summary():
    text = str(cube()[1].report)
    assert text.startswith("386 points, order 3 requested")
    assert "why below the requested order" in text
    for name in ("num_neighbors", "growth", "condition", "off_diagonal_ratio"):
        assert name in text
    for reason, count in cube()[1].report.reason_counts.items():
        assert reason in text
        assert str(count) in text
    assert len(text.splitlines()) < 25
    assert "why below" not in str(sphere().report)


@pytest.mark.parametrize("build", ["cotangent", "empty"])
def test_operators_without_stencils_have_a_report_too(build):
    if build == "empty":
        assert str(LaplaceBeltrami().report).startswith("0 points")
    else:
        report = LaplaceBeltrami.from_cotangent(*Torus().mesh(200)).report
        assert report.order_counts == {0: 200}
        assert "low order" in str(report)


def test_a_crease_falls_below_the_order_and_says_why():
    """On edges and corners of the cube nothing of order 3 exists; in the middle of the faces it does."""
    vertices, lb = cube()
    near = edges_near(vertices)
    assert (lb.report.order[near >= 2] < 3).all()
    middle = vertices.abs().sort(dim=1).values[:, 1] < 0.2
    assert (lb.report.order[middle] == 3).double().mean() > 0.5
    assert (lb.report.reason[near >= 2] > 0).all()


@cache
def rippled():
    """A sphere of 1,500 vertices with ripples of 5 spacings from crest to crest, steep as 35°."""
    vertices, faces = Sphere().mesh(1500)
    return vertices * (1 + 0.05 * (15 * vertices).sin().prod(1, keepdim=True)), faces


def test_unresolved_ripples_are_reported():
    """Most points ask for more than order 3 can follow, whatever stencils would pass otherwise."""
    report = LaplaceBeltrami.from_mesh(*rippled(), order=3).report
    assert report.reason_counts["points do not resolve the surface"] > 1200
    cloud = LaplaceBeltrami.from_points(rippled()[0], order=3).report
    assert cloud.reason_counts["points do not resolve the surface"] > 100


def test_eigenvalues_of_an_unresolved_mesh_are_those_of_its_triangles():
    """Within 1 % of robust_laplacian's on the mesh refined by midpoints; smooth fits alone are 3 % above."""
    vertices, faces = rippled()
    lb = LaplaceBeltrami.from_mesh(vertices, faces, order=3)
    finer, smaller = trimesh.remesh.subdivide(vertices.numpy(), faces.numpy())
    exact = LaplaceBeltrami.from_cotangent(torch.tensor(finer), torch.tensor(smaller))
    found, expected = (each.eigenbasis(10).eigenvalues[1:] for each in (lb, exact))
    assert (found / expected - 1).abs().max() < 0.01


def test_every_row_of_a_creased_mesh_is_valid():
    """Finite, Σ_j w_ij = 0, w_ii < 0, and stable as a whole."""
    _, lb = cube()
    matrix = lb.matrix.to_dense()
    assert matrix.isfinite().all()
    assert (matrix.sum(1).abs() <= 1e-12 * matrix.abs().amax(1)).all()
    assert (matrix.diagonal() < 0).all()
    assert lb.stencil.values[1:].isfinite().all()
    assert lb.certificate.holds
    assert (lb.mass > 0).all()
    torch.testing.assert_close(lb.mass.sum().item(), 6.0)


def test_low_order_rows_are_m_matrix_rows():
    """At order 0: off-diagonal entries ≥ 0, to the tolerance of the flips to Delaunay, and off-diagonal ratio 1."""
    _, lb = cube()
    rows = lb.report.order == 0
    if not rows.any():
        pytest.skip("no point of the cube fell back")
    matrix = lb.matrix.to_dense()
    off = matrix - matrix.diagonal().diag()
    assert (off[rows] >= -1e-6 * matrix.diagonal().abs().max()).all()
    torch.testing.assert_close(
        lb.report.off_diagonal_ratio[rows], torch.ones(int(rows.sum())).double()
    )


def test_fewer_points_than_polynomials_have_low_order_rows():
    """A tetrahedron at order 3: M-matrix rows, and the reason is that neighbours are too few."""
    signs = [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]
    points = torch.tensor(signs, dtype=torch.float64)
    faces = torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    rows = assemble(Stencils(mesh_shape(points, faces, Options(3)), Options(3)))
    assert rows.order.tolist() == [0] * 4
    assert rows.reason.tolist() == [Reason.FEW] * 4
    torch.testing.assert_close(rows.off_diagonal_ratio, torch.ones(4).double())
