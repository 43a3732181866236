"""Positions of the nodes of curved cells, and which edges are curved (`method.md`, section 9).

Boundary curves, mollified lengths and normals exist for triangles only; all else holds in any dimension.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.fits.polynomials import monomials
from torchlb.galerkin.assembly import area_element, flat_metric, metric
from torchlb.galerkin.coarse import lying_triangles, reaching_out, without_inside
from torchlb.galerkin.delaunay import Cover, delaunay_cover, sound_lengths
from torchlb.galerkin.elements import edge_lengths, simplex
from torchlb.galerkin.nodes import Nodes
from torchlb.geometry.frames import vertex_normals
from torchlb.geometry.local_fits import FitPlan, LocalFits
from torchlb.geometry.thresholds import FACTOR, ROUGH
from torchlb.geometry.vectors import Points, at
from torchlb.linalg.precision import AT_ONCE, SMALL

ROUNDS = 2
"""Rounds of projecting the nodes onto the fits of their vertices."""
AGREE = 0.075
"""Largest distance of a vertex's fit from the mean of the fits at a node, relative to the edge length."""


@dataclass(frozen=True)
class Ends:
    """Pairs (node, vertex) with the node's barycentric coordinate `share` > 0, sorted by vertex; `uses` per vertex."""

    node: Int[Tensor, " E"]
    vertex: Int[Tensor, " E"]
    share: Float[Tensor, " E"]
    uses: Int[Tensor, " N"]

    def of(
        self, vertices: Int[Tensor, " b"]
    ) -> Iterator[tuple[Int[Tensor, " c"], Int[Tensor, "c e"], Bool[Tensor, "c e"]]]:
        """Yield chunks of indices into `vertices`, the pairs of each, padded to equal length, and which are real."""
        start, uses = (self.uses.cumsum(0) - self.uses)[vertices], self.uses[vertices]
        for part in uses.argsort().split(AT_ONCE):  # similar numbers of pairs
            slot = torch.arange(int(uses[part[-1]]))
            own = start[part, None] + slot
            yield part, own.clamp_max(len(self.node) - 1), slot < uses[part, None]


class BoundaryNodes(NamedTuple):
    """Nodes whose position and value depend on boundary vertices alone: zero at these is zero on the whole boundary.

    They are displaced from the flat cells by (X, n), ℓ, as all nodes near them are, and take their values from boundary
    vertices, by `entries` (node, vertex, weight).
    """

    displacement: Float[Tensor, "X n"]
    nodes: Int[Tensor, " A"]
    entries: tuple[Int[Tensor, " E"], Int[Tensor, " E"], Float[Tensor, " E"]]


@dataclass(frozen=True)
class BoundaryNodesPlan:
    """Plan of the nodes along the boundary; this one of a shape without any."""

    nodes: Nodes

    def at(self, points: Float[Tensor, "N n"]) -> BoundaryNodes:
        """Evaluate the plan at these points."""
        none = torch.zeros(0, dtype=torch.int64)
        still = points.new_zeros(len(self.nodes.shares), points.shape[1])
        return BoundaryNodes(still, none, (none, none, points.new_zeros(0)))


@dataclass(frozen=True)
class CurvingPlan:
    """Plan of the curved cells.

    It says which edges are `curved`, which nodes are `bent`, on the surface instead of on a flat cell, and which
    triangles are `coarse`; the sheets of the cover of these are not glued along `fixed` edges, and `flips` make it
    Delaunay.
    """

    nodes: Nodes
    boundary: BoundaryNodesPlan
    curved: Bool[Tensor, " E"]
    bent: Bool[Tensor, " X"]
    coarse: Bool[Tensor, " F"]
    fixed: Bool[Tensor, " E"]
    flips: list[Tensor]

    def at(self, plan: FitPlan, fits: LocalFits) -> CurvedMesh:
        """Evaluate the curved cells at the points of the fits."""
        nodes, points, boundary = self.nodes, fits.points, self.boundary.at(fits.points)
        ends, flat, start, standing, _ = _moved(plan, fits, nodes, boundary)
        near = (standing - start).norm(dim=1) <= FACTOR * ROUGH * _sizes(points, nodes)
        standing = torch.where(near[:, None], standing, start)
        places = torch.cat([points, torch.where(self.bent[:, None], standing, flat)])
        lengths = sound_lengths(edge_lengths(points, nodes.cells), nodes.cells)
        shape = simplex(nodes.dim, nodes.degree)
        g = flat_metric(lengths)[:, None].repeat(1, len(shape.weights), 1)
        for part in self.curved[nodes.edge].any(1).nonzero()[:, 0].split(AT_ONCE):
            g[part] = metric(places, nodes.elements[part], shape)
        cover = self.cover(lengths, self.flips)
        astray = nodes.corners[self.bent & ~near].unique()
        return CurvedMesh(places, g, lengths, cover, boundary, ends, astray)

    def cover(self, lengths: Float[Tensor, "F e"], flips: list[Tensor] | None) -> Cover | None:
        """Intrinsic Delaunay tufted cover of the coarse triangles, glued along the free boundary; None without any."""
        coarse, nodes = self.coarse, self.nodes
        if not coarse.any():
            return None
        edge = nodes.edge[coarse]
        return delaunay_cover(nodes.cells[coarse], lengths[coarse], edge, self.fixed, flips)


