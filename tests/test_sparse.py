"""The sparse product equals the dense one, with all its derivatives, in every type and under every transformation."""

import copy
import shutil
import subprocess
import sys

import jaxtyping
import numpy as np
import pytest
import torch
from scipy import sparse
from torch.autograd import grad, gradcheck, gradgradcheck

from tolerances import TOLERANCE
from torchlb import LaplaceBeltrami
from torchlb.linalg.sparse import (
    _form_op,
    csr_product,
    from_scipy,
    to_scipy,
    transpose_pattern,
)
from torchlb.surfaces import Sphere

needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("c++", "g++", "clang++", "cl"))),
    reason="torch.compile needs a C++ compiler",
)
FLOATS, HALVES = [torch.float32, torch.float64], [torch.bfloat16, torch.float16]
# rows, columns of A, columns of x
SHAPES = [(6, 6, 3), (7, 4, 3), (4, 7, 1), (1, 5, 2), (5, 6, 0), (0, 5, 2), (5, 0, 2)]


class Product(torch.nn.Module):
    """A x for a random sparse A whose first row and first column are empty."""

    def __init__(self, rows, cols, dtype=torch.float64, index=torch.int64):
        super().__init__()
        keep = torch.rand(rows, cols) < 0.5
        keep[:1] = keep[:, :1] = False
        self.row, col = keep.nonzero().T.to(index)
        crow = torch.cat([torch.zeros(1), keep.sum(1).cumsum(0)]).to(index)
        self.shape = (rows, cols)
        pattern = (crow, col, *transpose_pattern(crow, col, cols))
        for name, part in zip(("crow", "col", "crow_t", "col_t", "order_t"), pattern, strict=True):
            self.register_buffer(name, part)
        self.values = torch.nn.Parameter(torch.randn(len(col), dtype=dtype))

    @property
    def pattern(self):
        return [self.crow, self.col, self.crow_t, self.col_t, self.order_t]

    def forward(self, x, values=None):
        values = self.values if values is None else values
        return csr_product([self.crow, self.col, self.crow_t, self.col_t, self.order_t], values, x)

    def dense(self):
        zero = torch.zeros(self.shape, dtype=self.values.dtype)
        return zero.index_put((self.row, self.col), self.values)


def features(size, columns, dtype=torch.float64):
    return torch.randn(size, columns, dtype=dtype, requires_grad=True)


def close(actual, expected, dtype=torch.float64):
    torch.testing.assert_close(actual, expected, **TOLERANCE[dtype])


@pytest.mark.parametrize("index", [torch.int32, torch.int64])
@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize("shape", SHAPES)
def test_product_and_gradients_are_those_of_the_dense_matrix(shape, dtype, index):
    rows, cols, columns = shape
    product, x = Product(rows, cols, dtype, index), features(cols, columns, dtype)
    actual, expected = product(x), product.dense() @ x
    close(actual, expected, dtype)
    direction, inputs = torch.randn_like(expected), (x, product.values)
    for a, b in zip(
        grad(actual, inputs, direction), grad(expected, inputs, direction), strict=True
    ):
        close(a, b, dtype)


@pytest.mark.parametrize("dtype", FLOATS)
def test_large_sparse_product_and_gradients_are_those_of_scipy(dtype):
    rng = np.random.default_rng(0)
    matrix = sparse.csr_array(rng.normal(size=(500, 300)) * (rng.random((500, 300)) < 0.1))
    crow, col, values = from_scipy(matrix)
    values, x = values.to(dtype).requires_grad_(), features(300, 40, dtype)
    y = csr_product([crow, col, *transpose_pattern(crow, col, 300)], values, x)
    g = torch.randn_like(y)
    close(y, torch.from_numpy(matrix @ x.detach().numpy()).to(dtype), dtype)
    grad_x, grad_values = grad(y, (x, values), g)
    close(grad_x, torch.from_numpy(matrix.T @ g.numpy()).to(dtype), dtype)
    close(grad_values, (g @ x.detach().T)[matrix.nonzero()], dtype)


