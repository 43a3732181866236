"""Compiled loops, and what sorts, joins and chooses pairs and triangles, beside definitions."""

import itertools

import mpmath
import numba
import numpy as np
import pytest
import torch
from scipy import sparse

from torchlb.cloud.cocone import best_manifold, conormals
from torchlb.fits.weights import left_inverse, scaled_system
from torchlb.galerkin import assembly
from torchlb.galerkin.pair import Pattern
from torchlb.geometry.compatibility import compatible, plucker_coordinates
from torchlb.geometry.complex import components, edges_of, spanning_pairs, tree_sides
from torchlb.geometry.thresholds import CREASE, HALF_CREASE
from torchlb.linalg import kernels


def test_without_a_place_for_it_what_is_compiled_is_not_kept(monkeypatch):
    def njit(signature, cache=False, **options):
        def refused(function):
            raise RuntimeError("no locator available")

        return refused if cache else numba.njit(signature, **options)

    monkeypatch.setattr(kernels, "njit", njit)
    assert kernels.compiled_for("float64(float64)")(lambda x: x + 1)(2.0) == 3.0


@pytest.mark.parametrize(("dim", "degree"), [(1, 3), (2, 1), (2, 4), (2, 8), (3, 2)])
@pytest.mark.parametrize("batch", [0, 1, 2, 64, 100])
def test_left_inverses_are_those_of_normal_equations_by_qr(dim, degree, batch):
    """And the condition is ‖R⁻¹‖ of columns of length one; a set on a line leaves the others as they are."""
    coords = torch.randn(batch, 90, dim, dtype=torch.float64)
    _, values, root = scaled_system(coords, degree)
    values[7::64] = 0.0
    inverse, condition = left_inverse(values, root)
    regular = torch.ones(batch, dtype=torch.bool)
    regular[7::64] = False
    q, r = torch.linalg.qr(root[..., None] * values)
    back = torch.linalg.inv(r[regular])
    expected = back @ q[regular].mT * root[regular][:, None]
    scale = expected.abs().amax((1, 2), keepdim=True)
    assert ((inverse[regular] - expected).abs() <= 1e-11 * scale).all()
    length = torch.linalg.vector_norm(r[regular], dim=1)
    torch.testing.assert_close(condition[regular], (length[..., None] * back).norm(dim=(1, 2)))
    assert not inverse[~regular].isfinite().any()


@pytest.mark.parametrize("degree", [1, 2, 4, 8])
def test_left_inverses_are_as_accurate_as_their_condition_allows(degree):
    """Every row, beside one computed with 50 digits."""
    mpmath.mp.dps = 50
    many = 1 if degree == 8 else 2
    coords = torch.randn(many, int(0.8 * (degree + 1) * (degree + 2)), 2, dtype=torch.float64)
    _, values, root = scaled_system(coords, degree)
    inverse, condition = left_inverse(values, root)
    for v, w, found, bound in zip(values, root, inverse, condition, strict=True):
        v = mpmath.matrix(v.tolist())
        weighted = v.T * mpmath.diag([mpmath.mpf(x) ** 2 for x in w.tolist()])
        exact = torch.tensor(((weighted * v) ** -1 * weighted).tolist(), dtype=torch.float64)
        error = ((found - exact).norm(dim=1) / exact.norm(dim=1)).max()
        assert error < torch.finfo(torch.float64).eps * 2 * bound


@pytest.mark.parametrize(("count", "density"), [(300, 0.3), (90, 0.05)])
def test_products_with_element_matrices_are_those_with_the_assembled_ones(count, density):
    """Upper triangle of PᵀAP for two lots of elements, whose rows are longer than was foreseen, or empty."""
    generator = np.random.default_rng(0)
    p = sparse.csr_array(sparse.random_array((400, count), density=density, rng=generator))
    lots, total = [], sparse.csr_array((400, 400), dtype=complex)
    for elements, size in ((150, 4), (40, 2)):
        nodes = torch.from_numpy(generator.integers(0, 400, (elements, size)))
        blocks = torch.randn(elements, size, size, dtype=torch.complex128)
        blocks = (blocks + blocks.mT).flatten(1)
        lots.append(assembly.ElementMatrices(nodes, blocks))
        total = total + assembly.summed(blocks, nodes, 400)
    found = assembly.upper_congruence(p, lots)
    expected = sparse.triu(p.T @ total @ p)
    assert abs(found - expected).max() < 1e-14 * abs(expected).max()
    sums = sum(lot.row_sums(400) for lot in lots)
    np.testing.assert_allclose(sums, total.imag.sum(axis=1), atol=1e-13)


