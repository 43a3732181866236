"""Factors, block Lanczos and the eigenbasis of a symmetric pair (K, M)."""

import igl
import numpy as np
import pytest
import torch
import trimesh
from scipy import linalg, sparse

from torchlb import LaplaceBeltrami
from torchlb.errors import EigenbasisError, InputError
from torchlb.linalg.factor import Factor, cholesky
from torchlb.linalg.lanczos import lanczos
from torchlb.spectral import pencil, sweeps
from torchlb.spectral.eigenbasis import stack_eigenbases, unstack_eigenbases
from torchlb.spectral.pencil import pencil_eigenbasis
from torchlb.surfaces import Ellipsoid, Sphere, UnitDisk


def path_matrix(size, shift):
    """Graph Laplacian of a path, plus a shift."""
    ones = np.ones(size - 1)
    degree = np.r_[1, np.full(size - 2, 2), 1] + shift
    return sparse.diags_array([-ones, degree, -ones], offsets=[-1, 0, 1]).tocsr()


@pytest.mark.parametrize("shift", [0.5, -0.5])  # positive definite, indefinite
@pytest.mark.parametrize("shape", [(30,), (30, 1), (30, 200), (30, 0)])
def test_a_factor_solves_in_the_type_of_the_right_hand_side(shift, shape):
    matrix, b = path_matrix(30, shift), torch.randn(shape, dtype=torch.float64)
    factor = cholesky(matrix)
    assert factor.is_cholesky == (shift > 0)
    torch.testing.assert_close(torch.from_numpy(matrix @ factor.solve(b).numpy()), b)
    torch.testing.assert_close(
        factor.solve(b.float()), factor.solve(b).float(), atol=1e-5, rtol=1e-5
    )


def test_a_factor_takes_unsorted_and_unsymmetric_matrices():
    matrix, b = path_matrix(30, 1.0), torch.randn(30, 2, dtype=torch.float64)
    solution = cholesky(matrix).solve(b)
    flipped = matrix.copy()
    for start, end in zip(matrix.indptr[:-1], matrix.indptr[1:], strict=True):
        flipped.indices[start:end] = matrix.indices[start:end][::-1]
        flipped.data[start:end] = matrix.data[start:end][::-1]
    flipped.has_sorted_indices = False
    torch.testing.assert_close(cholesky(flipped).solve(b), solution)
    upper = sparse.triu(matrix)
    torch.testing.assert_close(torch.from_numpy(upper @ cholesky(upper).solve(b).numpy()), b)


def test_a_symmetric_matrix_that_is_indefinite_is_solved_to_rounding():
    """Of a Poisson problem bordered by the mass, whose last diagonal entry is zero."""
    lb = LaplaceBeltrami.from_cotangent(*Ellipsoid().mesh(200))
    stiffness, mass = (m.to_dense().numpy() for m in (lb.stiffness, lb.mass_matrix))
    area = mass.sum(0)[:, None]
    bordered = np.block([[stiffness, area], [area.T, np.zeros((1, 1))]])
    b = torch.randn(201, 2, dtype=torch.float64)
    x = cholesky(bordered).solve(b)
    torch.testing.assert_close(torch.from_numpy(bordered) @ x, b, rtol=0, atol=1e-10)


def test_complex_systems_are_refused(unchecked):
    """And not solved for their real part."""
    matrix, b = path_matrix(30, 1.0), torch.ones(30, dtype=torch.complex128)
    for call in (lambda: cholesky(1j * matrix), lambda: cholesky(matrix).solve(b)):
        with pytest.raises(InputError, match="expected real numbers"):
            call()


def cycle_matrix(size):
    """Graph Laplacian of a cycle: eigenvalues 2 − 2 cos 2πj/N, twice each but the first (and the last if N is even)."""
    step = sparse.eye_array(size, k=1) + sparse.eye_array(size, k=1 - size)
    return sparse.csr_array(2 * sparse.eye_array(size) - step - step.T)


