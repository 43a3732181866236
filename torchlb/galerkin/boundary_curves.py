"""Polynomial curves along the boundary of a surface mesh, for a domain of high order (`method.md`, section 9).

Over each boundary edge the curve is the polynomial in arc length through the nearest boundary vertices. The same
Lagrange weights interpolate functions, so a function that vanishes at the boundary vertices vanishes on the curve.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.geometry.fit_search import MAX_LEBESGUE
from torchlb.geometry.thresholds import CREASE, FACTOR, KINK


@dataclass(frozen=True)
class BoundaryCurvesPlan:
    """Vertices that the polynomial curve over each boundary edge passes through.

    Attributes
    ----------
    index
        (G, 2 + 2s): both ends of the edge, then s vertices beyond its second end and s beyond its first, outwards.
    valid
        (G, 2 + 2s), whether an entry is used.
    """

    index: Int[Tensor, "G S"]
    valid: Bool[Tensor, "G S"]

    def at(self, points: Float[Tensor, "N n"]) -> BoundaryCurves:
        """Evaluate the curves."""
        steps = self.index.shape[1] // 2 - 1
        index, arcs = self.index, [points.new_zeros(len(self.index), 1)]
        for walk in index[:, 1 : 2 + steps], torch.cat([index[:, :1], index[:, 2 + steps :]], 1):
            step = points[walk[:, 1:]] - points[walk[:, :-1]]
            arcs.append(step.norm(dim=2).cumsum(1))
        length = (points[index[:, 1]] - points[index[:, 0]]).norm(dim=1, keepdim=True)
        first, ahead, behind = arcs
        return BoundaryCurves(
            index, self.valid, torch.cat([first, length, length + ahead, -behind], 1)
        )


@dataclass(frozen=True)
class BoundaryCurves:
    """A polynomial curve over each boundary edge.

    Attributes
    ----------
    index, valid
        As in `BoundaryCurvesPlan`.
    arc
        (G, S), arc length of these vertices from the first end of the edge, ℓ.
    """

    index: Int[Tensor, "G S"]
    valid: Bool[Tensor, "G S"]
    arc: Float[Tensor, "G S"]

    def over(self, edges: Int[Tensor, " E"]) -> BoundaryCurves:
        """Curves over a subset of the edges."""
        return BoundaryCurves(self.index[edges], self.valid[edges], self.arc[edges])

    def weights(self, share: Float[Tensor, "G q"]) -> Float[Tensor, "G q S"]:
        """Lagrange weights of the vertices at relative positions on the edge, 0 at its first end, 1 at its second."""
        size = self.index.shape[1]
        at = share * self.arc[:, 1:2]
        other = self.valid[:, None, :] & self.valid[:, :, None] & ~torch.eye(size, dtype=torch.bool)
        gap = torch.where(other, self.arc[:, :, None] - self.arc[:, None, :], 1.0)
        to = torch.where(other[:, None], at[:, :, None, None] - self.arc[:, None, None, :], 1.0)
        return (to / gap[:, None]).prod(-1) * self.valid[:, None]


def boundary_curves_plan(
    points: Float[Tensor, "N n"], edges: Int[Tensor, "G 2"], width: int
) -> BoundaryCurvesPlan:
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
    plan = BoundaryCurvesPlan(torch.cat([edges, right, left], 1), torch.cat([ends, *used], 1))
    _bound(plan.at(points))
    return plan


def _bound(curves: BoundaryCurves) -> None:
    """Drop the farthest vertices of curves whose Lebesgue constant is too large, as where the spacing jumps."""
    middle = curves.arc[:, 1:2] / 2
    distance = (curves.arc - middle).abs()
    distance[:, :2] = 0
    while True:
        size = curves.weights(torch.full_like(middle, 0.5)).abs().sum(2)[:, 0]
        steep = (size > MAX_LEBESGUE).nonzero()[:, 0]
        if len(steep) == 0:
            return
        curves.valid[steep, (distance * curves.valid)[steep].argmax(1)] = False


def _mates(points: Float[Tensor, "N n"], edges: Int[Tensor, "G 2"]) -> Int[Tensor, " two_G"]:
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
