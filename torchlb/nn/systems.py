"""The linear systems behind implicit steps and Poisson problems, by the weak pair or by the stencil.

A system is a K + b M with the rows and columns of Dirichlet points taken out. The weak pair is solved by conjugate
gradients; the factor of the linear pair, which is spectrally close and 20 times sparser, preconditions them
(`method.md`, section 10). Where rows of the fits have large weights, K is up to thirty times stiffer than K₁ at single
points, in functions that live there: smoothing before and after the factor's solve then takes a third of the steps.
Many times of one call share factors, those of powers of four. Factors are kept as long as the operator that they
belong to; a batch takes those of its shapes.
"""

from __future__ import annotations

import atexit
import math
from collections import OrderedDict
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy import sparse
from scipy.sparse import csgraph
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from torchlb.linalg.conjugate_gradients import conjugate_gradients
from torchlb.linalg.factor import cholesky, factorized
from torchlb.linalg.sparse import multiply
from torchlb.linalg.two_levels import two_levels
from torchlb.nn.conduction import Conducting
from torchlb.operator.batching import shapes_of
from torchlb.operator.laplace_beltrami import LaplaceBeltrami

KEPT = 8
"""Factors that are kept for each operator."""
SINGULAR = 1e-6
"""Share of M₁ over the area that makes K₁ definite; constants, which it moves alone, are split off."""
SPACING = 4.0
"""Between the times of shared factors: M + tK and its factor's matrix then differ by less than that."""
SINGLE, STIFFEST = 1e-5, 1e5
"""A tolerance from which on steps are taken in float32, unless the entries of M + tK sum to more than so many times the
area: what is rounded there would show."""
TINY = 1e-300
SHIFT = 1e-9
"""Of an inverted stencil that is singular, in units of its diagonal."""
Operator = LaplaceBeltrami | Conducting
_SYSTEMS: Any = WeakIdKeyDictionary()
atexit.register(_SYSTEMS.clear)  # cholespy reports factors that outlive Python as leaks


def system(lb: Operator, t: float | None) -> PairSystem | StencilSystem:
    """That of an implicit step of a time t, or of a Poisson problem for None."""
    kept = _SYSTEMS.setdefault(lb.values, OrderedDict())
    key = t, lb.values.device
    if key not in kept:
        kept[key] = PairSystem(lb, t) if lb.has_weak_form else StencilSystem(lb, t)
        if len(kept) > KEPT:
            kept.popitem(last=False)
    kept.move_to_end(key)
    return kept[key]


def solve_columns(
    lb: Operator,
    b: Float[Tensor, "N C"],
    time: Float[Tensor, " C"] | None,
    tolerance: float | None,
    transposed: bool = False,
) -> Float[Tensor, "N C"]:
    """(M + tK)⁻¹b of every column by its time, or K⁻¹b for a time of None; with the stencil 1 − tL and −L.

    A time of 0 has M, or 1, to invert. A tolerance of None takes linear elements for the pair.
    """
    shapes = shapes_of(lb)
    if shapes and all(shape.has_weak_form == lb.has_weak_form for shape in shapes):
        blocks = zip(shapes, b.split([shape.num_points for shape in shapes]), strict=True)
        parts = [solve_columns(s, part, time, tolerance, transposed) for s, part in blocks]
        return torch.cat(parts)
    if time is None:
        return system(lb, None).solve(b, tolerance, transposed)
    time = time.detach()
    level = time
    if lb.has_weak_form and len(time.unique()) > 1:
        level = SPACING ** (time.log() / math.log(SPACING)).ceil()
    u = torch.zeros_like(b, dtype=torch.float64)
    for t in level.unique().tolist():
        where = level == t
        solver = system(lb, t)
        options = {}
        if isinstance(solver, PairSystem) and not bool((time[where] == t).all()):
            options["times"] = time[where]
        u[:, where] = solver.solve(b[:, where], tolerance, transposed, **options)
    return u