def grid_pair(rows, columns):
    """Laplacian of a grid with the eigenvalues (2 − 2 cos πi/R) + (2 − 2 cos πj/C), and the identity."""
    parts = [path_matrix(rows, 0.0), path_matrix(columns, 0.0)]
    return sparse.csr_array(sparse.kronsum(*parts)), sparse.csr_array(
        sparse.eye_array(rows * columns)
    )


def grid_values(rows, columns):
    i, j = np.ogrid[:rows, :columns]
    return np.sort(np.ravel(4 - 2 * np.cos(np.pi * i / rows) - 2 * np.cos(np.pi * j / columns)))


def solved(k_matrix, m_matrix, k, **options):
    mass = torch.from_numpy(np.asarray(m_matrix.sum(axis=1)).ravel())
    return pencil_eigenbasis(k_matrix, m_matrix, mass, k, **options)


def weak_pair(rows, columns):
    """A pair close to the grid's: K = K₁ + K₁²/12, its next order, M = I + K₁/20; the same eigenvectors."""
    k1, m1 = grid_pair(rows, columns)
    return sparse.csr_array(k1 + k1 @ k1 / 12), sparse.csr_array(m1 + k1 / 20), (k1, m1)


def check_pairs(basis, k_matrix, m_matrix, tolerance=1e-9):
    """ΦᵀMΦ = I, ΦᵀKΦ = Λ, left = MΦ."""
    values, phi = basis.eigenvalues.numpy(), basis.eigenvectors.numpy()
    np.testing.assert_allclose(phi.T @ (m_matrix @ phi), np.eye(len(values)), atol=1e-9)
    np.testing.assert_allclose(
        phi.T @ (k_matrix @ phi), np.diag(values), atol=tolerance * values[-1]
    )
    np.testing.assert_allclose(basis.left.numpy(), m_matrix @ phi, atol=1e-12)


def inverse_of(matrix, shift):
    return Factor(sparse.csr_array(matrix + shift * sparse.eye_array(matrix.shape[0]))).solve


def test_lanczos_finds_multiplicities_larger_than_one():
    size, shift = 2000, 1e-5
    values, vectors = lanczos(
        inverse_of(cycle_matrix(size), shift),
        torch.clone,
        size,
        20,
        shift=shift,
        tolerance=1e-8,
    )
    exact = np.sort(2 - 2 * np.cos(2 * np.pi * np.arange(size) / size))[:20]
    np.testing.assert_allclose(values, exact, atol=1e-14)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(20), atol=1e-12)


def test_lanczos_goes_on_where_the_space_is_invariant():
    diagonal = sparse.diags_array(np.repeat([1.0, 2.0, 3.0], [40, 40, 120])).tocsr()
    solve = inverse_of(diagonal, 1.0)
    values, _ = lanczos(solve, torch.clone, 200, 50, shift=1.0, tolerance=1e-8)
    np.testing.assert_allclose(values, np.repeat([1.0, 2.0], [40, 10]))


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("stiff", [1e-6, 1e-3, 1e-1])
def test_ribbons_have_the_eigenvalues_of_their_length(stiff, linear):
    """A band of length N and width ε has λ_j = (2πj/N)², far below 1/area: K = ε cycle, M = ε; here M = 1, K = ε²."""
    matrices = stiff * cycle_matrix(1500), sparse.eye_array(1500).tocsr()
    basis = solved(*matrices, 21, **({"linear": matrices} if linear else {}))
    exact = stiff * np.sort(2 - 2 * np.cos(2 * np.pi * np.arange(1500) / 1500))[:21]
    np.testing.assert_allclose(basis.eigenvalues, exact, rtol=1e-5, atol=1e-12 * stiff)


@pytest.mark.parametrize("size", [30, 2500])  # dense, sparse
def test_a_pair_alone_has_exact_eigenvalues(size):
    matrices = cycle_matrix(size), sparse.eye_array(size).tocsr()
    basis = solved(*matrices, 9)
    exact = np.sort(2 - 2 * np.cos(2 * np.pi * np.arange(size) / size))[:9]
    np.testing.assert_allclose(basis.eigenvalues, exact, rtol=1e-9, atol=1e-13)
    check_pairs(basis, *matrices)


