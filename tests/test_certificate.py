"""The certificate: π > 0 and S = ½(ΠL + LᵀΠ) ≤ 0, and what follows from it."""

import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from scipy import sparse

import torchlb
from torchlb import LaplaceBeltrami, StabilityError, StabilityWarning
from torchlb.certified.certificate import check_certificate, left_null_vector, shared_outflow
from torchlb.cloud.surface import cloud_surface
from torchlb.errors import warn
from torchlb.linalg.precision import ROOT_EPS
from torchlb.surfaces import Hemisphere, Sphere, StarShaped, ThreeSphere, Torus, smooth_function

certified_mesh = partial(LaplaceBeltrami.from_mesh, weak_form=False, certify=True)
certified_cloud = partial(LaplaceBeltrami.from_points, weak_form=False, certify=True)


def dense(lb):
    return lb.matrix.to_dense()


def largest_of_s(lb):
    """λ_max(S) of S scaled to a diagonal of one, so that coarse parts are seen beside fine ones, densely."""
    weighted = lb.mass[:, None] * dense(lb)
    root = weighted.diagonal().abs().sqrt()
    return float(torch.linalg.eigvalsh((weighted + weighted.T) / 2 / root / root[:, None]).max())


def backward_error(lb):
    """Componentwise backward error of π: largest entry of πᵀL over the sum of its terms."""
    return float(((lb.mass @ dense(lb)).abs() / (lb.mass @ dense(lb).abs())).max())


@pytest.mark.parametrize("order", [1, 3, 5])
@pytest.mark.parametrize("surface", [Sphere(), Torus()], ids=["sphere", "torus"])
@pytest.mark.parametrize("sampling", ["points", "random_points"])
def test_certificate_holds_as_dense_linear_algebra_sees_it(surface, sampling, order):
    lb = certified_cloud(getattr(surface, sampling)(700), order=order)
    assert lb.certificate.holds
    assert lb.mass.min() > 0
    assert backward_error(lb) < 1e-13
    assert largest_of_s(lb) <= 1e-11


def test_quasi_uniform_points_need_no_round():
    lb = certified_cloud(Torus().points(2000), order=3)
    assert lb.certificate.rounds <= 1
    assert lb.report.order_counts[3] >= 0.99 * 2000


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("surface", [Sphere(), StarShaped()], ids=["sphere", "star"])
def test_random_clouds_keep_their_order_and_accuracy(surface):
    """A single low-order row would make the error a hundred times as large."""
    points = surface.random_points(4000)
    lb = certified_cloud(points, order=3)
    raw = LaplaceBeltrami.from_points(points, order=3, weak_form=False)
    assert lb.certificate.holds
    assert lb.certificate.rounds > 0
    assert lb.report.order_counts[3] >= 0.995 * 4000
    exact = surface.laplacian(smooth_function, points)
    error, raw_error = ((op(smooth_function(points)) - exact).norm() for op in (lb, raw))
    assert error <= 1.5 * raw_error


def test_diffusion_contracts_and_conserves():
    """‖e^{tL}‖_π ≤ 1 and πᵀ e^{tL} u = πᵀ u, for t over six decades."""
    lb = certified_cloud(Torus().random_points(500), order=3)
    root = lb.mass.sqrt()
    f = smooth_function(lb.points)
    total = lb.mass @ f
    for t in 10.0 ** torch.arange(-4, 3):
        flow = torch.linalg.matrix_exp(t.double() * dense(lb))
        norm = torch.linalg.matrix_norm(root[:, None] * flow / root, 2)
        assert norm <= 1 + 1e-10
        assert abs(lb.mass @ (flow @ f) - total) <= 1e-12 * (lb.mass @ f.abs())


def test_mass_is_a_quadrature_rule_of_the_order_of_the_operator():
    """|Σ π f / Σ π − mean f| falls at order ≥ p − 0.5; here p = 3 on the sphere, mean of z² = 1/3."""
    sizes = [500, 1000, 2000, 4000]
    errors = []
    for n in sizes:
        lb = certified_cloud(Sphere().points(n), order=3)
        square = lb.points[:, 2] ** 2
        errors.append(abs(float(lb.mass @ square / lb.mass.sum()) - 1 / 3))
    slope = -2 * np.polyfit(np.log(sizes), np.log(np.array(errors) + 1e-15), 1)[0]
    assert slope >= 2.5
    assert errors[-1] < 1e-6


