"""Spheres, tori, curves, disks: each a retraction and a chart for `base`, with its closed forms."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import ConvexHull, Delaunay
from scipy.special import jn_zeros, jnp_zeros
from torch import Tensor
from torch.nn.functional import pad

from torchlb.surfaces.base import Function, Places, Points, Surface, circle, require


class _Radial(Surface):
    """A surface with one point in each direction: the retraction of the unit vector."""

    def _chart(self, cube: Float[Tensor, "N d"]) -> Points:
        return self.retract(_directions(cube))

    def _faces(self, points: np.ndarray) -> np.ndarray:
        directions = points / np.linalg.norm(points, axis=1, keepdims=True)
        faces = ConvexHull(directions).simplices
        inward = np.linalg.det(directions[faces]) < 0
        faces[inward] = faces[inward, ::-1]
        return faces


@dataclass(frozen=True)
class _Round(_Radial):
    radius: float = 1.0

    def __post_init__(self) -> None:
        require(self.radius > 0, "radius", "a positive length", self.radius)

    def _retract(self, x: Places) -> Places:
        return self.radius * _unit(x)

    def _spectrum(self, k: int, condition: str) -> np.ndarray:
        d, degree = self.dim, np.arange(k)  # as often as there are harmonic polynomials
        times = [math.comb(j + d, d) - math.comb(max(j + d - 2, 0), d) for j in degree]
        return np.repeat(degree * (degree + d - 1) / self.radius**2, times)


class Sphere(_Round):
    """The sphere of radius `radius`, ℓ, in R³: eigenvalues l (l + 1) / radius², 2l + 1 times.

    Examples
    --------
    >>> Sphere().eigenvalues(5).tolist()
    [0.0, 2.0, 2.0, 2.0, 6.0]
    """


class Circle(_Round):
    """The circle of radius `radius`, ℓ, in R²: eigenvalues l² / radius², twice for l > 0."""

    dim: ClassVar[int] = 1
    ambient_dim: ClassVar[int] = 2


class ThreeSphere(_Round):
    """The sphere S³ of radius `radius`, ℓ, in R⁴: eigenvalues l (l + 2) / radius², (l + 1)² times."""

    dim: ClassVar[int] = 3
    ambient_dim: ClassVar[int] = 4


@dataclass(frozen=True)
class Ellipsoid(_Radial):
    """(x/a)² + (y/b)² + (z/c)² = 1 with semi-axes (a, b, c), ℓ."""

    semi_axes: tuple[float, float, float] = (1.5, 1.0, 0.7)

    def __post_init__(self) -> None:
        require(min(self.semi_axes) > 0, "semi_axes", "positive lengths", self.semi_axes)
        object.__setattr__(self, "semi_axes", tuple(self.semi_axes))  # hashable

    def _retract(self, x: Places) -> Places:
        return _unit(x / x.new_tensor(self.semi_axes)) * x.new_tensor(self.semi_axes)

    def _chart(self, cube: Float[Tensor, "N d"]) -> Points:
        return _directions(cube) * cube.new_tensor(self.semi_axes)  # more even than by direction


@dataclass(frozen=True)
class StarShaped(_Radial):
    """r(u) = 1 + amplitude (4xyz + 3x²z − y³ + xy) in the direction u = (x, y, z): smooth, dented, asymmetric."""

    amplitude: float = 0.2

    def __post_init__(self) -> None:
        require(0 <= self.amplitude <= 0.3, "amplitude", "0 to 0.3", self.amplitude)

    def _retract(self, x: Places) -> Places:
        u = _unit(x)
        a, b, c = u.split(1, dim=-1)
        return (1 + self.amplitude * (4 * a * b * c + 3 * a**2 * c - b**3 + a * b)) * u


@dataclass(frozen=True)
class Torus(Surface):
    """The torus around the z-axis: a circle of radius `minor` with its centre at the distance `major`, ℓ."""

    major: float = 1.0
    minor: float = 0.5

    def __post_init__(self) -> None:
        require(0 < self.minor < self.major, "minor", "0 < minor < major", self.minor)

    def _outward(self, points: Places) -> Places:
        return points - self.major * pad(_unit(points[..., :2]), (0, 1))

    def _retract(self, x: Places) -> Places:
        out = self._outward(x)
        return x - out + self.minor * _unit(out)

    def _chart(self, cube: Float[Tensor, "N d"]) -> Points:
        tube = self.minor * circle(cube[:, 1])
        return torch.cat([(self.major + tube[:, :1]) * circle(cube[:, 0]), tube[:, 1:]], 1)

    def _faces(self, points: np.ndarray) -> np.ndarray:
        """Delaunay in the conformal plane of the angle around the axis and ∫ minor dv / (major + minor cos v)."""
        x, y, z = points.T
        half = np.arctan2(z, np.hypot(x, y) - self.major) / 2
        ratio = math.sqrt((self.major - self.minor) / (self.major + self.minor))
        scale = self.minor / math.sqrt(self.major**2 - self.minor**2)
        tube = 2 * scale * np.arctan2(ratio * np.sin(half), np.cos(half))
        return _periodic_delaunay(np.stack([np.arctan2(y, x), tube], 1), np.array([1, scale]))

    def _spectrum(self, k: int, condition: str) -> np.ndarray:
        """Fourier collocation for f = g(v) w^{−1/2} e^{imu}, w = major + minor cos v; error about 1e-11 λ_k.

        −g″/minor² + (w″/2w − w′²/4w²) g/minor² + m² g/w² = λ g, analytic in a strip around the real v.
        """
        strip = math.acosh(self.major / self.minor)
        n = 2 * int(32 + 20 / strip + 2 * math.sqrt(k)) + 1
        v, wave = 2 * math.pi * np.arange(n) / n, np.fft.fftfreq(n, 1 / n)
        second = np.fft.ifft(wave[:, None] ** 2 * np.fft.fft(np.eye(n), axis=0), axis=0).real
        w = self.major + self.minor * np.cos(v)
        well = (self.major - w) / (2 * w) - (self.minor * np.sin(v) / (2 * w)) ** 2
        radial = (second + np.diag(well)) / self.minor**2
        values = _by_angle(k, lambda m: np.linalg.eigvalsh(radial + np.diag((m / w) ** 2)))
        return np.concatenate([[0.0], values[1:]])


@dataclass(frozen=True)
class CliffordTorus(Surface):
    """radius (cos a, sin a, cos b, sin b) in R⁴, flat: eigenvalues (j² + k²) / radius².

    At the default radius 1/√2, ℓ, it is minimal in the unit S³, and Δx = −2x.
    """

    radius: float = math.sqrt(0.5)
    ambient_dim: ClassVar[int] = 4

    def __post_init__(self) -> None:
        require(self.radius > 0, "radius", "a positive length", self.radius)

    def _retract(self, x: Places) -> Places:
        return self.radius * torch.cat([_unit(c) for c in x.split(2, dim=-1)], -1)

    def _chart(self, cube: Float[Tensor, "N d"]) -> Points:
        return self.radius * torch.cat([circle(cube[:, 0]), circle(cube[:, 1])], 1)

    def _faces(self, points: np.ndarray) -> np.ndarray:
        return _periodic_delaunay(np.arctan2(points[:, 1::2], points[:, ::2]), np.ones(2))

    def _spectrum(self, k: int, condition: str) -> np.ndarray:
        square = np.arange(-math.isqrt(k) - 2, math.isqrt(k) + 3) ** 2
        return np.add.outer(square, square).ravel() / self.radius**2


@dataclass(frozen=True)
class SpaceCurve(Surface):
    """The trefoil ((1 + ½cos 3t) cos 2t, (1 + ½cos 3t) sin 2t, ½sin 3t) in R³, of speed 1.8 to 3.4."""

    dim: ClassVar[int] = 1

    def _at(self, t: Float[Tensor, "*batch 1"]) -> Places:
        wide = 1 + (3 * t).cos() / 2
        return torch.cat([wide * (2 * t).cos(), wide * (2 * t).sin(), (3 * t).sin() / 2], -1)

    def _chart(self, cube: Float[Tensor, "N d"]) -> Points:
        return self._at(2 * math.pi * cube)

    def _retract(self, x: Places) -> Places:
        """The point t = 3t − 2t: the angle around the tube of a torus minus the angle around its axis."""
        a, b, c = x.split(1, dim=-1)
        return self._at(torch.atan2(c, torch.hypot(a, b) - 1) - torch.atan2(b, a))

    def _spectrum(self, k: int, condition: str) -> np.ndarray:
        return (2 * math.pi / self.area * np.arange(-k, k + 1)) ** 2


@dataclass(frozen=True)
class UnitDisk(Surface):
    """The flat disk x² + y² ≤ 1, z = 0: eigenvalues are squared zeros of J_m′, or of J_m for "dirichlet"."""

    perimeter: ClassVar[float] = 2 * math.pi

    def _retract(self, x: Places) -> Places:
        return x * x.new_tensor([1, 1, 0])

    def _chart(self, cube: Float[Tensor, "N d"]) -> Points:
        return pad(cube[:, :1].sqrt() * circle(cube[:, 1]), (0, 1))

    def _outward(self, points: Places) -> Places:
        return points.new_tensor([[0, 0, 1]]).expand_as(points)

    def _inside(self, points: Points, margin: float) -> Points:
        return points * ((1 - margin) / points.norm(dim=1, keepdim=True)).clamp(max=1)

    def _faces(self, points: np.ndarray) -> np.ndarray:
        return Delaunay(points[:, :2]).simplices

    def _spectrum(self, k: int, condition: str) -> np.ndarray:
        count = math.isqrt(k) + 8  # zeros are about π apart, and the k-th eigenvalue is about 4k
        if condition == "dirichlet":
            return _by_angle(k, lambda m: jn_zeros(m, count) ** 2)
        return _by_angle(k, lambda m: np.append([0.0] * (m == 0), jnp_zeros(m, count)) ** 2)


@dataclass(frozen=True)
class Hemisphere(Surface):
    """The unit sphere's half z ≥ 0: eigenvalues l (l + 1), l + 1 times, or l times for "dirichlet"."""

    perimeter: ClassVar[float] = 2 * math.pi

    def _retract(self, x: Places) -> Places:
        return _unit(x)

    def _chart(self, cube: Float[Tensor, "N d"]) -> Points:
        return _directions(cube * cube.new_tensor([0.5, 1]))  # from the pole to the equator

    def _inside(self, points: Points, margin: float) -> Points:
        height = points[:, 2:].clamp(min=math.sin(margin))
        return torch.cat([(1 - height**2).sqrt() * _unit(points[:, :2]), height], 1)

    def _faces(self, points: np.ndarray) -> np.ndarray:
        return Delaunay(points[:, :2] / (1 + points[:, 2:])).simplices  # stereographic: conformal

    def _spectrum(self, k: int, condition: str) -> np.ndarray:
        degree = np.arange(k + 1)
        return np.repeat(degree * (degree + 1.0), degree + (condition == "neumann"))


