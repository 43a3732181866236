"""Kernels and what stands in for them: the same to the bit, whichever a process takes."""

import itertools
import math
import os
import subprocess
import sys
import time

import mpmath
import numpy as np
import pytest
import torch
from scipy import sparse
from scipy.spatial import ConvexHull

from torchlb import LaplaceBeltrami, compiled
from torchlb.cloud import delaunay
from torchlb.cloud.cocone import best_manifold
from torchlb.cloud.delaunay import delaunay_tetrahedra
from torchlb.fits.least_squares import left_inverse
from torchlb.fits.polynomials import monomial_columns, monomials
from torchlb.fits.weights import scaled_system
from torchlb.galerkin import pair
from torchlb.galerkin.pair import stored, upper_product
from torchlb.geometry.admission import admissible
from torchlb.geometry.complex import components, edges_of, spanning_pairs, tree_sides
from torchlb.geometry.numbering import Numbering
from torchlb.linalg.sparse import both_products
from torchlb.surfaces import Hemisphere


@pytest.fixture
def both(monkeypatch):
    """A function of what to compute: that without kernels, and with them."""
    pytest.importorskip("numba")

    def computed(function, name):
        found = []
        for patience in (math.inf, 0):
            monkeypatch.setattr(compiled, "PATIENCE", patience)
            assert (compiled.kernel(name) is None) == (patience > 0)
            found.append(function())
        return found

    return computed


@pytest.mark.parametrize(("dim", "degree"), [(1, 3), (2, 1), (2, 4), (2, 8), (3, 2)])
@pytest.mark.parametrize("batch", [0, 1, 2, 64, 300])
def test_left_inverses_are_the_same_to_the_bit(dim, degree, batch, both):
    coords = torch.randn(batch, 90, dim, dtype=torch.float64)
    coords[1::7, :, 0] = 0.0  # on a line, and in a point: what is left has to be the same, too
    _, _, values, root = scaled_system(coords, degree)
    one, other = both(lambda: left_inverse(values, root), "left_inverse")
    for x, y in zip(one, other, strict=True):
        assert torch.equal(x.view(torch.int64) * ~x.isnan(), y.view(torch.int64) * ~y.isnan())


@pytest.mark.parametrize("degree", [1, 2, 4, 8])
def test_left_inverses_are_as_accurate_as_their_condition_allows(degree):
    """Every row, beside one computed with 50 digits."""
    mpmath.mp.dps = 50
    coords = torch.randn(2, int(0.8 * (degree + 1) * (degree + 2)), 2, dtype=torch.float64)
    _, _, values, root = scaled_system(coords, degree)
    inverse, condition = left_inverse(values, root)
    for v, w, found, bound in zip(values, root, inverse, condition, strict=True):
        v = mpmath.matrix(v.tolist())
        weighted = v.T * mpmath.diag([mpmath.mpf(x) ** 2 for x in w.tolist()])
        exact = torch.tensor(((weighted * v) ** -1 * weighted).tolist(), dtype=torch.float64)
        error = ((found - exact).norm(dim=1) / exact.norm(dim=1)).max()
        assert error < torch.finfo(torch.float64).eps * 2 * bound


def test_upper_products_are_the_same_to_the_bit(both, monkeypatch):
    """With few entries at a time, zeros that cancel, and columns that do not ascend."""
    generator = np.random.default_rng(0)
    p = sparse.csr_array(sparse.random_array((400, 90), density=0.05, rng=generator))
    matrix = sparse.random_array((400, 400), density=0.02, rng=generator)
    matrix = sparse.csr_array(matrix + matrix.T + 1j * sparse.eye_array(400))
    matrix.data[::5] = 0.0
    shuffled = p[:, ::-1]
    shuffled.indices = 89 - shuffled.indices
    monkeypatch.setattr(pair, "ROOM", 200)
    monkeypatch.setattr(pair, "ROWS", 40)
    one, other = both(lambda: upper_product(shuffled.copy(), matrix), "upper_product")
    expected = sparse.triu(p.T @ matrix @ p)
    assert abs(one - expected).max() < 1e-14 * abs(expected).max()
    for x in (one, other):
        x.sort_indices()
    assert np.array_equal(one.indptr, other.indptr)
    assert np.array_equal(one.indices, other.indices)
    assert np.array_equal(one.data, other.data)


