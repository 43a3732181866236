"""The analytic surfaces are what they claim: points on them, meshes, derivatives and spectra."""

import itertools
import math
from functools import cache

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import KDTree
from scipy.special import ellipeinc, ellipkinc, sph_harm_y
from torch.func import hessian, jacfwd, vmap

from tolerances import TOLERANCE
from torchlb import InputError, surfaces
from torchlb.surfaces import (
    Circle,
    CliffordTorus,
    Ellipsoid,
    Hemisphere,
    SpaceCurve,
    Sphere,
    StarShaped,
    ThreeSphere,
    Torus,
    UnitDisk,
    deserno_points,
    limit_surface,
    smooth_function,
    spherical_harmonic,
)
from torchlb.surfaces.base import _quadrature

BOUNDED = [UnitDisk(), Hemisphere()]
CURVES = [Circle(2.0), SpaceCurve()]
EMBEDDED = [Sphere(2.0), Ellipsoid(), StarShaped(), Torus()]  # closed surfaces in R³
ALL = [*EMBEDDED, CliffordTorus(), ThreeSphere(), *CURVES, *BOUNDED]
MESHED = [*EMBEDDED, CliffordTorus(), *BOUNDED]


@pytest.fixture(scope="module", autouse=True)
def surfaces_once():
    """Here they are computed each time."""


def each(cases):
    return pytest.mark.parametrize("surface", cases, ids=lambda case: type(case).__name__)


@cache
def points_on(surface):
    return surface.points(50)


@cache
def mesh_on(surface):
    return surface.mesh(400)


def close(actual, expected, scale=1.0):
    actual = torch.as_tensor(actual, dtype=torch.float64)
    expected = torch.as_tensor(expected, dtype=torch.float64)
    torch.testing.assert_close(actual / scale, expected / scale, **TOLERANCE[torch.float64])


@each(ALL)
def test_n_points_lie_on_the_surface_and_depend_on_the_seed_alone(surface):
    for draw in (surface.points, surface.random_points):
        points = draw(100, seed=3)
        assert points.shape == (100, surface.ambient_dim)
        assert points.dtype == torch.float64
        close(surface.retract(points), points)
        assert torch.equal(points, draw(100, seed=3))
        assert not torch.equal(points, draw(100, seed=4))


@each(ALL)
def test_points_are_quasi_uniform(surface):
    """Separation ≥ 0.6 and covering radius ≤ 0.9 mean spacings (area / n)^{1/d}, from a hundred points on."""
    for n, apart, covered in ((8, 0.3, 1.2), (150, 0.6, 0.9), (500, 0.6, 0.9)):
        points = surface.points(n)
        assert len(points) == n
        spacing = (surface.area / n) ** (1 / surface.dim)
        separation = KDTree(points).query(points, k=2)[0][:, 1].min()
        covering = KDTree(points).query(surface.random_points(20 * n, seed=1))[0].max()
        assert separation >= apart * spacing
        assert covering <= covered * spacing


@each(ALL)
def test_random_points_integrate_like_the_area(surface):
    """The mean of x over N uniform points is ∫ x / area, within 5 standard errors of it."""
    points = surface.random_points(20_000)
    cube, weights = _quadrature(surface.dim)
    mean = (surface._density(cube) * weights) @ surface._chart(cube) / surface.area
    assert ((points.mean(0) - mean).abs() <= 5 * points.std(0) / math.sqrt(20_000)).all()


def ellipsoid_area(a, b, c):
    """2πc² + 2πab / sin φ (E(φ, k) sin² φ + F(φ, k) cos² φ), cos φ = c/a, k² = a² (b² − c²) / b² (a² − c²)."""
    phi, m = math.acos(c / a), a**2 * (b**2 - c**2) / (b**2 * (a**2 - c**2))
    elliptic = ellipeinc(phi, m) * math.sin(phi) ** 2 + ellipkinc(phi, m) * math.cos(phi) ** 2
    return 2 * math.pi * (c**2 + a * b / math.sin(phi) * elliptic)


def test_area_is_that_of_the_closed_form():
    for surface, area in (
        (Sphere(2.0), 16 * math.pi),
        (Circle(2.0), 4 * math.pi),
        (ThreeSphere(2.0), 16 * math.pi**2),
        (Torus(2.0, 0.5), 4 * math.pi**2),
        (CliffordTorus(), 2 * math.pi**2),
        (UnitDisk(), math.pi),
        (Hemisphere(), 2 * math.pi),
        (Ellipsoid(), ellipsoid_area(1.5, 1.0, 0.7)),
        (Ellipsoid((5.0, 1.0, 0.5)), ellipsoid_area(5.0, 1.0, 0.5)),
        (StarShaped(0.0), 4 * math.pi),
    ):
        close(surface.area, area, scale=area)


