"""Intrinsic Delaunay triangulation of the tufted cover of flat triangles (Sharp and Crane 2020).

A boundary edge opposite an obtuse angle has a negative cotangent weight, and cannot be flipped. On the tufted cover,
two copies of every triangle glued along the boundary, it is an interior edge like all others.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.galerkin.assembly import area_element, flat_metric
from torchlb.geometry.complex import pieces_of
from torchlb.linalg.precision import EPS, NEGLIGIBLE, SINGLE, TINY

EDGES = tuple((i, (i + 1) % 3) for i in range(3))
"""Ends of the edges of a triangle, in the order of `subsets`."""


class Cover(NamedTuple):
    """Tufted cover of a set of triangles, with edge lengths in the order of `EDGES`, ℓ.

    Both copies of a vertex have one number, and an edge may join a vertex to itself. `flips` are batches of
    simultaneous edge flips; half-edge s of face f has number 3f + s. Each has `shares`: the pairs of triangles, and the
    first one's share of their joint area before the flip.
    """

    faces: Int[Tensor, "two_F 3"]
    lengths: Float[Tensor, "two_F 3"]
    flips: list[Tensor]
    shares: list[tuple[Tensor, Tensor]]

    def mixed(self) -> sparse.csr_array:
        """(2F, F), share of each original triangle in each one of the cover, by averages over flipped pairs."""
        count = len(self.faces) // 2
        one: Any = sparse.eye_array(count, format="csr")
        result: Any = sparse.vstack([one, one], format="csr")
        for pair, share in self.shares:
            same, pair, share = np.ones(2 * count), pair.cpu().numpy(), share.detach().cpu().numpy()
            same[pair] = 0
            row = np.append(np.arange(2 * count), pair[:, [0, 0, 1, 1]])
            col = np.append(np.arange(2 * count), pair[:, [0, 1, 0, 1]])
            weight = np.append(same, np.stack([share, 1 - share, share, 1 - share], 1))
            result = sparse.csr_array((weight, (row, col))) @ result
        return result


def mollified(sides: Float[Tensor, "F 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    """Mollified edge lengths (Sharp and Crane 2020): one constant per component leaves no triangle degenerate.

    Two edges of a triangle then exceed the third by 1e-5 of the mean length; with 1e-6, flips may not terminate.
    """
    spare = sides.sum(1) - 2 * sides.amax(1)
    if bool((spare >= SINGLE * sides.amax()).all()):
        return sides
    piece = pieces_of(faces.cpu().numpy(), int(faces.max()) + 1)
    piece = torch.from_numpy(piece).to(faces)[faces[:, 0]]
    number = torch.bincount(piece).clamp_min(1)
    mean = torch.zeros(len(number), dtype=sides.dtype).index_add_(0, piece, sides.mean(1)) / number
    lack = torch.zeros_like(mean).scatter_reduce_(0, piece, SINGLE * mean[piece] - spare, "amax")
    return sides + lack[piece, None]


def sound_lengths(
    sides: Float[Tensor, "F e"], cells: Int[Tensor, "F corners"]
) -> Float[Tensor, "F e"]:
    """Edge lengths with a positive definite metric in every cell; those of triangles are `mollified`.

    Tetrahedra without volume are shrunk to almost zero, and contribute nothing: Delaunay tetrahedra of a grid include
    such slivers, the four corners of a square; the others fill the solid.
    """
    if cells.shape[1] != 4:
        return mollified(sides, cells) if cells.shape[1] == 3 else sides
    longest = sides.amax(1)
    none = area_element(flat_metric(sides)) <= NEGLIGIBLE * longest**3
    return torch.where(none[:, None], EPS**2 * longest[:, None], sides)


def delaunay_cover(
    faces: Int[Tensor, "F 3"],
    lengths: Float[Tensor, "F 3"],
    edge: Int[Tensor, "F 3"],
    fixed: Bool[Tensor, " E"],
    flips: list[Tensor] | None = None,
) -> Cover:
    """Tufted cover of the triangles, flipped until it is intrinsic Delaunay except at `fixed` edges.

    `edge` numbers the edges of the faces. At an edge of any number of faces each face is glued to the back of the next.
    Where `flips` are given, these are repeated instead, whatever the lengths.
    """
    sheets = torch.cat([faces, faces.flip(1)])
    sides = torch.cat([lengths, lengths[:, [1, 0, 2]]])
    cover, twin = Cover(sheets, sides, [], []), _glued(faces, edge, fixed)
    for chosen in _lacking(sheets, sides, twin) if flips is None else flips:
        cover.flips.append(chosen)
        cover.shares.append(_flip(sheets, sides, twin, chosen))
    return cover


def _lacking(sheets: Tensor, sides: Tensor, twin: Tensor) -> Iterator[Int[Tensor, " C"]]:
    """Yield batches of edges to flip until all are Delaunay; the caller flips each before it asks for the next."""
    active = torch.arange(len(twin))
    while True:
        active = active[(twin[active] > active) & (active // 3 != twin[active] // 3)]
        weight = _foot(sides, active)[2] + _foot(sides, twin[active])[2]
        lacking = weight < -NEGLIGIBLE
        poor = active[lacking]
        chosen = poor[apart(poor // 3, twin[poor] // 3, weight[lacking], len(sheets))]
        if len(chosen) == 0:
            return
        faces = torch.cat([chosen, twin[chosen]]) // 3
        yield chosen
        slots = (3 * faces.view(-1, 1) + torch.arange(3)).flatten()
        met = torch.minimum(slots, twin[slots])
        active = torch.unique(torch.cat([active[lacking], met[met >= 0]]))


def _glued(faces: Tensor, edge: Tensor, fixed: Tensor) -> Int[Tensor, " six_F"]:
    """Opposite half-edge of every half-edge of the orientation double cover, −1 where the edge is fixed.

    Half-edge s of face f has the number 3f + s. Where several faces share an edge, each is glued to the next one.
    """
    count = len(faces)
    front = torch.arange(3 * count)
    back = 3 * (count + front // 3) + torch.tensor([1, 0, 2])[front % 3]
    starts, ends = (faces[:, [pair[i] for pair in EDGES]].flatten() for i in (0, 1))
    up = torch.where(starts < ends, front, back)  # the copy directed from the lower vertex
    down = front + back - up
    order = edge.flatten().argsort(stable=True)
    number = edge.flatten()[order]
    _, uses = torch.unique_consecutive(number, return_counts=True)
    following = torch.arange(1, 3 * count + 1)
    following[uses.cumsum(0) - 1] = uses.cumsum(0) - uses  # the last is glued to the first
    twin = torch.full((6 * count,), -1)
    one, other = up[order], down[order[following]]
    free = ~fixed[number]
    twin[one[free]], twin[other[free]] = other[free], one[free]
    return twin


def _foot(sides: Float[Tensor, "T 3"], slot: Int[Tensor, " H"]) -> list[Float[Tensor, " H"]]:
    """Foot of the opposite corner on the line of a half-edge, from its start, and height, ℓ; cotangent of its angle."""
    own, after, before = (sides[slot // 3, (slot + i) % 3] for i in range(3))
    foot = ((before - after) * (before + after) / own + own) / 2
    height = ((before - foot) * (before + foot)).clamp_min(0).sqrt()
    twice = after.square() + before.square() - own.square()
    return [foot, height, twice / (2 * own * height).clamp_min(TINY)]


def apart(one: Tensor, other: Tensor, weight: Tensor, num_faces: int) -> Int[Tensor, " C"]:
    """Independent edges, the lightest first: those of least weight among all that share a face with them."""
    order = weight.argsort(stable=True)
    rank = torch.arange(len(order))
    first = torch.full((num_faces,), len(order))
    pair = one[order], other[order]
    for face in pair:
        first.scatter_reduce_(0, face, rank, "amin")
    return order[(first[pair[0]] == rank) & (first[pair[1]] == rank)]


def _flip(
    sheets: Tensor, sides: Tensor, twin: Tensor, chosen: Int[Tensor, " C"]
) -> tuple[Int[Tensor, "C 2"], Float[Tensor, " C"]]:
    """Flip edges in place, (a, b, c) and (b, a, d) to (c, d, b) and (d, c, a); return an entry of `Cover.shares`."""
    other = twin[chosen]
    f, g = chosen // 3, other // 3
    (ab, bc, ca), (ba, ad, db) = (
        [3 * face + (slot + i) % 3 for i in range(3)] for face, slot in ((f, chosen), (g, other))
    )
    (x, y, _), (z, w, _) = _foot(sides, chosen), _foot(sides, other)
    across = torch.hypot(x + z - sides.view(-1)[ab], y + w)
    a, b, c, d = (sheets.view(-1)[slot] for slot in (ab, ba, ca, db))
    length = [sides.view(-1)[slot] for slot in (db, bc, ca, ad)]
    sheets[f], sheets[g] = torch.stack([c, d, b], 1), torch.stack([d, c, a], 1)
    sides[f] = torch.stack([across, length[0], length[1]], 1)
    sides[g] = torch.stack([across, length[2], length[3]], 1)
    place = torch.arange(len(twin))
    for old, face, slot in ((ab, f, 0), (db, f, 1), (bc, f, 2), (ba, g, 0), (ca, g, 1), (ad, g, 2)):
        place[old] = 3 * face + slot
    moved = torch.where(twin >= 0, place[twin], -1)
    twin[place] = moved
    return torch.stack([f, g], 1), y / (y + w)
