"""The weak pair: K symmetric, K1 = 0, K ≥ 0, M > 0 on any mesh, and of high order on those that resolve a surface."""

from functools import cache

import igl
import numpy as np
import pytest
import torch
from scipy import linalg, sparse
from scipy.sparse.linalg import eigsh

from tolerances import TOLERANCE
from torchlb import InputError, LaplaceBeltrami
from torchlb.galerkin import flips
from torchlb.galerkin.boundary import boundary_curves_plan, lagrange
from torchlb.galerkin.elements import lattice, simplex
from torchlb.galerkin.flips import flipped
from torchlb.galerkin.pair import mesh_pair
from torchlb.geometry.boundary import open_sides
from torchlb.geometry.fit_search import FitSearch
from torchlb.geometry.frames import complete_frames, vertex_normals
from torchlb.geometry.neighbors import GraphNeighborhoods, mesh_graph
from torchlb.surfaces import CliffordTorus, Hemisphere, Sphere, Torus, UnitDisk, deserno_points


def pair_of(lb):
    """(K, M) as scipy matrices."""
    shape = (lb.num_points, lb.num_points)
    where = lb.weak.col.numpy(), lb.weak.crow.numpy()
    return [
        sparse.csc_array(sparse.csr_array((v.numpy(), *where), shape=shape))
        for v in lb.weak.values[:2]
    ]


def eigenvalues(lb, k):
    fixed = lb.fixed
    free = np.arange(lb.num_points) if fixed is None else np.flatnonzero(~fixed.numpy())
    stiffness, mass = (matrix[free][:, free] for matrix in pair_of(lb))
    return np.sort(eigsh(stiffness, k, mass, sigma=-0.01)[0])


def noisy(vertices):
    generator = torch.Generator().manual_seed(0)
    size = 0.3 * (vertices[1:] - vertices[:-1]).norm(dim=1).min()
    return vertices + size * torch.randn(vertices.shape, generator=generator, dtype=vertices.dtype)


def sphere(**_):
    return Sphere().mesh(300)


def with_noise():
    vertices, faces = sphere()
    return noisy(vertices), faces


def with_random_flips():
    """Every fifth edge of a sphere flipped, whatever becomes of the triangles."""
    vertices, faces = sphere()
    faces = faces.clone()
    for number in range(0, len(faces), 5):
        a, b, c = faces[number].tolist()
        other = ((faces == a).any(1) & (faces == b).any(1)).nonzero()[:, 0]
        other = other[other != number]
        if len(other) == 1:
            d = next(v for v in faces[other[0]].tolist() if v not in (a, b))
            if not ((faces == c).any(1) & (faces == d).any(1)).any():
                faces[number] = torch.tensor([c, d, b])
                faces[other[0]] = torch.tensor([d, c, a])
    return vertices, faces


def with_doubled_faces():
    vertices, faces = sphere()
    return vertices, torch.cat([faces, faces[:20]])


def with_zero_area():
    """A vertex in the middle of an edge, and a triangle of no area between."""
    vertices, faces = sphere()
    a, b, _ = faces[0].tolist()
    middle = (vertices[a] + vertices[b])[None] / 2
    n = len(vertices)
    return torch.cat([vertices, middle]), torch.cat([faces, torch.tensor([[a, n, b]])])


def five_at_an_edge():
    angle = torch.arange(5, dtype=torch.float64) * 2 * torch.pi / 5
    around = torch.stack([angle.cos(), angle.sin(), torch.zeros(5, dtype=torch.float64)], 1)
    ends = torch.tensor([[0.0, 0, -1], [0, 0, 1]], dtype=torch.float64)
    return torch.cat([ends, around]), torch.tensor([[0, 1, 2 + i] for i in range(5)])


def two_pieces():
    vertices, faces = sphere()
    return torch.cat([vertices, vertices + 3]), torch.cat([faces, faces + len(vertices)])


def hair():
    """An open strip so thin that mollification is at work."""
    t = torch.arange(30, dtype=torch.float64)[:, None] / 30
    lower = torch.cat([t, 0 * t, t.square()], 1)
    i = torch.arange(29)
    faces = torch.stack(
        [torch.stack([i, i + 1, i + 30], 1), torch.stack([i + 1, i + 31, i + 30], 1)]
    )
    return torch.cat([lower, lower + torch.tensor([0, 1e-7, 0])]), faces.flatten(0, 1)


def tetrahedron():
    corners = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])
    return corners.double(), torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])


