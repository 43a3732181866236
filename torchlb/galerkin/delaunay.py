"""Intrinsic Delaunay triangles of what is flat, glued to its mirror image along the boundary (Sharp, Crane 2020).

A boundary edge across from an obtuse angle ties the vertex there to the line between its ends, however long that is. On
the surface and its mirror image, each triangle twice, it is an edge like all others, and may be flipped as well.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.galerkin.assembly import area_element, flat_metric
from torchlb.geometry.complex import pieces_of
from torchlb.linalg.precision import EPS, NEGLIGIBLE, SINGLE

EDGES = tuple((i, (i + 1) % 3) for i in range(3))
"""Ends of the sides of a triangle, in turn, in the order of `subsets`."""


class Cover(NamedTuple):
    """Triangles that cover others twice.

    Attributes
    ----------
    faces
        (2F, 3); copies of a vertex are one vertex, and sides may join it to itself.
    lengths
        (2F, 3), ℓ, of the sides in the order of `EDGES`.
    flips
        In order, the sides that were flipped at one time: side s of face f has number 3f + s.
    shares
        Of each of these lots the two triangles, and the share of the first in the area of both.
    """

    faces: Int[Tensor, "two_F 3"]
    lengths: Float[Tensor, "two_F 3"]
    flips: list[Tensor]
    shares: list[tuple[Tensor, Tensor]]

    def mixed(self) -> sparse.csr_array:
        """(2F, F), of each triangle what share of the given ones it has, as far as means over two triangles tell."""
        count = len(self.faces) // 2
        one: Any = sparse.eye_array(count, format="csr")
        result: Any = sparse.vstack([one, one], format="csr")
        for pair, share in self.shares:
            same = torch.ones(2 * count, dtype=torch.float64)
            same[pair.flatten()] = 0
            row = torch.cat([torch.arange(2 * count), pair[:, [0, 0, 1, 1]].flatten()])
            col = torch.cat([torch.arange(2 * count), pair[:, [0, 1, 0, 1]].flatten()])
            weight = torch.stack([share, 1 - share, share, 1 - share], 1).flatten()
            where = row.numpy(), col.numpy()
            result = sparse.csr_array((torch.cat([same, weight.detach()]).numpy(), where)) @ result
        return result


def mollified(sides: Float[Tensor, "F 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "F 3"]:
    """Lengths of edges, all of a component longer by so much that none of its triangles is without area.

    Two of a triangle are then longer than the third by 1e-5 of the mean; with a tenth of it flips may not end.
    """
    spare = sides.sum(1) - 2 * sides.amax(1)
    if bool((spare >= SINGLE * sides.amax()).all()):
        return sides
    piece = torch.from_numpy(pieces_of(faces.numpy(), int(faces.max()) + 1))[faces[:, 0]]
    number = torch.bincount(piece).clamp_min(1)
    mean = torch.zeros(len(number), dtype=sides.dtype).index_add_(0, piece, sides.mean(1)) / number
    lack = torch.zeros_like(mean).scatter_reduce_(0, piece, SINGLE * mean[piece] - spare, "amax")
    return sides + lack[piece, None]


def shrunk(sides: Float[Tensor, "F 6"]) -> Float[Tensor, "F 6"]:
    """Lengths of edges, those of tetrahedra without volume next to nothing, so that they count for nothing.

    Delaunay tetrahedra of a grid have such slivers, four points of a square; what is around them fills the solid.
    """
    longest = sides.amax(1)
    none = area_element(flat_metric(sides)) <= NEGLIGIBLE * longest**3
    return torch.where(none[:, None], EPS**2 * longest[:, None], sides)


def sound_lengths(
    sides: Float[Tensor, "F e"], cells: Int[Tensor, "F corners"]
) -> Float[Tensor, "F e"]:
    """Lengths of the edges of cells, as those of cells with an area or a volume, or next to nothing."""
    if cells.shape[1] == 3:
        return mollified(sides, cells)
    return shrunk(sides) if cells.shape[1] == 4 else sides


def delaunay_cover(
    faces: Int[Tensor, "F 3"],
    lengths: Float[Tensor, "F 3"],
    edge: Int[Tensor, "F 3"],
    fixed: Bool[Tensor, " E"],
    flips: list[Tensor] | None = None,
) -> Cover:
    """Triangles that cover the given ones twice, flipped until they are Delaunay but for the edges that are `fixed`.

    `edge` numbers the edges of the faces. However many faces an edge has, each is glued there to the back of the next.
    Given `flips` are done again instead, whatever the lengths are now.
    """
    sheets = torch.cat([faces, faces.flip(1)])
    sides = torch.cat([lengths, lengths[:, [1, 0, 2]]])
    cover, twin = Cover(sheets, sides, [], []), _glued(faces, edge, fixed)
    for chosen in _lacking(sheets, sides, twin) if flips is None else flips:
        cover.flips.append(chosen)
        cover.shares.append(_flip(sheets, sides, twin, chosen))
    return cover


def _lacking(sheets: Tensor, sides: Tensor, twin: Tensor) -> Iterator[Int[Tensor, " C"]]:
    """Sides to flip at one time, until all are Delaunay; each lot is flipped before the next is asked for."""
    active = torch.arange(len(twin))
    while True:
        active = active[(twin[active] > active) & (active // 3 != twin[active] // 3)]
        weight = _cotangents(sides, active) + _cotangents(sides, twin[active])
        lacking = weight < -NEGLIGIBLE
        chosen = _apart(active[lacking], twin[active[lacking]], weight[lacking], len(sheets))
        if len(chosen) == 0:
            return
        faces = torch.cat([chosen, twin[chosen]]) // 3
        yield chosen
        slots = (3 * faces.view(-1, 1) + torch.arange(3)).flatten()
        met = torch.minimum(slots, twin[slots])
        active = torch.unique(torch.cat([active[lacking], met[met >= 0]]))


def _glued(faces: Tensor, edge: Tensor, fixed: Tensor) -> Int[Tensor, " six_F"]:
    """Of side s of face f of the cover, number 3f + s, the side that it is glued to; −1 where it is fixed."""
    count = len(faces)
    front = torch.arange(3 * count)
    back = 3 * (count + front // 3) + torch.tensor([1, 0, 2])[front % 3]
    starts, ends = (faces[:, [pair[i] for pair in EDGES]].flatten() for i in (0, 1))
    up = torch.where(starts < ends, front, back)  # the copy that runs from the lower vertex on
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


def _foot(
    sides: Float[Tensor, "T 3"], slot: Int[Tensor, " H"]
) -> tuple[Float[Tensor, " H"], Float[Tensor, " H"]]:
    """Of the corner across from a side: the place of its foot on the side's line, from its start, and its height, ℓ."""
    face, side = slot // 3, slot % 3
    own, after, before = (sides[face, (side + i) % 3] for i in range(3))
    foot = ((before - after) * (before + after) / own + own) / 2
    return foot, ((before - foot) * (before + foot)).clamp_min(0).sqrt()