@dataclass(frozen=True)
class CurvedMesh:
    """Curved cells at given points: positions of the nodes, ℓ, metric at the Gauss points, ℓ², and edge lengths, ℓ.

    Lengths are mollified, and so are metrics of flat triangles. `cover` replaces coarse triangles, None without any;
    `ends` are the vertices whose fits the nodes use. At the vertices `astray` fits that were decided elsewhere put
    nodes far from the surface, which are on flat cells instead.
    """

    places: Float[Tensor, "NX n"]
    metric: Float[Tensor, "F Q S"]
    lengths: Float[Tensor, "F e"]
    cover: Cover | None
    boundary: BoundaryNodes
    ends: Ends
    astray: Int[Tensor, " A"]


def curve(
    plan: FitPlan, fits: LocalFits, rim: BoundaryNodesPlan, held: Bool[Tensor, " N"] | None = None
) -> tuple[CurvingPlan, CurvedMesh]:
    """Move the nodes onto the fits of their vertices where these agree, and flatten cells that this would distort.

    The nodes are those of `rim`; along the boundary of a surface they stay on its curves. `held` marks vertices with a
    Dirichlet condition, along whose boundary edges the sheets of a cover are not glued.
    """
    nodes, points, boundary = rim.nodes, fits.points, rim.at(fits.points)
    ends, flat, start, standing, sound = _moved(plan, fits, nodes, boundary)
    ratio = (start - flat).norm(dim=1) / _sizes(points, nodes)
    curved, *whole = nodes.by_side(sound & (ratio <= ROUGH))
    uses = nodes.sides[2].uses
    coarse, fixed = torch.zeros(len(nodes.cells), dtype=torch.bool), uses == 1
    if nodes.dim == 2:
        curved &= uses <= 2
        if points.shape[1] == 3:  # flat where the ends' normals differ by 120° or more, or vanish
            curved &= vertex_normals(points, nodes.faces)[nodes.edges].sum(1).norm(dim=1) > 1
        free = uses == 1
        if held is not None:
            free &= ~held[nodes.edges].all(1)
        coarse = lying_triangles(points, nodes, free) | without_inside(points, nodes, plan)
        curved[nodes.edge[coarse].flatten()] = False
        curved &= ~reaching_out(nodes, plan, coarse)[nodes.edges].any(1)
        fixed &= ~free
        fixed[nodes.edge[~coarse].flatten()] = True
    places, curved, bent, g, lengths = _flattened(points, nodes, (flat, standing), curved, whole)
    decided = CurvingPlan(nodes, rim, curved, bent, coarse, fixed, [])
    cover = decided.cover(lengths, None)
    if cover is not None:
        decided.flips.extend(cover.flips)
    return decided, CurvedMesh(places, g, lengths, cover, boundary, ends, nodes.corners[:0, 0])


def flat_places(points: Float[Tensor, "N n"], nodes: Nodes) -> Float[Tensor, "X n"]:
    """Positions of the nodes on flat cells."""
    return torch.einsum("xv,xvn->xn", nodes.shares, at(points, nodes.corners))


def node_ends(nodes: Nodes, count: int) -> Ends:
    """Pairs of every node and the vertices, `count` in all, with a positive barycentric coordinate there."""
    node, place = (nodes.shares > 0).nonzero(as_tuple=True)
    vertex = nodes.corners[node, place]
    order = vertex.argsort(stable=True)
    uses = torch.bincount(vertex, minlength=count)
    return Ends(node[order], vertex[order], nodes.shares[node, place][order], uses)


