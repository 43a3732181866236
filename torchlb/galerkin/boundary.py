"""Nodes along the boundary: on curves along the boundary of a surface, or on the boundary surface of a solid.

The boundary surface of a solid is curved like any other surface; boundary curves are polynomials in arc length.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.galerkin.boundary_curves import BoundaryCurvesPlan, boundary_curves_plan
from torchlb.galerkin.curving import (
    BoundaryNodes,
    BoundaryNodesPlan,
    CurvingPlan,
    curve,
    flat_places,
)
from torchlb.galerkin.elements import inner, subsets
from torchlb.galerkin.nodes import Nodes, lagrange_nodes
from torchlb.galerkin.prolongation import prolongation
from torchlb.geometry.boundary import boundary_creases, outer_faces
from torchlb.geometry.fit_search import FitSearch
from torchlb.geometry.frames import mesh_frames
from torchlb.geometry.local_fits import FitPlan, LocalFits
from torchlb.geometry.neighbors import GraphNeighborhoods, mesh_graph


def boundary_nodes(
    points: Float[Tensor, "N n"],
    nodes: Nodes,
    degrees: tuple[int, ...],
    held: Bool[Tensor, " N"] | None = None,
) -> BoundaryNodesPlan:
    """Plan the nodes along the boundary.

    Parameters
    ----------
    degrees
        Degrees of the fits of functions, best first.
    held
        (N,), vertices with a Dirichlet condition. Only there do values on a solid's boundary depend on it alone,
        linearly at creases.
    """
    outer = (nodes.sides[nodes.dim].uses == 1).nonzero()[:, 0]
    if nodes.dim == 1 or len(outer) == 0:
        return WithoutBoundary(len(nodes.shares))
    if nodes.dim == 2:
        # as many vertices on either side, and at least two more than a polynomial of degree r needs
        width = 2 * (nodes.degree // 2 + 2)
        return OnCurves(nodes, outer, boundary_curves_plan(points, nodes.edges[outer], width))
    faithful = tuple(degree for degree in degrees if degree > 2) or (3,)  # creases stay flat
    return OnSurface.of(points, nodes, faithful, held)


@dataclass(frozen=True)
class WithoutBoundary:
    """No boundary nodes, of `count` nodes in all."""

    count: int

    def at(self, points: Float[Tensor, "N n"]) -> BoundaryNodes:
        """No displacements and no entries."""
        index = torch.zeros(0, dtype=torch.int64)
        still = points.new_zeros(self.count, points.shape[1])
        return BoundaryNodes(still, index, (index, index, points.new_zeros(0)))


@dataclass(frozen=True)
class OnCurves:
    """Nodes on polynomial curves through the boundary vertices of a surface.

    The displacement over edge (i, j) is blended into its triangle by (b_i + b_j)², b barycentric; a quadratic one
    becomes b_i b_j.

    Attributes
    ----------
    nodes
        Lagrange nodes of the triangles.
    outer
        (G,), boundary edges.
    curves
        Vertices that the curves pass through.
    """

    nodes: Nodes
    outer: Int[Tensor, " G"]
    curves: BoundaryCurvesPlan

    def at(self, points: Float[Tensor, "N n"]) -> BoundaryNodes:
        """Positions and values of the boundary nodes."""
        nodes, outer, curves = self.nodes, self.outer, self.curves.at(points)
        within, on_edge = inner(3, nodes.degree), nodes.degree - 1
        steps = inner(2, nodes.degree)[:, 1].to(points).expand(len(outer), -1)
        ends = points[nodes.edges[outer]]

        def bulge(edges: Tensor, share: Tensor) -> Tensor:
            weights = curves.over(edges).weights(share)
            chord = ends[edges, 1] - ends[edges, 0]
            chord = ends[edges, None, 0] + share[..., None] * chord[:, None]
            return (weights[..., None] * points[curves.index[edges]][:, None]).sum(2) - chord

        every = torch.arange(len(outer))
        place = outer[:, None] * on_edge + torch.arange(on_edge)
        moved = points.new_zeros(len(nodes.shares), points.shape[1])
        moved[place] = bulge(every, steps)
        number = torch.full((len(nodes.edges),), -1)
        number[outer] = every
        for side, (i, j) in enumerate(subsets(2, 2)):
            face = (number[nodes.edge[:, side]] >= 0).nonzero()[:, 0]
            if len(face) == 0 or len(within) == 0:
                continue
            both = within[:, i] + within[:, j]
            share = (within[:, j] / both).expand(len(face), -1)
            part = both.square()[:, None] * bulge(number[nodes.edge[face, side]], share)
            inside = len(nodes.edges) * on_edge + face[:, None] * len(within)
            moved[inside + torch.arange(len(within))] += part
        weights = curves.weights(steps)  # (G, r − 1, S)
        used = curves.valid[:, None].expand_as(weights)
        node, vertex = place[..., None].expand_as(weights), curves.index[:, None].expand_as(weights)
        return BoundaryNodes(moved, place.flatten(), (node[used], vertex[used], weights[used]))


@dataclass(frozen=True)
class OnSurface:
    """Nodes on the boundary surface of a solid, with fits of functions on it where values are fixed.

    Attributes
    ----------
    nodes
        Lagrange nodes of the tetrahedra.
    vertices
        (b,), boundary vertices, in the surface's own numbering.
    cells
        (G, 3), boundary triangles, oriented outwards.
    fits, curving
        Plans of that surface.
    here
        (x,), number among the solid's nodes of each non-vertex node of the surface.
    inside
        (x,), whether the value there depends on boundary vertices alone.
    """

    nodes: Nodes
    vertices: Int[Tensor, " b"]
    cells: Int[Tensor, "G 3"]
    fits: FitPlan
    curving: CurvingPlan
    here: Int[Tensor, " x"]
    inside: Bool[Tensor, " x"]

    @classmethod
    def of(
        cls,
        points: Float[Tensor, "N 3"],
        nodes: Nodes,
        degrees: tuple[int, ...],
        held: Bool[Tensor, " N"] | None,
    ) -> OnSurface:
        """Plan the boundary surface, with fits of these degrees."""
        facets, on_edge = nodes.sides[3], nodes.degree - 1
        outer = (facets.uses == 1).nonzero()[:, 0]
        vertices, cells = torch.unique(outer_faces(points, nodes.cells), return_inverse=True)
        places, count = points[vertices], len(vertices)
        neighborhoods = GraphNeighborhoods(
            places, mesh_graph(cells, count), mesh_frames(places, cells)
        )
        plan, fits = FitSearch(neighborhoods, 0, degrees).finish()
        plan = plan.flattened(boundary_creases(points, nodes.cells)[vertices])
        own = lagrange_nodes(cells, count, nodes.degree)
        curving, _ = curve(places, plan, fits, own, WithoutBoundary(len(own.shares)))
        keys = (e[:, 0] * len(points) + e[:, 1] for e in (nodes.edges, vertices[own.edges]))
        edge = torch.searchsorted(*keys)
        within = outer[:, None] * facets.nodes + torch.arange(facets.nodes)
        within = len(nodes.edges) * on_edge + within
        on = edge[:, None] * on_edge + torch.arange(on_edge)
        inside = torch.zeros(len(own.shares), dtype=torch.bool)
        if held is not None:
            inside = held[vertices[own.corners]].all(1)
        here = torch.cat([on.flatten(), within.flatten()])
        return cls(nodes, vertices, cells, plan, curving, here, inside)

    def at(self, points: Float[Tensor, "N n"]) -> BoundaryNodes:
        """Positions and values of the boundary nodes."""
        places, own = points[self.vertices], self.curving.nodes
        fits = LocalFits.at(self.fits, places, mesh_frames(places, self.cells))
        surface = self.curving.at(places, self.fits, fits)
        moved = points.new_zeros(len(self.nodes.shares), points.shape[1])
        moved[self.here] = surface.places[len(places) :] - flat_places(places, own)
        still = WithoutBoundary(len(moved)).at(points)
        if not self.inside.any():
            return replace(still, displacement=moved)
        p = prolongation(self.fits, fits, self.curving, surface)[len(places) :].tocoo()
        node, vertex = (torch.from_numpy(part.astype(np.int64)) for part in p.coords)
        kept = self.inside[node]
        weights = torch.from_numpy(p.data)[kept]
        entries = self.here[node[kept]], self.vertices[vertex[kept]], weights
        return BoundaryNodes(moved, self.here[self.inside], entries)
