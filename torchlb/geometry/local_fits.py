"""Polynomials over the initial frame of every vertex: its tangent plane, the surface around it, functions on it.

`FitSearch` chooses their degrees and neighbours. The choice is a `FitPlan`, without coordinates; `LocalFits` holds the
numbers that follow from a plan at given points.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.fits.polynomials import num_monomials
from torchlb.fits.weights import CenteredFit, centered_fit
from torchlb.geometry.frames import orthonormalized
from torchlb.geometry.vectors import Frames, Points, at
from torchlb.linalg.precision import rows_at_once


class Neighborhoods(NamedTuple):
    """Neighbourhoods of fits of the same degree m and number of points, around `vertices`.

    `points` has the vertex first, and as padding; `keep` tells which neighbours are no padding. `frame` and `surface`
    tell whether the fit provides the tangent plane, and the graph of the surface; they are False for fits of functions.
    """

    degree: int
    vertices: Int[Tensor, " b"]
    points: Int[Tensor, "b K"]
    keep: Bool[Tensor, "b neighbors"]
    frame: Bool[Tensor, " b"]
    surface: Bool[Tensor, " b"]

    def parts(self, dim: int) -> Iterator[tuple[slice, Neighborhoods]]:
        """Yield chunks, with their slices, whose arrays of all monomials stay below `BYTES`."""
        size = rows_at_once(self.points.shape[1] * num_monomials(dim, self.degree))
        for first in range(0, len(self.vertices), size):
            part = slice(first, first + size)
            yield part, Neighborhoods(self.degree, *(tensor[part] for tensor in self[1:]))


@dataclass(frozen=True)
class FitPlan:
    """Degrees and neighbourhoods of all fits of a shape, of heights (`surface`) and of `functions`.

    Degrees of each vertex: `order`, of the fit behind its tangent plane, 0 for the initial plane; `surface_degree`, of
    the graph around it, 0 without; `degree`, m of the fit of functions, 0 where none passed, which leaves it flat.
    `reason` indexes in `REASONS` why the highest degree was not reached, `size` counts the points of the fit of
    functions, the vertex included.

    Graphs are kept up to the degree `highest`, fits of functions up to `jet`, which are evaluated at the fraction
    `reach` of the offset to a node. Fits of degree 2 and 3 keep the gradient, at half of the offset: the cubic Hermite
    interpolant in the middle of an edge, (u_a + u_b)/2 + (∂u_a − ∂u_b)/8 with ∂ along it, is the mean of u_a + ∇u_a·y
    over its ends.
    """

    surface: list[Neighborhoods]
    functions: list[Neighborhoods]
    order: Int[Tensor, " N"]
    surface_degree: Int[Tensor, " N"]
    degree: Int[Tensor, " N"]
    reason: Int[Tensor, " N"]
    size: Int[Tensor, " N"]
    highest: int
    jet: int
    reach: float

    def flattened(self, vertices: Bool[Tensor, " N"]) -> FitPlan:
        """Plan without fits of functions at these vertices, where the surface is then flat."""
        return replace(self, degree=torch.where(vertices, 0, self.degree))


class LocalFits:
    """Tangent planes (`frames`), graphs and coefficients of the fits at given points, over the `initial` frames.

    `second`, (N, d, d, n), 1/ℓ, are second derivatives of the graphs that gave the tangent planes, as vectors, zero for
    planes of degree 0 and 1.
    `heights`, (N, M − 1, n), ℓ, are graphs of the surface up to a degree, as vectors, zero beyond the monomials of a
    fit; `surface_radius` and `radius`, (N,), ℓ, are radii of the fits of heights and of functions; `coefficients` those
    of functions, in the order of `FitPlan.functions`, as in `CenteredFit`.
    """

    def __init__(self, points: Points, initial: Frames, degree: int) -> None:
        self.points, self.initial, self.frames = points, initial, initial.clone()
        terms = num_monomials(initial.shape[2], degree) - 1
        self.heights = points.new_zeros(len(points), terms, points.shape[1])
        self.surface_radius, self.radius = (points.new_ones(len(points)) for _ in range(2))
        self.second = points.new_zeros(len(points), *2 * initial.shape[2:], points.shape[1])
        self.coefficients: list[Tensor] = []

    @classmethod
    def at(cls, plan: FitPlan, points: Points, initial: Frames) -> LocalFits:
        """Compute the fits of a plan at these points."""
        found, dim = cls(points, initial, plan.highest), initial.shape[2]
        for block in plan.surface:
            for _, part in block.parts(dim):
                fit, _, graph = found.fitted(part)
                found.take_surface(part, fit, graph)
        for block in plan.functions:
            terms = num_monomials(dim, min(block.degree, plan.jet)) - 1
            kept = points.new_empty(len(block.vertices), terms, block.keep.shape[1])
            for place, part in block.parts(dim):
                fit, *_ = found.fit(part)
                kept[place] = fit.coefficients[:, :terms]
                found.radius[part.vertices] = fit.radius
            found.coefficients.append(kept)
        return found

    def let_go(self, *, functions: bool = True) -> None:
        """Release the graphs, not needed once there are elements, and the fits of functions, once there is a pair."""
        self.heights, self.second = self.heights[:0].clone(), self.second[:0].clone()
        if functions:
            self.coefficients = []

    def fit(self, block: Neighborhoods) -> tuple[CenteredFit, Tensor, Tensor]:
        """Fit polynomials around some vertices; return the fits, and offsets and coordinates of the neighbours.

        Offsets, (b, K − 1, n), are from the vertex, coordinates, (b, K − 1, d), those of the offsets in the initial
        tangent planes.
        """
        places, keep = at(self.points, block.points), None if block.keep.all() else block.keep
        offset = places[:, 1:] - places[:, :1]
        coords = offset @ at(self.initial, block.vertices)
        return centered_fit(coords, block.degree, keep), offset, coords

    def fitted(
        self, block: Neighborhoods
    ) -> tuple[CenteredFit, Float[Tensor, "b neighbors n"], Float[Tensor, "b M n"]]:
        """(fits; heights over the initial planes, to which they are made; the resulting graphs)."""
        fit, offset, coords = self.fit(block)
        heights = offset - coords @ at(self.initial, block.vertices).mT
        if not block.keep.all():
            heights = heights * block.keep[..., None]
        return fit, heights, fit.coefficients @ heights

    def take_surface(
        self, block: Neighborhoods, fit: CenteredFit, graph: Float[Tensor, "b M n"]
    ) -> None:
        """Store the tangent planes and the graphs of these fits."""
        on = block.frame
        if on.any():
            dim = self.initial.shape[2]
            tilted = at(self.initial, block.vertices[on]) + slope_of(fit, graph, dim)[on].mT
            self.frames[block.vertices[on]] = orthonormalized(tilted)
            if block.degree > 1:
                row, column = torch.triu_indices(dim, dim)
                terms = graph[on, dim : dim + len(row)] / fit.radius[on, None, None] ** 2
                half = torch.zeros_like(self.second[block.vertices[on]])
                half[:, row, column] = terms
                self.second[block.vertices[on]] = half + half.transpose(1, 2)
        on = block.surface
        if on.any():
            self.heights[block.vertices[on], : graph.shape[1]] = graph[on]
            self.surface_radius[block.vertices[on]] = fit.radius[on]


def slope_of(fit: CenteredFit, graph: Float[Tensor, "b M n"], dim: int) -> Float[Tensor, "b d n"]:
    """First derivatives of the fitted heights, vectors in the normal space."""
    return graph[:, :dim] / fit.radius[:, None, None]