def _sizes(points: Tensor, nodes: Nodes) -> Float[Tensor, " X"]:
    """Length of each node's edge, or the longest edge of its triangle or cell, ℓ."""
    length = (points[nodes.edges[:, 0]] - points[nodes.edges[:, 1]]).norm(dim=1)
    return nodes.at_nodes(length, *(length[side.edges].amax(1) for side in nodes.beyond))


def _moved(
    plan: FitPlan, fits: LocalFits, nodes: Nodes, boundary: BoundaryNodes
) -> tuple[Ends, Tensor, Tensor, Tensor, Bool[Tensor, " X"]]:
    """Project every node onto the mean of its vertices' fits.

    Returns the pairs of nodes and vertices, the positions on flat cells, those displaced by the boundary, those on the
    fits, (X, n), and whether the fits agree. A further round would move them by O(h⁶). Nodes along the boundary of a
    surface stay.
    """
    points = fits.points
    ends, flat = node_ends(nodes, len(points)), flat_places(points, nodes)
    place = start = flat + boundary.displacement
    size, lots = _sizes(points, nodes), list(ends.of(torch.arange(len(points))))
    apart, moves = torch.zeros_like(at(size, ends.node)), torch.zeros_like(at(start, ends.node))
    for _ in range(ROUNDS):
        for vertices, own, used in lots:
            frame, origin = at(fits.initial, vertices), at(points, vertices)[:, None]
            offset = at(place, at(ends.node, own)) - origin
            along = offset @ frame
            powers = monomials(along / fits.surface_radius[vertices, None, None], plan.highest)
            graph = powers @ at(fits.heights, vertices) + along @ frame.mT
            moves[own[used]] = (graph - offset)[used]
        mean = torch.zeros_like(start).index_add_(0, ends.node, ends.share[:, None] * moves)
        place, apart = place + mean, (moves - at(mean, ends.node)).norm(dim=1)
    bad = (apart > AGREE * at(size, ends.node)) | (plan.degree[ends.vertex] == 0)
    sound = (place - start).norm(dim=1) <= ROUGH * size
    sound[ends.node[bad]] = False
    if nodes.dim == 2:
        place = place.index_copy(0, boundary.nodes, start[boundary.nodes])
    return ends, flat, start, place, sound


def _flattened(
    points: Points, nodes: Nodes, stand: tuple[Tensor, Tensor], curved: Tensor, whole: list[Tensor]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Flatten edges of distorted cells until none is; return positions, curved edges, bent nodes, metric, lengths.

    `stand` holds the positions (X, n) on flat cells and on the surface; `curved` flags edges, (E,), and `whole`
    triangles and cells, that may be curved.
    """
    sides = edge_lengths(points, nodes.cells)
    lengths = sound_lengths(sides, nodes.cells)
    plane, shape = flat_metric(lengths), simplex(nodes.dim, nodes.degree)
    area = area_element(plane)
    curved = curved.clone()
    curved[nodes.edge[area < SMALL * sides.amax(1) ** nodes.dim].flatten()] = False
    g = plane[:, None].repeat(1, len(shape.weights), 1)
    new = torch.ones(len(nodes.cells), dtype=torch.bool)  # cells whose nodes have moved
    while True:
        smooth = [w & curved[s.edges].all(1) for w, s in zip(whole, nodes.beyond, strict=True)]
        bent = nodes.at_nodes(curved, *smooth)
        places = torch.cat([points, torch.where(bent[:, None], stand[1], stand[0])])
        some = curved[nodes.edge].any(1)
        g[new & ~some] = plane[new & ~some, None]
        before, curved = curved, curved.clone()
        for part in (new & some).nonzero()[:, 0].split(AT_ONCE):
            g[part] = metric(places, nodes.elements[part], shape)
            stretch = area_element(g[part]) / area[part, None]
            bad = ((stretch < 1 / FACTOR) | (stretch > FACTOR)).any(1)
            curved[nodes.edge[part[bad]].flatten()] = False
        if torch.equal(before, curved):
            return places, curved, bent, g, lengths
        new = (before & ~curved)[nodes.edge].any(1)