SHAPES = [
    sphere,
    with_noise,
    with_random_flips,
    with_doubled_faces,
    with_zero_area,
    five_at_an_edge,
]
SHAPES += [two_pieces, hair, tetrahedron]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("order", [1, 3, 5])
@pytest.mark.parametrize("shape", SHAPES, ids=[getattr(s, "__name__", "") for s in SHAPES])
def test_the_pair_is_symmetric_and_positive_on_anything(shape, order):
    """K = Kᵀ ≥ 0, K1 = 0, M = Mᵀ > 0, as many zero eigenvalues as components, mass > 0 with the sum of M."""
    vertices, faces = shape()
    if order > 1 and len(vertices) < 10:
        pytest.skip("too few points for a stencil")
    lb = LaplaceBeltrami.from_mesh(vertices, faces, order=order)
    stiffness, mass = (matrix.toarray() for matrix in pair_of(lb))
    assert (stiffness == stiffness.T).all()
    assert (mass == mass.T).all()
    np.testing.assert_allclose(stiffness.sum(1), 0, atol=1e-13 * stiffness.diagonal().max())
    scale = np.sqrt(mass.diagonal())
    assert linalg.eigvalsh(mass / scale / scale[:, None]).min() > 1e-9
    spectrum = linalg.eigvalsh(stiffness, mass)
    components = 2 if shape is two_pieces else 1
    zero = np.abs(spectrum[:components]).max()
    assert zero < min(1e-14 * spectrum.max(), spectrum[components] / 100)
    assert (lb.mass > 0).all()
    np.testing.assert_allclose(float(lb.mass.sum()), mass.sum(), rtol=1e-12)


@pytest.mark.parametrize("surface", [Sphere(), Torus(), UnitDisk()], ids=repr)
def test_linear_elements_are_the_cotangent_with_its_full_mass(surface):
    """The pair beside that of quadratic ones: libigl's matrices to rounding, a test of the assembly."""
    vertices, faces = surface.mesh(400)
    frames = complete_frames(vertex_normals(vertices, faces))
    neighborhoods = GraphNeighborhoods(vertices, mesh_graph(faces, len(vertices)), frames)
    pair = mesh_pair(faces, *FitSearch(neighborhoods, 0, (2,)).finish(), 2, (2,))[1].linear
    args = vertices.numpy(), faces.numpy()
    expected = -igl.cotmatrix(*args), igl.massmatrix(*args, igl.MASSMATRIX_TYPE_FULL)
    for values, matrix in zip(pair.values, expected, strict=True):
        ours = sparse.csr_array((values.numpy(), pair.col.numpy(), pair.crow.numpy()))
        assert abs(ours - matrix).max() < 1e-12


@cache
def deserno_mesh(size):
    points = deserno_points(size)
    return points, Sphere().triangulate(points)


CASES = [(1, 3.5, 1.2e-5), (3, 3.8, 1.2e-5), (4, 4.2, 2e-7)]


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(("order", "slope", "finest"), CASES)
def test_eigenvalues_of_the_sphere_converge(order, slope, finest):
    """λ_1 to λ_24 = l(l + 1): the slope over four sizes, and the error at the finest."""
    exact = np.repeat([l * (l + 1.0) for l in range(5)], [1, 3, 5, 7, 9])  # noqa: E741
    errors, sizes = [], [500, 1000, 2000, 4000]
    for size in sizes:
        lb = LaplaceBeltrami.from_mesh(*deserno_mesh(size), order=order)
        errors.append(np.abs(eigenvalues(lb, 25)[1:] / exact[1:] - 1).max())
    assert errors[-1] < finest, errors
    assert -2 * np.polyfit(np.log(sizes), np.log(errors), 1)[0] > slope