def deserno_points(n: int) -> Float[Tensor, "N 3"]:
    """About n points of the unit sphere, regular on circles of latitude (M. Deserno, 2004).

    The number of circles is rounded, that of points on each rounded up, as in Compadre's examples.
    """
    require(n >= 8, "n", "at least 8", n)
    area = 4 * math.pi / n
    circles = round(math.pi / math.sqrt(area))
    rows = []
    for theta in math.pi / circles * (np.arange(circles) + 0.5):
        count = math.ceil(2 * math.pi * math.sin(theta) * math.pi / circles / area)
        turns = torch.arange(count, dtype=torch.float64) / count
        rows.append(pad(math.sin(theta) * circle(turns), (0, 1), value=math.cos(theta)))
    return torch.cat(rows)


def spherical_harmonic(l: int, m: int) -> Function:  # noqa: E741
    """The real Y_l^m, of norm 1 in L² of the unit sphere, as a function (N, 3) → (N,).

    It is the homogeneous harmonic polynomial r^l Y_l^m: the normalised Legendre recurrence in z and r², times the real
    (m ≥ 0) or imaginary (m < 0) part of (x + iy)^|m|. So it is smooth at the poles, too.
    """
    order = abs(m)
    require(order <= l, "m", f"-{l} to {l}", m)

    def harmonic(points: Points) -> Tensor:
        x, y, z = points.unbind(-1)
        real, imaginary = torch.ones_like(x), torch.zeros_like(x)
        for _ in range(order):
            real, imaginary = x * real - y * imaginary, x * imaginary + y * real
        scale = math.prod((2 * j + 1) / (2 * j) for j in range(1, order + 1)) * (2 if m else 1)
        below, legendre = torch.zeros_like(x), torch.full_like(x, math.sqrt(scale / 4 / math.pi))
        last = 1.0
        for j in range(order + 1, l + 1):
            factor = math.sqrt((4 * j**2 - 1) / (j**2 - order**2))
            step = z * legendre - (x**2 + y**2 + z**2) * below / last
            below, legendre, last = legendre, factor * step, factor
        return legendre * (real if m >= 0 else imaginary)

    return harmonic