def test_the_area_element_is_integrated_once_for_equal_surfaces_and_apart_for_others():
    assert Torus(2.0, 0.5).area is Torus(2.0, 0.5).area
    assert Sphere(1.5).area == pytest.approx(9 * math.pi)
    assert Circle(1.5).area == pytest.approx(3 * math.pi)


def test_area_of_the_space_curve_is_its_length():
    """∫ |γ′| dt by the trapezoidal rule, with |γ′|² = 4 (1 + ½cos 3t)² + 9/4."""
    t = torch.arange(1000, dtype=torch.float64) * 2 * math.pi / 1000
    speed = (4 * (1 + (3 * t).cos() / 2) ** 2 + 9 / 4).sqrt()
    close(SpaceCurve().area, 2 * math.pi * speed.mean())


def test_star_is_not_convex():
    """Some point of it lies well outside of a tangent plane."""
    points = StarShaped().points(500)
    normals = StarShaped().normals(points)
    heights = normals @ points.T - (normals * points).sum(1, keepdim=True)
    assert heights.max() > 0.1


def test_deserno_points_are_as_many_as_in_the_literature():
    for n, count in ((2000, 2022), (8000, 8038), (32000, 32093)):
        points = deserno_points(n)
        assert points.shape == (count, 3)
        close(points.norm(dim=1), torch.ones(count))
    points = deserno_points(2000)
    assert len(Sphere().triangulate(points)) == 2 * len(points) - 4


@each(BOUNDED)
def test_ring_is_exactly_on_the_boundary_as_dense_as_the_interior(surface):
    points = surface.points(500)
    mask = surface.boundary_mask(points)
    count = int(mask.sum())
    ring = points[:count]
    assert mask[:count].all()
    turn = 2 * math.pi * torch.arange(count, dtype=torch.float64) / count
    close(ring, torch.stack([turn.cos(), turn.sin(), torch.zeros_like(turn)], 1))
    nearest = torch.from_numpy(KDTree(points).query(points[count:], k=2)[0][:, 1])
    assert 0.9 < (2 * math.pi / count) / nearest.mean() < 1.2
    assert (points[count:, :2].norm(dim=1) < 1).all()


def test_closed_surface_has_no_boundary():
    for surface in (*EMBEDDED, CliffordTorus(), *CURVES):
        assert not surface.boundary_mask(points_on(surface)).any()


def directed_edges(faces, n):
    ends = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    return ends[:, 0] * n + ends[:, 1], ends[:, 1] * n + ends[:, 0]