def test_total_mass_is_the_area():
    """Mesh: the sum of the triangles; cloud: second order."""
    surface = Sphere()
    vertices, faces = surface.mesh(1000)
    corners = vertices[faces]
    triangles = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    mesh = certified_mesh(vertices, faces).mass.sum()
    torch.testing.assert_close(mesh, triangles.norm(dim=1).sum() / 2)
    cloud = certified_cloud(vertices).mass.sum()
    assert abs(cloud / surface.area - 1) < 0.01


def test_three_dimensions():
    """S³ ⊂ R⁴: the certificate holds, and the mass sums to the volume 2π², as that of the pair does."""
    lb = LaplaceBeltrami.from_points(ThreeSphere().points(400), order=2, certify=True)
    assert lb.certificate.holds
    assert abs(lb.mass.sum() / (2 * math.pi**2) - 1) < 8.5e-3


def test_every_component_has_its_own_null_vector():
    """Two spheres of radius 1 and 2, apart: areas 4π and 16π, on each its own sum."""
    small = Sphere().points(500)
    points = torch.cat([small, 2 * Sphere().points(500, seed=1) + torch.tensor([5.0, 0, 0])])
    lb = certified_cloud(points, order=3)
    assert lb.certificate.components == 2
    assert lb.certificate.holds
    ratio = lb.mass[500:].sum() / lb.mass[:500].sum()
    assert abs(ratio - 4) < 0.05


@pytest.mark.parametrize("condition", ["neumann", "dirichlet"])
def test_parts_of_a_mesh_may_be_of_two_scales(condition):
    """A hemisphere beside a torus, as it is and smaller by 2²⁰: the same operator and mass, up to the scale."""
    (vertices, faces), (ring, corners) = Hemisphere().mesh(500), Torus().mesh(400)

    def build(factor):
        both = torch.cat([factor * vertices, ring + 9])
        return certified_mesh(both, torch.cat([faces, corners + 500]), condition=condition)

    unscaled, lb = build(1.0), build(2.0**-20)
    assert lb.certificate.holds
    square = torch.ones(900, dtype=torch.float64)
    square[:500] = 2.0**-40
    torch.testing.assert_close(lb.mass, square * unscaled.mass, rtol=1e-9, atol=0)
    torch.testing.assert_close(square[:, None] * dense(lb), dense(unscaled), rtol=1e-9, atol=1e-9)


def test_components_of_two_scales_are_judged_each_by_its_own():
    """A sphere of most of the points, as it is and smaller by powers of two: the same rounds, bit for bit.

    What the certificate lowers depends on the order in which points are stored. Three quarters of them, beside the rest
    along x alone, come apart at a median of the k-d tree, whatever their scale: the order is the same. The triangles
    are given, since those that a cloud gets depend on the sides of flat tetrahedra, which rounding decides.
    """
    sphere = Sphere().random_points(750)
    torus = Torus().random_points(250) + torch.tensor([9.0, 0.0, 0.0], dtype=torch.float64)

    faces = torch.cat([cloud_surface(sphere).cells, cloud_surface(torus).cells + 750])

    def build(factor):
        return certified_mesh(torch.cat([factor * sphere, torus]), faces, order=3)

    unscaled = build(1.0)
    for scale in (2.0**-10, 2.0**-20):
        lb = build(scale)
        assert lb.certificate.holds
        assert backward_error(lb) < 1e-13
        assert largest_of_s(lb) <= 1e-11
        assert lb.certificate.rounds == unscaled.certificate.rounds > 0
        assert torch.equal(lb.report.order, unscaled.report.order)
        small, rest = lb.mass.split([750, 250])
        torch.testing.assert_close(small / scale**2, unscaled.mass[:750], rtol=1e-12, atol=0)
        torch.testing.assert_close(rest, unscaled.mass[750:], rtol=1e-12, atol=0)


@pytest.mark.usefixtures("unchecked")
def test_a_surface_of_many_scales_is_stable_on_all_of_them():
    """Spacings down to 1e-7 at the pole of a sphere: S must be negative where they are 0.1, too."""
    generator = torch.Generator().manual_seed(1)
    radius = 0.3 * 10 ** (-6 * torch.rand(600, generator=generator).double())
    angle = 2 * math.pi * torch.rand(600, generator=generator).double()
    cap = torch.stack([radius * angle.cos(), radius * angle.sin(), (1 - radius**2).sqrt()], 1)
    lb = certified_cloud(torch.cat([Sphere().random_points(400), cap]), order=3)
    assert lb.certificate.holds
    assert backward_error(lb) < 1e-13
    assert largest_of_s(lb) <= 1e-11