@pytest.mark.parametrize("count", [1, 200])
def test_stored_matrices_are_symmetric(count):
    """Exactly, and rows of K sum to zero; from the upper triangle, columns in any order."""
    generator = np.random.default_rng(count)
    parts = [sparse.random_array((count, count), density=0.1, rng=generator) for _ in range(2)]
    matrix = sparse.csr_array(parts[0] + 1j * parts[1])
    matrix = sparse.csr_array(matrix + matrix.T + (1 + 1j) * sparse.eye_array(count))
    matrix.data *= 1 + 1e-15 * generator.standard_normal(len(matrix.data))
    upper = sparse.triu(matrix, format="csr")[:, ::-1][:, ::-1]
    one = Pattern.of(upper, torch.arange(count)).pair(upper)
    k, m = (sparse.csr_array((v, one.col, one.crow), 2 * (count,)).toarray() for v in one.values)
    assert np.array_equal(k, k.T)
    assert np.array_equal(m, m.T)
    assert np.abs(k.sum(1)).max() < 1e-14 * max(np.abs(k).max(), 1)
    np.testing.assert_allclose(m, matrix.imag.toarray(), rtol=1e-14, atol=1e-15)


def one_by_one(points, faces):
    """`best_manifold` by its definition: of every edge the tips of the triangles that were taken."""
    chosen, tips = [], {}

    def way(tip, edge):
        return conormals(points, *np.array([[tail] for tail in edge]), np.array([tip]))[0]

    for a, b, c in faces.tolist():
        sides = [
            (a, (min(b, c), max(b, c))),
            (b, (min(a, c), max(a, c))),
            (c, (min(a, b), max(a, b))),
        ]
        there = [(tip, other, edge) for tip, edge in sides for other in tips.get(edge, [])]
        full = any(len(tips.get(edge, [])) > 1 for _, edge in sides)
        if not full and all(way(x, e) @ way(y, e) <= CREASE for x, y, e in there):
            chosen.append([a, b, c])
            for tip, edge in sides:
                tips.setdefault(edge, []).append(tip)
    return np.array(chosen, dtype=int).reshape(-1, 3)


def test_manifolds_take_the_best_triangles_one_by_one():
    """Of random triangles, most of which do not fit to others, and of none."""
    points = np.random.default_rng(0).standard_normal((30, 3))
    some = np.array([c for c in itertools.combinations(range(30), 3) if sum(c) % 7 == 0])
    for faces in (some, some[:0], np.random.default_rng(1).permutation(some)):
        found = best_manifold(points, faces)
        assert np.array_equal(found, one_by_one(points, faces))
        assert len(found) >= min(len(faces), 30)


@pytest.mark.parametrize(("count", "pairs"), [(0, 0), (1, 0), (9, 5), (80, 50), (80, 400)])
def test_components_and_sides_are_consistent(count, pairs):
    """Joined nodes are in one component, sides are as every pair says that closed no circle with those before."""
    generator = np.random.default_rng(pairs)
    i, j = generator.integers(0, max(count, 1), (2, pairs))
    i, j = i[i != j], j[i != j]
    against = generator.random(len(i)) < 0.4
    label, chosen, rank = np.arange(count), [], components(i, j, count)
    for number, (a, b) in enumerate(zip(i, j, strict=True)):
        if label[a] != label[b]:
            chosen.append(number)
            label[label == label[b]] = label[a]
    assert sorted(spanning_pairs(i, j, count)) == chosen
    assert np.array_equal(rank[:, None] == rank, label[:, None] == label)
    sides = tree_sides(i, j, against, count)
    assert np.array_equal(sides[i[chosen]] ^ sides[j[chosen]], against[chosen])
    assert not sides[np.unique(label, return_index=True)[1]].any()


