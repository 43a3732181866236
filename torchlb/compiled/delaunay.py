"""Delaunay tetrahedra, compiled: points come one by one, each into the hole that its spheres leave (Bowyer, Watson).

Outside of the convex hull lie tetrahedra with the corner `BEYOND`. The signs of determinants count only where rounding
cannot have turned them. A point that a sphere may or may not contain is taken to be outside, so that what comes out is
Delaunay up to rounding; where a tetrahedron may have no volume there is no result.
"""

from __future__ import annotations

from typing import Any, no_type_check

import numpy as np
from numba import njit

BEYOND, GONE = -1, -2
FREE, MET = -1, -2
ODD = (0x1E3779B97F4A7C15, 0x3F58476D1CE4E5B9)
"""Factors that spread edges over a table."""
ORIENT, SPHERE = 8e-16, 2e-15
"""Of the sum of the absolute values of its terms, what a determinant may be off by (Shewchuk 1997: 7.8 and 18e-16)."""


@njit
@no_type_check
def _offset(points: np.ndarray, start: int, end: int) -> tuple[float, float, float]:
    return (
        points[end, 0] - points[start, 0],
        points[end, 1] - points[start, 1],
        points[end, 2] - points[start, 2],
    )


@njit
@no_type_check
def _solid(points: np.ndarray, a: int, b: int, c: int, d: int) -> float:
    """Six times the volume, negative on the other side; 0 if rounding may have turned its sign."""
    ax, ay, az = _offset(points, d, a)
    bx, by, bz = _offset(points, d, b)
    cx, cy, cz = _offset(points, d, c)
    bc, cb, ca, ac, ab, ba = bx * cy, cx * by, cx * ay, ax * cy, ax * by, bx * ay
    volume = az * (bc - cb) + bz * (ca - ac) + cz * (ab - ba)
    terms = abs(az) * (abs(bc) + abs(cb)) + abs(bz) * (abs(ca) + abs(ac))
    doubt = ORIENT * (terms + abs(cz) * (abs(ab) + abs(ba)))
    return volume if abs(volume) > doubt else 0.0


@njit
@no_type_check
def _within(points: np.ndarray, a: int, b: int, c: int, d: int, e: int) -> bool:
    """Whether the sphere through the first four contains the last for sure."""
    ax, ay, az = _offset(points, e, a)
    bx, by, bz = _offset(points, e, b)
    cx, cy, cz = _offset(points, e, c)
    dx, dy, dz = _offset(points, e, d)
    axby, bxay, bxcy, cxby = ax * by, bx * ay, bx * cy, cx * by
    cxdy, dxcy, dxay, axdy = cx * dy, dx * cy, dx * ay, ax * dy
    axcy, cxay, bxdy, dxby = ax * cy, cx * ay, bx * dy, dx * by
    ab, bc, cd = axby - bxay, bxcy - cxby, cxdy - dxcy
    da, ac, bd = dxay - axdy, axcy - cxay, bxdy - dxby
    al, bl = ax * ax + ay * ay + az * az, bx * bx + by * by + bz * bz
    cl, dl = cx * cx + cy * cy + cz * cz, dx * dx + dy * dy + dz * dz
    abc, bcd = az * bc - bz * ac + cz * ab, bz * cd - cz * bd + dz * bc
    cda, dab = cz * da + dz * ac + az * cd, dz * ab + az * bd + bz * da
    inside = (dl * abc - cl * dab) + (bl * cda - al * bcd)
    if inside <= 0:
        return False
    ax, bx, cx, dx = abs(az), abs(bz), abs(cz), abs(dz)
    ab, bc, cd = abs(axby) + abs(bxay), abs(bxcy) + abs(cxby), abs(cxdy) + abs(dxcy)
    da, ac, bd = abs(dxay) + abs(axdy), abs(axcy) + abs(cxay), abs(bxdy) + abs(dxby)
    terms = (cd * bx + bd * cx + bc * dx) * al + (da * cx + ac * dx + cd * ax) * bl
    terms += (ab * dx + bd * ax + da * bx) * cl + (bc * ax + ac * bx + ab * cx) * dl
    return inside > SPHERE * terms


@njit
@no_type_check
def _beyond(cells: np.ndarray, now: int) -> int:
    """The place of the corner `BEYOND`, 4 if there is none."""
    for place in range(4):
        if cells[now, place] == BEYOND:
            return place
    return 4


@njit
@no_type_check
def _side(points: np.ndarray, cells: np.ndarray, now: int, place: int, point: int) -> float:
    """`_solid` of a tetrahedron with the point in the place of a corner: negative if it is beyond the face there."""
    a = point if place == 0 else cells[now, 0]
    b = point if place == 1 else cells[now, 1]
    c = point if place == 2 else cells[now, 2]
    d = point if place == 3 else cells[now, 3]
    return _solid(points, a, b, c, d)


