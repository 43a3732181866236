"""Compiled loops of geodesic distance: sweeps over points and their triangles (`method.md`, section 10)."""

from __future__ import annotations

from typing import no_type_check

import numpy as np
from numba import njit

from torchlb.linalg.kernels import INNER, compiled_for
from torchlb.linalg.precision import LOW, SMALL


@njit(**INNER)
@no_type_check
def _source(d_j: float, d_k: float, base: float) -> tuple[float, float]:
    """The point at d_j and d_k from j and k: its place along jk, and how far it is below."""
    source = (d_j**2 - d_k**2 + base**2) / (2 * base)
    return source, np.sqrt(max(d_j**2 - source**2, 0.0))


@njit(**INNER)
@no_type_check
def _across(d_j: float, d_k: float, along: float, height: float, base: float) -> float:
    """Distance from i, `height` over jk at `along`, to the point below at d_j and d_k; infinite if it misses jk."""
    source, depth = _source(d_j, d_k, base)
    share = (source * height + along * depth) / ((height + depth) * base)
    return np.sqrt((source - along) ** 2 + (depth + height) ** 2) if 0 <= share <= 1 else np.inf


@compiled_for(
    "void(float64[::1], int64[::1], int64[::1], float64[:, ::1], int64[::1], int64[:, ::1], float64[:, ::1], "
    "int64[::1], float64)"
)
@no_type_check
def straighten(distance, foot, order, points, first, ends, sides, fell, enough):
    """Lower distances by paths across triangles, in place, in sweeps until none falls by more than `enough`.

    Those of point i are the rows first[i] … first[i + 1] − 1 of `ends`, their other corners (j, k), and of `sides`, the
    lengths of ij, ik and jk, the height of i over jk and its place along it. The path to i starts at the source of j or
    of k, its `foot`; if these differ, the distance of k from the source of j is unknown, and bounded below by the
    straight line and by the distance of k. `order` is that of the sweeps, `fell` work space, ones: when each fell last.
    """
    most, clock = np.inf, 0
    while most > enough:
        most = 0.0
        for i in order:
            clock += 1
            best, source = distance[i], foot[i]
            for t in range(first[i], first[i + 1]):
                j, k = ends[t, 0], ends[t, 1]
                if max(fell[j], fell[k]) <= clock - len(order):  # nothing new since the last sweep
                    continue
                d_j, d_k = distance[j], distance[k]
                by_j, by_k = d_j + sides[t, 0], d_k + sides[t, 1]
                base, height, along = sides[t, 2], sides[t, 3], sides[t, 4]
                if (d_j + d_k - base) / 2 + height < best:  # a lower bound of paths across
                    line_j, line_k = 0.0, 0.0
                    if foot[j] != foot[k]:
                        for x in range(points.shape[1]):
                            line_j += (points[foot[k], x] - points[j, x]) ** 2
                            line_k += (points[foot[j], x] - points[k, x]) ** 2
                        line_j, line_k = np.sqrt(line_j), np.sqrt(line_k)
                        by_k = min(by_k, _across(max(d_j, line_j), d_k, along, height, base))
                    by_j = min(by_j, _across(d_j, max(d_k, line_k), along, height, base))
                if min(by_j, by_k) < best:
                    best, source = min(by_j, by_k), foot[j] if by_j <= by_k else foot[k]
            if best < distance[i]:
                most, fell[i] = max(most, distance[i] - best), clock
                distance[i], foot[i] = best, source


@njit(**INNER)
@no_type_check
def _from_front(d_j, d_k, foot_point, here, radius, side):
    """Distance of i behind a front of this radius at the point `foot_point` of jk, itself `here`, and the part of jk.

    The part is that of the angle jk at the centre of the front before the path to i, or −1 where there is no angle.
    """
    base, height, along = side[2], side[3], side[4]
    radius = min(max(radius, -base / SMALL), base / SMALL)
    way, delay = np.sign(radius), here - radius
    x, depth = _source(d_j - delay, d_k - delay, base)
    delay += way * np.hypot(x - foot_point, depth) - radius
    x, depth = _source(d_j - delay, d_k - delay, base)
    path = delay + way * np.hypot(x - along, depth + way * height)
    crossing = x + (along - x) * depth / (depth + way * height)
    start, end = np.arctan2(-x, depth), np.arctan2(base - x, depth)
    part = (np.arctan2(crossing - x, depth) - start) / (end - start) if end > start else -1.0
    return path, part