@pytest.mark.usefixtures("unchecked")
def test_order_5_has_ten_digits_on_the_sphere():
    """λ_1 to λ_24 at N = 4,000 to 1e-9; method.md has 5e-11 at twice as many."""
    exact = np.repeat([l * (l + 1.0) for l in range(5)], [1, 3, 5, 7, 9])  # noqa: E741
    lb = LaplaceBeltrami.from_mesh(*deserno_mesh(4000), order=5)
    assert np.abs(eigenvalues(lb, 25)[1:] / exact[1:] - 1).max() < 1e-9


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize("condition", ["neumann", "dirichlet"])
@pytest.mark.parametrize(("surface", "order", "slope", "finest"), [
    (UnitDisk(), 1, 3.5, 1e-4),
    (UnitDisk(), 3, 3.5, 5e-5),
    (Hemisphere(), 4, 4.5, 3e-7),
    (Hemisphere(), 5, 6.0, 3e-9),
])  # fmt: skip
def test_domains_with_a_boundary_are_of_high_order_too(surface, order, slope, finest, condition):
    """First 12 eigenvalues, natural Neumann or rows and columns taken out, and curved edges along the rim."""
    exact = surface.eigenvalues(12, condition=condition).numpy()
    errors, sizes = [], [400, 800, 1200, 2107]
    for size in sizes:
        lb = LaplaceBeltrami.from_mesh(*surface.mesh(size), order=order, condition=condition)
        error = np.abs(eigenvalues(lb, 12) - exact)[exact > 0] / exact[exact > 0]
        errors.append(error.max())
    assert errors[-1] < finest, errors
    assert -2 * np.polyfit(np.log(sizes), np.log(errors), 1)[0] > slope


def test_area_and_rim_of_the_disk():
    """Σ mass = π and Σ B = 2π, at the order of the elements; a polygon's would be off by 1e-3."""
    lb = LaplaceBeltrami.from_mesh(*UnitDisk().mesh(500), order=3)
    assert abs(float(lb.mass.sum()) - torch.pi) < 1e-6
    assert abs(float(lb.boundary_mass.to_dense().sum()) - 2 * torch.pi) < 1e-6


def test_a_corner_stays_a_corner():
    """The unit square has area 1 and rim 4 to rounding, at every order."""
    axis = torch.linspace(0, 1, 12, dtype=torch.float64)
    vertices = torch.cartesian_prod(axis, axis)
    i = (torch.arange(11)[:, None] * 12 + torch.arange(11)).flatten()
    faces = torch.cat([torch.stack([i, i + 12, i + 13], 1), torch.stack([i, i + 13, i + 1], 1)])
    for order in (1, 3, 5):
        lb = LaplaceBeltrami.from_mesh(vertices, faces, order=order)
        assert abs(float(lb.mass.sum()) - 1) < 1e-12
        assert abs(float(lb.boundary_mass.to_dense().sum()) - 4) < 1e-12


@pytest.mark.usefixtures("unchecked")
def test_a_rim_whose_spacing_jumps_does_not_swing():
    """A square of cells 21 times as wide as others: curves through both would have weights of thousands."""
    x = np.concatenate([np.linspace(0, 0.5, 4), 0.5 + 0.008 * np.arange(1, 27), [0.854, 1]])
    grid = np.stack(np.meshgrid(x, x, indexing="ij"), -1).reshape(-1, 2)
    i = np.arange(len(grid)).reshape(len(x), len(x))
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    lb = LaplaceBeltrami.from_mesh(grid, faces, order=5)
    stiffness, mass = pair_of(lb)
    linear = lb.weak.linear_pair[2][0].abs().max()
    assert abs(stiffness).max() < 10 * linear
    assert abs(mass).max() < 0.2
    expected = np.pi**2 * np.array([1, 1, 2])
    np.testing.assert_allclose(eigenvalues(lb, 4)[1:], expected, rtol=0.1)


@pytest.mark.parametrize(("order", "bound"), [(1, 2e-4), (3, 2e-4), (5, 5e-7)])
def test_meshes_of_any_codimension_have_a_pair(order, bound):
    """Clifford's torus in R⁴: λ_1 to λ_24, the area, and K about as stiff as that of linear elements."""
    surface = CliffordTorus()
    vertices, faces = surface.mesh(2000)
    lb = LaplaceBeltrami.from_mesh(vertices, faces, order=order)
    assert lb.certificate is None
    error = eigenvalues(lb, 25)[1:] / surface.eigenvalues(25)[1:].numpy() - 1
    assert np.abs(error).max() < bound
    assert abs(float(lb.mass.sum()) / surface.area - 1) < bound
    stiffness, _ = pair_of(lb)
    if order < 4:
        assert stiffness.nnz < (60 if order == 1 else 90) * 2000
    crow, col, (linear, _) = lb.weak.linear_pair
    linear = sparse.csr_array((linear.numpy(), col.numpy(), crow.numpy())).diagonal()
    assert (stiffness.diagonal() < 2.5 * linear).all()