@pytest.mark.parametrize(("gap", "pieces"), [(0.08, 1), (0.4, 2)], ids=["crumple", "apart"])
def test_a_piece_smaller_than_a_row_hangs_together_with_what_is_near(gap, pieces):
    """A strip of 20 points on end over a sphere: no tangent plane joins it to the sphere."""
    step = 0.02 * torch.arange(5.0, dtype=torch.float64)
    y, z = torch.meshgrid(step[:4], step, indexing="ij")
    strip = torch.stack([torch.zeros(20).double(), y.flatten(), 1 + gap + z.flatten()], 1)
    lb = certified_cloud(torch.cat([Sphere().points(800), strip]))
    assert lb.certificate.holds
    assert lb.certificate.components == pieces


def test_points_on_a_line_are_no_surface():
    """No triangle goes through them; as a curve they are fine."""
    line = torch.nn.functional.pad(torch.arange(100.0).double()[:, None], (0, 2))
    with pytest.raises(ValueError, match=r"all 100 lie on a line.*dim=1"):
        certified_cloud(line)
    assert certified_cloud(line, dim=1).certificate.holds


def test_left_null_vector_of_a_known_chain():
    """Birth and death with rates 1 up, 2 down on three states: π ∝ (4, 2, 1)."""
    matrix = sparse.csr_array(np.array([[-1.0, 1, 0], [2, -3, 1], [0, 2, -2]]))
    mass, _, error = left_null_vector(matrix, torch.ones(3, dtype=torch.float64), np.zeros(3))
    torch.testing.assert_close(mass, torch.tensor([4.0, 2, 1], dtype=torch.float64) * 3 / 7)
    assert error < 1e-15


def test_an_unstable_operator_is_told_from_a_stable_one():
    """The certificate refuses a null vector with a negative entry, and an indefinite S."""
    ones = torch.ones(3, dtype=torch.float64)
    negative = np.array([[-1.0, 0.5, 0.5], [0.5, -1, 0.5], [1.25, -1, -0.25]])
    mass, result, _ = check_certificate(sparse.csr_array(negative), ones)
    torch.testing.assert_close(mass, torch.tensor([2.0, -1, 2], dtype=torch.float64))
    assert not result.holds
    assert result.min_pi == pytest.approx(-1)
    assert math.isnan(result.max_s)
    skewed = np.array([[-1.0, 1, 0], [0, -1, 1], [1, 0, -1]]) + 5 * np.array(
        [[1.0, -2, 1], [-2, 4, -2], [1, -2, 1]]
    )
    _, indefinite, feed = check_certificate(sparse.csr_array(skewed), ones)
    assert not indefinite.holds
    assert indefinite.max_s > 0
    assert feed.shape[1] >= 1


def test_outflow_takes_the_place_of_the_null_vector():
    """L = −1 on one point, a pair (−2, 1; 1, −2) beside it: πᵀL = −q with q the outflow, of the sum of the areas."""
    matrix = sparse.csr_array(np.array([[-1.0, 0, 0], [0, -2, 1], [0, 1, -2]]))
    areas = torch.tensor([1.0, 2, 3], dtype=torch.float64)
    np.testing.assert_allclose(shared_outflow(matrix, areas), [1.0, 2.5, 2.5])
    mass, result, _ = check_certificate(matrix, areas, outflow=True)
    torch.testing.assert_close(mass, torch.tensor([1.0, 2.5, 2.5], dtype=torch.float64))
    assert result.holds


def test_what_has_no_null_vector_is_said():
    """Inverse iteration shifts the diagonal by √ε of itself: here onto the eigenvalue √ε."""
    near = 1 - ROOT_EPS
    matrix = sparse.csr_array(np.array([[1.0, near], [near, 1.0]]))
    with pytest.raises(StabilityError, match="singular beyond its constants"):
        left_null_vector(matrix, torch.ones(2, dtype=torch.float64), np.zeros(2))


@pytest.mark.parametrize("order", [1, 3])
def test_rows_that_only_widen_are_counted_apart(order):
    """Random points keep their order: what rounds change is the number of neighbours."""
    lb = certified_cloud(Sphere().random_points(700), order=order)
    assert lb.certificate.rounds > 0
    assert lb.certificate.lowered == int((lb.report.order < order).sum())
    assert lb.certificate.widened > lb.certificate.lowered
    assert "rows widened" in str(lb.certificate)


