"""Where the nodes of curved triangles stand, and which edges are curved at all (`method.md`, section 9)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from torchlb.fits.polynomials import derivative_coefficients, monomials, num_monomials
from torchlb.galerkin.assembly import CHUNK, area_element, flat_metric, metric
from torchlb.galerkin.elements import EDGES, lattice, triangle
from torchlb.galerkin.nodes import Nodes
from torchlb.galerkin.rim import RimCurves, rim_curves
from torchlb.geometry.stars import pieces_of
from torchlb.geometry.vectors import at, dot
from torchlb.geometry.vertex_fits import VertexFits

NEWTON_STEPS = 4
AGREE, STEEP = 0.15, 0.3
"""Of an edge's length: how far the heights of its two ends may differ, and how large they may be."""
FLAT = 1e-3
"""Height of a triangle over its longest edge, below which it is flat."""
STRETCH = 3.0
"""Largest ratio of the curved area element and the flat one, or of the flat one and the curved one."""
SLACK = 1e-5
"""Of the mean length: what two edges of a triangle are to be longer than the third, by mollification."""


@dataclass(frozen=True)
class Surface:
    """A mesh, and the fits of its vertices.

    Attributes
    ----------
    points : (N, 3), ℓ.
    frames : (N, 3, 2), orthonormal, under the fits.
    normals : (N, 3), orthogonal to the frames, on the side of the faces; zero where these have none.
    fits : of functions, and of the surface.
    """

    points: Float[Tensor, "N 3"]
    frames: Float[Tensor, "N 3 2"]
    normals: Float[Tensor, "N 3"]
    fits: VertexFits


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
    places : (N + X, 3), ℓ.
    curved : (E,), which edges are.
    bent : (X,), which nodes stand on the surface instead of on a flat triangle.
    lengths : (F, 3), mollified.
    rim : numbers of the boundary edges; and the curves over them.
    """

    nodes: Nodes
    places: Float[Tensor, "NX 3"]
    curved: Bool[Tensor, " E"]
    bent: Bool[Tensor, " X"]
    lengths: Float[Tensor, "F 3"]
    rim: Int[Tensor, " G"]
    curves: RimCurves


def curve(surface: Surface, nodes: Nodes) -> tuple[CurvedMesh, Float[Tensor, "F Q 3"]]:
    """Stand the nodes on the fits where these agree, and flatten what they would distort.

    With it comes the metric at the Gauss points, of flat triangles from mollified lengths.
    """
    points, fits = surface.points, surface.fits
    rim = (nodes.uses == 1).nonzero()[:, 0]
    degree = max(int(fits.degree.max()), 2)
    curves = rim_curves(points, nodes.edges[rim], degree + 2 + degree % 2)
    flat = torch.einsum("xv,xvn->xn", nodes.shares, at(points, nodes.corners))
    start = flat + _rim_displacement(points, nodes, rim, curves)
    along = normalize(torch.einsum("xv,xvn->xn", nodes.shares, at(surface.normals, nodes.corners)))
    ends = node_ends(nodes)
    height, sound = _heights(surface, nodes, ends, start, along)
    outside = torch.zeros(len(nodes.faces), dtype=torch.bool)
    height = torch.where(_by_node(nodes, nodes.uses == 1, outside), 0.0, height)  # they are there
    ratio = (start - flat).norm(dim=1) / _sizes(points, nodes)
    curved, whole = _by_edge(nodes, sound & (ratio <= STEEP))
    opposed = surface.normals[nodes.edges].sum(1).norm(dim=1) <= 1
    curved &= ~opposed & (nodes.uses <= 2)
    standing = start + height[:, None] * along
    stand = flat, standing
    places, curved, bent, g, lengths = _flattened(points, nodes, stand, curved, whole)
    return CurvedMesh(nodes, places, curved, bent, lengths, rim, curves), g


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
) -> Float[Tensor, "X 3"]:
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


def _heights(
    surface: Surface, nodes: Nodes, ends: Ends, start: Tensor, along: Tensor
) -> tuple[Float[Tensor, " X"], Bool[Tensor, " X"]]:
    """t of every node, where the line start + tν meets the graphs of its vertices' fits; and whether they agree."""
    size = _sizes(surface.points, nodes)
    if not surface.fits.degree.any():
        return torch.zeros_like(size), torch.zeros_like(size, dtype=torch.bool)
    pairs = zip(ends.node.split(CHUNK), ends.vertex.split(CHUNK), strict=True)
    t = torch.cat([_met(surface, node, vertex, start, along) for node, vertex in pairs])
    least = torch.full_like(size, torch.inf).scatter_reduce(0, ends.node, t, "amin")
    most = torch.full_like(size, -torch.inf).scatter_reduce(0, ends.node, t, "amax")
    sound = (most - least <= AGREE * size) & (
        torch.maximum(most.abs(), least.abs()) <= STEEP * size
    )
    mean = torch.zeros_like(size).index_add(0, ends.node, ends.share * t.nan_to_num(0, 0, 0))
    return mean, sound


def _met(
    surface: Surface,
    node: Int[Tensor, " E"],
    vertex: Int[Tensor, " E"],
    start: Tensor,
    along: Tensor,
) -> Float[Tensor, " E"]:
    """t where the lines of the nodes meet the graphs of the vertices' fits, by Newton's method; ∞ where they do not."""
    fits, frame, normal = surface.fits, at(surface.frames, vertex), at(surface.normals, vertex)
    top, radius = int(fits.degree.max()), fits.radius[vertex, None]
    terms = num_monomials(2, top) - 1
    heights = (at(fits.heights, vertex)[:, :terms] @ normal[..., None])[..., 0]
    slopes = derivative_coefficients(heights, 2, top)
    direction = at(along, node)
    turn = (direction[:, None] @ frame)[:, 0] / radius
    offset, t = at(start, node) - at(surface.points, vertex), torch.zeros_like(radius[:, 0])
    for _ in range(NEWTON_STEPS):
        p = offset + t[:, None] * direction
        y = (p[:, None] @ frame)[:, 0] / radius
        powers = monomials(y, top)
        value = dot(p, normal) - dot(powers, heights)
        lower = powers[:, None, : slopes.shape[2] - 1]
        slope = slopes[..., 0] + dot(lower, slopes[..., 1:])
        t = t - value / (dot(direction, normal) - dot(slope, turn))
    return torch.where(t.isfinite() & (fits.degree[vertex] > 0), t, torch.inf)


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
    points: Float[Tensor, "N 3"],
    nodes: Nodes,
    stand: tuple[Float[Tensor, "X 3"], Float[Tensor, "X 3"]],
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