@pytest.mark.parametrize("columns", [0, 1, 9])
def test_both_products_are_the_same_to_the_bit(columns, both):
    generator = np.random.default_rng(columns)
    k = sparse.csr_array(sparse.random_array((300, 300), density=0.05, rng=generator))
    m = sparse.csr_array((generator.standard_normal(k.nnz), k.indices, k.indptr), shape=k.shape)
    x = generator.standard_normal((columns, 300)).T
    one, other = both(lambda: both_products(k, m, x), "both_products")
    for a, b, matrix in zip(one, other, (k, m), strict=True):
        assert np.array_equal(a, b)
        np.testing.assert_allclose(a, matrix.toarray() @ x, atol=1e-13)
    assert np.array_equal(both_products(k, sparse.eye_array(300).tocsr(), x)[1], x)


@pytest.mark.parametrize("count", [1, 200])
def test_mirrored_matrices_are_the_same_to_the_bit(count, both):
    """Symmetric, rows of K sum to zero, in whatever order points are numbered."""
    generator = np.random.default_rng(count)
    parts = [sparse.random_array((count, count), density=0.1, rng=generator) for _ in range(2)]
    upper = sparse.triu(parts[0] + 1j * parts[1]) + (1 + 1j) * sparse.eye_array(count)
    numbering = Numbering.along_tree(torch.rand(count, 3, dtype=torch.float64))
    for given in (None, numbering):
        one, other = both(lambda given=given: stored(upper, None, given), "mirrored")
        for name, x in vars(one).items():
            assert torch.equal(x, vars(other)[name])
        shape = (count, count)
        k, m = (sparse.csr_array((v, one.col, one.crow), shape).toarray() for v in one.values)
        assert np.array_equal(k, k.T)
        assert np.abs(k.sum(1)).max() < 1e-14 * max(np.abs(k).max(), 1)
        whole = (upper + upper.T).imag.toarray() / (1 + np.eye(count))
        place = np.arange(count) if given is None else given.here.numpy()
        assert np.array_equal(m, whole[np.ix_(place, place)])


def test_manifolds_are_the_same(both):
    """Of random triangles, most of which do not fit to others, and of none."""
    points = np.random.default_rng(0).standard_normal((60, 3))
    some = np.array([c for c in itertools.combinations(range(60), 3) if sum(c) % 7 == 0])
    for faces in (some, some[:0], np.random.default_rng(1).permutation(some)):
        one, other = both(lambda faces=faces: best_manifold(points, faces), "best_manifold")
        assert np.array_equal(one, other)
        assert len(one) >= min(len(faces), 60)
        if len(one):
            assert edges_of(one, 60).uses.max() == 2


@pytest.mark.parametrize(("count", "pairs"), [(0, 0), (1, 0), (9, 5), (80, 50), (80, 400)])
def test_components_and_sides_are_the_same(count, pairs, both):
    """And sides are consistent: as every pair that closed no circle says."""
    generator = np.random.default_rng(pairs)
    i, j = generator.integers(0, max(count, 1), (2, pairs))
    i, j = i[i != j], j[i != j]
    against = generator.random(len(i)) < 0.4
    one, other = both(lambda: components(i, j, count), "components")
    assert np.array_equal(one, other)
    assert (one[i] == one[j]).all()
    one, other = both(lambda: tree_sides(i, j, against, count), "components")
    assert np.array_equal(one, other)
    chosen = spanning_pairs(i, j, count)
    assert np.array_equal(one[i[chosen]] ^ one[j[chosen]], against[chosen])


@pytest.mark.parametrize("faces", [[], [[2, 0, 5]], [[0, 1, 2], [1, 3, 2], [1, 2, 4], [2, 1, 0]]])
def test_edges_are_the_same(faces, both):
    """Also of edges with more than two faces, and of faces that are there twice."""
    some = np.random.default_rng(0).integers(0, 40, (300, 3))
    for triangles in (np.array(faces, dtype=np.int64).reshape(-1, 3), some):
        one, other = both(lambda f=triangles: edges_of(f, 41), "edges")
        for name in ("keys", "of", "uses", "order"):
            assert np.array_equal(getattr(one, name), getattr(other, name))
        assert (one.keys[one.of] == one.keys.repeat(one.uses)[np.argsort(one.order)]).all()
        assert one.uses.sum() == triangles.size