@each(MESHED)
def test_mesh_is_a_consistently_oriented_manifold_with_the_right_topology(surface):
    """Each directed edge occurs once, its reverse too unless it joins boundary points; V − E + F = 2, 0 or 1."""
    for vertices, faces in (surface.mesh(40), mesh_on(surface)):
        n = len(vertices)
        assert torch.equal(vertices, surface.points(n))
        assert faces.dtype == torch.int64
        assert torch.equal(faces.unique(), torch.arange(n))
        edges, reverses = directed_edges(faces, n)
        assert len(edges.unique()) == len(edges)
        single = edges[~torch.isin(edges, reverses)]
        on_boundary = surface.boundary_mask(vertices)
        assert len(single) == on_boundary.sum()
        assert on_boundary[single // n].all()
        assert on_boundary[single % n].all()
        characteristic = n - len(torch.cat([edges, reverses]).unique()) // 2 + len(faces)
        torus = isinstance(surface, Torus | CliffordTorus)
        assert characteristic == (0 if torus else 1 if surface.perimeter else 2)


@each([*EMBEDDED, *BOUNDED])
def test_triangles_face_outward(surface):
    """A face's (b − a) × (c − a) is on the side of the normals at its corners."""
    vertices, faces = mesh_on(surface)
    a, b, c = vertices[faces].unbind(1)
    area_vectors = torch.linalg.cross(b - a, c - a)
    normals = surface.normals(vertices)
    assert ((area_vectors[:, None] * normals[faces]).sum(-1) > 0).all()


@each(MESHED)
def test_mesh_area_converges_to_the_area_and_no_triangle_is_degenerate(surface):
    """N = 400 triangulated: area to 2 %; 4√3 area / Σ edges² of each triangle > 0.3 (equilateral: 1)."""
    vertices, faces = mesh_on(surface)
    a, b, c = vertices[faces].unbind(1)
    sides = torch.stack([b - a, c - a], 1)
    areas = torch.linalg.det(sides @ sides.mT).sqrt() / 2
    assert areas.sum().item() == pytest.approx(surface.area, rel=0.02)
    squares = sum((p - q).square().sum(1) for p, q in [(a, b), (b, c), (c, a)])
    assert (4 * math.sqrt(3) * areas / squares).min() > 0.3


@each(ALL)
def test_frames_are_orthonormal_and_tangent(surface):
    """EᵀE = 1, and R(x + εE) − x = εE + O(ε²)."""
    points = points_on(surface)
    frames = surface.frames(points)
    close(frames.mT @ frames, torch.eye(surface.dim).expand(50, -1, -1))
    for e in frames.unbind(-1):
        difference = surface.retract(points + 1e-4 * e) - surface.retract(points - 1e-4 * e)
        torch.testing.assert_close(difference / 2e-4, e, rtol=0, atol=1e-6)


def test_normals_of_sphere_ellipsoid_and_torus():
    sphere, ellipsoid, torus = Sphere(2.0), Ellipsoid(), Torus()
    points = points_on(sphere)
    close(sphere.normals(points), points / 2)
    points = points_on(ellipsoid)
    slope = points / points.new_tensor(ellipsoid.semi_axes) ** 2
    close(ellipsoid.normals(points), slope / slope.norm(dim=1, keepdim=True))
    points = points_on(torus)
    core = torch.nn.functional.normalize(points * torch.tensor([1.0, 1, 0]), dim=1)
    close(torus.normals(points), (points - core) / 0.5)


def test_mean_curvature_normal_of_spheres_and_a_minimal_surface_of_one():
    """Δx = −d x / radius², and −2x on the Clifford torus in the unit S³."""
    cases = [(Sphere(2.0), -2 / 4), (ThreeSphere(), -3), (Circle(2.0), -1 / 4)]
    for surface, factor in (*cases, (CliffordTorus(), -2)):
        points = points_on(surface)
        close(surface.mean_curvature_normal(points), factor * points)


@each(ALL)
def test_mean_curvature_normal_is_normal(surface):
    points = points_on(surface)
    tangent = surface.frames(points).mT @ surface.mean_curvature_normal(points)[..., None]
    close(tangent, torch.zeros_like(tangent))


def test_laplacian_of_spherical_harmonics():
    """ΔY = −l (l + 1) Y, at the poles as well."""
    points = torch.cat([points_on(Sphere()), torch.tensor([[0.0, 0, 1], [0, 0, -1]]).double()])
    for degree, m in ((0, 0), (1, -1), (5, 4), (5, 0), (6, -6), (20, 7)):
        harmonic, eigenvalue = spherical_harmonic(degree, m), degree * (degree + 1)
        laplacian = Sphere().laplacian(harmonic, points)
        close(laplacian, -eigenvalue * harmonic(points), scale=max(1, eigenvalue))


def test_laplacian_and_gradient_on_the_torus_in_angles():
    """f = cos 2u sin v: Δf = f_uu / w² + (w f_v)_v / (r² w), w = R + r cos v; ∇f = f_u e_u / w + f_v e_v / r."""
    torus = Torus(2.0, 0.7)
    points = points_on(torus)

    def angles(x):
        around = torch.atan2(x[:, 1], x[:, 0])
        return around, torch.atan2(x[:, 2], torch.hypot(x[:, 0], x[:, 1]) - 2.0)

    def f(x):
        u, v = angles(x)
        return (2 * u).cos() * v.sin()

    u, v = angles(points)
    w, zero = 2.0 + 0.7 * v.cos(), torch.zeros_like(u)
    second = -v.sin() - 0.7 * v.sin() / w * v.cos()
    close(torus.laplacian(f, points), -4 * f(points) / w**2 + (2 * u).cos() * second / 0.7**2)
    e_u = torch.stack([-u.sin(), u.cos(), zero], 1)
    e_v = torch.stack([-v.sin() * u.cos(), -v.sin() * u.sin(), v.cos()], 1)
    f_u, f_v = -2 * (2 * u).sin() * v.sin(), (2 * u).cos() * v.cos()
    close(torus.gradient(f, points), (f_u / w)[:, None] * e_u + (f_v / 0.7)[:, None] * e_v)


def test_laplacian_of_eigenfunctions():
    """−Δf = λf for harmonic polynomials of the spheres, products of waves on the flat surfaces."""
    for surface, f, eigenvalue in (
        (CliffordTorus(), lambda x: (x[:, 0] ** 2 - x[:, 1] ** 2) * x[:, 2], 2 * (4 + 1)),
        (CliffordTorus(2.0), lambda x: x[:, 0] * x[:, 3], 2 / 4),
        (ThreeSphere(), lambda x: x[:, 0] * x[:, 1] + x[:, 2] ** 2 - x[:, 3] ** 2, 8),
        (Circle(2.0), lambda x: x[:, 0] ** 3 - 3 * x[:, 0] * x[:, 1] ** 2, 9 / 4),
        (Hemisphere(), lambda x: x[:, 0] * x[:, 2], 6),
        (UnitDisk(), lambda x: (3 * x[:, 0]).sin() * (2 * x[:, 1]).cos(), 13),
    ):
        points = surface.random_points(100)
        close(surface.laplacian(f, points), -eigenvalue * f(points))


def test_laplacian_on_a_curve_is_the_second_derivative_by_arc_length():
    """f″ = (f_tt − f_t s_t / s) / s² for the speed s(t), by Fourier differentiation."""
    curve, count = SpaceCurve(), 128
    points = curve._chart(torch.arange(count, dtype=torch.float64)[:, None] / count)
    wave = torch.fft.fftfreq(count, 1 / count, dtype=torch.float64)

    def derivative(values):
        return torch.fft.ifft(1j * wave * torch.fft.fft(values)).real

    speed = torch.stack([derivative(column) for column in points.T]).norm(dim=0)
    expected = derivative(derivative(smooth_function(points)) / speed) / speed
    torch.testing.assert_close(
        curve.laplacian(smooth_function, points), expected, rtol=0, atol=1e-8
    )


def test_laplacian_on_the_ellipsoid_is_that_of_the_level_set_formula():
    """Δ_M f = Δf − nᵀ (∇²f) n − (div n) n·∇f with n = ∇F / |∇F|."""
    ellipsoid = Ellipsoid()
    points = points_on(ellipsoid)

    def normal(x):
        slope = x / points.new_tensor(ellipsoid.semi_axes) ** 2
        return slope / slope.norm()

    n = vmap(normal)(points)
    divergence = vmap(jacfwd(normal))(points).diagonal(dim1=1, dim2=2).sum(1)
    slope, bend = vmap(jacfwd(smooth_function))(points), vmap(hessian(smooth_function))(points)
    expected = bend.diagonal(dim1=1, dim2=2).sum(1) - torch.einsum("xi,xij,xj->x", n, bend, n)
    expected -= divergence * (n * slope).sum(1)
    close(ellipsoid.laplacian(smooth_function, points), expected)
    close(ellipsoid.gradient(smooth_function, points), slope - (n * slope).sum(1)[:, None] * n)


@each(ALL)
def test_mean_curvature_normal_is_that_of_central_differences(surface):
    """Δx = (1 − EEᵀ) Σ_i ∂²/∂ε² R(x + ε e_i) at ε = 0."""
    points, eps = points_on(surface), 1e-3
    frames = surface.frames(points)
    second = torch.zeros_like(points)
    for e in frames.unbind(-1):
        second += surface.retract(points + eps * e) - 2 * points + surface.retract(points - eps * e)
    second -= (frames @ (frames.mT @ second[..., None]))[..., 0]
    torch.testing.assert_close(
        surface.mean_curvature_normal(points), second / eps**2, rtol=1e-4, atol=1e-3
    )


def test_fields_of_many_channels_are_differentiated_each():
    """Δ and ∇ of (f, g) are (Δf, Δg) and (∇f, ∇g), shapes (N, C) and (N, n, C)."""
    torus = Torus()
    points = points_on(torus)

    def pair(x):
        return torch.stack([smooth_function(x), x[:, 0] * x[:, 2]], 1)

    close(torus.laplacian(pair, points)[:, 0], torus.laplacian(smooth_function, points))
    gradient = torus.gradient(pair, points)
    assert gradient.shape == (50, 3, 2)
    close(gradient[:, :, 0], torus.gradient(smooth_function, points))


def test_spherical_harmonic_agrees_with_scipy():
    """√2 (−1)^m Re or Im Y_l^|m|, without the phase (−1)^m."""
    points = points_on(Sphere())
    x, y, z = points.numpy().T
    for degree, m in ((0, 0), (3, 0), (5, 4), (4, -3), (12, 12)):
        complex_valued = sph_harm_y(degree, abs(m), np.arccos(z), np.arctan2(y, x))
        part = complex_valued.imag if m < 0 else complex_valued.real
        expected = part * (1 if m == 0 else math.sqrt(2) * (-1) ** m)
        close(spherical_harmonic(degree, m)(points), torch.from_numpy(expected))


def test_smooth_function_is_its_formula():
    x, y, z, w = torch.randn(4, 20, dtype=torch.float64)
    plane = torch.exp(x / 2) * torch.sin(2 * y + 0.3)
    space = plane + x * torch.cos(1.5 * z)
    close(smooth_function(torch.stack([x, y], 1)), plane)
    assert torch.equal(smooth_function(torch.stack([x, y, z], 1)), space)
    close(smooth_function(torch.stack([x, y, z, w], 1)), space + y * torch.cos(1.5 * w))


def test_eigenvalues_of_spheres_circles_and_the_flat_torus():
    """l (l + 1), l (l + 2), l² and j² + k² with their multiplicities, over the radius squared."""
    close(Sphere(2.0).eigenvalues(10) * 4, [0, 2, 2, 2, 6, 6, 6, 6, 6, 12])
    close(ThreeSphere().eigenvalues(15), [0, *[3] * 4, *[8] * 9, 15])
    close(Circle(2.0).eigenvalues(6) * 4, [0, 1, 1, 4, 4, 9])
    close(CliffordTorus(1.0).eigenvalues(14), [0, *[1] * 4, *[2] * 4, *[4] * 4, 5])
    length = 2 * math.pi / SpaceCurve().area
    close(SpaceCurve().eigenvalues(4), [0, length**2, length**2, 4 * length**2])


TORUS_EIGENVALUES = [  # R = 1, r = 0.5, with multiplicity
    *[(0.0, 1), (0.997472228, 2), (3.17827121, 2), (3.90692525, 1), (4.48915308, 1)],
    *[(5.05486779, 2), (6.18060331, 2), (6.65205815, 2), (8.16247260, 2), (10.0568008, 2)],
    *[(12.6129542, 2), (12.7010054, 2), (14.8217076, 2), (16.1307959, 1), (16.2068949, 1)],
]


def test_eigenvalues_of_the_torus():
    expected = [value for value, times in TORUS_EIGENVALUES for _ in range(times)]
    values = Torus().eigenvalues(len(expected))
    np.testing.assert_allclose(values, expected, rtol=5e-9, atol=0)
    close(Torus(2.0, 1.0).eigenvalues(50), Torus().eigenvalues(50) / 4)


@pytest.mark.parametrize("minor", [0.01, 0.5, 0.95])
def test_eigenvalues_of_thin_and_thick_tori_follow_weyls_law(minor):
    """The eigenvalues are ascending from 0, and λ_k → 4πk / area."""
    values = Torus(1.0, minor).eigenvalues(400)
    assert values[0] == 0
    assert (values.diff() >= -1e-9).all()
    if minor >= 0.5:
        weyl = 4 * math.pi * 400 / Torus(1.0, minor).area
        assert values[-1].item() == pytest.approx(weyl, rel=0.1)
    else:  # a thin torus is nearly a circle: −1/4 (minor / major)² corrections only
        np.testing.assert_allclose(values[:5], [0, 1, 1, 4, 4], rtol=1e-3)


def test_eigenvalues_of_the_disk_are_squared_bessel_zeros():
    """j′_{1,1} = 1.8411838, j′_{2,1} = 3.0542369, j′_{0,2} = 3.8317060; j_{0,1} = 2.4048256, j_{1,1} = 3.8317060."""
    zeros = [0, *[1.8411837813] * 2, *[3.0542369282] * 2, 3.8317059702]
    np.testing.assert_allclose(UnitDisk().eigenvalues(6).sqrt(), zeros, rtol=1e-9)
    zeros = [2.4048255577, 3.8317059702, 3.8317059702]
    np.testing.assert_allclose(UnitDisk().eigenvalues(3, "dirichlet").sqrt(), zeros, rtol=1e-9)
    weyl = UnitDisk().eigenvalues(400, "neumann")[-1], UnitDisk().eigenvalues(400, "dirichlet")[-1]
    assert weyl[0] < 4 * 400 < weyl[1]  # λ_k = 4k ∓ 4√k


def test_eigenvalues_of_the_hemisphere():
    """l (l + 1), l + 1 times for harmonics even in z, l times for odd ones."""
    close(Hemisphere().eigenvalues(7), [0, 2, 2, 6, 6, 6, 12])
    close(Hemisphere().eigenvalues(6, condition="dirichlet"), [2, 6, 6, 12, 12, 12])


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Sphere(0.0), "radius: expected a positive length"),
        (lambda: CliffordTorus(-1.0), "radius: expected a positive length"),
        (lambda: Ellipsoid((1.0, 0.0, 1.0)), "semi_axes: expected positive lengths"),
        (lambda: Torus(1.0, 1.0), "minor: expected 0 < minor < major"),
        (lambda: StarShaped(1.0), "amplitude"),
        (lambda: Sphere().points(7), "n: expected at least 8, got 7"),
        (lambda: Sphere().random_points(0), "n: expected a positive number"),
        (lambda: deserno_points(1), "n: expected at least 8"),
        (lambda: Ellipsoid().eigenvalues(5), "Ellipsoid: no exact eigenvalues are known"),
        (lambda: Sphere().eigenvalues(0), "k: expected a positive number"),
        (lambda: Sphere().eigenvalues(3, "dirichlet"), "condition: expected neumann"),
        (lambda: UnitDisk().eigenvalues(3, "robin"), "expected neumann or dirichlet, got robin"),
        (lambda: ThreeSphere().mesh(50), "ThreeSphere: expected dimension 2, for tri"),
        (lambda: Circle().mesh(50), "Circle: expected dimension 2"),
        (lambda: SpaceCurve().mesh(50), "SpaceCurve: expected dimension 2"),
        (lambda: CliffordTorus().normals(CliffordTorus().points(9)), "use frames"),
        (lambda: Sphere().frames(torch.zeros(4, 2).double()), r"float64 points \(N, 3\)"),
        (lambda: Sphere().frames(torch.eye(3)), "float32"),
        (lambda: Sphere(2.0).frames(torch.eye(3).double()), r"use retract\), got others: \[0, 1"),
        (lambda: Sphere().laplacian(lambda x: x.sum()[None], torch.eye(3).double()), "f: expected"),
        (
            lambda: Torus(1.0, 0.9).mesh(16),
            "points: expected more of them, or less regular, got 16",
        ),
        (lambda: spherical_harmonic(2, 3), "m: expected -2 to 2, got 3"),
    ],
)
def test_errors_say_what_was_expected(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_duplicates_and_not_a_number_are_errors_that_name_the_points():
    points = points_on(Sphere()).clone()
    with pytest.raises(ValueError, match=r"are there duplicates\?\), got \[\d+\]"):
        Sphere().triangulate(torch.cat([points, points[7:8]]))
    points[5, 1] = math.nan
    with pytest.raises(ValueError, match=r"others: \[5\]"):
        Sphere().frames(points)


def test_public_names_exist():
    assert all(hasattr(surfaces, name) for name in surfaces.__all__)


def test_levels_of_a_limit_surface_are_nested_and_watertight():
    vertices, faces = Ellipsoid().mesh(150)
    points, meshes = limit_surface(vertices, faces, 3)
    assert torch.equal(meshes[0], faces)
    for level, mesh in enumerate(meshes):
        count = int(mesh.max()) + 1
        assert count == 2 + 148 * 4**level
        assert len(mesh) == 2 * count - 4
        coarser, _ = limit_surface(vertices, faces, level)  # the same surface at every level
        torch.testing.assert_close(points[:count], coarser, rtol=0, atol=1e-14)
        assert trimesh.Trimesh(coarser.numpy(), mesh.numpy(), process=False).is_watertight


def test_normals_of_a_limit_surface_converge():
    """Angles between the triangles at an edge halve from level to level: no crease is left."""
    points, meshes = limit_surface(*Ellipsoid().mesh(150), 4)
    angles = []
    for mesh in meshes[1:]:
        shape = trimesh.Trimesh(points.numpy()[: int(mesh.max()) + 1], mesh.numpy(), process=False)
        angles.append(shape.face_adjacency_angles.mean())
    for coarse, fine in itertools.pairwise(angles):
        assert fine == pytest.approx(coarse / 2, rel=0.1)


def test_a_limit_surface_is_that_of_a_closed_mesh():
    vertices, faces = UnitDisk().mesh(100)
    with pytest.raises(InputError, match=r"expected a closed mesh, got \d+ edges"):
        limit_surface(vertices, faces, 1)
