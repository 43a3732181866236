"""A manifold with exact answers, from two maps.

A manifold M of dimension d in R^n is two maps: a *retraction* R of a neighbourhood onto M, the identity on M, and a
chart of the unit cube. The rest follows. DR(x) is a projector onto the tangent space, so its leading singular vectors
are an exact frame E = [e_1 … e_d], and in the local coordinates y ↦ R(x + E y) the metric at 0 is the identity and
Γ^k_ij = e_k·∂_ij R. With F = f∘R and s = Σ_i D²R[e_i, e_i],

    Δf = Σ_i D²F[e_i, e_i] − DF[E Eᵀ s].

Everything is float64, and derivatives are exact to rounding: forward-mode differentiation along the frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor
from torch.func import jvp
from torch.nn.functional import pad

from torchlb.errors import InputError
from torchlb.linalg.precision import ROOT_EPS

PACKING = {2: (4 / 3) ** 0.25, 3: 2 ** (1 / 6)}
"""Spacing of the densest lattice of density 1, by dimension."""

Places = Float[Tensor, "*batch n"]
Points = Float[Tensor, "N n"]
Values = Float[Tensor, "*batch_and_channels"]
Function = Callable[[Tensor], Tensor]  # (N, n) → (N,) or (N, C), each row by itself


class Surface:
    """A compact smooth manifold in R^n. The boundary, where there is one, is the unit circle of z = 0."""

    dim: ClassVar[int] = 2
    ambient_dim: ClassVar[int] = 3
    perimeter: ClassVar[float] = 0.0  # length ℓ of the boundary

    # A subclass defines the methods that follow; the rest derives from them.

    def _retract(self, x: Places) -> Places:
        raise NotImplementedError

    def _chart(self, cube: Float[Tensor, "N d"]) -> Points:
        """Points with coordinates in [0, 1)^d; a boundary is at u_0 = 1."""
        raise NotImplementedError

    def _outward(self, points: Places) -> Places:
        """A field on the positive side of the tangent plane, not necessarily normal."""
        return points

    def _inside(self, points: Points, margin: float) -> Points:
        """Points moved to at least the margin from the boundary."""
        return points

    def _faces(self, points: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def _spectrum(self, k: int, condition: str) -> np.ndarray:
        """The k least eigenvalues, or more of them in any order."""
        raise InputError(f"{type(self).__name__}: no exact eigenvalues are known")

    def retract(self, x: Places) -> Places:
        """Smooth map R of a neighbourhood onto the surface, the identity on it."""
        return self._retract(x)

    def eigenvalues(self, k: int, condition: str = "neumann") -> Float[Tensor, " k"]:
        """The first k exact eigenvalues of −Δ with multiplicity, ascending, 1/ℓ²; ValueError if unknown."""
        known = ["neumann", "dirichlet"] if self.perimeter else ["neumann"]
        require(condition in known, "condition", " or ".join(known), condition)
        require(k >= 1, "k", "a positive number", k)
        return torch.from_numpy(np.sort(self._spectrum(k, condition))[:k])

    @property
    def area(self) -> float:
        """The d-dimensional volume, ℓ^d, by Gauss quadrature of the chart's area element; to rounding."""
        return _area_and_peak(self)[0]

    def _density(self, cube: Float[Tensor, "N d"]) -> Float[Tensor, " N"]:
        """Area element √det JᵀJ of the chart."""
        jacobian = _jacobian(self._chart, cube)
        return torch.linalg.det(jacobian.mT @ jacobian).sqrt()

    def _sample(self, n: int, draw: Callable[[int], Tensor]) -> Points:
        """n points uniform in area, by rejection from `draw(count)`, (count, d + 1) in [0, 1)."""
        area, peak = _area_and_peak(self)
        bound = 1.001 * peak
        count = int(1.1 * n * bound / area) + 64
        while True:
            cube, level = draw(count).split([self.dim, 1], dim=1)
            accepted = cube[bound * level[:, 0] <= self._density(cube)]
            if len(accepted) >= n:
                return self._chart(accepted[:n])
            count *= 2

    def random_points(self, n: int, seed: int = 0) -> Points:
        """n independent points, uniform with respect to area."""
        require(n >= 1, "n", "a positive number", n)
        source = torch.Generator().manual_seed(seed)
        return self._sample(n, lambda count: _uniform(count, self.dim + 1, source))

    def points(self, n: int, seed: int = 0) -> Points:
        """n ≥ 8 quasi-uniform points: a low-discrepancy sequence, then short-range repulsion.

        Boundary points come first, equally spaced and exactly on the boundary. Spacings of a curve are 0.75 to 1.25 of
        the mean.
        """
        require(n >= 8, "n", "at least 8", n)
        source = torch.Generator().manual_seed(seed)
        if self.dim == 1:
            return self._stratified((torch.arange(n)[:, None] + _uniform(n, 1, source) / 4) / n)
        half = self.perimeter / 2  # a point on the boundary has half a cell
        if half:  # (n − half / spacing) (spacing / packing)² = area
            discriminant = half**2 + 4 * n * self.area * PACKING[2] ** 2
            spacing = (half + math.sqrt(discriminant)) / (2 * n)
        else:
            spacing = PACKING[self.dim] * (self.area / n) ** (1 / self.dim)
        turns = torch.linspace(0, 1, round(self.perimeter / spacing) + 1, dtype=torch.float64)[:-1]
        ring = pad(circle(turns), (0, self.ambient_dim - 2))
        shift = _uniform(1, self.dim + 1, source)
        scale = torch.ones_like(shift)
        scale[0, 0] -= half * spacing / self.area  # area of the half cells at the boundary
        free = self._sample(n - len(ring), lambda count: scale * _kronecker(count, shift))
        return torch.cat([ring, self._repel(free, ring, spacing)])

    def _stratified(self, shares: Float[Tensor, "N 1"]) -> Points:
        """Points of a curve, by fractions of its length."""
        grid = torch.linspace(0, 1, 4097, dtype=torch.float64)[:, None]
        length = pad(torch.cumulative_trapezoid(self._density(grid)), (1, 0)).numpy()
        cube = np.interp(shares[:, 0].numpy() * length[-1], length, grid[:, 0].numpy())
        return self._chart(torch.from_numpy(cube)[:, None])

    def _repel(self, free: Points, fixed: Float[Tensor, "B n"], spacing: float) -> Points:
        """The free points after 40 steps away from neighbours nearer than 1.3 spacings."""
        neighbors = min((self.dim + 1) ** 2, len(free) + len(fixed) - 1)
        for _ in range(10):
            everything = torch.cat([free, fixed]).numpy()
            _, found = KDTree(everything).query(free.numpy(), k=neighbors + 1)
            nearest = np.asarray(found)[:, 1:]  # without the point itself
            frames = self.frames(free)  # R need not be the nearest point: stay on its tangent plane
            for _ in range(4):  # neighbours change slowly
                offset = (free[:, None] - torch.cat([free, fixed])[nearest]) / (1.3 * spacing)
                distance = offset.norm(dim=-1, keepdim=True)
                push = ((1 - distance).clamp(min=0) * offset / distance).sum(1)[..., None]
                step = 0.3 * spacing * (frames @ (frames.mT @ push))[..., 0]
                free = self._inside(self.retract(free + step), spacing / 2)
        return free

    def boundary_mask(self, points: Points) -> Bool[Tensor, " N"]:
        """Mask of the points that lie on the boundary."""
        on_circle = (self._checked(points)[:, :2].norm(dim=1) - 1).abs() < ROOT_EPS
        return on_circle & (self.perimeter > 0)

    def _checked(self, points: Points) -> Points:
        name, expected = type(self).__name__, f"float64 points (N, {self.ambient_dim})"
        fits = points.ndim == 2 and points.shape[1] == self.ambient_dim
        given = f"{points.dtype} {tuple(points.shape)}"
        require(fits and points.dtype == torch.float64, name, expected, given)
        distance = (self.retract(points) - points).norm(dim=1)
        off = torch.nonzero(~(distance <= ROOT_EPS))[:, 0].tolist()  # NaN is off the surface, too
        require(not off, name, "points on the surface (use retract)", f"others: {off[:8]}")
        return points.detach()

    def frames(self, points: Points) -> Float[Tensor, "N n d"]:
        """Exact orthonormal tangent frames."""
        return torch.linalg.svd(_jacobian(self.retract, self._checked(points)))[0][..., : self.dim]

    def normals(self, points: Points) -> Points:
        """Exact unit normals of a hypersurface, outward (+z on the disk)."""
        codim = self.ambient_dim - self.dim
        require(codim == 1, type(self).__name__, "codimension 1 (else use frames)", codim)
        points = self._checked(points)
        normals = torch.linalg.svd(_jacobian(self.retract, points))[0][..., -1]
        return normals * (normals * self._outward(points)).sum(1, keepdim=True).sign()

    def gradient(self, f: Function, points: Points) -> Values:
        """Tangent gradient, 1/ℓ, as ambient vectors (N, n) or (N, n, C)."""
        frames = self.frames(points)
        slopes = [_derivative(f, points.detach(), e) for e in frames.unbind(-1)]
        return torch.einsum("xni,xi...->xn...", frames, torch.stack(slopes, 1))

    def laplacian(self, f: Function, points: Points) -> Values:
        """Exact Δf, 1/ℓ², (N,) or (N, C); the analyst's sign, Δ Y_l = −l (l + 1) Y_l on the unit sphere.

        Functions that torch cannot differentiate in forward mode, such as `torch.special.bessel_j0`, count as constant.
        """
        frames, points = self.frames(points), points.detach()
        bending = _second_derivatives(self.retract, points, frames)
        drift = (frames @ (frames.mT @ bending[..., None]))[..., 0]

        def pulled(x: Tensor) -> Tensor:
            return f(self.retract(x))

        return _second_derivatives(pulled, points, frames) - _derivative(pulled, points, drift)

    def mean_curvature_normal(self, points: Points) -> Points:
        """Exact Δx, 1/ℓ: normal to the surface, inward where it is convex, d times the mean curvature."""
        return self.laplacian(lambda x: x, points)

    def triangulate(self, points: Points) -> Int[Tensor, "F 3"]:
        """Triangles on points of a surface of dimension 2, oriented outward; each point is a vertex."""
        require(self.dim == 2, type(self).__name__, "dimension 2, for triangles", self.dim)
        faces = self._faces(self._checked(points).numpy()).astype(np.int64)
        unused = np.setdiff1d(np.arange(len(points)), faces).tolist()
        require(not unused, "points", "each in a triangle (are there duplicates?)", unused[:8])
        return torch.from_numpy(faces)

    def mesh(self, n: int, seed: int = 0) -> tuple[Points, Int[Tensor, "F 3"]]:
        """`points(n, seed)` and their triangles."""
        points = self.points(n, seed)
        return points, self.triangulate(points)