def test_curves_of_the_rim_reproduce_polynomials_of_arc_length():
    """Weights sum to one, and a straight rim of uneven steps gives its own points back."""
    x = torch.tensor([0.0, 1, 1.5, 2.7, 4, 5.5], dtype=torch.float64)
    points = torch.stack([x, 0 * x, 0 * x], 1)
    rim = torch.stack([torch.arange(5), torch.arange(1, 6)], 1)
    curves = boundary_curves_plan(points, rim, 4)
    share = torch.full((5, 1), 0.3, dtype=torch.float64)
    weights = lagrange(curves.arcs(points), curves.valid, share)
    places = (weights * x[curves.index][:, None]).sum(-1)[:, 0]
    torch.testing.assert_close(places, x[:-1] + 0.3 * x.diff(), **TOLERANCE[torch.float64])
    cubic = (weights * (x[curves.index] ** 3)[:, None]).sum(-1)[:, 0]
    torch.testing.assert_close(cubic, places**3, **TOLERANCE[torch.float64])


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_elements_integrate_and_differentiate_polynomials(degree):
    """Σ φ_i = 1, Σ ∇φ_i = 0, and ∫ x^r over the reference triangle is 1/((r + 1)(r + 2))."""
    shape, nodes = simplex(2, degree), lattice(2, degree)
    torch.testing.assert_close(shape.values.sum(1), torch.ones_like(shape.weights))
    assert shape.gradients.sum(1).abs().max() < 1e-12
    power = shape.values @ nodes[:, 1] ** degree
    assert abs(float(shape.weights @ power) - 1 / (degree + 1) / (degree + 2)) < 1e-14
    assert abs(float(simplex(1, degree).weights.sum()) - 1) < 1e-14


def test_a_folded_triangle_is_flipped_away():
    """A vertex pulled over the opposite edge of a flat patch: the flip unfolds it; a good mesh stays as it is."""
    axis = torch.arange(6, dtype=torch.float64)
    vertices = torch.nn.functional.pad(torch.cartesian_prod(axis, axis), (0, 1))
    i = (torch.arange(5)[:, None] * 6 + torch.arange(5)).flatten()
    faces = torch.cat([torch.stack([i, i + 6, i + 7], 1), torch.stack([i, i + 7, i + 1], 1)])
    assert torch.equal(flipped(vertices, faces), faces)
    vertices[14] += torch.tensor([0.8, -0.8, 0])
    corners = vertices[flipped(vertices, faces)]
    up = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    before = vertices[faces]
    was = torch.linalg.cross(before[:, 1] - before[:, 0], before[:, 2] - before[:, 0])[:, 2]
    assert (was < 0).any()
    assert (up > 0).all()


def test_scaling_and_turning():
    """K has no unit and M is an area: under x → 2Rx, K stays and M grows fourfold."""
    vertices, faces = Torus().mesh(500)
    turn = linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    one = LaplaceBeltrami.from_mesh(vertices, faces)
    two = LaplaceBeltrami.from_mesh(2 * vertices @ torch.from_numpy(turn), faces)
    difference = (one.stiffness.to_dense() - two.stiffness.to_dense()).abs().max()
    assert difference < 1e-9
    assert (4 * one.mass_matrix.to_dense() - two.mass_matrix.to_dense()).abs().max() < 1e-10


def test_a_plane_is_a_plane_in_space():
    """A mesh in R² has the pair of the same mesh in R³."""
    vertices, faces = UnitDisk().mesh(300)
    flat = LaplaceBeltrami.from_mesh(vertices[:, :2].contiguous(), faces)
    space = LaplaceBeltrami.from_mesh(vertices, faces)
    assert (flat.stiffness.to_dense() - space.stiffness.to_dense()).abs().max() < 1e-9


def test_blocks_of_any_size_make_the_same_pair(monkeypatch):
    """Of a hemisphere of one block, and of many with a rest, in all that is done a few at a time."""
    vertices, faces = Hemisphere().mesh(500)
    whole = LaplaceBeltrami.from_mesh(vertices, faces)
    rooms = ("assembly", "curving")
    for module in (*(f"galerkin.{room}" for room in rooms), "stencils.shape"):
        monkeypatch.setattr(f"torchlb.{module}.AT_ONCE", 70)
    parts = LaplaceBeltrami.from_mesh(vertices, faces)
    assert whole.weak.col.equal(parts.weak.col)
    for one, two in zip(whole.weak.values, parts.weak.values, strict=True):
        assert (one - two).abs().max() < 1e-12 * one.abs().max()


