"""Where the nodes of curved cells stand, and which edges are curved at all (`method.md`, section 9).

Curves along the boundary, mollified lengths and normals are of triangles alone; all else is of any dimension.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.fits.polynomials import monomials
from torchlb.galerkin.assembly import CHUNK, area_element, flat_metric, metric
from torchlb.galerkin.coarse import coarse_triangles, cover_of
from torchlb.galerkin.delaunay import Cover
from torchlb.galerkin.elements import simplex
from torchlb.galerkin.nodes import Nodes
from torchlb.geometry.frames import vertex_normals
from torchlb.geometry.stars import pieces_of
from torchlb.geometry.vectors import at
from torchlb.geometry.vertex_fits import VertexFits

ROUNDS = 2
"""Of moving the nodes to the graphs of their vertices."""
AGREE, STEEP = 0.075, 0.3
"""Of an edge's length: how far a graph may be from the mean of a node's, and the node from the edge."""
FLAT = 1e-3
"""Height of a triangle over its longest edge, below which it is flat."""
NO_VOLUME, POINT = 1e-6, 1e-30
"""Volume of a tetrahedron over the cube of its longest edge, that rounding may make of none; and the size that it has
then, over that edge."""
STRETCH = 3.0
"""Largest ratio of the curved area element and the flat one, or of the flat one and the curved one."""
SLACK = 1e-5
"""Of the mean length: what two edges of a triangle are to be longer than the third, by mollification."""


@dataclass(frozen=True)
class Ends:
    """Pairs of a node beyond the vertices and a vertex that it asks, with the vertex's share."""

    node: Int[Tensor, " E"]
    vertex: Int[Tensor, " E"]
    share: Float[Tensor, " E"]


@dataclass(frozen=True)
class BoundaryNodes:
    """Nodes whose place and value follow from the boundary alone, so that what vanishes there vanishes on all of it.

    Attributes
    ----------
    displacement
        (X, n), ℓ: of every node from its flat place, by the boundary.
    nodes
        (A,), those along the boundary.
    entries
        (node, vertex, weight) of the values of these nodes, by vertices of the boundary.
    """

    displacement: Float[Tensor, "X n"]
    nodes: Int[Tensor, " A"]
    entries: tuple[Int[Tensor, " E"], Int[Tensor, " E"], Float[Tensor, " E"]]


@dataclass(frozen=True)
class CurvedMesh:
    """Where the nodes stand.

    Attributes
    ----------
    nodes
        The numbering.
    places
        (N + X, n), ℓ.
    curved
        (E,), which edges are.
    bent
        (X,), which nodes stand on the surface instead of on a flat cell.
    lengths
        (F, e) of the edges, mollified, ℓ.
    coarse, cover
        (F,), which triangles are flat for the reasons of `coarse_triangles`; and what stands for them.
    boundary
        What is known of the nodes along the boundary.
    """

    nodes: Nodes
    places: Float[Tensor, "NX n"]
    curved: Bool[Tensor, " E"]
    bent: Bool[Tensor, " X"]
    lengths: Float[Tensor, "F e"]
    coarse: Bool[Tensor, " F"]
    cover: Cover | None
    boundary: BoundaryNodes


def curve(
    points: Float[Tensor, "N n"],
    fits: VertexFits,
    nodes: Nodes,
    boundary: BoundaryNodes,
    held: Bool[Tensor, " N"] | None = None,
) -> tuple[CurvedMesh, Float[Tensor, "F Q S"]]:
    """Stand the nodes on the graphs of their vertices where these agree, and flatten what they would distort.

    With it comes the metric at the Gauss points, of flat triangles from mollified lengths. Nodes along the boundary of
    triangles stay on its curves. `held` are vertices with a Dirichlet condition: boundary edges between them are no
    mirrors.
    """
    flat = torch.einsum("xv,xvn->xn", nodes.shares, at(points, nodes.corners))
    start = flat + boundary.displacement
    standing, sound = _moved(points, fits, nodes, start)
    if nodes.dim == 2:
        standing[boundary.nodes] = start[boundary.nodes]
    ratio = (start - flat).norm(dim=1) / _sizes(points, nodes)
    curved, *whole = nodes.by_side(sound & (ratio <= STEEP))
    uses = nodes.sides[2].uses
    coarse, free = torch.zeros(len(nodes.cells), dtype=torch.bool), uses == 1
    if nodes.dim == 2:
        curved &= ~_opposed(points, nodes) & (uses <= 2)
        if held is not None:
            free &= ~held[nodes.edges].all(1)
        coarse = coarse_triangles(points, nodes, fits, free)
        curved[nodes.edge[coarse].flatten()] = False
    places, curved, bent, g, lengths = _flattened(points, nodes, (flat, standing), curved, whole)
    cover = cover_of(nodes, lengths, coarse, free) if nodes.dim == 2 else None
    return CurvedMesh(nodes, places, curved, bent, lengths, coarse, cover, boundary), g


def _opposed(points: Tensor, nodes: Nodes) -> Bool[Tensor, " E"]:
    """Edges whose ends' normals are more than 120° apart, or none."""
    if points.shape[1] != 3:
        return torch.zeros(len(nodes.edges), dtype=torch.bool)
    return vertex_normals(points, nodes.faces)[nodes.edges].sum(1).norm(dim=1) <= 1


def node_ends(nodes: Nodes) -> Ends:
    """The vertices with a share in each node."""
    node, place = (nodes.shares > 0).nonzero(as_tuple=True)
    return Ends(node, nodes.corners[node, place], nodes.shares[node, place])


