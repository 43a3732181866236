"""Chains of segments through points of curves in any Rⁿ, by NN-crust.

T. K. Dey and P. Kumar, *A simple provable algorithm for curve reconstruction*, 1999: each point is joined to its
nearest one and to the nearest on its other side, here if both ends agree. Loose ends are joined by the shortest
segments. A segment longer than the gaps between random points is left out, and the curve ends there.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from torch import Tensor

from torchlb.cloud.complexes import Complex, in_words, places_of
from torchlb.cloud.frames import cloud_frames, settled_normals
from torchlb.cloud.manifold import in_turn
from torchlb.cloud.noise import denoised
from torchlb.errors import InputError, first_few, warn
from torchlb.geometry.neighbors import nearest_neighbors
from torchlb.geometry.thresholds import CREASE, FACTOR, HALF_CREASE, OBTUSE, RING, ROUGH, WIDER
from torchlb.geometry.vectors import Coords, Mask, Nearest, Points, inner, lengths
from torchlb.linalg.precision import TINY

NEAR = 2 * RING
"""Number of nearest points that hold those beside a point, and of segments on either side that give the spacing."""
RANDOM = 2.0
"""A segment is a gap if it is 3 + v (ln N + RANDOM) times as long as those around, where v is 0 for evenly spaced
points and 1 for random ones: one in N e⁵ exponential gaps is as long, so that one curve in 150 is cut."""

Links = Int[np.ndarray, "N 2"]


def cloud_curve(
    points: Points, *, normals: Points | None = None, boundary: Bool[Tensor, " N"] | None = None
) -> Complex:
    """The curve through all points: closed and open chains, which end at the points of the boundary.

    In R² it faces the side of the normals where most of them agree; without them closed chains face outward.
    """
    size = min(NEAR + 1, len(points))
    near, oriented = nearest_neighbors(points, size), False
    if normals is not None:
        normals, oriented = settled_normals(points, normals, near)
    single = np.zeros(len(points), dtype=bool) if boundary is None else boundary.numpy()
    moved, noise = denoised(points, cloud_frames(points, near, 1), near)
    usual = 2 * float((points[near[:, -1]] - points).norm(dim=1).median()) / (size - 1)
    noise = noise if noise < ROUGH * usual else 0.0
    if noise:
        points, near = moved, nearest_neighbors(moved, size)
    tangents = cloud_frames(points, near, 1)[..., 0].numpy() if noise else None
    places, index = points.numpy(), near.numpy()
    links = _joined(places, _links(places, index, single, noise, tangents), single, noise)
    links = _with_passed_by(places, index, links)
    chains, spacing, gaps = _cut(places, in_turn(links), noise)
    alone = torch.tensor([chain[0] for chain in chains if len(chain) == 1])
    if len(alone):
        raise InputError(
            f"points: {len(alone)} ({first_few(alone)}) are farther from all others than points of a "
            "curve are apart, and no segment reaches them; leave them out, or add points between"
        )
    _warn(places, index, chains, spacing, gaps)
    if noise:
        warn(
            f"points: they lie beside the curve by {noise:.2g} (root mean square), and are moved onto a smooth one for "
            "all that is computed; give the segments to from_mesh if they lie on it"
        )
    cells = [np.stack([chain[:-1], chain[1:]], 1) for chain in chains]
    if points.shape[1] == 2:
        given = normals.numpy() if oriented and normals is not None else None
        cells = [_facing_out(places, segments, given) for segments in cells]
    return Complex(points=points, cells=torch.from_numpy(np.concatenate(cells)))


def _links(
    points: Coords, near: Nearest, single: Mask, noise: float, tangents: Coords | None
) -> Links:
    """(N, 2) points beside each, −1 for none, where both ends agree; at most one for those that are `single`.

    Noisy points are ordered along the tangent, among those that the noise may have moved off it.
    """
    rows = np.arange(len(points))
    offset = points[near[:, 1:]] - points[:, None]
    distance = lengths(offset)
    if tangents is not None:
        along = inner(offset, tangents[:, None])
        across = np.sqrt(np.maximum(distance**2 - along**2, 0))
        offset, distance = along[..., None] * tangents[:, None], np.abs(along)
        distance[across > np.maximum(FACTOR * noise, HALF_CREASE * distance)] = np.inf
    first = distance.argmin(1)
    cosine = inner(offset, offset[rows, first][:, None])
    cosine /= np.maximum(lengths(offset) * lengths(offset[rows, first])[:, None], TINY)
    distance[(cosine >= CREASE) | single[:, None]] = np.inf
    distance *= (2 + cosine) ** 2  # straight on before sideways
    second = distance.argmin(1)
    some = np.isfinite(distance[rows, second])
    i = np.concatenate([rows, rows[some]])
    j = np.concatenate([near[rows, 1 + first], near[rows, 1 + second][some]])
    key = np.unique(i * len(points) + j)
    i, j = np.divmod(key, len(points))
    agreed = np.isin(j * len(points) + i, key)
    i, j = i[agreed], j[agreed]
    links = np.full((len(points), 2), -1)
    again = np.append(False, i[1:] == i[:-1]).astype(np.int64)
    links[i, again] = j
    return links


def _joined(points: Coords, links: Links, single: Mask, noise: float) -> Links:
    """Join loose ends by the shortest segments that do not turn back, but for noise."""
    free = np.where(single, 1, 2) - (links >= 0).sum(1)
    loose = np.flatnonzero(free > 0)
    if len(loose) < 2:
        return links
    size = min(RING + 1, len(loose))
    near = np.asarray(KDTree(points[loose]).query(points[loose], k=size)[1])
    i, j = loose.repeat(size), loose[near].ravel()
    i, j = i[i < j], j[i < j]
    order = np.argsort(lengths(points[i] - points[j]), kind="stable")

    def open_to(here: int, there: int) -> bool:
        other = links[here].max()
        if other < 0 or free[here] == 0:
            return bool(free[here])
        back, onward = points[[other, there]] - points[here]
        short = min(back @ back, onward @ onward) < (FACTOR * noise) ** 2
        return bool(short or back @ onward <= 0)

    for one, two in zip(i[order].tolist(), j[order].tolist(), strict=True):
        if two not in links[one] and open_to(one, two) and open_to(two, one):
            for here, there in ((one, two), (two, one)):
                links[here, links[here].argmin()] = there
                free[here] -= 1
    return links


def _with_passed_by(points: Coords, near: Nearest, links: Links) -> Links:
    """Insert points without segments into the neighbouring segment that grows least, unless its length doubles."""
    for i in np.flatnonzero((links < 0).all(1)).tolist():
        best, ends = 1.0, None
        for a in near[i, 1:].tolist():
            for b in links[a][links[a] >= 0].tolist():
                old, *new = lengths(points[[a, a, b]] - points[[b, i, i]])
                if sum(new) - old < best * old:
                    best, ends = sum(new) / old - 1, (a, b)
        if ends is not None:
            for here, there in (ends, ends[::-1]):
                links[here, links[here] == there] = i
            links[i] = ends
    return links


def _cut(
    points: Coords, chains: list[np.ndarray], noise: float
) -> tuple[list[np.ndarray], Float[np.ndarray, " N"], list[int]]:
    """(chains cut at their gaps; spacing around each point, ℓ; ends of gaps less than twice as long as the limit)."""
    steps = [np.diff(points[chain], axis=0) for chain in chains]
    sizes = [lengths(step) for step in steps]
    uneven = (np.abs(np.diff(x)) / np.maximum(x[1:] + x[:-1], TINY) for x in sizes)
    spread = np.concatenate(list(uneven))
    random = min(1.0, 2 * float(np.median(spread))) if len(spread) else 0.0
    limit = FACTOR + random * (np.log(len(points)) + RANDOM)
    found, spacing, doubtful = [], np.zeros(len(points)), []
    for chain, step, length in zip(chains, steps, sizes, strict=True):
        closed = len(chain) > 1 and bool(chain[0] == chain[-1])
        usual = _usual(length, closed) if len(length) > 1 else length
        spacing[chain[-1]], spacing[chain[:-1]] = usual[-1:].sum(), usual
        cosine = inner(step, np.roll(step, 1, 0)) / np.maximum(length * np.roll(length, 1), TINY)
        turn = np.arccos(np.clip(cosine, -1, 1))
        turn[: not closed] = 0
        # a segment half as long again is a gap, too, if the angles at its two ends add up to a turn back
        back = (turn + np.roll(turn, -1) > OBTUSE) & (noise == 0)  # noisy ones have any direction
        share = length / np.maximum(np.where(back, WIDER, limit) * usual, TINY)
        gap = np.flatnonzero(share > 1)
        for k in gap[(share[gap] < 2) & ~back[gap]]:
            doubtful += chain[k : k + 2].tolist()
        if closed and len(gap):
            chain, gap = np.roll(chain[:-1], -gap[0] - 1), gap[1:] - gap[0] - 1
        found += np.split(chain, gap + 1)
    return found, spacing, doubtful


def _usual(length: Float[np.ndarray, " S"], closed: bool) -> Float[np.ndarray, " S"]:
    """Mean length of the segments before each or of those after it, whichever is larger: the density may jump."""
    count, width = len(length), min(NEAR, len(length) - 1) if closed else 0
    around = np.pad(length, width, mode="wrap")
    parts = (np.convolve(np.pad(x, 1), np.ones(NEAR)) for x in (around, np.ones_like(around)))
    total, number = (part[width:][: count + NEAR + 1] for part in parts)
    mean = total / np.maximum(number, 1)
    return np.maximum(mean[:count], mean[-count:])


def _facing_out(
    points: Float[np.ndarray, "N 2"], segments: np.ndarray, normals: Float[np.ndarray, "N 2"] | None
) -> Int[np.ndarray, "S 2"]:
    """Segments of a chain, facing as the normals do; without normals outward if it is closed, else up."""
    a, b = points[segments].swapaxes(0, 1)
    normal = (b - a)[:, ::-1] * [1, -1]
    if normals is not None:
        outward = normals[segments].sum(1)
    else:
        closed = segments[0, 0] == segments[-1, 1]
        outward = (a + b) / 2 - a.mean(0) if closed else np.array([0.0, 1])
    return segments if np.sum(normal * outward) >= 0 else segments[:, ::-1]


def _warn(
    points: Coords, near: Nearest, chains: list[np.ndarray], spacing: np.ndarray, gaps: list[int]
) -> None:
    """Warn where parts of the curve are close, or gaps are hardly longer than segments."""
    number, place, size = np.zeros((3, len(points)))
    for k, chain in enumerate(chains):
        way = np.append(0, np.cumsum(lengths(np.diff(points[chain], axis=0))))
        number[chain], place[chain] = k, way
        size[chain] = way[-1] if chain[0] == chain[-1] else np.inf
    way = np.abs(place[near] - place[:, None])
    way = np.minimum(way, np.abs(size[:, None] - way))
    other = (way > FACTOR * spacing[:, None]) | (number[near] != number[:, None])
    apart = lengths(points[near] - points[:, None])
    close = (other & (apart < WIDER * spacing[:, None])).any(1)

    def where(marked: np.ndarray) -> str:
        return in_words(places_of(points, near, marked))

    if close.any():
        warn(
            f"points: {int(close.sum())} are nearer to another part of the curve than its points are apart, most of "
            f"them near {where(close)}; it may go over to the other part there. Add points there, build each part by "
            "itself (LaplaceBeltrami.batch), or give the segments to from_mesh"
        )
    if len(gaps):
        at_gap = np.isin(np.arange(len(points)), gaps)
        warn(
            f"points: the curve ends at gaps hardly longer than those between its points, near {where(at_gap)}; add "
            "points where it goes on, or give the segments to from_mesh"
        )