def normalized(vectors):
    return vectors / np.linalg.norm(vectors, axis=1)[:, None]


def near(points, random):
    """Moved by a hundred-thousandth, into general position."""
    return points + 1e-5 * random.standard_normal(points.shape)


CLOUDS = {
    "cube": lambda random: random.random((700, 3)),
    "far away": lambda random: random.random((300, 3)) + 1e5,
    "sphere": lambda random: near(normalized(random.standard_normal((900, 3))), random),
    "grid": lambda random: near(np.stack(np.meshgrid(*[np.arange(6.0)] * 3), -1), random).reshape(
        -1, 3
    ),
    "flat": lambda random: random.random((400, 3)) * [1.0, 1.0, 1e-6],
    "sheets": lambda random: random.random((500, 3)) * [1, 1, 0.1] + np.arange(500)[:, None] % 2,
    "few": lambda random: random.random((5, 3)),
    "four": lambda random: random.random((4, 3)),
}


def compiled_tetrahedra(points, room=None):
    """Corners and neighbours; both without rows where there is no result."""
    kernel = pytest.importorskip("torchlb.compiled.delaunay").delaunay
    return kernel(points, delaunay._by_rounds(points), room or delaunay.ROOM * len(points) + 256)


@pytest.mark.parametrize("name", CLOUDS)
def test_tetrahedra_are_the_same_and_delaunay(name):
    """They fill the convex hull, each is beside those with its faces, and no sphere contains a point."""
    points = CLOUDS[name](np.random.default_rng(0))
    cells, beside = compiled_tetrahedra(points)
    for x, y in zip((cells, beside), delaunay._by_qhull(points), strict=True):
        assert np.array_equal(x, y)
    corners = points[cells]
    sides = corners[:, 1:] - corners[:, :1]
    volume = np.abs(np.linalg.det(sides)) / 6
    assert volume.sum() == pytest.approx(ConvexHull(points).volume, rel=1e-9)
    center = np.linalg.solve(sides, (sides**2).sum(2)[..., None] / 2)[..., 0] + corners[:, 0]
    radius = np.linalg.norm(center - corners[:, 0], axis=1)
    for part in np.array_split(np.arange(len(cells)), 20):
        distance = np.linalg.norm(points - center[part, None], axis=2)
        assert (distance > (1 - 1e-7) * radius[part, None]).all()
    assert_beside(cells, beside)


def assert_beside(cells, beside):
    for cell, numbers in zip(cells, beside, strict=True):
        for corner, number in zip(cell, numbers, strict=True):
            if number >= 0:
                assert len(set(cells[number]) & set(cell) - {corner}) == 3


def test_where_signs_are_in_doubt_there_are_no_tetrahedra_or_they_are_whole():
    """Of points from near to 10 to the power 10 away, where faces of the hull can be in doubt."""
    found = 0
    for seed in range(300):
        random = np.random.default_rng(seed)
        far = random.standard_normal((8, 3)) * 10.0 ** random.integers(1, 11, (8, 1))
        points = near(np.concatenate([normalized(random.standard_normal((30, 3))), far]), random)
        cells, beside = compiled_tetrahedra(points)
        found += len(cells) > 0
        if len(cells):
            assert_beside(cells, beside)
            assert set(cells.ravel()) == set(range(38))
    assert 30 < found < 300


def test_where_there_are_no_tetrahedra_qhull_finds_them(both):
    """On a grid, where nothing is in general position; and where they are more than there is room for."""
    grid = np.stack(np.meshgrid(*[np.arange(5.0)] * 3), -1).reshape(-1, 3)
    crossing = np.zeros((2, 150, 3))
    crossing[0, :, 0] = crossing[1, :, 1] = np.linspace(0, 1, 150)
    crossing[1, :, 2] = 1
    crossing += 1e-7 * np.random.default_rng(0).standard_normal(crossing.shape)
    crossing = crossing.reshape(-1, 3)
    assert len(compiled_tetrahedra(crossing, room=2**16)[0]) > delaunay.ROOM * 300 + 256
    for points in (grid, crossing):
        assert len(compiled_tetrahedra(points)[0]) == 0
        one, other = both(lambda p=points: delaunay_tetrahedra(p), "delaunay")
        for x, y in zip(one, other, strict=True):
            assert np.array_equal(x, y)
        assert len(other[0]) > len(points)


