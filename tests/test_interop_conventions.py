"""Signs, factors and masses against the libraries themselves; docs/conventions.md has the same table."""

import copy

import igl
import lapy
import numpy as np
import potpourri3d
import pytest
import robust_laplacian
import torch
from scipy import sparse
from torch_geometric.utils import get_mesh_laplacian

from torchlb import LaplaceBeltrami
from torchlb.interop.conventions import SIGNS, edge_weights, weak_matrices
from torchlb.surfaces import Ellipsoid


@pytest.fixture(scope="module", autouse=True)
def shape():
    """Made when the first test runs, not when tests are collected."""
    global VERTICES, FACES, V, F, COTANGENT, STENCIL
    VERTICES, FACES = Ellipsoid().mesh(200)
    V, F = VERTICES.numpy(), FACES.numpy()
    COTANGENT = LaplaceBeltrami.from_cotangent(VERTICES, FACES)
    STENCIL = LaplaceBeltrami.from_mesh(VERTICES, FACES, order=3, weak_form=False, certify=True)


def dense(index, weight):
    return torch.zeros(200, 200).double().index_put(tuple(index), weight, accumulate=True)


def largest(matrix):
    return abs(matrix).max()


def test_the_scipy_matrix_is_the_operator():
    f = torch.randn(200).double()
    for lb in (COTANGENT, STENCIL):
        matrix = lb.to_scipy()
        assert isinstance(matrix, sparse.csr_array)
        assert matrix.shape == (200, 200)
        np.testing.assert_allclose(matrix @ f.numpy(), lb(f).numpy(), rtol=1e-10, atol=1e-9)
    assert copy.deepcopy(STENCIL).float().to_scipy().dtype == np.float32


def test_the_cotangent_operator_is_each_librarys_matrix():
    """Entry by entry: igl's C, and −C of potpourri3d, LaPy and, on a Delaunay mesh, robust_laplacian."""
    theirs = {
        "igl": igl.cotmatrix(V, F),
        "potpourri3d": potpourri3d.cotan_laplacian(V, F, denom_eps=1e-10),
        "lapy": lapy.Solver(lapy.TriaMesh(V, F), lump=True).stiffness,
        "diffusion_net": potpourri3d.cotan_laplacian(V, F, denom_eps=1e-10),
    }
    for name, matrix in theirs.items():
        ours, _ = weak_matrices(COTANGENT, name)
        assert largest(ours - matrix) < 1e-8 * largest(ours), name  # potpourri3d's denom_eps


def test_signs_of_both_operators():
    """xᵀCx has the sign that the library's own matrix has."""
    x = np.random.default_rng(0).standard_normal(200)
    robust, _ = robust_laplacian.mesh_laplacian(V, F)
    theirs = {"igl": x @ igl.cotmatrix(V, F) @ x, "robust_laplacian": x @ robust @ x}
    theirs |= dict.fromkeys(("potpourri3d", "lapy", "diffusion_net"), -theirs["igl"])
    assert theirs.keys() == SIGNS.keys()
    for lb in (COTANGENT, STENCIL):
        for name, form in theirs.items():
            matrix, mass = weak_matrices(lb, name)
            assert np.sign(x @ matrix @ x) == np.sign(form) == -SIGNS[name], name
            np.testing.assert_allclose(mass.diagonal(), lb.mass.numpy())


def test_masses():
    """Ours of the cotangent is igl's Voronoi; a third of the triangles' areas elsewhere; all sum to the area."""
    voronoi = igl.massmatrix(V, F, igl.MASSMATRIX_TYPE_VORONOI).diagonal()
    third = igl.massmatrix(V, F, igl.MASSMATRIX_TYPE_BARYCENTRIC).diagonal()
    np.testing.assert_allclose(COTANGENT.mass.numpy(), voronoi)
    np.testing.assert_allclose(potpourri3d.vertex_areas(V, F), third)
    lumped = lapy.Solver(lapy.TriaMesh(V, F), lump=True).mass.diagonal()
    np.testing.assert_allclose(lumped, third)
    assert lapy.Solver(lapy.TriaMesh(V, F)).mass.nnz > 200  # full, unless lumped
    area = igl.doublearea(V, F).sum() / 2
    robust = robust_laplacian.mesh_laplacian(V, F)[1].diagonal()  # of intrinsic Delaunay triangles
    for mass in (voronoi, third, STENCIL.mass.numpy(), robust):
        assert mass.sum() == pytest.approx(area, rel=1e-4 if mass is robust else 1e-9)


def test_the_stencils_weak_matrix_has_zero_row_and_column_sums_and_a_semidefinite_part():
    matrix, _ = weak_matrices(STENCIL, "potpourri3d")
    scale = largest(matrix)
    assert np.abs(matrix.sum(axis=0)).max() < 1e-12 * scale * 200
    assert np.abs(matrix.sum(axis=1)).max() < 1e-12 * scale * 200
    assert largest(matrix - matrix.T) > 0.01 * scale
    values = np.linalg.eigvalsh((matrix + matrix.T).toarray() / 2)
    assert values.min() > -1e-10 * values.max()


def test_edge_weights_are_pygs():
    index, weight = get_mesh_laplacian(VERTICES, FACES.T.contiguous())
    theirs = dense(index, weight)
    ours = dense(*edge_weights(COTANGENT))
    torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)
    strong = dense(*edge_weights(STENCIL, "rw"))
    torch.testing.assert_close(strong, STENCIL.matrix.to_dense())


def test_errors(unchecked):
    with pytest.raises(ValueError, match=r"convention: expected one of.*geomstats"):
        weak_matrices(COTANGENT, "geomstats")
    with pytest.raises(ValueError, match="normalization: expected None or 'rw', got 'sym'"):
        edge_weights(COTANGENT, "sym")
