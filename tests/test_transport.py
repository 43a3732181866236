"""Transport of tangent vectors, the logarithmic map, curl, the Helmholtz–Hodge decomposition."""

import numpy as np
import pytest
import torch
from scipy.spatial import Delaunay
from torch.nn.functional import pad

from torchlb import (
    DerivativeError,
    InputError,
    LaplaceBeltrami,
    geodesic_distance,
    hodge_decomposition,
    logarithmic_map,
    parallel_transport,
    vector_heat_flow,
)
from torchlb.surfaces import Circle, CliffordTorus, Hemisphere, Sphere, Torus


@pytest.fixture(scope="module")
def sphere():
    return LaplaceBeltrami.from_mesh(*Sphere().mesh(1000))


def along_great_circles(points, source, vector):
    """A tangent vector of the unit sphere at `source`, turned with the great circles from there; and the distances."""
    cosine = points @ source
    away = torch.nn.functional.normalize(points - cosine[:, None] * source, dim=1)
    angle = cosine.clamp(-1, 1).acos()
    there = angle.cos()[:, None] * away - angle.sin()[:, None] * source
    along = away @ vector
    return vector - along[:, None] * away + along[:, None] * there, angle, away


@pytest.mark.parametrize("build", [LaplaceBeltrami.from_mesh, LaplaceBeltrami.from_points])
def test_transport_and_logarithm_on_the_sphere(build):
    vertices, faces = Sphere().mesh(1000)
    lb = build(vertices, faces) if build == LaplaceBeltrami.from_mesh else build(vertices)
    source = torch.nn.functional.normalize(lb.points[3], dim=0)
    tangent = lb.frames[3] - torch.outer(source, source @ lb.frames[3])
    exact, angle, away = along_great_circles(lb.points, source, tangent[:, 0])
    near = (angle < 2.5) & (angle > 0)
    moved = parallel_transport(lb, 3, 2 * tangent[:, 0])
    assert (moved / 2 - exact).norm(dim=1)[near].mean() < 2e-3
    assert (moved.norm(dim=1) - 2).abs().max() < 1e-3
    coordinates = logarithmic_map(lb, 3)
    expected = angle[:, None] * (away @ tangent)
    assert (coordinates - expected).norm(dim=1)[near].mean() < 5e-3
    both = logarithmic_map(lb, [3, 7])
    torch.testing.assert_close(both[..., 0], coordinates, rtol=0, atol=0)
    with pytest.raises(InputError, match="surface with triangles"):
        logarithmic_map(LaplaceBeltrami.from_points(Circle().points(40)), 0)


def test_the_nearest_source_decides(sphere):
    """It is that from each source by itself; heat mixes lengths. Channels are fields of their own."""
    vectors = torch.stack([3 * sphere.frames[0, :, 0], sphere.frames[1, :, 1]])
    moved = parallel_transport(sphere, [0, 1], vectors)
    each = torch.stack([parallel_transport(sphere, s, vectors[s]) for s in (0, 1)])
    nearest = geodesic_distance(sphere, [0, 1], each=True).argmin(1)
    torch.testing.assert_close(moved, each[nearest, torch.arange(1000)])
    mixed = parallel_transport(sphere, [0, 1], vectors, method="heat").norm(dim=1)
    torch.testing.assert_close(mixed[:2], torch.tensor([3.0, 1.0]).double(), rtol=0.1, atol=0)
    assert mixed.max() < 3 + 1e-9
    assert mixed.min() > 1 - 1e-9
    several = parallel_transport(sphere, [0, 1], torch.stack([vectors, vectors.flip(1)], 2))
    torch.testing.assert_close(several[..., 0], moved)


