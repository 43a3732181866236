"""Jacobi–Davidson sweeps for the eigenpairs of K u = λ M u (`method.md`, section 10).

A sweep corrects each eigenvector u by some conjugate-gradient steps for (K − λM)w = Ku − λMu on the complement of the
known vectors. Rayleigh–Ritz follows: first among all u − w, mostly enough, or among all u and w where an error is
large; in later sweeps among the u and the w that are needed. The steps, taken in float32, give only directions, so that
no digits are lost. Their preconditioner is a two-grid cycle, Chebyshev smoothing in K around a solve with the factor of
the P1 pair.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from torchlb.errors import EigenbasisError
from torchlb.geometry.thresholds import FACTOR
from torchlb.linalg.conjugate_gradients import Linear
from torchlb.linalg.lanczos import BLOCK
from torchlb.linalg.precision import (
    AT_ONCE,
    LARGEST_FACTORED,
    ROOT_EPS,
    ROUNDING,
    ROUNDS,
    SMALL,
    TINY,
)
from torchlb.linalg.sparse import multiply
from torchlb.linalg.two_grid import Matrix, absolute_row_sums, two_grid, without_small_entries

LONGEST = 24
"""Maximal number of conjugate-gradient steps in a sweep."""
ASTRAY = 0.5
"""Estimated error above which a sweep takes one step only, and the first one keeps the old vectors beside the new."""
CHUNK = 10 * BLOCK
"""Columns that are corrected together: more take memory, and no less time."""
SAFETY = 4.0
"""Factor on the estimated errors, which are too small where K is softer than its preconditioner."""

Matrices = Sequence[Matrix]  # K, M, M₁
Blocks = tuple[Tensor, ...]  # U, KU, MU

_dots = partial(torch.linalg.vecdot, dim=0)


def closed(values: Tensor, k: int, tolerance: float) -> int:
    """The least number of pairs, k or more, that splits no group of equal eigenvalues; all if there is none."""
    gaps = pad(values.diff() > max(ROOT_EPS, tolerance) * values[1:], (0, 1), value=True)
    gaps[: min(k, len(values)) - 1] = False
    return int(gaps.int().argmax()) + 1


class _Maps:
    """Products with K and M, in float64 and in float32, with K − λM₁, and an approximate inverse of K.

    That is the two-grid cycle around `solve`, a product with the inverse of K₁ + σM₁.
    """

    def __init__(self, matrices: Matrices, solve: Linear) -> None:
        single = [partial(multiply, crow, col, v.float()) for crow, col, v in matrices]
        self.single, self._near = single[:2], single[2]
        self.whole = [partial(_in_chunks, partial(multiply, *each)) for each in matrices[:2]]
        rough = without_small_entries(*matrices[0])
        sums = absolute_row_sums(rough[0], rough[2])
        self.cycle = two_grid(partial(multiply, *rough), sums, solve)

    def shifted(self, p: Tensor, shifts: Tensor) -> Tensor:
        """(K − λM₁)p of every column by its λ."""
        return self.single[0](p).sub_(self._near(p).mul_(shifts))


def _in_chunks(product: Linear, x: Tensor) -> Tensor:
    """A product by some columns at once, for which the library takes several times their memory."""
    result = torch.empty_like(x)
    for here, part in zip(result.split(CHUNK, 1), x.split(CHUNK, 1), strict=True):
        here.copy_(product(part))
    return result


def swept(
    matrices: Matrices, u: Float[Tensor, "N m"], k: int, solve: Linear, tolerance: float, zero: int
) -> tuple[Tensor, ...] | None:
    """Sweep from the P1 eigenvectors until the first k eigenvalues are accurate; None if that takes too many sweeps.

    Of K, M and M₁, and a product with the inverse of K₁ + σM₁; `zero` is the number of eigenvalues 0 among the m. The
    result has the eigenvalues, estimates of their relative errors, U and MU.
    """
    maps, count = _Maps(matrices, solve), u.shape[1]
    u = u.float().contiguous()
    values, known = _ritz([[u], *([on(u)] for on in maps.single)], count)
    for sweep in range(ROUNDS + 1):
        keep = closed(values, k, tolerance) if sweep else count
        size, estimates, r, z = _residuals(maps, known, values[:keep])
        scale = SAFETY * size.double() ** 2 / values[:keep].abs().clamp_min(TINY)
        errors = scale * estimates.abs()
        errors[:zero] = 0.0
        if sweep and float(errors.max()) <= tolerance:
            u, _, mu = (x[:, :keep] for x in known)
            return values[:keep], errors, u, mu
        coarse = float(errors[:k].max()) > ASTRAY
        active = (errors > tolerance if sweep else torch.ones_like(errors)).nonzero()[:, 0]
        # each step leaves a quarter of the energy or less, so the last one takes off FACTOR times what is left
        enough = FACTOR * (SMALL * errors).clamp_min(tolerance) / scale.clamp_min(TINY)
        right = [x.float()[..., active] for x in (r, z, values[:keep], enough)]
        del r, z
        small, steps = (known[0].float(), known[2].float()), 1 if coarse else LONGEST
        parts = zip(*(x.split(CHUNK, -1) for x in right), strict=True)
        w = torch.cat([_correction(maps, small, part, steps) for part in parts], dim=1).double()
        del right, small, parts
        if sweep:
            new = [w.addmm_(known[0], known[2].T @ w, alpha=-1)]
        else:
            new, known = [known[0].double(), w] if coarse else [known[0] - w * size], ()
        space = [new, *([on(x) for x in new] for on in maps.whole)]
        if sweep:
            space = [[old, *parts] for old, parts in zip(known, space, strict=True)]
        w = new = None
        known = ()
        values, known = _ritz(space, count)
    if len(u) > LARGEST_FACTORED:
        raise EigenbasisError(
            f"eigenbasis: after {ROUNDS} sweeps the estimated relative error of some of {k} eigenvalues is above "
            f"{tolerance:.1g}; ask for a larger tolerance"
        )
    return None


def _residuals(maps: _Maps, known: Blocks, values: Tensor) -> tuple[Tensor, ...]:
    """The norms of Ku − λMu, their energies in units of these, the residuals of norm one, and the cycle of these."""
    r, z = torch.empty(2, len(known[0]), len(values), device=values.device)
    size, energy = torch.empty_like(values), torch.empty(len(values), device=values.device)
    for some in torch.arange(len(values), device=values.device).split(CHUNK):
        residual, mu = (x.index_select(1, some) for x in known[1:])
        residual.addcmul_(mu, values[some].to(mu), value=-1)
        size[some] = residual.norm(dim=0).clamp_min(TINY).to(size)
        r[:, some] = residual.div_(size[some].to(residual)).float()
        del residual, mu
        z[:, some] = maps.cycle(r[:, some])
        energy[some] = _dots(r[:, some], z[:, some])
    return size, energy, r, z


def _correction(
    maps: _Maps, known: tuple[Tensor, Tensor], right: tuple[Tensor, ...], steps: int
) -> Tensor:
    """Conjugate gradients for every column of (K − λM)w = r, M-orthogonal to U; of [U, MU] and [r, cycle(r), λ, ε].

    A column ends with the step that reduces its energy by less than ε, or with the last step.
    """
    (u, mu), (r, z, shifts, enough) = known, right
    w, p, square = torch.zeros_like(r), torch.zeros_like(r), torch.ones_like(enough)
    at, found = torch.arange(r.shape[1], device=r.device), []
    for step in range(steps):
        z = z - u @ (mu.T @ z)
        before, square = square, _dots(r, z).clamp_min(0)  # negative only by rounding
        p = torch.addcmul(z, p, torch.where(before > 0, square / before, 0.0))
        product = maps.shifted(p, shifts)
        curvature = _dots(p, product)
        length = torch.where(curvature > 0, square / curvature, 0.0)
        w.addcmul_(p, length)
        goes_on = (length * square > enough) & (step < steps - 1)
        ends, stays = (where.nonzero()[:, 0] for where in (~goes_on, goes_on))
        if len(ends):
            found.append((at[ends], w.index_select(1, ends)))
            parts = r, product, length, w, p, at, square, shifts, enough
            r, product, length, w, p, at, square, shifts, enough = (
                x.index_select(-1, stays) for x in parts
            )
        if len(stays) == 0:
            break
        r = torch.addcmul(r, product, length, value=-1)
        z = maps.cycle(r)
    order, w = (torch.cat(parts, -1) for parts in zip(*found, strict=True))
    return w.index_select(1, order.argsort())


def _ritz(space: list[list[Tensor]], count: int) -> tuple[Tensor, Blocks]:
    """Rayleigh–Ritz on the span of U, from the columns of (U, KU, MU): the smallest values and their (U, KU, MU).

    Each is given as a list of blocks of columns. The first one is overwritten by the result, and the others let go.
    """
    a, b = (
        torch.cat([torch.cat([(u.T @ x).double() for x in product], 1) for u in space[0]])
        for product in space[1:]
    )
    scale = torch.where(b.diagonal() > 0, b.diagonal(), np.inf) ** -0.5  # drop vectors without mass
    squares, q = torch.linalg.eigh(b * scale * scale[:, None])
    q = (scale[:, None] * q / squares.clamp_min(TINY).sqrt())[:, squares > ROUNDING]
    values, y = torch.linalg.eigh(q.T @ a @ q)
    y = (q @ y[:, :count]).to(space[0][0])
    found = []
    while space:
        blocks = space.pop(0)
        fits = blocks[0].shape[1] == y.shape[1]
        result = blocks[0] if fits else blocks[0].new_empty(len(blocks[0]), y.shape[1])
        for rows in zip(result.split(AT_ONCE), *(x.split(AT_ONCE) for x in blocks), strict=True):
            torch.mm(torch.cat(rows[1:], 1), y, out=rows[0])
        found.append(result)
    return values[:count], tuple(found)
