"""Three loops without a fast form in NumPy, SciPy or torch, compiled by numba; those of distances are in `pde.fronts`.

Callers import them where they call them, so that importing the package does not load numba. Each is compiled for one
signature only at its first call, and cached beside this file, or in the user's cache.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, no_type_check

import numpy as np
from numba import njit

INNER = {"error_model": "numpy", "no_cfunc_wrapper": True, "no_cpython_wrapper": True}
"""Options of functions that only compiled code calls; each wrapper takes a twentieth of a second to compile."""

LANES = 64
"""Left inverses computed together; 16 to 128 take about as long."""


def compiled_for(signature: str) -> Callable[[Any], Any]:
    """Compile for one signature at the first call, cached on disk for later processes if there is a place to write."""

    def deferred(function: Any) -> Any:
        @cache
        def compiled() -> Any:
            options = {"error_model": "numpy", "nogil": True, "no_cfunc_wrapper": True}
            try:
                return njit(signature, cache=True, **options)(function)
            except RuntimeError:  # numba finds no place to write to
                return njit(signature, **options)(function)

        return lambda *arguments: compiled()(*arguments)

    return deferred


@njit(**INNER)
@no_type_check
def _product(x, y, total):
    """Inner products of columns."""
    size, lanes = x.shape
    for a in range(lanes):
        total[a] = x[0, a] * y[0, a]
    for k in range(1, size):
        for a in range(lanes):
            total[a] += x[k, a] * y[k, a]


@njit(**INNER)
@no_type_check
def _subtract(factor, x, y):
    """Subtract multiples of columns from others."""
    size, lanes = x.shape
    for k in range(size):
        for a in range(lanes):
            y[k, a] -= factor[a] * x[k, a]


@njit(**INNER)
@no_type_check
def _scale(x, factor):
    size, lanes = x.shape
    for k in range(size):
        for a in range(lanes):
            x[k, a] *= factor[a]


def left_inverse(columns: np.ndarray, root: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """C = R⁻¹Qᵀ√ω of √ω V = QR by modified Gram–Schmidt, and the norms of R⁻¹.

    `columns` are those of every V, (B, M, K), `root` is √ω, (B, K). `LANES` matrices are interleaved in memory, so that
    loops over them are vectorised.
    """
    batch, terms, size = columns.shape
    lanes = max(min(LANES, batch), 1)
    found, square = np.empty_like(columns), np.zeros(batch)
    room = np.ones((terms, size, lanes)), np.empty((terms, terms, lanes)), np.empty((terms, lanes))
    _left_inverse(columns, root, *room, found, square)
    return found, np.sqrt(square)


# Any allocation in compiled code takes a tenth of a second to compile. @no_type_check keeps checkers off.
@compiled_for(
    "void(float64[:, :, ::1], float64[:, ::1], float64[:, :, ::1], float64[:, :, ::1], float64[:, ::1], "
    "float64[:, :, ::1], float64[::1])"
)
@no_type_check
def _left_inverse(columns, root, a, r, square, found, condition):
    batch, terms, size = columns.shape
    lanes = a.shape[2]
    for first in range(0, batch, lanes):
        count = min(lanes, batch - first)
        for j in range(terms):
            for k in range(size):
                for b in range(count):
                    a[j, k, b] = columns[first + b, j, k] * root[first + b, k]
        for j in range(terms):
            _product(a[j], a[j], square[j])
        for j in range(terms):
            _product(a[j], a[j], r[j, j])
            for b in range(lanes):
                r[j, j, b] = 1 / np.sqrt(r[j, j, b])
            _scale(a[j], r[j, j])
            for i in range(j + 1, terms):
                _product(a[i], a[j], r[j, i])
                _subtract(r[j, i], a[j], a[i])
        for j in range(terms - 1, -1, -1):
            _scale(a[j], r[j, j])
            for i in range(j):
                _subtract(r[i, j], a[j], a[i])
        for j in range(terms):
            _product(a[j], a[j], r[j, j])
            for b in range(count):
                condition[first + b] += r[j, j, b] * square[j, b]
            for k in range(size):
                for b in range(count):
                    found[first + b, j, k] = a[j, k, b] * root[first + b, k]


@njit(**INNER)
@no_type_check
def _distance(points, frames, planes, center, other, slope, alignment):
    """Squared distance, ℓ², or −1 where `geometry.compatibility.compatible` rejects the other point."""
    square, flat, cosine = 0.0, 0.0, 0.0
    for x in range(points.shape[1]):
        square += (points[other, x] - points[center, x]) ** 2
    for a in range(frames.shape[2]):
        along = 0.0
        for x in range(points.shape[1]):
            along += (points[other, x] - points[center, x]) * frames[center, x, a]
        flat += along * along
    for x in range(planes.shape[1]):
        cosine += planes[other, x] * planes[center, x]
    return square if square - flat <= slope**2 * square and abs(cosine) >= alignment else -1.0


@njit(**INNER)
@no_type_check
def _nearest_first(square, ball, total, size):
    """Insertion sort of the `size` nearest, ties by their number; return how many these are."""
    kept = 0
    for a in range(total):
        key, point, place = square[a], ball[a], kept
        while place > 0 and (
            square[place - 1] > key or (square[place - 1] == key and ball[place - 1] > point)
        ):
            place -= 1
        if place < size:
            kept = min(kept + 1, size)
            for b in range(kept - 1, place, -1):
                square[b], ball[b] = square[b - 1], ball[b - 1]
            square[place], ball[place] = key, point
    return kept


def k_hop_neighborhoods(
    shape: tuple[np.ndarray, ...],
    graph: tuple[np.ndarray, ...],
    centers: np.ndarray,
    size: int,
    bounds: tuple[float, int, float, float],
) -> tuple[np.ndarray, np.ndarray]:
    """The `size` nearest points of each k-hop neighbourhood, padded by the centre, and how many are real.

    The `shape` has points (N, n), frames of their tangent planes, (N, n, d), the Plücker coordinates of these planes,
    and sides, vectors (N, n): a point opposed to the centre's is rejected; they are zero where no sides are known. The
    `graph` has the row starts and columns of its CSR pattern, without loops. The `bounds` are the number of points and
    that of rings at which a neighbourhood stops growing, and those of `compatible`.
    """
    index, count = np.empty((len(centers), size), np.int32), np.empty(len(centers), np.int32)
    seen, ball = np.zeros((2, len(shape[0])), np.int32)
    room = seen, ball, np.empty(len(shape[0]))
    _k_hop_neighborhoods(shape, graph, centers, bounds, room, index, count)
    return index, count


@compiled_for(
    "void(Tuple((float64[:, ::1], float64[:, :, ::1], float64[:, ::1], float64[:, ::1])), UniTuple(int32[::1], 2), "
    "int64[::1], Tuple((float64, int64, float64, float64)), Tuple((int32[::1], int32[::1], float64[::1])), "
    "int32[:, ::1], int32[::1])"
)
@no_type_check
def _k_hop_neighborhoods(shape, graph, centers, bounds, room, index, count):
    """Breadth-first search; `seen` holds the last row, plus one, that reached a point."""
    size = index.shape[1]
    points, frames, planes, sides = shape
    indptr, indices = graph
    wanted, rings, slope, alignment = bounds
    seen, ball, square = room
    for row in range(len(centers)):
        center = centers[row]
        seen[center] = row + 1
        ball[0], square[0] = center, -1.0  # before all that coincide with it
        total, first = 1, 0
        for _ in range(rings):
            ring = total
            for a in range(first, ring):
                for edge in range(indptr[ball[a]], indptr[ball[a] + 1]):
                    other = indices[edge]
                    if seen[other] == row + 1:
                        continue
                    seen[other] = row + 1
                    side = 0.0
                    for x in range(sides.shape[1]):
                        side += sides[other, x] * sides[center, x]
                    distance = -1.0
                    if side >= 0:
                        distance = _distance(
                            points, frames, planes, center, other, slope, alignment
                        )
                    if distance >= 0:
                        ball[total], square[total] = other, distance
                        total += 1
            first = ring
            if total >= wanted or first == total:
                break
        count[row] = _nearest_first(square, ball, total, size)
        for a in range(size):
            index[row, a] = ball[a] if a < count[row] else center


@compiled_for(
    "int64(int64, Tuple((int32[::1], uint32[::1], float64[::1])), Tuple((int32[::1], uint32[::1], float64[::1])), "
    "UniTuple(int64[::1], 4), Tuple((uint32[::1], complex128[::1])), Tuple((complex128[::1], int32[::1], "
    "uint32[::1])), Tuple((complex128[::1], int32[::1], uint32[::1])), Tuple((int32[::1], uint32[::1], "
    "complex128[::1])))"
)
@no_type_check
def congruence(first, left, right, rows, elements, of_nodes, of_columns, result):
    """Rows of the upper triangle of PᵀAP (Gustavson 1978) from `first` on, until one does not fit; return its number.

    `left` and `right` are Pᵀ and P, with ascending columns. Row a of A is the sum of the parts from `part_ptr[a]` to
    `part_ptr[a + 1]`, with `part_size` entries in the columns `nodes[part_col :]`, `values[part_value :]`. A row of
    PᵀA, `middle`, has entries at the nodes `reached`; one of the product, `total`, at the columns `found`. `met` and
    `seen` are work space, −1.
    """
    left_ptr, left_col, left_value = left
    right_ptr, right_col, right_value = right
    part_ptr, part_col, part_value, part_size = rows
    nodes, values = elements
    middle, met, reached = of_nodes
    total, seen, found = of_columns
    indptr, indices, data = result
    count = len(indptr) - 1
    for i in range(first, count):
        many, width = 0, 0
        for k in range(left_ptr[i], left_ptr[i + 1]):
            a, weight = left_col[k], left_value[k]
            for part in range(part_ptr[a], part_ptr[a + 1]):
                at, place = part_col[part], part_value[part]
                for m in range(part_size[part]):
                    b = nodes[at + m]
                    if met[b] != i:
                        met[b], middle[b], reached[many] = i, 0.0, b
                        many += 1
                    middle[b] += weight * values[place + m]
        for k in range(many):
            b = reached[k]
            x = middle[b]
            for place in range(right_ptr[b + 1] - 1, right_ptr[b] - 1, -1):
                j = right_col[place]
                if j < i:
                    break
                if seen[j] != i:
                    seen[j], total[j], found[width] = i, 0.0, j
                    width += 1
                total[j] += right_value[place] * x
        start = indptr[i]
        if start + width > len(indices):
            return i
        for k in range(width):
            indices[start + k], data[start + k] = found[k], total[found[k]]
        indptr[i + 1] = start + width
    return count