def test_transport_where_it_is_known():
    """In the plane, and in a sheet rolled up from it, a vector keeps its components, whatever the condition is."""
    x = torch.rand(500, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    faces = torch.from_numpy(Delaunay(x.numpy()).simplices).long()
    fin = torch.cat([faces, torch.tensor([[*faces[0, :2], len(x)]])])  # a third face at an edge
    angle, height = x.unbind(1)
    rolled = torch.stack([angle.sin(), angle.cos(), height], 1)
    turned = torch.stack([angle.cos(), -angle.sin(), 0 * angle], 1)
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    exact = 0.6 * turned + 0.8 * axis
    flat = axis.roll(1)[None] * 0.6 + axis.roll(2)[None] * 0.8
    for points, vectors, cells in (
        (pad(x, (0, 1)), flat, faces),
        (rolled, exact, faces),
        (rolled, exact, fin),
    ):
        points = torch.cat([points, 1.1 * points[cells[-1, :1]]])[: 1 + int(cells.max())]
        lb = LaplaceBeltrami.from_mesh(points, cells, condition="dirichlet")
        for method, bound in (("paths", 2e-3), ("heat", 3e-2)):
            moved = parallel_transport(lb, 5, vectors[5 % len(vectors)], method=method)[:500]
            assert (moved - vectors).norm(dim=1).median() < bound


def test_methods_where_they_are_for():
    """One-sided surfaces, those of higher codimension and curves are for steps of heat, as are points that move."""
    u = torch.linspace(0, 2 * torch.pi, 61)[:-1].double().repeat_interleave(9)
    v = torch.linspace(-0.3, 0.3, 9).double().repeat(60)
    reach = 1 + v * (u / 2).cos()
    band = torch.stack([reach * u.cos(), reach * u.sin(), v * (u / 2).sin()], 1)
    ring = LaplaceBeltrami.from_points(Circle().points(60))
    square = LaplaceBeltrami.from_mesh(*CliffordTorus().mesh(300))
    for lb in (LaplaceBeltrami.from_points(band), ring, square):
        vector = lb.frames[0, :, 0]
        moved = parallel_transport(lb, 0, vector)
        torch.testing.assert_close(moved, parallel_transport(lb, 0, vector, method="heat"))
        with pytest.raises(InputError, match="oriented surfaces"):
            parallel_transport(lb, 0, vector, method="paths")
    lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(300))
    carrying = lb.at(lb.points.clone().requires_grad_())
    vector = lb.frames[0, :, 0]
    heat = parallel_transport(lb, 0, vector, method="heat")
    torch.testing.assert_close(parallel_transport(carrying, 0, vector).detach(), heat)
    with pytest.raises(DerivativeError):
        parallel_transport(carrying, 0, vector, method="paths").sum().backward()


def test_transport_has_the_derivative_of_differences():
    torch.manual_seed(0)
    lb = LaplaceBeltrami.from_mesh(*Hemisphere().mesh(100))
    lb = lb.at(lb.points + 0.002 * torch.randn_like(lb.points))
    way, weight = torch.randn_like(lb.points), torch.randn_like(lb.points)
    vector, other = torch.randn(2, 3, dtype=torch.float64)

    def value(points, v):
        return (weight * parallel_transport(lb.at(points), [5], v[None], method="heat")).sum()

    x, v = lb.points.clone().requires_grad_(), vector.clone().requires_grad_()
    one, two = torch.autograd.grad(value(x, v), (x, v))
    ends = [float(value(lb.points + s * 1e-6 * way, vector + s * 1e-6 * other)) for s in (1, -1)]
    found = float((one * way).sum() + (two * other).sum())
    assert found == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-3)


def test_the_curl_is_that_of_stokes(sphere):
    """Of ν × ∇f it is Δf, of gradients 0; a normal part does not count."""
    f = sphere.points[:, 0] * sphere.points[:, 1]
    slope = sphere.gradient(f)
    assert sphere.curl(slope).abs().max() < 1e-2
    turned = torch.linalg.cross(sphere.normals, slope)
    both = turned + sphere.points[:, :1] * sphere.normals
    for v in (turned, both):
        assert (sphere.curl(v) + 6 * f).abs().max() < 2e-2
    columns = torch.stack([slope, turned], 2)
    torch.testing.assert_close(sphere.curl(columns)[:, 1], sphere.curl(turned))
    with pytest.raises(InputError, match="surface in R³"):
        LaplaceBeltrami.from_mesh(*CliffordTorus().mesh(200)).curl(torch.zeros(200, 4))


def test_hodge_parts_of_a_sphere_are_a_gradient_and_a_rotated_one(sphere):
    x, y, z = sphere.points.unbind(1)
    f, g = x * y + z, x * z
    turned = torch.linalg.cross(sphere.normals, sphere.gradient(g))
    parts = hodge_decomposition(sphere, sphere.gradient(f) + turned)
    assert (parts.potential - f).abs().max() < 1e-3
    assert (parts.stream - g).abs().max() < 1e-3
    assert (parts.gradient - sphere.gradient(f)).abs().max() < 5e-3
    assert (parts.rotated - turned).abs().max() < 5e-3
    assert parts.harmonic.abs().max() < 5e-3


def test_hodge_parts_add_up_and_are_orthogonal():
    lb = LaplaceBeltrami.from_mesh(*Torus().mesh(2000))
    x, y, z = lb.points.unbind(1)
    field = torch.stack([y * z, x**2, x.sin()], 1) + torch.stack([-y, x, 0 * x], 1)
    parts = hodge_decomposition(lb, field)
    three = [parts.gradient, parts.rotated, parts.harmonic]
    tangent = lb.connection.vectors(lb.connection.components(field))
    torch.testing.assert_close(sum(three), tangent)
    size = lb.inner(tangent, tangent).sum()
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert abs(lb.inner(three[one], three[other]).sum()) < 2e-7 * size
    harmonic = lb.connection.components(parts.harmonic)
    basis = lb.connection.hodge.eigenbasis(2)
    inside = basis.from_basis(basis.to_basis(harmonic))
    assert (inside - harmonic).norm() < 1e-2 * harmonic.norm()


