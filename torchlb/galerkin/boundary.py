"""Nodes along the boundary: on curves through the vertices of an edge loop, on the surface of a solid.

The boundary of a complex of dimension d is one of dimension d − 1. That of a solid is curved like any other surface;
that of triangles by polynomials over arc length.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.galerkin.curving import BoundaryNodes, curve
from torchlb.galerkin.elements import inner, subsets
from torchlb.galerkin.nodes import Nodes, lagrange_nodes
from torchlb.galerkin.prolongation import prolongation
from torchlb.galerkin.rim import RimCurves, rim_curves
from torchlb.geometry.boundary import boundary_creases
from torchlb.geometry.frames import mesh_frames
from torchlb.geometry.neighbors import GraphBalls, mesh_graph
from torchlb.geometry.vertex_fits import VertexFits

WIDTH = {2: 6, 3: 6, 4: 8}
"""Vertices that a curve along the boundary goes through, by the degree of the elements."""


def boundary_nodes(
    points: Float[Tensor, "N n"],
    nodes: Nodes,
    degrees: tuple[int, ...],
    held: Bool[Tensor, " N"] | None = None,
) -> BoundaryNodes:
    """What the boundary says of the nodes.

    Parameters
    ----------
    degrees
        Those of the fits of functions, best first.
    held
        (N,), where a Dirichlet condition holds. On the boundary of a solid values follow from it alone only there: at
        its creases they are linear.
    """
    outer = (nodes.sides[nodes.dim].uses == 1).nonzero()[:, 0]
    if nodes.dim == 1 or len(outer) == 0:
        return _none(points, nodes)
    if nodes.dim == 2:
        return _on_curves(points, nodes, outer)
    faithful = tuple(degree for degree in degrees if degree > 2) or (3,)  # creases stay flat
    return _on_surface(points, nodes, faithful, held)


def _none(points: Tensor, nodes: Nodes) -> BoundaryNodes:
    index = nodes.cells.new_zeros(0)
    still = points.new_zeros(len(nodes.shares), points.shape[1])
    return BoundaryNodes(still, index, (index, index, points.new_zeros(0)))


def _on_curves(points: Tensor, nodes: Nodes, rim: Int[Tensor, " G"]) -> BoundaryNodes:
    """On polynomials through the boundary's vertices; displacements continue inside by (b_i + b_j)² of the edge (i, j).

    A quadratic displacement b_i b_j of the edge is so continued by itself.
    """
    curves = rim_curves(points, nodes.edges[rim], WIDTH[nodes.degree])
    within, on_edge = inner(3, nodes.degree), nodes.degree - 1
    steps = inner(2, nodes.degree)[:, 1].to(points).expand(len(rim), -1)
    ends = points[nodes.edges[rim]]

    def bulge(edges: Tensor, share: Tensor) -> Tensor:
        weights = replace(curves, **{k: v[edges] for k, v in vars(curves).items()}).weights(share)
        chord = ends[edges, None, 0] + share[..., None] * (ends[edges, 1] - ends[edges, 0])[:, None]
        return (weights[..., None] * points[curves.index[edges]][:, None]).sum(2) - chord

    every = torch.arange(len(rim))
    place = rim[:, None] * on_edge + torch.arange(on_edge)
    moved = _none(points, nodes).displacement
    moved[place] = bulge(every, steps)
    number = torch.full((len(nodes.edges),), -1)
    number[rim] = every
    for side, (i, j) in enumerate(subsets(2, 2)):
        face = (number[nodes.edge[:, side]] >= 0).nonzero()[:, 0]
        if len(face) == 0 or len(within) == 0:
            continue
        both = within[:, i] + within[:, j]
        share = (within[:, j] / both).expand(len(face), -1)
        part = both.square()[:, None] * bulge(number[nodes.edge[face, side]], share)
        inside = len(nodes.edges) * on_edge + face[:, None] * len(within)
        moved[inside + torch.arange(len(within))] += part
    return BoundaryNodes(moved, place.flatten(), _curve_entries(curves, steps, place))


def _curve_entries(
    curves: RimCurves, steps: Float[Tensor, "G q"], place: Int[Tensor, "G q"]
) -> tuple[Tensor, Tensor, Tensor]:
    """(node, vertex, weight) along the curves."""
    weights = curves.weights(steps)  # (G, r − 1, S)
    used = curves.valid[:, None].expand_as(weights)
    node = place[..., None].expand_as(weights)
    vertex = curves.index[:, None].expand_as(weights)
    return node[used], vertex[used], weights[used]


def _on_surface(
    points: Tensor,
    nodes: Nodes,
    degrees: tuple[int, ...],
    held: Bool[Tensor, " N"] | None,
) -> BoundaryNodes:
    """On the surface through the boundary's vertices, with the fits of functions on it where it is fixed."""
    facets, on_edge = nodes.sides[3], nodes.degree - 1
    cell, place = (facets.uses[facets.of] == 1).nonzero(as_tuple=True)
    outer = facets.of[cell, place]
    corners = facets.corners[outer]
    vertices, cells = torch.unique(
        _facing_out(points, corners, nodes.cells[cell]), return_inverse=True
    )
    places, count = points[vertices], len(vertices)
    balls = GraphBalls(places, mesh_graph(cells, count), mesh_frames(places, cells))
    fits = VertexFits(balls, degrees).complete()
    fits.degree[boundary_creases(points, nodes.cells)[vertices]] = 0
    own = lagrange_nodes(cells, count, nodes.degree)
    surface, _ = curve(places, fits, own, _none(places, own))
    flat = torch.einsum("xv,xvn->xn", own.shares, places[own.corners])
    keys = (ends[:, 0] * len(points) + ends[:, 1] for ends in (nodes.edges, vertices[own.edges]))
    edge = torch.searchsorted(*keys)
    within = len(nodes.edges) * on_edge + outer[:, None] * facets.nodes + torch.arange(facets.nodes)
    here = torch.cat(
        [(edge[:, None] * on_edge + torch.arange(on_edge)).flatten(), within.flatten()]
    )
    moved = _none(points, nodes).displacement
    moved[here] = surface.places[count:] - flat
    if held is None:
        return replace(_none(points, nodes), displacement=moved)
    inside = held[vertices[own.corners]].all(1)
    p = sparse.coo_array(prolongation(places, fits, surface)[count:])
    node, vertex = (torch.from_numpy(part.astype(np.int64)) for part in p.coords)
    kept = inside[node]
    entries = here[node[kept]], vertices[vertex[kept]], torch.from_numpy(p.data)[kept]
    return BoundaryNodes(moved, here[inside], entries)


def _facing_out(
    points: Float[Tensor, "N n"], corners: Int[Tensor, "G 3"], cells: Int[Tensor, "G 4"]
) -> Int[Tensor, "G 3"]:
    """Facets of these cells, in R³ wound so that their normals point away from the fourth corners."""
    if points.shape[1] != 3:
        return corners
    a, b, c = points[corners].unbind(1)
    inward = points[cells.sum(1) - corners.sum(1)] - a
    turned = (torch.linalg.cross(b - a, c - a) * inward).sum(1) > 0
    return torch.where(turned[:, None], corners.flip(1), corners)
