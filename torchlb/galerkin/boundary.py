"""Nodes along the boundary: on curves along the boundary of a surface, or on the boundary surface of a solid.

The boundary surface of a solid is curved like any other. Over each boundary edge of a surface the curve is the
polynomial in arc length through the nearest boundary vertices (`method.md`, section 9). The same Lagrange weights
interpolate functions, so a function that vanishes at the boundary vertices vanishes on the curve.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.galerkin.curving import (
    BoundaryNodes,
    BoundaryNodesPlan,
    CurvingPlan,
    curve,
    flat_places,
)
from torchlb.galerkin.elements import inner, subsets
from torchlb.galerkin.nodes import Nodes, lagrange_nodes
from torchlb.galerkin.prolongation import Prolongation
from torchlb.geometry.boundary import boundary_creases, outer_faces
from torchlb.geometry.fit_search import MAX_LEBESGUE, FitSearch
from torchlb.geometry.frames import mesh_frames
from torchlb.geometry.local_fits import FitPlan, LocalFits
from torchlb.geometry.neighbors import GraphNeighborhoods, mesh_graph
from torchlb.geometry.thresholds import CREASE, FACTOR, KINK
from torchlb.geometry.vectors import Points


def boundary_nodes(
    points: Points, nodes: Nodes, degrees: tuple[int, ...], held: Bool[Tensor, " N"] | None = None
) -> BoundaryNodesPlan:
    """Plan the nodes along the boundary, for fits of functions of these degrees, best first.

    `held` marks vertices with a Dirichlet condition. Only there do values on a solid's boundary depend on it alone,
    linearly at creases.
    """
    outer = (nodes.sides[nodes.dim].uses == 1).nonzero()[:, 0]
    if nodes.dim == 1 or len(outer) == 0:
        return BoundaryNodesPlan(nodes)
    if nodes.dim == 2:
        # as many vertices on either side, and at least two more than a polynomial of degree r needs
        width = 2 * (nodes.degree // 2 + 2)
        return OnCurves(nodes, outer, boundary_curves_plan(points, nodes.edges[outer], width))
    faithful = tuple(degree for degree in degrees if degree > 2) or (3,)  # creases stay flat
    return OnSurface.of(points, nodes, faithful, held)


@dataclass(frozen=True)
class OnCurves(BoundaryNodesPlan):
    """Nodes on polynomial curves through the boundary vertices of a surface, over its edges `outer`, (G,).

    The displacement over edge (i, j) is blended into its triangle by (b_i + b_j)², b barycentric; a quadratic one
    becomes b_i b_j.
    """

    outer: Int[Tensor, " G"]
    curves: BoundaryCurves

    def at(self, points: Points) -> BoundaryNodes:
        """Positions and values of the boundary nodes."""
        nodes, outer = self.nodes, self.outer
        index, valid = self.curves.index, self.curves.valid
        arcs = self.curves.arcs(points)
        within, on_edge = inner(3, nodes.degree), nodes.degree - 1
        steps = inner(2, nodes.degree)[:, 1].to(points).expand(len(outer), -1)
        ends = points[nodes.edges[outer]]

        def bulge(edges: Tensor, share: Tensor) -> Tensor:
            weights = lagrange(arcs[edges], valid[edges], share)
            chord = ends[edges, 1] - ends[edges, 0]
            chord = ends[edges, None, 0] + share[..., None] * chord[:, None]
            return (weights[..., None] * points[index[edges]][:, None]).sum(2) - chord

        every = torch.arange(len(outer))
        place = outer[:, None] * on_edge + torch.arange(on_edge)
        moved = points.new_zeros(len(nodes.shares), points.shape[1])
        moved[place] = bulge(every, steps)
        number = torch.full((len(nodes.edges),), -1)
        number[outer] = every
        for side, (i, j) in enumerate(subsets(2, 2)):
            face = (number[nodes.edge[:, side]] >= 0).nonzero()[:, 0]
            both = within[:, i] + within[:, j]
            share = (within[:, j] / both).expand(len(face), -1)
            part = both.square()[:, None] * bulge(number[nodes.edge[face, side]], share)
            inside = len(nodes.edges) * on_edge + face[:, None] * len(within)
            moved[inside + torch.arange(len(within))] += part
        weights = lagrange(arcs, valid, steps)  # (G, r − 1, S)
        used = valid[:, None].expand_as(weights)
        node, vertex = place[..., None].expand_as(weights), index[:, None].expand_as(weights)
        return BoundaryNodes(moved, place.flatten(), (node[used], vertex[used], weights[used]))


@dataclass(frozen=True)
class OnSurface(BoundaryNodesPlan):
    """Nodes on the boundary surface of a solid, with fits of functions on it where values are fixed.

    `cells` are the boundary triangles in the numbering of the boundary `vertices`, oriented outwards; `fits` and
    `curving` are plans of that surface. `here` has the numbers among the solid's nodes of its nodes that are no
    vertices; values at those `inside` depend on boundary vertices alone.
    """

    vertices: Int[Tensor, " b"]
    cells: Int[Tensor, "G 3"]
    fits: FitPlan
    curving: CurvingPlan
    here: Int[Tensor, " x"]
    inside: Bool[Tensor, " x"]

    @classmethod
    def of(
        cls, points: Points, nodes: Nodes, degrees: tuple[int, ...], held: Bool[Tensor, " N"] | None
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
        curving, _ = curve(plan, fits, BoundaryNodesPlan(own))
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

    def at(self, points: Points) -> BoundaryNodes:
        """Positions and values of the boundary nodes."""
        places, own = points[self.vertices], self.curving.nodes
        fits = LocalFits.at(self.fits, places, mesh_frames(places, self.cells))
        surface = self.curving.at(self.fits, fits)
        moved = points.new_zeros(len(self.nodes.shares), points.shape[1])
        moved[self.here] = surface.places[len(places) :] - flat_places(places, own)
        if not self.inside.any():
            return super().at(points)._replace(displacement=moved)
        p = Prolongation(self.fits, fits, self.curving, surface)
        row, length, vertex, weights = p.entries()
        node = row.repeat_interleave(length) - len(places)
        kept = (node >= 0) & self.inside[node]
        found = self.here[node[kept]], self.vertices[vertex[kept]], weights[kept]
        return BoundaryNodes(moved, self.here[self.inside], found)


@dataclass(frozen=True)
class BoundaryCurves:
    """Vertices that the polynomial curve over each boundary edge passes through, (G, 2 + 2s), and which are used.

    They are both ends of the edge, then s vertices beyond its second end and s beyond its first, outwards.
    """

    index: Int[Tensor, "G S"]
    valid: Bool[Tensor, "G S"]

    def arcs(self, points: Points) -> Float[Tensor, "G S"]:
        """Arc length of these vertices from the first end of the edge, ℓ."""
        index, steps = self.index, self.index.shape[1] // 2 - 1
        arcs = []
        for walk in index[:, 1 : 2 + steps], torch.cat([index[:, :1], index[:, 2 + steps :]], 1):
            step = points[walk[:, 1:]] - points[walk[:, :-1]]
            arcs.append(step.norm(dim=2).cumsum(1))
        length = (points[index[:, 1]] - points[index[:, 0]]).norm(dim=1, keepdim=True)
        return torch.cat([torch.zeros_like(length), length, length + arcs[0], -arcs[1]], 1)


def lagrange(
    arc: Float[Tensor, "G S"], valid: Bool[Tensor, "G S"], share: Float[Tensor, "G q"]
) -> Float[Tensor, "G q S"]:
    """Lagrange weights of the vertices at relative positions on the edge, 0 at its first end, 1 at its second."""
    at = share * arc[:, 1:2]
    other = valid[:, None, :] & valid[:, :, None] & ~torch.eye(arc.shape[1], dtype=torch.bool)
    gap = torch.where(other, arc[:, :, None] - arc[:, None, :], 1.0)
    to = torch.where(other[:, None], at[:, :, None, None] - arc[:, None, None, :], 1.0)
    return (to / gap[:, None]).prod(-1) * valid[:, None]


def boundary_curves_plan(points: Points, edges: Int[Tensor, "G 2"], width: int) -> BoundaryCurves:
    """Plan curves through `width` vertices, fewer near corners, over the boundary edges `edges`."""
    mate = _mates(points, edges)
    walks = [_walk(edges, mate, side, width - 2) for side in (0, 1)]
    (left, left_length, wrapped), (right, right_length, _) = walks
    extra = torch.where(wrapped, left_length.clamp_max(width - 2), width - 2)
    ahead = torch.minimum(right_length, torch.maximum(extra // 2, extra - left_length))
    behind = torch.minimum(left_length, extra - ahead)
    place = torch.arange(width - 2)
    ends = torch.ones_like(edges, dtype=torch.bool)
    used = place < ahead[:, None], place < behind[:, None]
    curves = BoundaryCurves(torch.cat([edges, right, left], 1), torch.cat([ends, *used], 1))
    # drop the farthest vertices while a Lebesgue constant is too large, as where the spacing jumps
    arc = curves.arcs(points)
    distance = (arc - arc[:, 1:2] / 2).abs()
    distance[:, :2] = 0
    while True:
        size = lagrange(arc, curves.valid, torch.full_like(arc[:, :1], 0.5)).abs().sum(2)[:, 0]
        steep = (size > MAX_LEBESGUE).nonzero()[:, 0]
        if len(steep) == 0:
            return curves
        curves.valid[steep, (distance * curves.valid)[steep].argmax(1)] = False


def _mates(points: Points, edges: Int[Tensor, "G 2"]) -> Int[Tensor, " two_G"]:
    """Edge end that smoothly continues each edge end, −1 for none; end s of edge e has number e + G s."""
    count = len(edges)
    vertex = torch.cat([edges[:, 0], edges[:, 1]])
    order = vertex.argsort(stable=True)
    _, uses = torch.unique_consecutive(vertex[order], return_counts=True)
    first = uses.cumsum(0) - uses
    one, two = order[first[uses == 2]], order[first[uses == 2] + 1]
    mate = torch.full_like(vertex, -1)
    mate[one], mate[two] = two, one
    away = points[torch.cat([edges[:, 1], edges[:, 0]])] - points[vertex]
    away = torch.nn.functional.normalize(away, eps=torch.finfo(away.dtype).tiny)
    straight = torch.where(mate >= 0, -(away * away[mate]).sum(1), -1.0)  # cosine of the turn
    angle = straight.clamp(-1, 1).acos()
    far = torch.cat([angle[count:], angle[:count]])  # at the other end of the same edge
    beside = torch.maximum(far, far[mate])
    corner = straight < CREASE
    corner |= (straight < KINK) & (angle > FACTOR * beside)
    return torch.where(corner, -1, mate)


def _walk(
    edges: Int[Tensor, "G 2"], mate: Int[Tensor, " two_G"], side: int, steps: int
) -> tuple[Int[Tensor, "G steps"], Int[Tensor, " G"], Bool[Tensor, " G"]]:
    """Vertices beyond one end of every edge (the last repeated), their number, and whether the walk closed."""
    count = len(edges)
    end, start = edges[:, side], edges[:, 1 - side]
    half = torch.arange(count) + count * side
    alive, wrapped = (torch.full((count,), value) for value in (True, False))
    at, vertices, length = end, [], torch.zeros(count, dtype=torch.int64)
    for _ in range(steps):
        following = mate[half]
        alive &= following >= 0
        half = torch.where(alive, (following + count) % (2 * count), half)  # the far end
        next_at = torch.cat([edges[:, 0], edges[:, 1]])[half]
        wrapped |= alive & (next_at == start)
        alive &= next_at != start
        at = torch.where(alive, next_at, at)
        length += alive
        vertices.append(at)
    return torch.stack(vertices, 1), length, wrapped
