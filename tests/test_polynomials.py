"""Monomials, their derivatives, and the functionals of a stencil, against derivatives taken by torch."""

from math import comb

import pytest
import torch
from torch.func import hessian, jacrev, vmap

from tolerances import TOLERANCE
from torchlb.fits.polynomials import (
    exponents,
    gradient_functional,
    hessian_functional,
    laplacian_functional,
    monomial_derivatives,
    monomials,
    num_monomials,
)

CASES = [(dim, degree) for dim in (1, 2, 3, 4) for degree in (1, 2, 3, 4, 6)]
SECOND = [case for case in CASES if case[1] >= 2]


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


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
@pytest.mark.parametrize(("dim", "degree"), CASES)
def test_monomials_are_products_of_powers(dim, degree, shape):
    """y^α = Π_c y_c^α_c, for any batch."""
    y = torch.randn(*shape, dim, dtype=torch.float64)
    expected = (y[..., None, :] ** exponents(dim, degree)).prod(-1)
    assert expected.shape == (*shape, num_monomials(dim, degree) - 1)
    close(monomials(y, degree), expected)


@pytest.mark.parametrize(("dim", "degree"), CASES)
def test_derivatives_are_those_of_autograd(dim, degree):
    """∂_c y^α at random points and, where a power of zero could go wrong, at the origin."""
    y = torch.cat([torch.randn(4, dim).double(), torch.zeros(1, dim).double()])
    close(monomial_derivatives(y, degree), vmap(jacrev(lambda x: monomials(x, degree)))(y))


@pytest.mark.parametrize(("dim", "degree"), CASES)
def test_gradient_functional_is_the_jacobian_at_the_origin(dim, degree):
    zero = torch.zeros(dim, dtype=torch.float64)
    close(gradient_functional(dim, degree), monomial_derivatives(zero, degree))


@pytest.mark.parametrize(("dim", "degree"), SECOND)
def test_hessian_and_laplacian_functionals_are_second_derivatives_at_the_origin(dim, degree):
    """Pairs a ≤ b in the order (1,1), (1,2), …, (d,d); Δ is the sum of those with a = b."""
    zero = torch.zeros(dim, dtype=torch.float64)
    second = hessian(lambda y: monomials(y, degree))(zero)
    a, b = torch.triu_indices(dim, dim)
    close(hessian_functional(dim, degree), second[:, a, b])
    trace = second.diagonal(dim1=1, dim2=2).sum(-1, keepdim=True)
    close(laplacian_functional(dim, degree), trace)


def test_second_moment_of_the_laplacian_is_two():
    """Σ w y⊗y = 2 Id: the corrected moment."""
    a, b = torch.triu_indices(3, 3)
    moments = laplacian_functional(3, 2)[-6:, 0]
    assert torch.equal(moments, 2.0 * (a == b))


@pytest.mark.parametrize("functional", [hessian_functional, laplacian_functional])
def test_second_derivatives_need_degree_two(functional):
    with pytest.raises(ValueError, match="degree ≥ 2, got degree 1"):
        functional(2, 1)
