"""The boundary term of a Robin condition κ∂_ν f + a f = 0: a matrix R beside K, M and B."""

from __future__ import annotations

from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchlb.galerkin.pair import SparsePair, WeakPair
from torchlb.linalg.precision import LOW


def absorbing(pair: WeakPair, a: Float[Tensor, " N"], at_boundary: Bool[Tensor, " N"]) -> WeakPair:
    """Append R_ij = B_ij √(a_i a_j), a ≥ 0 at the boundary vertices, to the pair; return the pair itself where R = 0.

    R is positive semidefinite for every a ≥ 0, equals aB for constant a, and is as accurate as B where a is smooth and
    positive. The P1 pair takes B lumped to its row sums, but at least to a tenth of its absolute row sums.
    """
    whole, near = pair.matrices, pair.linear
    if len(whole.values) < 3 or not (a[at_boundary] > 0).any():
        return pair
    row, boundary = _rows(whole), whole.values[2]
    sums, sizes = (torch.zeros_like(a).index_add(0, row, b) for b in (boundary, boundary.abs()))
    a = torch.where(at_boundary, a, 0.0)
    if bool((sizes[~at_boundary] > 0).any()):
        a = _continued(a, at_boundary, near or whole)
    values = [*whole.values, boundary * (a[row] * a[whole.col]).sqrt()]
    if near is not None:
        row = _rows(near)
        lumped = torch.where(row == near.col, sums.maximum(LOW * sizes)[row], 0.0)
        near = replace(near, values=torch.stack([*near.values, lumped, lumped * a[row]]))
    return replace(pair, matrices=replace(whole, values=torch.stack(values)), linear=near)


def _continued(
    a: Float[Tensor, " N"], at_boundary: Bool[Tensor, " N"], pair: SparsePair
) -> Float[Tensor, " N"]:
    """Extend a to the inside by means over known neighbours, ring by ring.

    B has entries inside where fits along the boundary of a solid, or coarse triangles, reach there. Another extension
    changes eigenvalues of a cube of 2,000 points by 5e-6.
    """
    row, known = _rows(pair), at_boundary
    while True:
        near = known[pair.col]
        count, total = (
            torch.zeros_like(a).index_add(0, row[near], x[pair.col[near]])
            for x in (torch.ones_like(a), a)
        )
        new = ~known & (count > 0)
        if not new.any():
            return a
        a, known = torch.where(new, total / count, a), known | new


def _rows(matrices: SparsePair) -> Tensor:
    return torch.arange(len(matrices.crow) - 1).repeat_interleave(matrices.crow.diff())