def test_hodge_parts_with_a_boundary():
    """On a cap there is no harmonic field that is tangent to the boundary; w is zero there."""
    lb = LaplaceBeltrami.from_mesh(*Hemisphere().mesh(2000))
    x, y, z = lb.points.unbind(1)
    turned = torch.linalg.cross(lb.normals, lb.gradient(z * (1 + x)))
    parts = hodge_decomposition(lb, lb.gradient(x * y + z**2) + turned)
    assert parts.stream[lb.boundary].abs().max() == 0
    assert (parts.stream - z * (1 + x)).abs().max() < 5e-3
    size = [float(lb.inner(v, v).sum()) for v in (parts.harmonic, parts.gradient)]
    assert size[0] < 1e-3 * size[1]


def test_hodge_parts_are_differentiable_in_the_field(sphere):
    v = torch.randn_like(sphere.points).requires_grad_()
    weight = torch.randn_like(sphere.points)
    (g,) = torch.autograd.grad((weight * hodge_decomposition(sphere, v).rotated).sum(), v)
    linear = (weight * hodge_decomposition(sphere, v.detach()).rotated).sum()
    assert float((g * v).sum()) == pytest.approx(float(linear), rel=1e-6)
    moved = sphere.at(sphere.points.clone().requires_grad_())
    with pytest.raises(DerivativeError):
        hodge_decomposition(moved, v).gradient.sum().backward()


def test_bad_input_is_refused(sphere):
    with pytest.raises(InputError, match="sources"):
        parallel_transport(sphere, 1000, sphere.points[0])
    with pytest.raises(InputError, match="vectors"):
        parallel_transport(sphere, [0, 1], sphere.points[:3])
    with pytest.raises(InputError, match="medium"):
        hodge_decomposition(sphere.with_medium(density=2.0), sphere.points)
    batch = LaplaceBeltrami.batch([sphere, sphere])
    with pytest.raises(InputError, match="unbatch"):
        hodge_decomposition(batch, batch.points)


def test_vectors_stay_as_they_are_in_flat_spaces():
    """On random triangles and tetrahedra; with two sources that of the nearest one."""
    rng = np.random.default_rng(0)
    for dim, count in ((2, 300), (3, 400)):
        points = rng.uniform(size=(count, dim))
        cells = Delaunay(points).simplices
        sides = points[cells[:, 1:]] - points[cells[:, :1]]
        lb = LaplaceBeltrami.from_mesh(points, cells[np.abs(np.linalg.det(sides)) > 1e-6])
        given = torch.randn(2, dim, dtype=torch.float64)
        for method in (None, "heat"):
            one = parallel_transport(lb, 5, given[0], method=method)
            torch.testing.assert_close(one, given[:1].expand(count, -1))
            both = parallel_transport(lb, [5, 9], given, method=method)
            nearest = geodesic_distance(lb, [5, 9], each=True).argmin(1)
            torch.testing.assert_close(both, given[nearest])


def test_heat_that_may_reverse_vectors_is_told():
    """On random triangles in a plane of space, the exact result is the vector itself."""
    points = np.random.default_rng(0).uniform(size=(1500, 2))
    faces, space = Delaunay(points).simplices, np.pad(points, ((0, 0), (0, 1)))
    lb, axis = LaplaceBeltrami.from_mesh(space, faces), torch.eye(3, dtype=torch.float64)[0]
    with pytest.warns(UserWarning, match="a step of heat from the sources is not positive"):
        moved = parallel_transport(lb, 400, axis, method="heat")
    reversed_ = moved[:, 0] < 0
    assert 0 < reversed_.sum() < 20
    assert parallel_transport(lb, 400, axis, method="paths")[:, 0].min() > 0.99


def test_integers_are_vectors():
    """They were cut off to integers on the way."""
    lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(200))
    up = torch.tensor([0, 0, 1]).repeat(200, 1)
    calls = [
        lambda v: parallel_transport(lb, 0, v[0]),
        lambda v: vector_heat_flow(lb, v, 0.1),
        lambda v: hodge_decomposition(lb, v).gradient,
        lambda v: lb.connection.components(v),
        lambda v: lb.connection.vectors(v[:, 1:].flatten()),
    ]
    for call in calls:
        for given in (up, up > 0):
            torch.testing.assert_close(call(given), call(up.double()))


def test_tangent_fields_keep_their_type_under_autocast():
    lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(700)).to(torch.float32)
    v = lb.points.roll(1, 1)
    expected = vector_heat_flow(lb, v, 0.1), lb.curvatures().directions
    lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(700)).to(torch.float32)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = vector_heat_flow(lb, v, 0.1), lb.curvatures().directions
        assert lb.eigenbasis(5).eigenvalues.dtype == torch.float32
    for one, other in zip(found, expected, strict=True):
        assert one.dtype == torch.float32
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)