def _derivative(f: Function, x: Points, direction: Points) -> Values:
    """Df(x)[direction], row by row."""
    slope = jvp(f, (x,), (direction,))[1]
    require(len(slope) == len(x), "f", f"{len(x)} rows", tuple(slope.shape))
    return slope


def _second_derivatives(f: Function, x: Points, frames: Float[Tensor, "N n d"]) -> Values:
    """Σ_i D²f(x)[e_i, e_i] along the columns of the frames, row by row."""
    terms = [_derivative(lambda z, e=e: _derivative(f, z, e), x, e) for e in frames.unbind(-1)]
    return torch.stack(terms).sum(0)


def _jacobian(f: Function, x: Points) -> Float[Tensor, "N n_values n"]:
    axes = torch.eye(x.shape[1], dtype=x.dtype)
    return torch.stack([_derivative(f, x, axis.expand_as(x)) for axis in axes], -1)


@lru_cache
def _quadrature(dim: int) -> tuple[Float[Tensor, "Q d"], Float[Tensor, " Q"]]:
    """Gauss nodes and weights of the unit cube."""
    gauss, weight = np.polynomial.legendre.leggauss(256 if dim < 3 else 24)
    nodes = torch.cartesian_prod(*[torch.from_numpy(gauss + 1) / 2] * dim)
    weights = torch.cartesian_prod(*[torch.from_numpy(weight) / 2] * dim)
    return nodes.view(-1, dim), weights.view(-1, dim).prod(1)