@pytest.mark.parametrize(("order", "bound"), [(3, 5e-4), (5, 5e-5)])
def test_meshes_of_random_vertices_keep_their_order_and_accuracy(order, bound):
    """Where the surface is resolved, uneven vertices take wider stencils, not the triangles' own row."""
    points = Sphere().random_points(2000)
    hull = trimesh.convex.convex_hull(points.numpy())
    vertices, faces = torch.as_tensor(hull.vertices), torch.as_tensor(hull.faces)
    assert len(vertices) == 2000
    lb = certified_mesh(vertices, faces, order=order)
    assert lb.certificate.holds
    assert lb.report.order_counts[order] >= 0.995 * 2000
    exact = Sphere().laplacian(smooth_function, vertices)
    error = (lb(smooth_function(vertices)) - exact).norm()
    assert error <= bound * exact.norm()


@pytest.mark.parametrize(("share", "bound"), [(0.01, 4.2e-4), (0.1, 4.2e-3)])
def test_noise_keeps_the_operator_stable_and_its_spectrum(share, bound):
    """Eigenvalues 1 to 15 of the unit sphere, those of the pair."""
    lb = LaplaceBeltrami.from_points(noisy_sphere(2000, share), certify=True)
    assert lb.certificate.holds
    exact = Sphere().eigenvalues(16)[1:]
    assert (lb.eigenbasis(16).eigenvalues[1:] / exact - 1).abs().max() <= bound


def test_wider_stencils_of_a_fixed_size_average_noise():
    """Nothing can widen them, so they are judged as the widest of the candidates: few fall; Δf gains."""
    points = noisy_sphere(2000, 0.1)
    f, exact = smooth_function(points), Sphere().laplacian(smooth_function, Sphere().points(2000))
    fixed = certified_cloud(points, num_neighbors=60)
    assert fixed.certificate.holds
    assert fixed.report.order_counts[3] >= 0.99 * 2000
    assert (fixed(f) - exact).norm() < 0.56 * (certified_cloud(points)(f) - exact).norm()


def noisy_sphere(count, share):
    """Noise in all directions, in units of the spacing."""
    noise = torch.randn(count, 3, generator=torch.Generator().manual_seed(0)).double()
    return Sphere().points(count) + share * math.sqrt(Sphere().area / count) * noise


@pytest.mark.filterwarnings("ignore:vertices")
def test_coincident_vertices_have_each_its_own_row():
    """Ten vertices of a sphere doubled, half of the triangles on either twin: each row is centred on itself."""
    vertices, faces = Sphere().mesh(1000)
    for vertex in range(0, 1000, 100):
        own = (faces == vertex).any(1).nonzero()[:, 0]
        half = own[: len(own) // 2]
        faces[half] = torch.where(faces[half] == vertex, len(vertices), faces[half])
        vertices = torch.cat([vertices, vertices[vertex : vertex + 1]])
    lb = LaplaceBeltrami.from_mesh(vertices, faces, condition=None, weak_form=False)
    diagonal = dense(lb).diagonal()
    assert diagonal.max() < 0.1 * diagonal.median()
    assert (lb.report.order == 3).all()
    error = lb(smooth_function(vertices)) - Sphere().laplacian(smooth_function, vertices)
    assert error.abs().max() < 5e-3
    assert certified_mesh(vertices, faces, condition=None).certificate.holds


def test_uncertified_operator_says_so():
    lb = LaplaceBeltrami.from_points(Sphere().points(300))
    assert lb.certificate is None
    assert "certify=False" in repr(lb)


def test_a_certificate_that_does_not_hold_is_a_warning_with_names(monkeypatch):
    monkeypatch.setattr("torchlb.certified.certificate.MOST_ROUNDS", 0)
    points = Sphere().random_points(500)
    message = r"does NOT hold.*where rounds end; the worst points: \d+, \d+"
    with pytest.warns(StabilityWarning, match=message):
        lb = certified_cloud(points)
    assert not lb.certificate.holds
    assert "NOT STABLE" in repr(lb)


def test_a_warning_names_the_line_that_called_torchlb():
    """However deep inside it arises: here two calls of a file in its folder."""
    inside = str(Path(torchlb.__file__).parent / "inside.py")
    names = {"warn": getattr(warn, "__wrapped__", warn)}  # less the checks of its types
    exec(compile("def deep(): warn('!')\ndef outer(): deep()", inside, "exec"), names)
    with pytest.warns(UserWarning, match="!") as caught:
        names["outer"]()
    assert caught[0].filename == __file__