def test_admission_is_the_same(both):
    """In R², R³ and R⁴, and at points that coincide."""
    for n in (2, 3, 4):
        points, normals = torch.randn(2, 300, n, dtype=torch.float64)
        points[::9] = points[0]
        normals = normals / normals.norm(dim=1, keepdim=True)
        pairs = torch.randint(0, 300, (2, 5000))
        one, other = both(lambda a=points, b=normals, c=pairs: admissible(a, b, *c), "admissible")
        assert torch.equal(one, other)
        assert 0 < one.sum() < 5000
    # Heights of half the distance, and near it.
    grid = torch.cartesian_prod(*[torch.arange(4, dtype=torch.float64)] * 3)
    normals = torch.tensor([[0.6, 0.0, 0.8], [0.0, 0.0, 1.0]], dtype=torch.float64).repeat(32, 1)
    pairs = torch.cartesian_prod(torch.arange(64), torch.arange(64)).T
    one, other = both(lambda: admissible(grid, normals, *pairs), "admissible")
    assert torch.equal(one, other)


@pytest.mark.parametrize(("dim", "degree"), [(1, 3), (2, 1), (2, 6), (3, 4)])
@pytest.mark.parametrize("batch", [0, 1, 50])
def test_monomials_are_the_same(dim, degree, batch, both):
    coords = torch.randn(batch, 12, dim, dtype=torch.float64)
    one, other = both(lambda: monomial_columns(coords, degree), "monomials")
    assert torch.equal(one, other)
    assert torch.equal(one, monomials(coords, degree))


@pytest.mark.parametrize("on_mesh", [True, False])
def test_operators_are_the_same_to_the_bit(on_mesh, both):
    vertices, faces = Hemisphere().mesh(400)

    def built():
        if on_mesh:
            return LaplaceBeltrami.from_mesh(vertices, faces).state_dict()
        return LaplaceBeltrami.from_points(vertices).state_dict()

    one, other = both(built, "graph_balls")
    assert one.keys() == other.keys()
    for name, x in one.items():
        if isinstance(x, torch.Tensor):
            torch.testing.assert_close(x, other[name], rtol=0, atol=0, equal_nan=True, msg=name)


def test_time_within_time_counts_once(monkeypatch):
    monkeypatch.setattr(compiled, "_spent", [0.0])
    start = time.perf_counter()
    with compiled.standing_in(), compiled.standing_in():
        time.sleep(0.02)
    assert 0.02 <= compiled._spent[0] <= time.perf_counter() - start


def test_without_numba_all_works(monkeypatch):
    monkeypatch.setattr(compiled, "PATIENCE", 0)
    for name in compiled.KERNELS:
        monkeypatch.setitem(sys.modules, f"torchlb.compiled.{name}", None)
    monkeypatch.setattr(compiled, "_loaded", compiled._loaded.__wrapped__)
    assert not compiled.prepare()
    lb = LaplaceBeltrami.from_mesh(*Hemisphere().mesh(300))
    assert (lb.mass.sum() - 2 * math.pi).abs() < 1e-3


def test_where_numba_does_not_compile_there_are_no_kernels():
    pytest.importorskip("numba")
    program = "from torchlb import compiled; print(compiled.prepare())"
    for disabled, expected in (("0", "True"), ("1", "False")):
        environment = os.environ | {"NUMBA_DISABLE_JIT": disabled}
        command = [sys.executable, "-c", program]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        assert done.stdout.strip() == expected


def test_kernels_are_loaded_when_waiting_took_as_long(monkeypatch):
    pytest.importorskip("numba")
    monkeypatch.setattr(compiled, "_spent", [0.0])
    monkeypatch.setattr(compiled, "PATIENCE", 1e-3)
    assert compiled.kernel("left_inverse") is None
    while compiled._spent[0] < 1e-3:
        before = compiled._spent[0]
        left_inverse(torch.ones(1, 2, 1).double(), torch.ones(1, 2).double())
        assert compiled._spent[0] > before
    assert compiled.kernel("left_inverse") is not None