def _cotangents(sides: Tensor, slot: Tensor) -> Float[Tensor, " H"]:
    """Of the angles across from sides."""
    face, side = slot // 3, slot % 3
    own, after, before = (sides[face, (side + i) % 3] for i in range(3))
    _, height = _foot(sides, slot)
    tiny = torch.finfo(sides.dtype).tiny
    return (after.square() + before.square() - own.square()) / (2 * own * height).clamp_min(tiny)


def _apart(one: Tensor, other: Tensor, weight: Tensor, num_faces: int) -> Int[Tensor, " C"]:
    """Of these sides those with the least weight of all that share a face."""
    order = weight.argsort(stable=True)
    rank = torch.arange(len(order))
    first = torch.full((num_faces,), len(order))
    pair = one[order] // 3, other[order] // 3
    for face in pair:
        first.scatter_reduce_(0, face, rank, "amin")
    return one[order[(first[pair[0]] == rank) & (first[pair[1]] == rank)]]


def _flip(
    sheets: Tensor, sides: Tensor, twin: Tensor, chosen: Int[Tensor, " C"]
) -> tuple[Int[Tensor, "C 2"], Float[Tensor, " C"]]:
    """Flip sides, in place: of (a, b, c) and (b, a, d) make (c, d, b) and (d, c, a); as in `Cover.shares`."""
    other = twin[chosen]
    f, g = chosen // 3, other // 3
    (ab, bc, ca), (ba, ad, db) = (
        [3 * face + (slot + i) % 3 for i in range(3)] for face, slot in ((f, chosen), (g, other))
    )
    (x, y), (z, w) = _foot(sides, chosen), _foot(sides, other)
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