def smooth_function(points: Places) -> Float[Tensor, "*batch"]:
    """A generic smooth function on R^n: e^{x/2} sin(2y + 0.3) on R², + x cos(1.5z) on R³, + y cos(1.5w) on R⁴."""
    columns = points.unbind(-1)
    value = (columns[0] / 2).exp() * (2 * columns[1] + 0.3).sin()
    for before, column in zip(columns, columns[2:], strict=False):
        value = value + before * (1.5 * column).cos()
    return value


def _unit(x: Places) -> Places:
    return x / x.norm(dim=-1, keepdim=True)


def _directions(cube: Float[Tensor, "N d"]) -> Float[Tensor, "N n"]:
    """Points of the unit sphere of dimension d, uniform in area if those of the cube are."""
    around, u = circle(cube[:, -1]), cube[:, :1]
    if cube.shape[1] == 1:
        return around
    if cube.shape[1] == 2:  # Archimedes: the height is uniform
        return torch.cat([2 * (u * (1 - u)).sqrt() * around, 1 - 2 * u], 1)
    return torch.cat([u.sqrt() * around, (1 - u).sqrt() * circle(cube[:, 1])], 1)  # so is x² + y²


def _periodic_delaunay(base: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Delaunay triangles of points (N, 2) of the plane, repeated with the periods 2π scale (2,)."""
    count, period = len(base), 2 * math.pi * scale
    shifts = sorted(itertools.product((-1, 0, 1), repeat=2), key=any)  # (0, 0) first
    copies = (base + period * np.array(shifts)[:, None]).reshape(-1, 2)
    near = np.flatnonzero((np.abs(copies) <= period).all(1))  # base is within half a period
    faces = near[Delaunay(copies[near]).simplices]
    vertices = faces % count
    lowest = np.take_along_axis(faces, vertices.argmin(1)[:, None], 1)[:, 0]
    vertices = vertices[lowest < count]  # of its translates, the one with its lowest vertex in base
    edges = np.unique(np.concatenate([vertices[:, [i, i - 1]] for i in range(3)]), axis=0)
    manifold = len(vertices) == 2 * count and len(edges) == 6 * count
    require(manifold, "points", "more of them, or less regular", f"{count} with {len(edges)} edges")
    return vertices


def _by_angle(k: int, spectrum: Callable[[int], np.ndarray]) -> np.ndarray:
    """The k least of the ascending spectra for m = 0, 1, 2, …, whose first values increase; m > 0 counts twice."""
    values = spectrum(0)
    for m in itertools.count(1):
        more = spectrum(m)
        if len(values) >= k and more[0] > values[k - 1]:
            break
        values = np.sort(np.concatenate([values, more, more]))
    return values[:k]