def test_a_group_of_equal_eigenvalues_is_not_split():
    assert len(solved(cycle_matrix(30), sparse.eye_array(30).tocsr(), 8).eigenvalues) == 9


@pytest.mark.parametrize("tolerance", [1e-4, 1e-10])
def test_a_weak_pair_reaches_its_tolerance(tolerance):
    stiffness, mass_matrix, linear = weak_pair(37, 41)
    basis = solved(stiffness, mass_matrix, 30, linear=linear, tolerance=tolerance)
    x = grid_values(37, 41)[: len(basis.eigenvalues)]
    exact = (x + x**2 / 12) / (1 + x / 20)
    np.testing.assert_allclose(basis.eigenvalues, exact, rtol=tolerance)
    assert basis.eigenvalues[0] == 0
    assert basis.relative_errors.max() <= tolerance
    check_pairs(basis, stiffness, mass_matrix)


def test_fewer_pairs_are_the_first_of_more():
    stiffness, mass_matrix, linear = weak_pair(37, 41)
    few, many = (solved(stiffness, mass_matrix, k, linear=linear) for k in (6, 40))
    k = len(few.eigenvalues)
    torch.testing.assert_close(few.eigenvalues, many.eigenvalues[:k], rtol=2e-4, atol=0)


def test_a_sphere_has_the_eigenvalues_of_a_dense_solve():
    sphere = trimesh.creation.icosphere(subdivisions=4)
    stiffness = sparse.csr_array(-igl.cotmatrix(sphere.vertices, sphere.faces))
    mass_matrix = sparse.csr_array(
        igl.massmatrix(sphere.vertices, sphere.faces, igl.MASSMATRIX_TYPE_FULL)
    )
    mass_matrix = mass_matrix * (1 + np.random.default_rng(0).random(stiffness.shape[0]) / 2)
    mass_matrix = sparse.csr_array((mass_matrix + mass_matrix.T) / 2)
    exact = linalg.eigh(stiffness.toarray(), mass_matrix.toarray(), subset_by_index=(0, 29))[0]
    basis = solved(stiffness, mass_matrix, 30)
    np.testing.assert_allclose(basis.eigenvalues[1:30], exact[1:], rtol=1e-10)
    check_pairs(basis, stiffness, mass_matrix)


@pytest.mark.parametrize("size", [4, 900])
def test_components_have_one_zero_eigenvalue_each_and_a_global_constant(size):
    block = cycle_matrix(size)
    stiffness = sparse.block_diag([block, 2 * block, block], format="csr")
    mass_matrix = sparse.diags_array(np.repeat([1.0, 3.0, 2.0], size)).tocsr()
    basis = solved(stiffness, mass_matrix, 12)
    assert (basis.eigenvalues == 0).sum() == 3
    constant = basis.eigenvectors[:, 0]
    assert (constant == constant[0]).all()
    np.testing.assert_allclose(constant[0], (6 * size) ** -0.5)
    check_pairs(basis, stiffness, mass_matrix)


def test_of_many_components_only_as_many_constants_as_wanted():
    """n zeros of n parts would be a dense basis, (N, n); the first k have KΦ = 0 and ΦᵀMΦ = I, and one is constant."""
    parts, edge = 3000, sparse.csr_array([[1.0, -1.0], [-1.0, 1.0]])
    stiffness = sparse.kron(sparse.eye_array(parts), edge, format="csr")
    mass_matrix = sparse.diags_array(np.repeat(1 + np.arange(parts) / parts, 2)).tocsr()
    basis = solved(stiffness, mass_matrix, 7)
    assert (basis.eigenvalues == torch.zeros(7)).all()
    assert (basis.eigenvectors[:, 0] == basis.eigenvectors[0, 0]).all()
    check_pairs(basis, stiffness, mass_matrix)


