"""Monomials, their derivatives, and the functionals of a stencil, against derivatives taken by torch."""

from math import comb

import pytest
import torch
from torch.func import hessian, jacrev, vmap

from tolerances import TOLERANCE
from torchlb.fits.polynomials import (
    exponents,
    functionals,
    monomial_derivatives,
    monomials,
    num_monomials,
)

CASES = [(1, 6), (2, 1), (2, 4), (2, 6), (3, 3), (4, 2)]


def close(actual, expected):
    torch.testing.assert_close(actual, expected, **TOLERANCE[torch.float64])


@pytest.mark.parametrize(("dim", "degree"), CASES)
def test_exponents_are_all_of_the_degrees_once_in_ascending_order(dim, degree):
    """M − 1 = C(m + d, d) − 1 multi-indices, 1 ≤ |α| ≤ m."""
    alpha = exponents(dim, degree)
    total = alpha.sum(1)
    assert num_monomials(dim, degree) == comb(degree + dim, dim)
    assert alpha.shape == (comb(degree + dim, dim) - 1, dim)
    assert len(torch.unique(alpha, dim=0)) == len(alpha)
    assert torch.equal(total, total.sort().values)
    assert (total.min(), total.max(), alpha.min()) == (1, degree, 0 if dim > 1 else 1)


@pytest.mark.parametrize(("dim", "degree"), CASES)
def test_monomials_are_products_of_powers(dim, degree):
    """y^α = Π_c y_c^α_c, for any batch."""
    for shape in [(), (5,), (2, 3)]:
        y = torch.randn(*shape, dim, dtype=torch.float64)
        expected = (y[..., None, :] ** exponents(dim, degree)).prod(-1)
        assert expected.shape == (*shape, num_monomials(dim, degree) - 1)
        close(monomials(y, degree), expected)


@pytest.mark.parametrize(("dim", "degree"), CASES)
def test_derivatives_are_those_of_autograd(dim, degree):
    """∂_c y^α at random points and, where a power of zero could go wrong, at the origin: there the functional."""
    y = torch.cat([torch.randn(4, dim).double(), torch.zeros(1, dim).double()])
    slopes = monomial_derivatives(y, degree)
    close(slopes, vmap(jacrev(lambda x: monomials(x, degree)))(y))
    close(functionals(dim, degree)[:, :dim], slopes[-1])


@pytest.mark.parametrize(("dim", "degree"), CASES)
def test_laplacian_functional_is_the_trace_of_second_derivatives_at_the_origin(dim, degree):
    second = hessian(lambda y: monomials(y, degree))(torch.zeros(dim, dtype=torch.float64))
    trace = second.diagonal(dim1=1, dim2=2).sum(-1)
    close(functionals(dim, degree)[:, dim], trace)
