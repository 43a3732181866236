"""Monomials in local coordinates, and differential functionals of them.

A stencil is exact for polynomials. Their basis is the monomials y^α of the d local coordinates, 1 ≤ |α| ≤ m; the
constant is left out because the centre of a stencil takes care of it (`method.md`, section 2). A derivative at the
origin sees exactly one monomial: ∂^β y^α (0) = α! if α = β and 0 otherwise, so a differential functional with constant
coefficients is a short column of factorials.
"""

from __future__ import annotations

from itertools import chain, combinations_with_replacement
from math import comb

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.linalg.devices import constant


def num_monomials(dim: int, degree: int) -> int:
    """Number M of monomials of `dim` variables and total degree ≤ `degree`, the constant included.

    >>> [num_monomials(2, m) for m in (2, 4, 6)]
    [6, 15, 28]
    """
    return comb(degree + dim, dim)


@constant
def exponents(dim: int, degree: int) -> Int[Tensor, "M d"]:
    """Multi-indices α with 1 ≤ |α| ≤ `degree`, by ascending |α|; M − 1 of them, one a row.

    >>> exponents(2, 2).tolist()
    [[1, 0], [0, 1], [2, 0], [1, 1], [0, 2]]
    """
    rows = [
        [variables.count(c) for c in range(dim)]
        for total in range(1, degree + 1)
        for variables in combinations_with_replacement(range(dim), total)
    ]
    return torch.tensor(rows)


def monomials(coords: Float[Tensor, "*batch d"], degree: int) -> Float[Tensor, "*batch M"]:
    """Values y^α of the monomials 1 ≤ |α| ≤ `degree` at the points y, in the order of `exponents`; none of degree 0.

    In a batch each monomial is contiguous in memory, as LAPACK expects the columns of a matrix.

    >>> monomials(torch.tensor([2.0, 3.0]), 2).tolist()
    [2.0, 3.0, 4.0, 6.0, 9.0]
    """
    if degree * coords.shape[-1] == 0:
        return coords[..., :0]
    variables = coords.unbind(-1)
    columns, last = list(variables), [[y] for y in variables]
    for _ in range(degree - 1):  # `last` has those of one degree by their first variable
        last = [[y * z for z in chain(*last[c:])] for c, y in enumerate(variables)]
        columns += chain(*last)
    return torch.stack(columns, dim=-2).mT if coords.ndim > 1 else torch.stack(columns)


def monomial_derivatives(
    coords: Float[Tensor, "*batch d"], degree: int
) -> Float[Tensor, "*batch M d"]:
    """Gradients ∂_c y^α of the monomials 1 ≤ |α| ≤ `degree` at the points y.

    >>> monomial_derivatives(torch.tensor([2.0, 3.0]), 2).tolist()
    [[1.0, 0.0], [0.0, 1.0], [4.0, 0.0], [3.0, 2.0], [0.0, 6.0]]
    """
    factor, place = _lowered(coords.shape[-1], degree)
    lower = torch.cat([torch.ones_like(coords[..., :1]), monomials(coords, degree - 1)], dim=-1)
    taken = lower.index_select(-1, place.flatten())
    return factor.to(coords) * taken.unflatten(-1, place.shape)


@constant
def _lowered(dim: int, degree: int) -> tuple[Float[Tensor, "M d"], Int[Tensor, "M d"]]:
    """For ∂_c y^α = α_c y^(α − e_c): α_c, and the index of α − e_c among the constant and the monomials."""
    alpha = exponents(dim, degree)
    places = {tuple(beta): number for number, beta in enumerate([[0] * dim, *alpha.tolist()])}
    lowered = (alpha[:, None, :] - torch.eye(dim, dtype=torch.int64)).tolist()
    place = [[places.get(tuple(beta), 0) for beta in betas] for betas in lowered]
    return alpha.double(), torch.tensor(place)


def functionals(dim: int, degree: int) -> Float[Tensor, "M F"]:
    """The d first derivatives of every monomial at y = 0, 1 where α = e_c, then Δ, 2 where α = 2 e_c.

    >>> functionals(2, 2).T.tolist()
    [[1.0, 0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0, 2.0]]
    """
    alpha = exponents(dim, degree)
    gradient = (alpha[:, None, :] == torch.eye(dim, dtype=alpha.dtype)).all(-1)
    laplacian = 2 * ((alpha == 2).any(1) & (alpha.sum(1) == 2))
    return torch.cat([gradient, laplacian[:, None]], dim=1).double()