def _sizes(points: Tensor, nodes: Nodes) -> Float[Tensor, " X"]:
    """Of every node the length of its edge, or the longest of its triangle or cell."""
    length = (points[nodes.edges[:, 0]] - points[nodes.edges[:, 1]]).norm(dim=1)
    return nodes.at_nodes(length, *(length[side.edges].amax(1) for side in nodes.beyond))


def _moved(
    points: Tensor, fits: VertexFits, nodes: Nodes, start: Float[Tensor, "X n"]
) -> tuple[Float[Tensor, "X n"], Bool[Tensor, " X"]]:
    """Where the graphs of its vertices take every node, in the mean; and whether they agree.

    Asked again from there they do so at the same place, but for h⁶.
    """
    ends, size, place = node_ends(nodes), _sizes(points, nodes), start
    parts = list(zip(ends.node.split(CHUNK), ends.vertex.split(CHUNK), strict=True))
    apart = torch.zeros_like(size[ends.node])
    for _ in range(ROUNDS):
        moves = torch.cat(
            [_to_graph(points, fits, at(place, node), vertex) for node, vertex in parts]
        )
        mean = torch.zeros_like(start).index_add_(0, ends.node, ends.share[:, None] * moves)
        place, apart = place + mean, (moves - at(mean, ends.node)).norm(dim=1)
    bad = (apart > AGREE * at(size, ends.node)) | (fits.degree[ends.vertex] == 0)
    sound = (place - start).norm(dim=1) <= STEEP * size
    sound[ends.node[bad]] = False
    return place, sound


def _to_graph(
    points: Tensor, fits: VertexFits, places: Float[Tensor, "E n"], vertex: Int[Tensor, " E"]
) -> Float[Tensor, "E n"]:
    """From places to the graph of the surface at a vertex, orthogonally to its frame."""
    surface, frame, offset = fits.surface, at(fits.frames, vertex), places - at(points, vertex)
    along = offset[:, None] @ frame
    powers = monomials(along / surface.radius[vertex, None, None], surface.highest)
    return (powers @ at(surface.heights, vertex) + along @ frame.mT)[:, 0] - offset


def mollified(sides: Float[Tensor, "F 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    """Lengths of edges, all of a component longer by so much that none of its triangles is without area."""
    spare = sides.sum(1) - 2 * sides.amax(1)
    if bool((spare >= SLACK * sides.amax()).all()):
        return sides
    piece = torch.from_numpy(pieces_of(faces.numpy(), int(faces.max()) + 1))[faces[:, 0]]
    number = torch.bincount(piece).clamp_min(1)
    mean = torch.zeros(len(number), dtype=sides.dtype).index_add_(0, piece, sides.mean(1)) / number
    lack = torch.zeros_like(mean).scatter_reduce_(0, piece, SLACK * mean[piece] - spare, "amax")
    return sides + lack[piece, None]


def shrunk(sides: Float[Tensor, "F 6"]) -> Float[Tensor, "F 6"]:
    """Lengths of edges, those of tetrahedra without volume next to nothing, so that they count for nothing.

    Delaunay tetrahedra of a grid have such slivers, four points of a square; what is around them fills the solid.
    """
    longest = sides.amax(1)
    none = area_element(flat_metric(sides)) <= NO_VOLUME * longest**3
    return torch.where(none[:, None], POINT * longest[:, None], sides)


def _flattened(
    points: Float[Tensor, "N n"],
    nodes: Nodes,
    stand: tuple[Float[Tensor, "X n"], Float[Tensor, "X n"]],
    curved: Bool[Tensor, " E"],
    whole: list[Bool[Tensor, " _"]],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Places, curved edges, bent nodes, metric, lengths: edges around distorted cells are flat, until none is.

    `stand` is where nodes are on flat cells and on the surface; `whole`, which triangles and cells may have theirs
    there.
    """
    lengths = sides = (points[nodes.edges[:, 0]] - points[nodes.edges[:, 1]]).norm(dim=1)[
        nodes.edge
    ]
    if nodes.dim == 2:
        lengths = mollified(sides, nodes.cells)
    elif nodes.dim == 3:
        lengths = shrunk(sides)
    plane, shape = flat_metric(lengths), simplex(nodes.dim, nodes.degree)
    area = area_element(plane)
    curved = curved.clone()
    curved[nodes.edge[area < FLAT * sides.amax(1) ** nodes.dim].flatten()] = False
    g = plane[:, None].repeat(1, len(shape.weights), 1)
    new = torch.ones(len(nodes.cells), dtype=torch.bool)  # cells whose nodes have moved
    while True:
        smooth = [w & curved[s.edges].all(1) for w, s in zip(whole, nodes.beyond, strict=True)]
        bent = nodes.at_nodes(curved, *smooth)
        places = torch.cat([points, torch.where(bent[:, None], stand[1], stand[0])])
        some = curved[nodes.edge].any(1)
        g[new & ~some] = plane[new & ~some, None]
        before, curved = curved, curved.clone()
        for part in (new & some).nonzero()[:, 0].split(CHUNK):
            g[part] = metric(places, nodes.elements[part], shape)
            stretch = area_element(g[part]) / area[part, None]
            bad = ((stretch < 1 / STRETCH) | (stretch > STRETCH)).any(1)
            curved[nodes.edge[part[bad]].flatten()] = False
        if torch.equal(before, curved):
            return places, curved, bent, g, lengths
        new = (before & ~curved)[nodes.edge].any(1)