@pytest.mark.parametrize("faces", [[], [[2, 0, 5]], [[0, 1, 2], [1, 3, 2], [1, 2, 4], [2, 1, 0]]])
def test_edges_are_those_of_all_pairs(faces):
    """Also of edges with more than two faces, and of faces that are there twice."""
    some = np.random.default_rng(0).integers(0, 40, (300, 3))
    for triangles in (np.array(faces, dtype=np.int64).reshape(-1, 3), some):
        found = edges_of(triangles, 41)
        tail, head = found.ends
        key = np.minimum(tail, head) * 41 + np.maximum(tail, head)
        keys, of, uses = np.unique(key, return_inverse=True, return_counts=True)
        for one, other in zip((found.keys, found.of, found.uses), (keys, of, uses), strict=True):
            assert np.array_equal(one, other)
        assert np.array_equal(found.order, key.argsort(kind="stable"))


def grown(points, frames, sides, graph, center, size, wanted, rings):
    """A k-hop neighbourhood by its definition, ring by ring."""
    planes = frames if frames.shape[2] < points.shape[1] else torch.zeros_like(points)
    ball, ring = [center], [center]
    for _ in range(rings):
        near = sorted({int(j) for i in ring for j in graph[[i]].indices} - set(ball))
        near = torch.tensor(near, dtype=torch.int64)
        start = torch.full_like(near, center)
        good = (sides[near] @ sides[center]) >= 0
        if frames.shape[1] > frames.shape[2]:
            good &= compatible(points, planes, start, near)
        ring = near[good].tolist()
        ball += ring
        if len(ball) >= wanted or not ring:
            break
    distance = (points[ball] - points[center]).square().sum(1)
    distance[0] = -1.0
    order = sorted(range(len(ball)), key=lambda k: (float(distance[k]), ball[k]))
    return [ball[k] for k in order[:size]]


@pytest.mark.parametrize(("n", "dim"), [(2, 2), (2, 1), (3, 1), (3, 2), (4, 2), (5, 3)])
def test_graph_balls_are_what_walks_reach(n, dim):
    """In every codimension: of frames that turn from point to point, on a graph at random, a tenth at one place."""
    generator = torch.Generator().manual_seed(n + 10 * dim)
    points, sides = torch.randn(2, 120, n, dtype=torch.float64, generator=generator)
    points[:12] = points[12]
    points[:, dim:] *= 0.3
    frames = torch.eye(n, dtype=torch.float64)[:, :dim] + 0.4 * torch.randn(
        120, n, dim, dtype=torch.float64, generator=generator
    )
    frames = torch.linalg.qr(frames)[0]
    pairs = torch.randint(120, (2, 700), generator=generator).numpy()
    graph = sparse.csr_array((np.ones(700), pairs), shape=(120, 120))
    graph = sparse.csr_array(graph + graph.T)
    graph.setdiag(0)
    graph.eliminate_zeros()
    sides = sides + 2 * torch.eye(n, dtype=torch.float64)[0]
    planes = plucker_coordinates(frames)
    shape = tuple(x.contiguous().numpy() for x in (points, frames, planes, sides))
    rows = graph.indptr.astype(np.int32), graph.indices.astype(np.int32)
    bounds = 18.0, 4, HALF_CREASE, CREASE
    index, count = kernels.k_hop_neighborhoods(shape, rows, np.arange(120), 12, bounds)
    for center in range(120):
        expected = grown(points, frames, sides, graph, center, 12, 18.0, 4)
        assert index[center, : count[center]].tolist() == expected
        assert (index[center, count[center] :] == center).all()
    assert count.min() < 12 <= count.max()
