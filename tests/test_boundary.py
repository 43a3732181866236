"""Boundaries: their points and conormals, and the Neumann condition as data of the stencil."""

import itertools
import math
from functools import cache, partial

import numpy as np
import pytest
import torch
from scipy.sparse.linalg import eigs

from torchlb import LaplaceBeltrami
from torchlb.cloud import reconstruct
from torchlb.geometry.boundary import boundary_of_mesh
from torchlb.geometry.frames import mesh_frames
from torchlb.stencils.low_order import MeshLowOrder
from torchlb.surfaces import Hemisphere, Sphere, Torus, UnitDisk

certified_mesh = partial(LaplaceBeltrami.from_mesh, weak_form=False, certify=True)
certified_cloud = partial(LaplaceBeltrami.from_points, weak_form=False, certify=True)


def spectrum(lb, count):
    """The smallest eigenvalues of −Δ and the spectral abscissa of Δ, densely."""
    values = torch.linalg.eigvals(lb.matrix.to_dense())
    return (-values.real).sort().values[:count], float(values.real.max())


def smallest(lb, count):
    """The smallest eigenvalues of −Δ, by shift and invert from the right of the spectrum."""
    found = eigs(lb.to_scipy().tocsc(), count, sigma=0.5, return_eigenvectors=False)
    return torch.from_numpy(np.sort(-found.real))


def operators(surface, n, order):
    vertices, faces = surface.mesh(n)
    mask = surface.boundary_mask(vertices)
    yield certified_mesh(vertices, faces, order=order)
    yield certified_cloud(vertices, dim=2, order=order, boundary=mask)


@pytest.mark.parametrize("surface", [UnitDisk(), Hemisphere()], ids=["disk", "hemisphere"])
@pytest.mark.parametrize(
    ("order", "bound"), [(1, 3e-2), (2, 5e-2), (3, 2e-3), (4, 2e-3), (5, 1e-4)]
)
def test_neumann_spectrum(surface, order, bound):
    """First 10 eigenvalues against the exact ones at N = 700, and the certificate."""
    exact = surface.eigenvalues(10)
    for lb in operators(surface, 700, order):
        values, abscissa = spectrum(lb, 10)
        assert ((values - exact).abs()[1:] / exact[1:]).max() <= bound
        assert abscissa <= 1e-10 * lb.stencil.values[0].abs().max()
        assert lb.certificate.holds


@pytest.mark.parametrize("surface", [UnitDisk(), Hemisphere()], ids=["disk", "hemisphere"])
@pytest.mark.parametrize("condition", ["neumann", "dirichlet"])
@pytest.mark.parametrize("order", [1, 2, 3, 5])
def test_spectrum_converges_at_the_order(surface, condition, order):
    """Slope of the worst of the first 10 eigenvalues ≥ p − 0.5 over N = 350, 700, 1400 (the zero is exact)."""
    sizes, errors = [350, 700, 1400], []
    for n in sizes:
        lb = certified_mesh(*surface.mesh(n), order=order, condition=condition)
        exact = surface.eigenvalues(10, condition=condition)
        values = smallest(lb, 10)
        errors.append(float(((values - exact).abs()[1:] / exact[1:]).max()))
    slope = -2 * np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    assert slope >= order - 0.5


@pytest.mark.parametrize("surface", [UnitDisk(), Hemisphere()], ids=["disk", "hemisphere"])
@pytest.mark.parametrize(
    ("order", "bound"), [(1, 3e-2), (2, 5e-2), (3, 2e-3), (4, 2.5e-3), (5, 3e-4)]
)
def test_dirichlet_spectrum(surface, order, bound):
    """First 10 eigenvalues against squared Bessel zeros (disk) and l(l + 1) (hemisphere) at N = 700, mesh and cloud."""
    vertices, faces = surface.mesh(700)
    mask = surface.boundary_mask(vertices)
    exact = surface.eigenvalues(10, condition="dirichlet")
    for lb in (
        certified_mesh(vertices, faces, order=order, condition="dirichlet"),
        certified_cloud(vertices, dim=2, order=order, boundary=mask, condition="dirichlet"),
    ):
        values, abscissa = spectrum(lb, 10)
        assert ((values - exact).abs() / exact).max() <= bound
        assert abscissa < 0
        assert lb.certificate.holds
        assert lb.certificate.components == 1