@pytest.mark.parametrize("size", [50, 3000])
def test_fixed_points_are_zeros_of_the_eigenvectors(size):
    stiffness, mass_matrix = path_matrix(size, 0.0), sparse.eye_array(size).tocsr()
    fixed = np.isin(np.arange(size), [0, size - 1])
    basis = solved(stiffness, mass_matrix, 5, fixed=fixed)
    exact = 2 - 2 * np.cos(np.pi * np.arange(1, 6) / (size - 1))
    np.testing.assert_allclose(basis.eigenvalues, exact, rtol=1e-8)
    assert (basis.eigenvectors[fixed] == 0).all()


@pytest.mark.parametrize("size", [1, 2, 3])
def test_tiny_shapes_have_as_many_pairs_as_points(size):
    stiffness = sparse.csr_array(size * np.eye(size) - np.ones((size, size)))
    basis = solved(stiffness, sparse.eye_array(size).tocsr(), 5)
    np.testing.assert_allclose(basis.eigenvalues, [0.0] + [size] * (size - 1))


def test_the_basis_of_a_pair_projects_in_the_full_mass_and_keeps_its_errors():
    stiffness, mass_matrix, linear = weak_pair(5, 6)
    basis = solved(stiffness, mass_matrix, 30, linear=linear)
    f = torch.randn(30, 2, dtype=torch.float64)
    torch.testing.assert_close(basis.from_basis(basis.to_basis(f)), f)
    first, second = unstack_eigenbases(stack_eigenbases([basis, basis.truncate(4)]))
    assert len(second.relative_errors) == 4
    values, vectors = basis
    assert values is basis.eigenvalues
    assert vectors is basis.eigenvectors
    torch.testing.assert_close(first.relative_errors, basis.relative_errors)


def test_a_negative_eigenvalue_is_an_error():
    with pytest.raises(EigenbasisError, match="should be positive"):
        solved(-cycle_matrix(10), sparse.eye_array(10).tocsr(), 3)


def test_factors_take_over_where_sweeps_stall(monkeypatch):
    """With a warning, and to the same eigenvalues; beyond the size that is factored an error says what to do."""
    lb = LaplaceBeltrami.from_mesh(*Ellipsoid().mesh(900))
    expected = lb.eigenbasis(10, tolerance=1e-10).eigenvalues
    monkeypatch.setattr(pencil, "ROUNDS", 1)
    monkeypatch.setattr(sweeps, "ROUNDS", 1)  # or a tolerance beyond rounding
    fresh = LaplaceBeltrami.from_mesh(*Ellipsoid().mesh(900))
    with pytest.warns(UserWarning, match="after 1 sweeps some of 10 eigenvalues .* Factors of the"):
        found = fresh.eigenbasis(10, tolerance=1e-10)
    torch.testing.assert_close(found.eigenvalues, expected, rtol=1e-9, atol=1e-9)
    gram = found.eigenvectors.T @ (fresh.mass_matrix @ found.eigenvectors)
    torch.testing.assert_close(gram, torch.eye(len(gram), dtype=gram.dtype), rtol=0, atol=1e-8)
    monkeypatch.setattr(sweeps, "LARGEST_FACTORED", 800)
    with pytest.raises(EigenbasisError, match="ask for a larger tolerance"):
        LaplaceBeltrami.from_mesh(*Ellipsoid().mesh(900)).eigenbasis(10, tolerance=1e-10)


@pytest.mark.filterwarnings("error:eigenbasis")
def test_a_rough_start_costs_no_digits():
    """Where the linear pair is far from (K, M): what is kept of the start had products in float32 once."""
    size, random = 40, np.random.default_rng(0)
    step = sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(size - 1, size))
    line = sparse.eye_array(size)
    edges = sparse.csr_array(sparse.vstack([sparse.kron(step, line), sparse.kron(line, step)]))
    weights = np.where(random.random(edges.shape[0]) < 0.3, 4.0, 1.0)
    stiffness = sparse.csr_array(edges.T @ sparse.diags_array(weights) @ edges)
    near = sparse.csr_array(edges.T @ edges)
    mass = sparse.csr_array(sparse.eye_array(size**2))
    basis = pencil_eigenbasis(
        stiffness, mass, torch.ones(size**2), 20, linear=(near, mass), tolerance=1e-12
    )
    exact = linalg.eigh(stiffness.toarray(), subset_by_index=(0, 19), eigvals_only=True)
    np.testing.assert_allclose(basis.eigenvalues[1:], exact[1:], rtol=1e-11)