@njit
@no_type_check
def _conflicts(points: np.ndarray, cells: np.ndarray, now: int, point: int) -> bool:
    """Whether a tetrahedron has to go for a point: its sphere contains it, or it lies beyond that face of the hull."""
    place = _beyond(cells, now)
    if place < 4:
        return _side(points, cells, now, place, point) > 0
    a, b, c, d = cells[now, 0], cells[now, 1], cells[now, 2], cells[now, 3]
    return _within(points, a, b, c, d, point)


@njit
@no_type_check
def _located(
    points: np.ndarray, cells: np.ndarray, beside: np.ndarray, start: int, point: int
) -> int:
    """The tetrahedron with the point, or one beyond the hull that it sees, by a walk; −1 if that does not end."""
    now, before = start, -1
    for _ in range(len(cells)):
        if _beyond(cells, now) < 4:
            return now
        after = now
        for place in range(4):
            other = beside[now, place]
            if other != before and _side(points, cells, now, place, point) < 0:
                after = other
                break
        if after == now:
            return now
        now, before = after, now
    return -1


@njit
@no_type_check
def _hole(
    points: np.ndarray,
    cells: np.ndarray,
    beside: np.ndarray,
    mark: np.ndarray,
    hole: np.ndarray,
    rim: np.ndarray,
    point: int,
    turn: int,
) -> Any:
    """All tetrahedra, from the first in `hole` on, that have to go, and the faces around them: how many of both.

    Parameters
    ----------
    mark : of each ± the last turn in which it was looked at, − if it could stay.
    rim : room for the faces, each a tetrahedron that goes, and the place of the corner opposite to the face.
    """
    mark[hole[0]] = turn
    size, faces, done = 1, 0, 0
    while done < size and faces + 4 <= len(rim):
        now = hole[done]
        for place in range(4):
            other = beside[now, place]
            seen = mark[other]
            if seen != turn and seen != -turn:
                seen = turn if _conflicts(points, cells, other, point) else -turn
                mark[other] = seen
                if seen == turn:
                    hole[size] = other
                    size += 1
            if seen != turn:
                rim[faces, 0], rim[faces, 1] = now, place
                faces += 1
        done += 1
    return size, faces if done == size else len(cells)


@njit
@no_type_check
def _filled(
    points: np.ndarray,
    cells: np.ndarray,
    beside: np.ndarray,
    rim: np.ndarray,
    new: np.ndarray,
    point: int,
) -> bool:
    """Whether all tetrahedra from a point to the faces around its hole have a volume; they are there then."""
    for a in range(len(rim)):
        old, place, now = rim[a, 0], rim[a, 1], new[a]
        for corner in range(4):
            cells[now, corner] = point if corner == place else cells[old, corner]
        if _beyond(cells, now) == 4 and _side(points, cells, now, place, point) <= 0:
            return False
        other = beside[old, place]
        beside[now, place] = other
        for back in range(4):
            if beside[other, back] == old:
                beside[other, back] = now
    return True


@njit
@no_type_check
def _linked(
    cells: np.ndarray,
    beside: np.ndarray,
    new: np.ndarray,
    point: int,
    keys: np.ndarray,
    sides: np.ndarray,
    bits: int,
) -> bool:
    """Whether each edge around a hole has two of the new tetrahedra, which are beside each other then.

    An edge has four where a hole is pinched, which only faces of the hull that are in doubt bring about.

    Parameters
    ----------
    keys, sides : a hash table with so many bits: of edges, by the sums of their ends and of the squares, the
        tetrahedron · 4 + the place opposite.
    """
    left = 0
    sides[:] = FREE
    for now in new:
        ends, squares = -point, -point * point
        for place in range(4):
            corner = np.int64(cells[now, place])
            ends, squares = ends + corner, squares + corner * corner
        for place in range(4):
            corner = np.int64(cells[now, place])
            if corner == point:
                continue
            one, two = ends - corner, squares - corner * corner
            slot = np.int64(np.uint64(one * ODD[0] + two * ODD[1]) >> np.uint64(64 - bits))
            while sides[slot] != FREE and (keys[slot, 0] != one or keys[slot, 1] != two):
                slot = (slot + 1) % len(sides)
            if sides[slot] == FREE:
                sides[slot], keys[slot, 0], keys[slot, 1] = 4 * now + place, one, two
                left += 1
            elif sides[slot] == MET:
                return False
            else:
                other, back = sides[slot] // 4, sides[slot] % 4
                beside[now, place], beside[other, back] = other, now
                sides[slot] = MET
                left -= 1
    return left == 0


