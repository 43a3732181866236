"""Lagrange nodes of a complex of simplices: their numbering and barycentric coordinates."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.galerkin.elements import facet_nodes, inner, subsets
from torchlb.geometry.boundary import sub_simplices


@dataclass(frozen=True)
class Sides:
    """Sub-simplices of one dimension of a complex, each listed once, with ascending corners.

    `of` has those of each cell in the order of `subsets`, `edges` their edges, `uses` the number of cells that each
    belongs to, `nodes` the number of nodes inside each.
    """

    corners: Int[Tensor, "S s"]
    of: Int[Tensor, "F c"]
    edges: Int[Tensor, "S e"]
    uses: Int[Tensor, " S"]
    nodes: int


@dataclass(frozen=True)
class Nodes:
    """Nodes of degree r: `count` vertices, then those inside each edge, inside each triangle, and so on.

    `faces` are the cells with their orientation, `cells` those with ascending corners; `sides` has their sub-simplices
    by number of corners: edges, triangles, …, and facets. Nodes that are no vertices have barycentric coordinates
    `shares` with respect to `corners`; `elements` has the nodes of each cell in the order of `lattice`.
    """

    count: int
    degree: int
    closed: bool
    faces: Int[Tensor, "F corners"]
    cells: Int[Tensor, "F corners"]
    sides: dict[int, Sides]
    corners: Int[Tensor, "X corners"]
    shares: Float[Tensor, "X corners"]
    elements: Int[Tensor, "F n"]

    def __reduce__(self) -> tuple[Any, ...]:
        """State for files: what the nodes follow from."""
        return lagrange_nodes, (self.faces, self.count, self.degree, self.closed)

    @property
    def dim(self) -> int:
        """Dimension d of the cells."""
        return self.cells.shape[1] - 1

    @property
    def edges(self) -> Int[Tensor, "E 2"]:
        """The edges, lower vertex first."""
        return self.sides[2].corners

    @property
    def edge(self) -> Int[Tensor, "F e"]:
        """The edges of each cell."""
        return self.sides[2].of

    @property
    def beyond(self) -> list[Sides]:
        """Sub-simplices of dimension 2 and higher, cells included."""
        return [self.sides[size] for size in range(3, self.dim + 2)]

    def at_nodes(self, *values: Tensor) -> Tensor:
        """Repeat values of the edges, of the triangles, … at the nodes inside them, in node order."""
        parts = zip(values, [self.sides[2], *self.beyond], strict=True)
        return torch.cat([x.repeat_interleave(side.nodes, 0) for x, side in parts])

    def by_side(self, values: Bool[Tensor, " X"]) -> list[Bool[Tensor, " _"]]:
        """Whether a flag holds at all nodes inside each edge, each triangle, and so on."""
        sides = [self.sides[2], *self.beyond]
        parts = values.split([len(side.uses) * side.nodes for side in sides])
        return [x.view(len(s.uses), s.nodes).all(1) for s, x in zip(sides, parts, strict=True)]

    def boundary(self) -> tuple[Int[Tensor, " G"], Int[Tensor, "G n"]]:
        """Facets of one cell only: that cell, and their nodes in the order of `lattice`."""
        facets = self.sides[self.dim]
        cell, place = (facets.uses[facets.of] == 1).nonzero(as_tuple=True)
        local = facet_nodes(self.dim, self.degree)[place]
        return cell, self.elements[cell].gather(1, local)


def lagrange_nodes(
    cells: Int[Tensor, "F corners"], num_points: int, degree: int, closed: bool = False
) -> Nodes:
    """Number the nodes of degree r on a complex of any topology; `closed` ignores its boundary.

    >>> lagrange_nodes(torch.tensor([[0, 1, 2], [1, 3, 2]]), 4, 2).elements.tolist()
    [[0, 1, 2, 4, 6, 5], [1, 2, 3, 6, 8, 7]]
    """
    faces, cells, count, sides = cells, cells.sort(1).values, num_points, {}
    corners_of_cell = cells.shape[1]
    dim = corners_of_cell - 1
    corners, shares, elements = [], [], [cells]
    for size in range(min(dim, 2), corners_of_cell + 1):
        side = sides[size] = _sides(cells, size, degree, sides.get(2))
        if side.nodes == 0:
            continue
        number = count + side.of[..., None] * side.nodes + torch.arange(side.nodes)
        elements.append(number.flatten(1))
        padding = side.corners[:, :1].expand(-1, corners_of_cell - size)
        corners.append(torch.cat([side.corners, padding], 1).repeat_interleave(side.nodes, 0))
        share = torch.nn.functional.pad(inner(size, degree), (0, corners_of_cell - size))
        shares.append(share.repeat(len(side.uses), 1))
        count += len(side.uses) * side.nodes
    if closed:
        sides[dim] = replace(sides[dim], uses=sides[dim].uses.clamp_min(2))
    return Nodes(
        num_points,
        degree,
        closed,
        faces,
        cells,
        sides,
        torch.cat([cells[:0], *corners]),
        torch.cat([inner(corners_of_cell, 1), *shares]),
        torch.cat(elements, 1),
    )


def _sides(cells: Int[Tensor, "F corners"], size: int, degree: int, edges: Sides | None) -> Sides:
    """Sub-simplices with `size` corners, sorted by their corners; cells keep their order."""
    dim, nodes = cells.shape[1] - 1, len(inner(size, degree)) if size > 1 else 0
    if size == dim + 1:
        corners, of = cells, torch.arange(len(cells))[:, None]
        uses = torch.ones(len(cells), dtype=torch.int64)
    else:
        corners, of, uses = sub_simplices(cells, subsets(dim, size))
    if edges is None:
        return Sides(corners, of, torch.arange(len(corners))[:, None], uses, nodes)
    places = {pair: place for place, pair in enumerate(subsets(dim, 2))}
    own = corners.new_zeros(len(corners), size * (size - 1) // 2)
    for column, subset in zip(of.T, subsets(dim, size), strict=True):
        pairs = [places[subset[i], subset[j]] for i, j in subsets(size - 1, 2)]
        own[column] = edges.of[:, pairs]
    return Sides(corners, of, own, uses, nodes)