@pytest.mark.parametrize(("rows", "cols"), [(5, 5), (4, 6)])
def test_first_and_second_derivatives_in_values_and_x(rows, cols):
    product, x = Product(rows, cols), features(cols, 2)
    assert gradcheck(product, (x, product.values))
    assert gradgradcheck(product, (x, product.values))


def test_third_derivative_is_that_of_the_dense_matrix():
    product, x = Product(5, 4), features(4, 2)

    def third(y):
        for inputs in (x, product.values, x):
            (y,) = grad(y.pow(2).sum(), inputs, create_graph=True)
        return y

    close(third(product(x)), third(product.dense() @ x))


def test_gradient_in_x_alone_does_not_compute_that_in_values(monkeypatch):
    product, x = Product(5, 4), features(4, 2)
    product.requires_grad_(False)
    monkeypatch.setattr("torchlb.linalg.sparse._values", None)
    close(grad(product(x).sum(), x)[0], product.dense().sum(0)[:, None].expand(4, 2))


def test_features_that_are_not_contiguous():
    product, x = Product(5, 4, torch.float32), torch.randn(3, 4).T
    close(product(x), product.dense() @ x, torch.float32)


@pytest.mark.parametrize("half", HALVES)
@pytest.mark.parametrize("dtype", FLOATS)
def test_half_features_compute_in_the_type_of_the_values_and_keep_their_own(dtype, half):
    product, x = Product(6, 5, dtype), features(5, 3, half)
    y = product(x)
    torch.testing.assert_close(y, (product.dense() @ x.to(dtype)).to(half), rtol=0, atol=0)
    grad_x, grad_values = grad(y.sum(), (x, product.values))
    assert (grad_x.dtype, grad_values.dtype) == (half, dtype)


@pytest.mark.parametrize("half", HALVES)
def test_half_values_compute_in_float32(half):
    product = Product(6, 5, half)
    for dtype in (half, torch.float32):
        x = torch.randn(5, 3, dtype=dtype)
        torch.testing.assert_close(product(x), (product.dense().float() @ x.float()).to(dtype))


@pytest.mark.parametrize(("first", "second"), [FLOATS, FLOATS[::-1]])
def test_the_wider_of_float32_and_float64_wins(first, second):
    product, x = Product(6, 5, first), features(5, 3, second)
    y = product(x)
    close(y, product.dense().double() @ x.double())
    assert [g.dtype for g in grad(y.sum(), (x, product.values))] == [second, first]


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_autocast_changes_nothing(dtype):
    product, x = Product(6, 5, torch.float32), features(5, 3, dtype)
    expected = product(x)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        y = product(x)
        after_a_layer = product(torch.nn.Linear(3, 3)(x))
        gradients = grad(y.sum(), (x, product.values))
    assert after_a_layer.dtype == torch.bfloat16
    torch.testing.assert_close(y, expected, rtol=0, atol=0)
    torch.testing.assert_close(gradients, grad(expected.sum(), (x, product.values)), rtol=0, atol=0)


@needs_compiler
def test_compiled_without_graph_breaks_it_gives_the_same(monkeypatch):
    # Dynamo cannot trace the types that the test run checks at every call.
    monkeypatch.setattr(jaxtyping.config, "jaxtyping_disable", True)
    product = Product(6, 5, torch.float32)
    compiled = torch.compile(lambda x: product(torch.sin(x)).cos(), fullgraph=True, dynamic=True)
    for columns in (3, 8):
        x = features(5, columns, torch.float32)
        actual, expected = compiled(x), (product.dense() @ x.sin()).cos()
        close(actual, expected, torch.float32)
        inputs = (x, product.values)
        close(grad(actual.sum(), inputs), grad(expected.sum(), inputs), torch.float32)


def test_exported_for_any_number_of_columns_it_gives_the_same():
    product = Product(6, 5)
    columns = torch.export.Dim("columns", min=2, max=64)
    program = torch.export.export(product, (torch.randn(5, 3),), dynamic_shapes=({1: columns},))
    x = torch.randn(5, 8)
    close(program.module()(x), product(x))