@njit(**INNER)
@no_type_check
def _way(i, distance, foot, first, ends, sides, anywhere):
    """Length of the shortest path to i, its triangle, or −1, and whether it is along ij (0), ik (1) or across jk (2).

    Corners are nearer than i, or `anywhere`.
    """
    best, t, side = np.inf, -1, 0
    for triangle in range(first[i], first[i + 1]):
        j, k = ends[triangle, 0], ends[triangle, 1]
        by_j, by_k = distance[j] + sides[triangle, 0], distance[k] + sides[triangle, 1]
        j_known = anywhere or distance[j] < distance[i]
        k_known = anywhere or distance[k] < distance[i]
        if j_known and by_j < best:
            best, t, side = by_j, triangle, 0
        if k_known and by_k < best:
            best, t, side = by_k, triangle, 1
        if j_known and k_known and foot[j] == foot[k]:
            base, height, along = sides[triangle, 2], sides[triangle, 3], sides[triangle, 4]
            across = _across(distance[j], distance[k], along, height, base)
            if across <= best:
                best, t, side = across, triangle, 2
    return best, t, side


@compiled_for(
    "float64(float64[::1], int64[::1], int64[::1], int64[::1], int64[:, ::1], float64[:, ::1], float64[::1], boolean, "
    "float64[::1], float64[::1], float64[::1], float64[::1], float64[::1])"
)
@no_type_check
def bend(
    distance, foot, order, first, ends, sides, curvature, again, given, angle, result, spread, slope
):
    """Correct distances as `straighten` leaves them by the Gaussian curvature K; `order` is ascending.

    Jacobi's equation J'' = −KJ along a path, with J = 0 and J' = 1 at its source, has the radius J/J' of the wave
    front, which is the distance if K = 0. So the source behind a triangle is put at this radius, and the delay makes up
    for the difference. `spread` is J over the distance, `slope` is J'. Where K is not a number, or J below `LOW` times
    the distance, near a focus, they are 1, as if K had been 0. A path behind a focus, of a length that those to j and k
    exclude, takes over their corrections. `angle` is the direction in which the path leaves its source, which is
    `given` for the neighbours of the source and else not a number. Corners that are farther than i are used `again`, in
    further sweeps. The other arguments are those of `straighten`. Return the largest change of a place, by angle or
    distance.
    """
    most = 0.0
    for i in order:
        before, direction = result[i], angle[i]
        result[i], spread[i], slope[i] = distance[i], 1.0, 1.0
        best, t, side = _way(i, distance, foot, first, ends, sides, again and distance[i] > 0)
        if t < 0:  # a source, or out of reach
            continue
        j, k = ends[t, 0], ends[t, 1]
        if side < 2:
            m, length = ends[t, side], sides[t, side]
            a, b, bent = spread[m] * result[m], slope[m], curvature[m]
            path, turned = result[m] + length, angle[m]
        else:
            base, height, along = sides[t, 2], sides[t, 3], sides[t, 4]
            x, depth = _source(distance[j], distance[k], base)
            foot_point = (x * height + along * depth) / (height + depth)
            share, length = foot_point / base, np.hypot(foot_point - along, height)
            x, depth = _source(result[j], result[k], base)
            here = np.hypot(x - foot_point, depth)
            a = ((1 - share) * spread[j] + share * spread[k]) * here
            b = (1 - share) * slope[j] + share * slope[k]
            bent = (1 - share) * curvature[j] + share * curvature[k]
            path, part = _from_front(result[j], result[k], foot_point, here, a / b, sides[t])
            low = max(result[j] - sides[t, 0], result[k] - sides[t, 1])
            high = min(result[j] + sides[t, 0], result[k] + sides[t, 1])
            if not low - SMALL * base <= path <= high + SMALL * base:
                more_j, more_k = result[j] - distance[j], result[k] - distance[k]
                path, part, b = best + (1 - share) * more_j + share * more_k, -1.0, np.nan
            turned = angle[k] if np.isnan(angle[j]) else angle[j]
            between = (angle[k] - turned + np.pi) % (2 * np.pi) - np.pi
            if not np.isnan(between):
                turned += (part if part >= 0 else share) * between
        angle[i] = turned if np.isnan(given[i]) else given[i]
        bent = (bent + curvature[i]) / 4
        after = a + b * length - bent * length**2 * (a + b * length / 3)
        if path > 0:
            result[i] += path - best
            if after > LOW * path:
                spread[i], slope[i] = after / path, b - bent * length * (2 * a + b * length)
        turn = np.sin((angle[i] - direction) / 2)
        most = max(most, abs(result[i] - before))
        if not np.isnan(turn):
            most = max(most, 2 * distance[i] * abs(turn))
    return most