def test_report_of_the_pair():
    """All edges of a resolved sphere are curved, its fits of degree 4; the numbers are in the printed report."""
    report = LaplaceBeltrami.from_mesh(*Sphere().mesh(500)).report
    assert report.curved_share == 1
    assert report.fit_counts == {4: 500}
    assert "100.00 % of the edges curved" in repr(report)
    cube = LaplaceBeltrami.from_mesh(*with_noise()).report
    assert cube.curved_share < 1


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_pair_travels(dtype):
    """In a state, in a batch and back, in another floating type."""
    shapes = [s.mesh(200) for s in (Sphere(), UnitDisk())]
    one, two = (LaplaceBeltrami.from_mesh(v, f, order=1).to(dtype) for v, f in shapes)
    batch = LaplaceBeltrami.batch([one, two])
    assert batch.stiffness.dtype == dtype
    expected = torch.block_diag(one.mass_matrix.to_dense(), two.mass_matrix.to_dense())
    assert torch.equal(batch.mass_matrix.to_dense(), expected)
    for before, after in zip((one, two), batch.unbatch(), strict=True):
        assert torch.equal(before.weak.values, after.weak.values)
        assert torch.equal(before.weak.linear.col, after.weak.linear.col)
    empty = LaplaceBeltrami()
    empty.load_state_dict(two.state_dict())
    assert torch.equal(empty.boundary_mass.to_dense(), two.boundary_mass.to_dense())


def test_what_has_no_pair_or_no_boundary_says_so():
    bare = LaplaceBeltrami.from_mesh(*Sphere().mesh(100), order=1, weak_form=False)
    assert not bare._has_weak_form
    assert bare.certificate is None
    with pytest.raises(InputError, match="no weak pair"):
        _ = bare.stiffness
    with pytest.raises(InputError, match="3 points are fewer"):
        LaplaceBeltrami.from_mesh(torch.eye(3), torch.tensor([[0, 1, 2]]))
    with pytest.raises(InputError, match="closed"):
        _ = LaplaceBeltrami.from_mesh(*Sphere().mesh(100), order=1).boundary_mass


def test_a_certificate_beside_the_pair():
    """certify=True: π is then the mass, whose sum is that of the pair."""
    lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(300), certify=True)
    assert lb.certificate.holds
    assert lb._has_weak_form
    assert (lb.mass @ lb.matrix.to_dense()).abs().max() < 1e-8
    np.testing.assert_allclose(
        float(lb.mass.sum()), float(lb.mass_matrix.to_dense().sum()), rtol=1e-9
    )


def test_lengths_are_mollified_by_component():
    """A sphere beside one a million times as large, and a triangle without area: each keeps its own area."""
    vertices, faces = Sphere().mesh(300)
    small = 1e-6 * vertices + torch.tensor([3.0, 0, 0]).double()
    flat = torch.tensor([[5.0, 0, 0], [5.5, 0, 0], [6.0, 0, 0], [5.5, 0.5, 0]]).double()
    points = torch.cat([vertices, small, flat])
    corners = torch.cat([faces, faces + 300, torch.tensor([[600, 601, 602], [600, 602, 603]])])
    alone = LaplaceBeltrami.from_mesh(vertices, faces, order=2).mass.sum()
    mass = LaplaceBeltrami.from_mesh(points, corners, order=2).mass
    torch.testing.assert_close(mass[:300].sum(), alone)
    torch.testing.assert_close(mass[300:600].sum() * 1e12, alone, rtol=1e-6, atol=0.0)


def test_flips_end(monkeypatch):
    """An edge that was flipped away does not come back, though normals change between: faces of a crumpled sheet."""
    x, y = torch.cartesian_prod(torch.arange(20), torch.arange(20)).double().T
    z = torch.randn(400, generator=torch.Generator().manual_seed(1)).double() / 2
    number = torch.arange(400).view(20, 20)
    low, right, up, far = (
        part.flatten()
        for part in (number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:])
    )
    faces = torch.cat([torch.stack([low, right, far], 1), torch.stack([low, far, up], 1)])
    vertices = torch.stack([x, y, z], 1)
    rounds = []
    one_round = flips._flips
    monkeypatch.setattr(flips, "_flips", lambda *a: rounds.append(a) or one_round(*a))
    after = flipped(vertices, faces)
    assert 1 < len(rounds) < 10
    assert len(open_sides(after)[0]) == len(open_sides(faces)[0])
