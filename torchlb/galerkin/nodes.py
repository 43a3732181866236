"""The Lagrange nodes of a mesh: their numbers, and where they stand on its flat triangles."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.galerkin.elements import EDGES, lattice
from torchlb.geometry.manifold import edges_of


@dataclass(frozen=True)
class Nodes:
    """Nodes of degree r: the vertices, r − 1 on every edge from its lower vertex on, those inside the faces.

    Attributes
    ----------
    degree : r.
    faces : (F, 3).  edges : (E, 2), lower vertex first.
    edge : (F, 3), the edges of the faces, in the order of `EDGES`.
    uses : (E,), number of faces at each edge.
    corners, shares : (X, 3), vertices and barycentrics of each node beyond the vertices; an edge's third share is 0.
    elements : (F, n), nodes of each face in the order of `lattice`.
    """

    degree: int
    faces: Int[Tensor, "F 3"]
    edges: Int[Tensor, "E 2"]
    edge: Int[Tensor, "F 3"]
    uses: Int[Tensor, " E"]
    corners: Int[Tensor, "X 3"]
    shares: Float[Tensor, "X 3"]
    elements: Int[Tensor, "F n"]

    def on_edges(self, values: Tensor) -> Tensor:
        """Of every node on an edge, in order, the value of its edge."""
        return values.repeat_interleave(self.degree - 1, 0)

    def inside(self, values: Tensor) -> Tensor:
        """Of every node inside a face, in order, the value of its face."""
        return values.repeat_interleave(len(lattice(self.degree)) - 3 * self.degree, 0)


def lagrange_nodes(faces: Int[Tensor, "F 3"], num_points: int, degree: int) -> Nodes:
    """The nodes of degree r ≥ 2 on a mesh of any topology.

    >>> lagrange_nodes(torch.tensor([[0, 1, 2], [1, 3, 2]]), 4, 2).elements.tolist()
    [[0, 1, 2, 4, 6, 5], [1, 3, 2, 7, 8, 6]]
    """
    found = edges_of(faces.numpy(), num_points)
    keys, of, uses = (torch.from_numpy(part) for part in (found.keys, found.of, found.uses))
    edges = torch.stack([keys // num_points, keys % num_points], 1)
    edge = of.view(-1, 3).roll(1, 1)  # those across corners 2, 0, 1
    on_edge = degree - 1
    steps = torch.arange(1, degree, dtype=torch.float64) / degree
    shares = torch.stack([1 - steps, steps, 0 * steps], 1).repeat(len(edges), 1)
    corners = torch.cat([edges, edges[:, :1]], 1).repeat_interleave(on_edge, 0)
    inner = lattice(degree)[3 * degree :]
    numbers = num_points + edge[:, :, None] * on_edge + torch.arange(on_edge)
    turned = torch.stack([faces[:, i] > faces[:, j] for i, j in EDGES], 1)
    numbers = torch.where(turned[..., None], numbers.flip(-1), numbers)
    first = num_points + len(edges) * on_edge + torch.arange(len(faces))[:, None] * len(inner)
    return Nodes(
        degree,
        faces,
        edges,
        edge,
        uses,
        torch.cat([corners, faces.repeat_interleave(len(inner), 0)]),
        torch.cat([shares, inner.repeat(len(faces), 1)]),
        torch.cat([faces, numbers.flatten(1), first + torch.arange(len(inner))], 1),
    )