class _Components:
    """Means over the connected components of a shape, and which of them have a Dirichlet point."""

    def __init__(self, lb: Operator) -> None:
        if isinstance(lb, LaplaceBeltrami) and not lb.has_weak_form:
            crow, col = lb.crow, lb.col
        else:
            crow, col, _ = lb.linear_pair
        where = (np.ones(len(col)), col.cpu().numpy(), crow.cpu().numpy())
        graph = sparse.csr_array(where, shape=lb.shape)
        self.count, number = csgraph.connected_components(graph, directed=False)
        self.of = torch.from_numpy(number.astype(np.int64)).to(col.device)
        held = torch.zeros(self.count, device=col.device)
        if lb.fixed is not None:
            held = held.index_add(0, self.of, lb.fixed.float())
        if self.count > 1:
            held = held[self.of]
        self.free = (held == 0)[
            :, None
        ]  # points whose component has no Dirichlet point; one for all if there is one

    def sums(self, weights: Float[Tensor, "N 1"], x: Float[Tensor, "N C"]) -> Float[Tensor, "_ C"]:
        """Of every point the weighted sum over its component; one row for all where there is one component."""
        if self.count == 1:
            return weights.T @ x
        found = x.new_zeros(self.count, x.shape[1])
        return found.index_add(0, self.of, weights * x)[self.of]


class PairSystem:
    """K, or M + tK, of a weak pair."""

    def __init__(self, lb: Operator, t: float | None) -> None:
        stiffness, mass = (v.detach().double() for v in lb.weak_values[:2])
        crow, col, linear = lb.linear_pair
        self.pattern = lb.weak_crow, lb.weak_col
        values = stiffness if t is None else mass + t * stiffness
        self.stiffness, self.mass, self.singular = stiffness, mass, t is None
        self.unit = values.abs().max()
        self.values = values / self.unit
        self.free = None if lb.fixed is None else (~lb.fixed).double()[:, None]
        self.components = _Components(lb)
        self.ones_mass = multiply(*self.pattern, mass, torch.ones_like(lb.mass.double())[:, None])
        self.one = torch.ones_like(self.ones_mass)
        self.area = self.components.sums(self.one, self.ones_mass)
        self.steps = 0
        self.soft = not self.singular and bool(values.abs().sum() <= STIFFEST * mass.sum())
        n = lb.num_points
        first, second = (
            sparse.csr_array(
                (v.detach().double().cpu().numpy(), col.cpu().numpy(), crow.cpu().numpy()),
                shape=(n, n),
            )
            for v in linear[:2]
        )
        first = first - sparse.diags_array(
            first.sum(1)
        )  # rounded to float32 it would be indefinite
        if t is None:
            scale = (SINGULAR / self.area).sqrt().expand(n, 1)[:, 0]
            scale = sparse.diags_array(scale.cpu().numpy())
            matrix = first + scale @ second @ scale
        else:
            matrix = second + t * first
        if self.free is not None:
            free = self.free[:, 0].cpu().numpy()
            keep = sparse.diags_array(free)
            matrix = keep @ matrix @ keep + sparse.diags_array((1 - free) * matrix.diagonal())
        self.factor = cholesky((matrix + matrix.T) / 2)
        self.cycle = None  # the cotangent's pair is the linear one
        if len(lb.linear_crow):
            values = self.values
            if self.free is not None:
                rows = torch.repeat_interleave(self.pattern[0].diff())
                values = values * self.free[rows, 0] * self.free[self.pattern[1], 0]
            self.cycle, _ = two_levels(*self.pattern, values, self._coarse)

    def solve(
        self,
        b: Float[Tensor, "N C"],
        tolerance: float | None,
        transposed: bool = False,
        times: Float[Tensor, " C"] | None = None,
    ) -> Float[Tensor, "N C"]:
        """The solution, zero at Dirichlet points, of mean zero on the other components of a Poisson problem.

        On these, constants are split off, for which M + tK is M: they and the mass stay to rounding. A tolerance of
        None takes the factor's solution, that of linear elements; `times`, from t / 4 to t, are those of the columns.
        """
        b = self._inside(b.double())
        mean = self._mean(self.one, b)
        right = torch.addcmul(b, self.ones_mass, mean, value=-1)
        if tolerance is None:
            x = self._inside(self.factor.solve(right))
        else:
            size = right.norm(dim=0).clamp_min(TINY)
            x, self.steps = conjugate_gradients(
                lambda x: self._product(x, times),
                (right / size).to(torch.float32 if self.soft and tolerance >= SINGLE else b.dtype),
                self._precondition,
                tolerance=tolerance,
            )
            x = x.double() * (size / self.unit)
        shift = -self._mean(self.ones_mass, x)
        return x.add_(shift if self.singular else shift + mean)

    def _mean(self, weights: Tensor, x: Tensor) -> Tensor:
        """Weighted sums over components that no Dirichlet point holds, by their areas; 0 on the others."""
        return torch.where(self.components.free, self.components.sums(weights, x) / self.area, 0.0)

    def _product(self, x: Tensor, times: Tensor | None) -> Tensor:
        if times is None:
            return self._inside(multiply(*self.pattern, self.values.to(x), x))
        stiffness, mass = (multiply(*self.pattern, v.to(x), x) for v in (self.stiffness, self.mass))
        return self._inside((mass + times.to(x) * stiffness) / self.unit)

    def _precondition(self, r: Tensor) -> Tensor:
        """Of a residual: the factor's solve between smoothing in the matrix of time t, in float32."""
        return self._coarse(r) if self.cycle is None else self.cycle(r.float()).to(r)

    def _coarse(self, r: Tensor) -> Tensor:
        """The factor's solve, without the constants, which are large from rounding alone where K is singular."""
        x = self.unit * self._inside(self.factor.solve(r.double()))
        return (x - self._mean(self.ones_mass, x) if self.singular else x).to(r)

    def _inside(self, x: Tensor) -> Tensor:
        return x if self.free is None else x * self.free.to(x)