def test_dirichlet_rows():
    """Values on the boundary reach no other point and decay by themselves; xy(1 − r²) has the right Laplacian."""
    vertices, faces = UnitDisk().mesh(1000)
    mask = UnitDisk().boundary_mask(vertices)
    lb = certified_mesh(vertices, faces, order=3, condition="dirichlet")
    matrix = lb.matrix.to_dense()
    assert (matrix[~mask][:, mask] == 0).all()
    assert torch.equal(matrix[mask], torch.diag(matrix.diagonal())[mask])
    assert matrix.diagonal()[mask].max() < matrix.diagonal()[~mask].mean()
    x, y = vertices[:, 0], vertices[:, 1]
    error = (lb(x * y * (1 - x**2 - y**2)) + 12 * x * y)[~mask]
    assert error.norm() < 1e-8 * (12 * x * y).norm()  # a polynomial of degree 4 is exact at p = 3


def test_a_close_pair_on_a_dirichlet_boundary_is_not_stiff():
    """Two rim points of a cloud 1e-9 apart: −4d/h² of that would hide all else from time steps and the certificate."""
    points = UnitDisk().points(300)
    mask = UnitDisk().boundary_mask(points)
    rim = points[mask][0]
    twin = rim + 1e-9 * torch.stack([-rim[1], rim[0], rim[2]])
    points, mask = torch.cat([points, twin[None]]), torch.cat([mask, torch.tensor([True])])
    lb = certified_cloud(points, dim=2, boundary=mask, condition="dirichlet")
    assert lb.certificate.holds
    own = lb.matrix.to_dense().diagonal().abs()
    assert own[mask].max() < 300 * own[~mask].max()


@pytest.mark.filterwarnings("ignore:vertices")
def test_the_sides_of_a_slit_may_coincide():
    """A square mesh whose seam was not merged halfway across: twins on the boundary, at the same place."""
    step = torch.linspace(0, 1, 17, dtype=torch.float64)
    x, y = (v.flatten() for v in torch.meshgrid(step, step, indexing="ij"))
    vertices = torch.stack([x, y, torch.zeros(289)], 1)
    corner = torch.arange(289).reshape(17, 17)
    a, b, c, d = (
        v.flatten() for v in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:])
    )
    faces = torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)])
    seam = ((y == 0.5) & (x < 0.5)).nonzero()[:, 0]
    upper = torch.arange(289).scatter(0, seam, 289 + torch.arange(len(seam)))
    above = (y[faces] >= 0.5).all(1)
    faces[above] = upper[faces[above]]
    lb = LaplaceBeltrami.from_mesh(
        torch.cat([vertices, vertices[seam]]), faces, condition="dirichlet"
    )
    assert lb.stencil.values[0].isfinite().all()


def test_heat_leaves_through_a_dirichlet_boundary_only():
    """The norm of π contracts strictly; a closed component beside it keeps its heat to rounding."""
    vertices, faces = UnitDisk().mesh(300)
    ball, shell = Sphere().mesh(300)
    both = torch.cat([vertices, ball + 5])
    lb = certified_mesh(both, torch.cat([faces, shell + 300]), condition="dirichlet")
    assert lb.certificate.holds
    assert lb.certificate.components == 2
    rate = lb.mass @ lb.matrix.to_dense()
    assert rate[300:].abs().max() < 1e-12 * (lb.mass @ lb.matrix.to_dense().abs()).max()
    assert rate[:300].min() < -1e-3
    assert rate[:300].max() < 1e-10


def wavy_disk(n):
    """A curved sheet whose rim is r = 1 + 0.12 cos 5θ."""
    vertices, faces = UnitDisk().mesh(n)
    mask = UnitDisk().boundary_mask(vertices)
    x, y, _ = vertices.T
    stretch = 1 + 0.12 * (x**2 + y**2) * torch.cos(5 * torch.atan2(y, x))
    return torch.stack([x * stretch, y * stretch, 0.3 * x * y * stretch**2], 1), faces, mask