@njit
@no_type_check
def _begun(order: np.ndarray, cells: np.ndarray, beside: np.ndarray) -> None:
    """The tetrahedron of the first four points, and those around it."""
    for now in range(5):
        for place in range(4):
            cells[now, place], beside[now, place] = order[place], 1 + place
    for place in range(4):  # seen from the other side: two corners change places
        one, two, around = (place + 1) % 4, (place + 2) % 4, 1 + place
        cells[around, place], beside[around, place] = BEYOND, 0
        cells[around, one], beside[around, one] = order[two], 1 + two
        cells[around, two], beside[around, two] = order[one], 1 + one


@njit
@no_type_check
def _sorted(cells: np.ndarray, beside: np.ndarray, count: int) -> Any:
    """The tetrahedra within the convex hull, corners and rows in ascending order."""
    total, kept, other = 0, np.empty(len(cells), np.int32), np.empty(len(cells), np.int32)
    for now in range(len(cells)):
        if cells[now, 0] == GONE or _beyond(cells, now) < 4:
            continue
        kept[total] = now
        total += 1
        for last in range(1, 4):
            for place in range(last, 0, -1):
                one, two = cells[now, place - 1], cells[now, place]
                if one > two:
                    cells[now, place - 1], cells[now, place] = two, one
                    one, two = beside[now, place - 1], beside[now, place]
                    beside[now, place - 1], beside[now, place] = two, one
    for place in range(3, -1, -1):  # by the first corner at last
        ends = np.zeros(count + 1, np.int64)
        for a in range(total):
            ends[cells[kept[a], place] + 1] += 1
        for a in range(count):
            ends[a + 1] += ends[a]
        for a in range(total):
            corner = cells[kept[a], place]
            other[ends[corner]] = kept[a]
            ends[corner] += 1
        kept, other = other, kept
    number = np.full(len(cells), -1, np.int64)
    for a in range(total):
        number[kept[a]] = a
    corners, near = np.empty((total, 4), np.int64), np.empty((total, 4), np.int64)
    for a in range(total):
        for place in range(4):
            corners[a, place] = cells[kept[a], place]
            near[a, place] = number[beside[kept[a], place]]
    return corners, near


@njit(
    "Tuple((int64[:, ::1], int64[:, ::1]))(float64[:, ::1], int64[::1], int64)",
    cache=True,
    nogil=True,
)
@no_type_check
def delaunay(points: np.ndarray, order: np.ndarray, room: int) -> Any:
    """Corners of the tetrahedra of points in R³, and which is beside each, opposite to that corner; −1 for none.

    Points come in the given order, the first four being the corners of a tetrahedron. Corners are in ascending order,
    and so are the tetrahedra. Without rows if there is no result, or no `room`, 256 or more, for as many tetrahedra.
    """
    cells, beside = np.empty((room, 4), np.int32), np.empty((room, 4), np.int32)
    mark, hole, free = np.zeros(room, np.int32), np.empty(room, np.int32), np.empty(room, np.int32)
    rim, new = np.empty((room // 4, 2), np.int32), np.empty(room // 4, np.int32)
    keys, sides = np.empty((2 * room, 2), np.int64), np.empty(2 * room, np.int64)
    nothing = np.empty((0, 4), np.int64), np.empty((0, 4), np.int64)
    if _solid(points, order[0], order[1], order[2], order[3]) <= 0:
        return nothing
    _begun(order, cells, beside)
    used, left, last = 5, 0, 0
    for turn in range(4, len(points)):
        point = order[turn]
        hole[0] = _located(points, cells, beside, last, point)
        if hole[0] < 0:
            return nothing
        size, faces = _hole(points, cells, beside, mark, hole, rim, point, turn)
        if faces > len(rim) or used + faces - left > room:
            return nothing
        for a in range(faces):
            if left > 0:
                left -= 1
                new[a] = free[left]
            else:
                new[a] = used
                used += 1
        if not _filled(points, cells, beside, rim[:faces], new[:faces], point):
            return nothing
        bits = 6
        while 2**bits < 4 * faces:
            bits += 1
        edges = keys[: 2**bits], sides[: 2**bits]
        if not _linked(cells, beside, new[:faces], point, *edges, bits):
            return nothing
        for a in range(size):
            cells[hole[a], 0] = GONE
            free[left] = hole[a]
            left += 1
        for a in range(faces):
            if _beyond(cells, new[a]) == 4:
                last = new[a]
                break
    return _sorted(cells[:used], beside[:used], len(points))