class StencilSystem:
    """−L, or 1 − tL, of a stencil L, by sparse LU on the CPU."""

    def __init__(self, lb: Operator, t: float | None) -> None:
        n = lb.num_points
        assert isinstance(lb, LaplaceBeltrami)
        matrix = sparse.csr_array(lb.to_scipy(), dtype=np.float64)
        self.components = None
        shift = 1.0
        if t is None:
            self.components = _Components(lb)
            shift = SHIFT * float(np.median(np.abs(matrix.diagonal())))
            t = 1.0
        self.free = None if lb.fixed is None else (~lb.fixed).double()[:, None]
        self.mass = lb.mass.detach().double()[:, None]
        self.lu = factorized(sparse.csc_array(shift * sparse.eye_array(n) - t * matrix), 1e-2)

    def solve(
        self, b: Float[Tensor, "N C"], tolerance: float | None, transposed: bool = False
    ) -> Float[Tensor, "N C"]:
        """As for the pair, but exact; `transposed` for the transposed matrix."""
        b = b.double() if self.free is None else b.double() * self.free
        if self.components is not None:
            b = self._without(b, transposed)
        x = self.lu.solve(b.detach().cpu().numpy(), "T" if transposed else "N")
        result = torch.from_numpy(x).to(b)
        result = result if self.free is None else result * self.free
        return result if self.components is None else self._without(result, transposed)

    def _without(self, x: Tensor, transposed: bool) -> Tensor:
        """Without constants, in the mass π, or without π, in the sum."""
        assert self.components is not None
        ones = torch.ones_like(self.mass)
        area = self.components.sums(ones, self.mass)
        one, other = (ones, self.mass) if transposed else (self.mass, ones)
        less = other * self.components.sums(one, x) / area
        return x - torch.where(self.components.free, less, 0.0)