def test_a_correction_of_zero_leaves_the_space_as_it_is():
    """As where K − λM is not positive in its first direction."""
    stiffness, mass_matrix, _ = weak_pair(5, 6)
    u = np.random.default_rng(0).random((30, 4))
    space = [torch.from_numpy(x) for x in (u, stiffness @ u, mass_matrix @ u)]
    expected, _ = sweeps._ritz([[x] for x in space], 4)
    found, _ = sweeps._ritz([[x, torch.zeros_like(x[:, :1])] for x in space], 4)
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("unit", [1e-20, 1e20])
def test_eigenpairs_are_those_in_any_unit(unit):
    """Masses that leave the range of float32, in which sweeps are taken; of an open shape, too."""
    for surface, condition in ((Ellipsoid(), "neumann"), (UnitDisk(), "dirichlet")):
        vertices, faces = surface.mesh(800)
        one, other = (
            LaplaceBeltrami.from_mesh(vertices * u, faces, condition=condition).eigenbasis(12)
            for u in (1.0, unit)
        )
        torch.testing.assert_close(
            other.eigenvalues * unit**2, one.eigenvalues, rtol=1e-5, atol=1e-9
        )
        identity = torch.eye(other.eigenvectors.shape[1], dtype=torch.float64)
        torch.testing.assert_close(other.to_basis(other.eigenvectors), identity, rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("build", "dtype"),
    [("from_mesh", "float64"), ("from_mesh", "float32"), ("from_cotangent", "float64")],
)
def test_a_stiffness_matrix_has_no_factor(build, dtype):
    """K1 = 0, which rounding hides: the last pivot is 1e-14, K⁻¹ 1e14. K + cM has one, and K without a point."""
    vertices, faces = Sphere().mesh(300)
    lb = getattr(LaplaceBeltrami, build)(vertices.numpy().astype(dtype), faces)
    stiffness, mass = lb.to_scipy("stiffness"), lb.to_scipy("mass")
    least = {"float32": 0.1, "float64": 1e-6}[dtype]
    for singular in (
        stiffness,
        sparse.block_diag([stiffness, stiffness + mass]),
        stiffness + 1e-15 * mass,
        stiffness.astype(float) * 1e20 if dtype == "float64" else stiffness,
    ):
        with pytest.raises(InputError, match=r"singular.*K1 = 0.*K \+ cM"):
            cholesky(singular)
    right = torch.from_numpy(mass.sum(axis=1)).double()
    x = cholesky(stiffness + least * mass).solve(least * right)  # (K + cM)1 = cM1
    torch.testing.assert_close(x, torch.ones_like(x), rtol=1e-2, atol=0)
    assert cholesky(stiffness[1:, 1:]).solve(right[1:]).isfinite().all()


@pytest.mark.parametrize(
    "matrix",
    [
        sparse.diags_array([1.0, 0.0, 2.0]),
        sparse.csr_array((4, 4)),
        sparse.csr_array(np.ones((2, 2))),
        sparse.csr_array(np.array([[1.0, 2.0], [3.0, 6.0]])),
        sparse.csr_array(1 / (1 + np.add.outer(np.arange(14.0), np.arange(14.0)))),  # Hilbert's
    ],
)
def test_other_singular_matrices_have_no_factor(matrix):
    with pytest.raises(InputError, match="singular"):
        cholesky(matrix)


def test_badly_scaled_matrices_have_a_factor():
    """A small pivot alone is no reason: each row has its own unit."""
    x = cholesky(sparse.diags_array([1.0, 1e-20, 1e20])).solve(torch.ones(3).double())
    torch.testing.assert_close(x, torch.tensor([1.0, 1e20, 1e-20]).double())
    for wrong in (sparse.csr_array((4, 5)), sparse.csr_array(np.array([[np.nan]]))):
        with pytest.raises(InputError, match="square one of finite entries"):
            cholesky(wrong)
