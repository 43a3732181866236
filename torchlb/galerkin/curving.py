"""Where the nodes of curved triangles stand, and which edges are curved at all (`method.md`, section 9)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.fits.polynomials import monomials
from torchlb.galerkin.assembly import CHUNK, area_element, flat_metric, metric
from torchlb.galerkin.coarse import coarse_triangles, cover_of
from torchlb.galerkin.delaunay import Cover
from torchlb.galerkin.elements import EDGES, lattice, triangle
from torchlb.galerkin.nodes import Nodes
from torchlb.galerkin.rim import RimCurves, rim_curves
from torchlb.geometry.frames import vertex_normals
from torchlb.geometry.stars import pieces_of
from torchlb.geometry.vectors import at
from torchlb.geometry.vertex_fits import VertexFits

ROUNDS = 2
"""Of moving the nodes to the graphs of their vertices."""
RIM = {2: 6, 3: 6, 4: 8}
"""Vertices that a curve along the boundary goes through, by the degree of the elements."""
AGREE, STEEP = 0.075, 0.3
"""Of an edge's length: how far a graph may be from the mean of a node's, and the node from the edge."""
FLAT = 1e-3
"""Height of a triangle over its longest edge, below which it is flat."""
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
class CurvedMesh:
    """Where the nodes stand.

    Attributes
    ----------
    nodes : the numbering.
    places : (N + X, n), ℓ.
    curved : (E,), which edges are.
    bent : (X,), which nodes stand on the surface instead of on a flat triangle.
    lengths : (F, 3), mollified.
    coarse : (F,), which triangles are flat for the reasons of `coarse_triangles`; and what stands for them.
    rim : numbers of the boundary edges; and the curves over them.
    """

    nodes: Nodes
    places: Float[Tensor, "NX n"]
    curved: Bool[Tensor, " E"]
    bent: Bool[Tensor, " X"]
    lengths: Float[Tensor, "F 3"]
    coarse: Bool[Tensor, " F"]
    cover: Cover
    rim: Int[Tensor, " G"]
    curves: RimCurves


def curve(
    points: Float[Tensor, "N n"],
    fits: VertexFits,
    nodes: Nodes,
    held: Bool[Tensor, " N"] | None = None,
) -> tuple[CurvedMesh, Float[Tensor, "F Q 3"]]:
    """Stand the nodes on the graphs of their vertices where these agree, and flatten what they would distort.

    With it comes the metric at the Gauss points, of flat triangles from mollified lengths. `held` are vertices with a
    Dirichlet condition: boundary edges between them are no mirrors.
    """
    rim = (nodes.uses == 1).nonzero()[:, 0]
    curves = rim_curves(points, nodes.edges[rim], RIM[nodes.degree])
    flat = torch.einsum("xv,xvn->xn", nodes.shares, at(points, nodes.corners))
    start = flat + _rim_displacement(points, nodes, rim, curves)
    standing, sound = _moved(points, fits, nodes, start)
    outside = torch.zeros(len(nodes.faces), dtype=torch.bool)
    of_rim = _by_node(nodes, nodes.uses == 1, outside)
    standing = torch.where(of_rim[:, None], start, standing)
    ratio = (start - flat).norm(dim=1) / _sizes(points, nodes)
    curved, whole = _by_edge(nodes, sound & (ratio <= STEEP))
    curved &= ~_opposed(points, nodes) & (nodes.uses <= 2)
    free = nodes.uses == 1
    if held is not None:
        free &= ~held[nodes.edges].all(1)
    coarse = coarse_triangles(points, nodes, fits, free)
    curved[nodes.edge[coarse].flatten()] = False
    places, curved, bent, g, lengths = _flattened(points, nodes, (flat, standing), curved, whole)
    cover = cover_of(nodes, lengths, coarse, free)
    return CurvedMesh(nodes, places, curved, bent, lengths, coarse, cover, rim, curves), g


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
    """Of every node the length of its edge, or the longest of its face."""
    length = (points[nodes.edges[:, 0]] - points[nodes.edges[:, 1]]).norm(dim=1)
    return torch.cat([nodes.on_edges(length), nodes.inside(length[nodes.edge].amax(1))])


def _by_node(nodes: Nodes, of_edge: Tensor, of_face: Tensor) -> Tensor:
    """Values of edges and faces, at their nodes."""
    return torch.cat([nodes.on_edges(of_edge), nodes.inside(of_face)])


def _by_edge(nodes: Nodes, good: Bool[Tensor, " X"]) -> tuple[Tensor, Tensor]:
    """Edges all of whose nodes are good, and the nodes inside faces that are."""
    split = len(nodes.edges) * (nodes.degree - 1)
    return good[:split].view(len(nodes.edges), -1).all(1), good[split:]


def _rim_displacement(
    points: Tensor, nodes: Nodes, rim: Int[Tensor, " G"], curves: RimCurves
) -> Float[Tensor, "X n"]:
    """From the flat nodes to the boundary's curves; inside of a triangle by (b_i + b_j)² of the edge's (i, j).

    A quadratic displacement b_i b_j of the edge is so continued by itself.
    """
    result = torch.zeros_like(points[:1]).repeat(len(nodes.shares), 1)
    if len(rim) == 0:
        return result
    inner, on_edge = lattice(nodes.degree)[3 * nodes.degree :], nodes.degree - 1
    steps = torch.arange(1, nodes.degree).to(points) / nodes.degree
    ends = points[nodes.edges[rim]]

    def bulge(edges: Tensor, share: Tensor) -> Tensor:
        weights = replace(curves, **{k: v[edges] for k, v in vars(curves).items()}).weights(share)
        chord = ends[edges, None, 0] + share[..., None] * (ends[edges, 1] - ends[edges, 0])[:, None]
        return (weights[..., None] * points[curves.index[edges]][:, None]).sum(2) - chord

    every = torch.arange(len(rim))
    place = rim[:, None] * on_edge + torch.arange(on_edge)
    result[place] = bulge(every, steps.expand(len(rim), -1))
    number = torch.full((len(nodes.edges),), -1)
    number[rim] = every
    for side, (i, j) in enumerate(EDGES):
        face = (number[nodes.edge[:, side]] >= 0).nonzero()[:, 0]
        if len(face) == 0 or len(inner) == 0:
            continue
        both = inner[:, i] + inner[:, j]
        share = (inner[:, j] / both).expand(len(face), -1)
        turned = nodes.faces[face, i] > nodes.faces[face, j]
        share = torch.where(turned[:, None], 1 - share, share)
        moved = both.square()[:, None] * bulge(number[nodes.edge[face, side]], share)
        place = len(nodes.edges) * on_edge + face[:, None] * len(inner) + torch.arange(len(inner))
        result[place] += moved
    return result


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


def _flattened(
    points: Float[Tensor, "N n"],
    nodes: Nodes,
    stand: tuple[Float[Tensor, "X n"], Float[Tensor, "X n"]],
    curved: Bool[Tensor, " E"],
    whole: Bool[Tensor, " I"],
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Places, curved edges, bent nodes, metric, lengths: edges around distorted triangles are flat, until none is.

    `stand` is where nodes are on flat triangles and on the surface; `whole`, which of those inside faces may be there.
    """
    corners = at(points, nodes.faces)
    sides = (corners.roll(-1, dims=1) - corners).norm(dim=2)
    lengths = mollified(sides, nodes.faces)
    plane, shape = flat_metric(lengths), triangle(nodes.degree)
    area = area_element(plane)
    curved = curved.clone()
    curved[nodes.edge[area < FLAT * sides.amax(1).square()].flatten()] = False
    inside = len(lattice(nodes.degree)) - 3 * nodes.degree
    g = plane[:, None].repeat(1, len(shape.weights), 1)
    new = torch.ones(len(nodes.faces), dtype=torch.bool)  # triangles whose nodes have moved
    while True:
        kept = curved[nodes.edge]
        smooth = kept.all(1) & whole.view(len(nodes.faces), inside).all(1)
        bent = _by_node(nodes, curved, smooth)
        places = torch.cat([points, torch.where(bent[:, None], stand[1], stand[0])])
        some = kept.any(1)
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
