"""The linear systems behind implicit steps and Poisson problems.

A system is a K + b M, where K includes the terms of a Robin condition and of a potential, without the rows and columns
of Dirichlet points. It is solved by conjugate gradients, preconditioned with a factor of the P1 pair, which is
spectrally close and 20 times sparser (`method.md`, section 10). Where rows of the fits have large weights, K is up to
thirty times stiffer than K₁ at single points, in local functions: smoothing before and after the factor's solve then
takes a third of the iterations. Several times in one call share factors, those of powers of four. Factors are kept as
long as their operator; a batch uses those of its shapes.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from functools import cached_property, partial
from typing import Literal
from weakref import finalize

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor

from torchlb.errors import DiffusionError
from torchlb.linalg.conjugate_gradients import Linear, conjugate_gradients
from torchlb.linalg.factor import Factor
from torchlb.linalg.precision import LOW, NEGLIGIBLE, ROOT_EPS, SINGLE, TINY
from torchlb.linalg.sparse import multiply, to_scipy
from torchlb.linalg.two_grid import Matrix, absolute_row_sums, two_grid, without_small_entries
from torchlb.operator.batching import shapes_of
from torchlb.operator.storage import OperatorStorage

KEPT = 8
"""Number of factors kept for each operator."""
SPACING = 4.0
"""Ratio of successive times with factors: M + tK and the matrix of its factor differ by its square root at most."""

Tolerance = float | Literal["P1"]
"""Relative tolerance of a solve with the weak pair; "P1" for the solution by P1 elements, of second order."""


def pair_system(lb: OperatorStorage) -> PairSystem:
    """The system of an operator with a weak pair, for all times."""
    cache = lb.cache
    cache.system = cache.system or PairSystem(lb)
    return cache.system


def solve_columns(
    lb: OperatorStorage,
    b: Float[Tensor, "N C"],
    time: Float[Tensor, " C"] | None,
    tolerance: Tolerance,
) -> Float[Tensor, "N C"]:
    """(M + tK)⁻¹b of every column by its time, or K⁻¹b for a time of None."""
    time = None if time is None else time.detach()
    return _by_shape(lb, b, lambda system, part: system.solve(part, time, tolerance))


def means(lb: OperatorStorage, b: Float[Tensor, "N C"]) -> Float[Tensor, "N C"]:
    """1ᵀb over the area of each component on which K1 = 0, at its points; zero on others."""
    return _by_shape(lb, b, lambda system, part: system.mean(part.double()).expand_as(part))


def _by_shape(
    lb: OperatorStorage, b: Tensor, function: Callable[[PairSystem, Tensor], Tensor]
) -> Tensor:
    """A function of the system and the rows of b of each shape, whose factors serve its batch."""
    shapes = shapes_of(lb) or (lb,)
    parts = zip(shapes, b.split([shape.num_points for shape in shapes]), strict=True)
    return torch.cat([function(pair_system(shape), part) for shape, part in parts])


class PairSystem:
    """K, and M + tK for every t, of a weak pair."""

    def __init__(self, lb: OperatorStorage) -> None:
        self.dim = lb.dim
        crow, col, values = lb.weak.pair
        self.stiffness, self.mass = self.parts = list(values.detach())
        self.units = [values.abs().max().double() for values in self.parts]
        self.pattern = crow.int(), col.int()
        self.free = None if lb.fixed is None else (~lb.fixed).double()[:, None]
        self.one = torch.ones_like(lb.mass.double())[:, None]
        self.ones_mass = self.mass_product(self.one)
        self.stiff = float(self.stiffness.double().abs().sum() / self.mass.double().sum())
        self.smooths = lb.weak.linear.num_rows > 0  # the cotangent's pair is its own P1 pair
        self.steps = 0
        crow, col, linear = lb.weak.linear_pair
        first, second = (to_scipy(crow, col, v.double(), lb.shape) for v in linear)
        losing = lb.weak.losing(lb.fixed)
        # the connected components, those where K1 = 0, and their areas
        pattern = np.ones(first.nnz), first.indices, first.indptr
        graph = sparse.csr_array(pattern, shape=first.shape)  # with entries that are zero
        self.count, number = csgraph.connected_components(graph, directed=False)
        self.component = torch.from_numpy(number.astype(np.int64)).to(losing.device)
        held = losing.new_zeros(self.count, dtype=torch.float32)
        held = held.index_add(0, self.component, losing.float())
        self.unheld = ((held if self.count == 1 else held[self.component]) == 0)[:, None]
        self.area = self._sums(self.one, self.ones_mass)
        if lb.weak.of_functions:
            sums = first.sum(1)  # negative row sums (float32) would make it indefinite
            sums = np.where(losing.cpu().numpy(), np.minimum(sums, 0.0), sums)
            first = first - sparse.diags_array(sums)
        self.linear = first, second
        self.factors: OrderedDict[float | None, Factor] = OrderedDict()
        finalize(self, self.factors.clear)  # cholespy reports factors that outlive Python as leaks

    def _sums(self, weights: Float[Tensor, "N 1"], x: Float[Tensor, "N C"]) -> Float[Tensor, "_ C"]:
        """Weighted sums over the component of each point, one row where there is one component."""
        if self.count == 1:
            return weights.T @ x
        found = x.new_zeros(self.count, x.shape[1])
        return found.index_add(0, self.component, weights * x)[self.component]

    def solve(
        self, b: Float[Tensor, "N C"], time: Float[Tensor, " C"] | None, tolerance: Tolerance
    ) -> Float[Tensor, "N C"]:
        """Solve (M + tK)u = b for the time of every column, or Ku = b for a time of None; u is 0 at Dirichlet points.

        The solution of a Poisson problem has mean zero on components where K1 = 0. There constants are split off, for
        which M + tK is M: constants and the mass are exact to rounding.
        """
        if b.shape[1] == 0:
            return b.double()
        if time is not None and bool((time.diff() < 0).any()):  # group the columns of each factor
            order = time.argsort()
            return self.solve(b[:, order], time[order], tolerance)[:, order.argsort()]
        if time is not None and bool(time[0] == time[-1]):
            time = time[:1]
        b = self.inside(b.double())
        mean = self.mean(b)
        right = torch.addcmul(b, self.ones_mass, mean, value=-1)
        if time is not None and bool(self.unheld.all()):
            # for a longer time the constants of M + tK would be lost in rounding; without them u is K⁻¹b/t
            longest = float(self.area.amax()) ** (2 / self.dim) / ROOT_EPS
            right, time = right * (longest / time).clamp_max(1.0), time.clamp_max(longest)
        near = partial(self.near, self.levels(time, b.shape[1]))
        x = near(right) if tolerance == "P1" else self._solved(right, time, tolerance, near)
        shift = -self.mean(x, self.ones_mass)
        return x.add_(shift if time is None else shift + mean)

    def solve_beyond(
        self,
        b: Float[Tensor, "N C"],
        values: Float[Tensor, " C"],
        known: Float[Tensor, "N m"],
        largest: Float[Tensor, ""],
    ) -> Float[Tensor, "N C"]:
        """(K − λM)⁻¹b of every column by its λ, on the functions orthogonal in M to the known eigenvectors.

        Their eigenvalues reach up to the largest, from which the λ should keep some distance.
        """
        left, time = self.mass_product(known), 1 / largest[None]
        unit, shares = self._shares(time)
        parts = [v.double() / of for v, of in zip(self.parts, self.units, strict=True)]
        shares_of = shares[0], -values * time * shares[1]
        terms = [(share, (*self.pattern, v)) for share, v in zip(shares_of, parts, strict=True)]
        near = partial(self.near, self.levels(time, b.shape[1]))
        inverse = self._inverse(shares, unit, near)

        def precondition(r: Tensor) -> Tensor:
            # the vectors are known to the tolerance of their pairs
            x = inverse(r - left @ (known.T @ r))
            return x - known @ (left.T @ x)

        b = self.inside(b - left @ (known.T @ b))
        size = b.norm(dim=0).clamp_min(TINY)
        right = b / size * (time / unit)
        x, _ = conjugate_gradients(partial(self._product, terms), right, precondition)
        return x * size

    def mass_product(self, x: Float[Tensor, "N C"]) -> Float[Tensor, "N C"]:
        """M x, in float64."""
        return multiply(*self.pattern, self.mass.double(), x.double())

    def stiffness_product(self, x: Float[Tensor, "N C"]) -> Float[Tensor, "N C"]:
        """K x, in float64."""
        return multiply(*self.pattern, self.stiffness.double(), x.double())

    def _solved(
        self, right: Float[Tensor, "N C"], time: Tensor | None, tolerance: float, near: Linear
    ) -> Float[Tensor, "N C"]:
        """Solve by conjugate gradients, with right-hand sides and matrices scaled to about one.

        Columns of several times are solved together: a product takes hardly longer for thirty than for one.
        """
        unit, shares = self._shares(time)
        soft = time is not None and 1 + float(time[-1]) * self.stiff <= 1 / SINGLE
        dtype = torch.float32 if soft and tolerance >= SINGLE else torch.float64
        wide = torch.promote_types(self.mass.dtype, dtype)
        values = [(v.to(wide) / of).to(dtype) for v, of in zip(self.parts, self.units, strict=True)]
        exact = [(share.to(dtype), v) for share, v in zip(shares, values, strict=False)]
        if len(unit) == 1:
            whole = torch.stack([share * v for share, v in exact]).sum(0)
            exact = [(torch.ones_like(unit).to(dtype), whole)]
        product = partial(self._product, [(share, (*self.pattern, v)) for share, v in exact])
        inverse = self._inverse(shares, unit, near, centered=time is None)
        size = right.norm(dim=0).clamp_min(TINY)
        b = (right / size).to(dtype)
        x, self.steps = conjugate_gradients(product, b, inverse, tolerance=tolerance)
        return x.double() * (size / unit)

    def _shares(self, time: Tensor | None) -> tuple[Float[Tensor, " C"], list[Tensor]]:
        """A scale for the matrix of each time, and its shares of K and M scaled to one; K alone without times."""
        of_stiffness, of_mass = self.units
        if time is None:
            return of_stiffness[None], [torch.ones_like(of_stiffness[None])]
        unit = of_mass + time * of_stiffness
        return unit, [time * of_stiffness / unit, of_mass / unit]

    @cached_property
    def _rough(self) -> list[tuple[Matrix, Float[Tensor, "N 1"]]]:
        """Smoothing matrices, K and M scaled to one without small entries, and their absolute row sums."""
        parts = zip(self.parts, self.units, strict=True)
        matrices = [without_small_entries(*self.pattern, v.double() / unit) for v, unit in parts]
        return [(m, absolute_row_sums(m[0], m[2])) for m in matrices]

    def _inverse(
        self, shares: list[Tensor], unit: Tensor, near: Linear, *, centered: bool = False
    ) -> Linear:
        """The factors' solve as a preconditioner, within a two-grid cycle in float32 where that smooths.

        The cycle is of K alone where M is small for the shortest time.
        """

        def coarse(r: Tensor) -> Tensor:
            x = near(r.double()).mul_(unit)
            # where K is singular rounding adds large constants
            return (x - self.mean(x, self.ones_mass) if centered else x).to(r)

        if not self.smooths:
            return coarse
        shares = [share.float() for share in shares]
        sums = [share * s for share, (_, s) in zip(shares, self._rough, strict=False)]
        terms = [(share, matrix) for share, (matrix, _) in zip(shares, self._rough, strict=False)]
        if len(sums) == 2 and bool((sums[0][:, 0] > sums[1][:, 0] / LOW).all()):
            terms = terms[:1]
        cycle = two_grid(partial(self._product, terms), sum(sums[1:], sums[0]), coarse)
        return lambda r: cycle(r.float()).to(r)

    def _product(self, terms: list[tuple[Tensor, Matrix]], x: Tensor) -> Tensor:
        """Product of every column with its shares of the matrices."""
        parts = [share * multiply(*matrix, x) for share, matrix in terms]
        return self.inside(sum(parts[1:], parts[0]))

    def levels(self, time: Tensor | None, columns: int) -> list[tuple[float | None, int]]:
        """Times of factors and the number of columns for each: for several times, the nearest powers of four.

        Times so short that tK is small beside M share one factor; of too many powers every second or third is taken.
        """
        if time is None or len(time) == 1:
            return [(None if time is None else float(time), columns)]
        power = time.clamp_min(LOW / self.stiff).log() / math.log(SPACING)
        every = max(math.ceil(float(power[-1] - power[0]) / (KEPT - 1)), 1)
        level = SPACING ** (every * (power / every).round())
        level, count = level.unique_consecutive(return_counts=True)
        return list(zip(level.tolist(), count.tolist(), strict=True))

    def near(self, levels: list[tuple[float | None, int]], r: Tensor) -> Tensor:
        """The solution by P1 elements."""
        blocks = r.split([count for _, count in levels], dim=1)
        solved = [self.factor(t).solve(block) for (t, _), block in zip(levels, blocks, strict=True)]
        return self.inside(torch.cat(solved, dim=1))

    def factor(self, t: float | None) -> Factor:
        """The factor of M₁ + tK₁, or of K₁ with a small multiple of M₁ that makes it definite."""
        if t not in self.factors:
            self.factors[t] = self._factored(t)
            if len(self.factors) > KEPT:
                self.factors.popitem(last=False)
        self.factors.move_to_end(t)
        return self.factors[t]

    def _factored(self, t: float | None) -> Factor:
        first, second = self.linear
        if t is None:
            scale = (NEGLIGIBLE * self.area ** (-2 / self.dim)).sqrt().expand_as(self.one)[:, 0]
            scale = sparse.diags_array(scale.cpu().numpy())
            matrix = first + scale @ second @ scale
        else:
            matrix = second + t * first
        if self.free is not None:
            free = self.free[:, 0].cpu().numpy()
            keep = sparse.diags_array(free)
            matrix = keep @ matrix @ keep + sparse.diags_array((1 - free) * matrix.diagonal())
        try:
            return Factor(sparse.csr_array((matrix + matrix.T) / 2))
        except RuntimeError as error:  # a pivot of zero
            raise DiffusionError(
                "solves: the matrix is singular to rounding, as where cells are degenerate, or a shape moved too far "
                "from where its plan was made (lb.at); build the operator anew"
            ) from error

    def mean(self, b: Float[Tensor, "N C"], weights: Tensor | None = None) -> Float[Tensor, "_ C"]:
        """Weighted sums over components where K1 = 0, over their areas, as `_sums`; 0 on the others."""
        sums = self._sums(self.one if weights is None else weights, b)
        return torch.where(self.unheld, sums / self.area, 0.0)

    def inside(self, x: Tensor) -> Tensor:
        """x, set to zero at Dirichlet points."""
        return x if self.free is None else x * self.free.to(x)