@lru_cache
def _area_and_peak(surface: Surface) -> tuple[float, float]:
    """Integral and maximum of the area element; cached for equal surfaces."""
    nodes, weights = _quadrature(surface.dim)
    density = surface._density(nodes)
    return float(density @ weights), float(density.max())


def circle(turns: Float[Tensor, " N"]) -> Float[Tensor, "N 2"]:
    """Points of the unit circle, by fractions of a turn."""
    return torch.stack([(2 * math.pi * turns).cos(), (2 * math.pi * turns).sin()], 1)


def _uniform(rows: int, columns: int, generator: torch.Generator) -> Float[Tensor, "rows columns"]:
    return torch.rand(rows, columns, generator=generator, dtype=torch.float64)


def _kronecker(count: int, shift: Float[Tensor, "1 D"]) -> Float[Tensor, "count D"]:
    """The sequence shift + i (φ⁻¹, …, φ⁻ᵈ, √2) mod 1, where φ^{d+1} = φ + 1 (M. Roberts, 2018).

    The first d coordinates have low discrepancy in d dimensions; the last is only for rejection.
    """
    dim, golden = shift.shape[1] - 1, 2.0
    for _ in range(60):
        golden = (1 + golden) ** (1 / (dim + 1))
    step = [golden**-c for c in range(1, dim + 1)] + [math.sqrt(2)]
    index = torch.arange(count, dtype=torch.float64)[:, None]
    return (shift + index * torch.tensor(step, dtype=torch.float64)) % 1


def require(condition: bool, name: str, expected: str, value: object) -> None:
    """Raise a ValueError that says what was expected and what came, unless the condition holds."""
    if not condition:
        raise InputError(f"{name}: expected {expected}, got {value}")