@pytest.mark.parametrize("dtype", [*FLOATS, torch.bfloat16])
def test_operations_are_registered_as_pytorch_asks(dtype):
    product, x, y = Product(6, 5, dtype), features(5, 3, dtype), features(6, 3, dtype)
    given = ("product", product.values, x), ("transposed", product.values, y), ("values", y, x)
    for kind, a, b in given:
        torch.library.opcheck(_form_op, (*product.pattern, a, b, kind))


def test_a_copied_module_gives_the_same():
    product, x = Product(6, 5), features(5, 3)
    torch.testing.assert_close(copy.deepcopy(product)(x), product(x), rtol=0, atol=0)


@pytest.mark.parametrize("index", [torch.int32, torch.int64])
def test_transposed_pattern_is_that_of_scipy(index):
    product = Product(7, 5, index=index)
    crow, col, order = transpose_pattern(product.crow, product.col, 5)
    assert {crow.dtype, col.dtype, order.dtype} == {index}
    expected = from_scipy(to_scipy(product.crow, product.col, product.values, (7, 5)).T)
    torch.testing.assert_close((crow.long(), col.long(), product.values[order]), expected)


def test_scipy_and_back():
    product = Product(7, 5)
    matrix = to_scipy(product.crow, product.col, product.values, product.shape)
    np.testing.assert_array_equal(matrix.toarray(), product.dense().detach())
    torch.testing.assert_close(
        from_scipy(matrix), (product.crow, product.col, product.values.detach())
    )


def test_from_scipy_sorts_columns_and_sums_duplicates_without_touching_the_matrix():
    given = sparse.csr_array(([1.0, 2.0, 4.0, 8.0], [2, 0, 2, 1], [0, 3, 4]), shape=(2, 3))
    parts = [part.tolist() for part in from_scipy(given)]
    assert parts == [[0, 2, 3], [0, 2, 1], [2.0, 5.0, 8.0]]
    assert given.indices.tolist() == [2, 0, 2, 1]


def test_importing_torchlb_silences_nobody():
    """torch says of the first CSR tensor of a process that they are in beta; torchlb keeps that from its own alone."""
    program = """
import warnings
with warnings.catch_warnings(record=True) as said:
    warnings.simplefilter("always")
    import torch, torchlb
    own = torchlb.linalg.sparse.csr_tensor if MINE else torch.sparse_csr_tensor
    own(torch.tensor([0, 1]), torch.tensor([0]), torch.tensor([1.0]), 1 if MINE else (1, 1))
print(sum("Sparse CSR" in str(each.message) for each in said))
"""
    for mine, count in ((True, 0), (False, 1)):
        text = program.replace("MINE", str(mine))
        done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True)
        assert done.stdout.strip() == str(count), done.stderr


@pytest.mark.parametrize("name", ["stiffness", "laplacian", "gradient"])
def test_products_under_the_transforms_of_torch_func(name):
    """grad, jvp, vmap, a Hessian, and vmap of grad, as by autograd and by linearity."""
    lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(60))
    f, way = torch.randn(2, 60, 2, dtype=torch.float64)

    def product(x):
        return lb.gradient(x) if name == "gradient" else lb.product(name, x)

    def energy(x):
        return product(x).square().sum()

    leaf = f.clone().requires_grad_()
    (expected,) = torch.autograd.grad(energy(leaf), leaf)
    torch.testing.assert_close(torch.func.grad(energy)(f), expected)
    torch.testing.assert_close(torch.func.jvp(product, (f,), (way,))[1], product(way))
    both = torch.stack([f, way])
    torch.testing.assert_close(torch.func.vmap(product)(both)[1], product(way))
    torch.testing.assert_close(torch.func.vmap(torch.func.grad(energy))(both)[0], expected)
    curvature = torch.func.hessian(lambda x: energy(x[:, None]))(f[:, 0])
    torch.testing.assert_close(curvature @ way[:, 0], torch.func.grad(energy)(way)[:, 0])