def cut_torus(n):
    """A torus with a fifth of its turn taken out, on a grid."""
    around = round(math.sqrt(0.6 * n))
    along = n // around
    u = torch.linspace(0.3, 5.2, along).double()
    v = torch.arange(around).double() * math.tau / around
    u, v = torch.meshgrid(u, v, indexing="ij")
    reach = 1 + 0.4 * v.cos()
    points = torch.stack([reach * u.cos(), reach * u.sin(), 0.4 * v.sin()], -1).view(-1, 3)
    index = torch.arange(n // around * around).view(along, around)
    a, b = index[:-1], index[:-1].roll(-1, 1)
    c, d = index[1:], index[1:].roll(-1, 1)
    faces = torch.cat([torch.stack([a, c, b], -1), torch.stack([b, c, d], -1)]).view(-1, 3)
    mask = torch.zeros(along, around, dtype=torch.bool)
    mask[[0, -1]] = True
    return points, faces, mask.view(-1)


@cache
def first_eigenvalue(shape, condition):
    lb = certified_mesh(*shape(2000)[:2], order=3, condition=condition)
    return smallest(lb, 2)[int(condition == "neumann")]


@pytest.mark.parametrize(
    ("order", "shape", "condition"),
    [
        (1, wavy_disk, "neumann"),
        (1, cut_torus, "dirichlet"),
        (3, wavy_disk, "dirichlet"),
        (3, cut_torus, "neumann"),
        (4, wavy_disk, "neumann"),
        (4, cut_torus, "dirichlet"),
        (5, wavy_disk, "dirichlet"),
        (5, cut_torus, "neumann"),
    ],
)
def test_curved_boundaries(order, shape, condition):
    """The certificate holds, and the first eigenvalue is within 2 % of that with 2,000 points at p = 3."""
    vertices, faces, mask = shape(700)
    exact = first_eigenvalue(shape, condition)
    for lb in (
        certified_mesh(vertices, faces, order=order, condition=condition),
        certified_cloud(vertices, order=order, boundary=mask, condition=condition),
    ):
        assert lb.certificate.holds
        values, abscissa = spectrum(lb, 2)
        assert abscissa <= 1e-10 * lb.stencil.values[0].abs().max()
        assert abs(values[int(condition == "neumann")] / exact - 1) < 0.02


@pytest.mark.parametrize(("condition", "bound"), [("neumann", 0.05), ("dirichlet", 0.25)])
@pytest.mark.parametrize("order", [1, 3, 5])
def test_a_cylinder_of_rows_has_its_gradient_and_curvature_at_its_ends(order, condition, bound):
    """Four or five rows of points do not determine a polynomial of degree 4 or 6 across them without the condition."""
    u, z = torch.meshgrid(
        torch.arange(60).double() * math.tau / 60, torch.linspace(0, 2, 20).double(), indexing="ij"
    )
    points = torch.stack([u.cos(), u.sin(), z], -1).view(-1, 3)
    index = torch.arange(1200).view(60, 20)
    a, b = index[:, :-1], index.roll(-1, 0)[:, :-1]
    faces = torch.cat([torch.stack([a, b, b + 1], -1), torch.stack([a, b + 1, a + 1], -1)])
    lb = LaplaceBeltrami.from_mesh(points, faces.view(-1, 3), order=order, condition=condition)
    slope = lb.gradient(points[:, 2])
    torch.testing.assert_close(
        slope, torch.tensor([[0, 0, 1.0]]).double().expand(1200, 3), atol=2e-3, rtol=0
    )
    bend = torch.tensor([-1.0, -1, 0], dtype=torch.float64) * points
    torch.testing.assert_close(lb.mean_curvature_normal(), bend, atol=bound, rtol=0)


def test_conormals_of_disk_and_hemisphere():
    """ν = x on the rim of the disk, ν = −e_z on that of the hemisphere."""
    for surface in (UnitDisk(), Hemisphere()):
        vertices, faces = surface.mesh(700)
        frames = mesh_frames(vertices, faces)
        if isinstance(surface, Hemisphere):
            frames = surface.frames(vertices)
        boundary = boundary_of_mesh(vertices, faces, 4).at(vertices, frames)
        mask = surface.boundary_mask(vertices)
        assert torch.equal(boundary.mask, mask)
        down = torch.tensor([0.0, 0, -1]).double().expand(int(mask.sum()), 3)
        exact = vertices[mask] if isinstance(surface, UnitDisk) else down
        assert (boundary.conormals[mask] - exact).norm(dim=1).max() < 1e-4
        assert (boundary.conormals[~mask] == 0).all()


def test_neumann_condition_at_the_edges_of_a_cube():
    """cos πx on 6 · 9³ tetrahedra: Δ at p = 3 is within 0.3 % up to the edges and corners."""
    line, across = torch.linspace(0, 1, 10, dtype=torch.float64), torch.tensor([100, 10, 1])
    vertices = torch.cartesian_prod(line, line, line)
    start = (torch.cartesian_prod(*[torch.arange(9)] * 3) * across).sum(1)
    walks = [torch.tensor(p).cumsum(0) for p in itertools.permutations(across.tolist())]
    faces = [torch.stack([start, *(start + step for step in walk)], 1) for walk in walks]
    lb = LaplaceBeltrami.from_mesh(vertices, torch.cat(faces))
    f = torch.cos(math.pi * vertices[:, 0])
    assert (lb(f) + math.pi**2 * f).abs().max() < 0.03


def test_boundary_of_a_cloud_is_detected():
    points = UnitDisk().points(700)
    asked = certified_cloud(points, dim=2, boundary="detect")
    told = certified_cloud(points, dim=2, boundary=UnitDisk().boundary_mask(points))
    torch.testing.assert_close(asked.matrix.to_dense(), told.matrix.to_dense())


@pytest.mark.parametrize("surface", [Sphere(), Torus()], ids=["sphere", "torus"])
def test_gaps_between_random_points_are_no_boundary(surface):
    """Asking for the boundary of a closed shape changes nothing."""
    points = surface.random_points(800)
    asked, told = (certified_cloud(points, boundary=b) for b in ("detect", None))
    assert torch.equal(asked.stencil.values, told.stencil.values)


def test_boundary_of_random_points_is_detected():
    """Of a hemisphere, whose rim no point is on: eigenvalues within 8.5 %."""
    points = Hemisphere().random_points(800)
    values = LaplaceBeltrami.from_points(points, boundary="detect").eigenbasis(6).eigenvalues
    exact = Hemisphere().eigenvalues(6)
    assert ((values - exact)[1:] / exact[1:]).abs().max() < 0.085


@pytest.mark.parametrize("condition", ["neumann", "dirichlet"])
@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_boundary_may_be_a_few_points(count, condition):
    points = Sphere().points(300)
    mask = (points - points[0]).norm(dim=1).argsort().argsort() < count
    lb = certified_cloud(points, boundary=mask, condition=condition)
    assert lb.certificate.holds


def test_low_order_rows_and_areas_of_a_square_in_four_dimensions():
    """On the triangles through its points: Δx = 0 but at the ends of x; areas that are 1 in all."""
    line = torch.linspace(0, 1, 9, dtype=torch.float64)
    square = torch.cartesian_prod(line, line)
    found = reconstruct(torch.cat([square, 0 * square], 1), 2)
    low_order, x = MeshLowOrder(found.points, found.cells), square[:, 0]
    length, col, values, _ = low_order.rows(((x > 0) & (x < 1)).nonzero()[:, 0])
    assert torch.segment_reduce(values * x[col], "sum", lengths=length).abs().max() < 1e-10
    assert abs(low_order.areas().sum() - 1) < 1e-12


def test_gradient_at_the_boundary_serves_any_function():
    """x has ∂x/∂ν ≠ 0 on the rim, and its gradient is e_x up to there."""
    vertices, faces = UnitDisk().mesh(700)
    lb = certified_mesh(vertices, faces, order=3)
    error = lb.gradient(vertices[:, 0]) - torch.tensor([1.0, 0, 0]).double()
    assert error.norm(dim=1).max() < 1e-8


def test_boundary_can_be_left_alone():
    """Without a condition x keeps Δx = 0 on the rows of full order up to the rim."""
    vertices, faces = UnitDisk().mesh(700)
    lb = LaplaceBeltrami.from_mesh(vertices, faces, order=2, condition=None, weak_form=False)
    exact_rows = lb.report.order == 2
    assert lb(vertices[:, 0])[exact_rows].abs().max() < 1e-8


@pytest.mark.parametrize("bad", ["dirichlet", torch.zeros(3, dtype=torch.bool), torch.zeros(300)])
def test_bad_boundaries_are_refused(bad):
    with pytest.raises(ValueError, match="boundary"):
        certified_cloud(UnitDisk().points(300), dim=2, boundary=bad)


def test_bad_boundary_of_a_mesh_is_refused():
    with pytest.raises(ValueError, match="boundary"):
        certified_mesh(*UnitDisk().mesh(300), boundary="robin")


@pytest.mark.parametrize("condition", ["neumann", "dirichlet", None])
def test_first_derivatives_and_curvature_hold_at_a_rim_whatever_the_condition(condition):
    """∇f, ∇²f and Δx use no condition, and where Δ has no stencil those of ∇ are of the highest degree there is."""
    vertices, faces = UnitDisk().mesh(1200)
    vertices = vertices[:, :2]
    lb = LaplaceBeltrami.from_mesh(vertices, faces, condition=condition)
    x, y = vertices.T
    f = x.exp() * (2 * y).sin()
    gradient = torch.stack([f, 2 * x.exp() * (2 * y).cos()], 1)
    assert (lb.gradient(f) - gradient).abs().max() < 5e-3
    assert (lb.hessian(f).diagonal(dim1=1, dim2=2).sum(1) + 3 * f).abs().max() < 0.2
    assert lb.mean_curvature_normal().abs().max() < 1e-10


def test_curvature_at_the_rim_of_the_cotangent_operator():
    """Where its rows are those of a Neumann condition, which positions do not satisfy."""
    lb = LaplaceBeltrami.from_cotangent(*UnitDisk().mesh(500))
    assert lb.mean_curvature_normal().norm(dim=1).max() < 1e-10


def test_points_on_a_line_along_the_rim_have_no_stencil():
    """20 rings of 200 points: the nearest of a rim's points are on its ring, and ∂_ν f = 0 alone looks across."""
    angle = 2 * math.pi * torch.arange(200, dtype=torch.float64) / 200
    height = torch.linspace(0, 3, 20, dtype=torch.float64)
    circle = torch.stack([angle.cos(), angle.sin()], 1)
    points = torch.cat([circle.repeat(20, 1), height.repeat_interleave(200)[:, None]], 1)
    lb = LaplaceBeltrami.from_points(points)
    f = torch.cos(math.pi / 3 * points[:, 2])
    assert (lb(f) + (math.pi / 3) ** 2 * f).abs().max() < 0.05
    assert (lb.gradient(points[:, 2]) - torch.tensor([0.0, 0, 1])).abs().max() < 1e-3
    rim = lb.boundary
    conormals = boundary_of_mesh(points, lb.faces, 4).at(points, lb.frames).conormals[rim]
    assert (conormals[:, 2] * (points[rim, 2] - 1.5)).min() > 1


def test_a_condition_that_holds_nowhere_is_told():
    with pytest.warns(UserWarning, match="holds nowhere"):
        LaplaceBeltrami.from_points(Sphere().points(300), condition="dirichlet", boundary="detect")


def test_an_open_surface_in_four_dimensions_has_its_boundary():
    line = torch.linspace(0, 1, 16, dtype=torch.float64)
    square = torch.cartesian_prod(line, line)
    x, y = square.T
    lb = LaplaceBeltrami.from_points(torch.stack([x, y, x**2, x * y], 1), dim=2)
    assert torch.equal(lb.boundary, ((square == 0) | (square == 1)).any(1))
