"""Drawing in three dimensions with matplotlib, of input that `figures` checks: projection, the painter's algorithm."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

Eye = tuple[float, float]
"""Elevation of the eye above the plane of x and y, and azimuth from x, in degrees."""
Views = Eye | Sequence[Eye]
Shape = tuple[np.ndarray, np.ndarray | None]
"""Points (N, 3), and triangles (F, 3), None for a cloud."""

VIEW: Eye = (25.0, -55.0)
"""Default view of a surface: elevation and azimuth, °."""
LIGHT = (-0.35, 0.45, 0.82)
"""Direction of the light in the picture's coordinates: right, up, towards the eye."""
INK = "0.1"
"""Colour of isolines, and of arrows on a coloured shape."""


def plain(color: str, count: int) -> np.ndarray:
    """One colour, (count, 4)."""
    from matplotlib.colors import to_rgba

    return np.tile(to_rgba(color), (count, 1))


def _project(points: np.ndarray, view: Any) -> np.ndarray:
    """Coordinates (N, 3) in the picture: right, up, towards the eye."""
    elevation, azimuth = view
    turn = Rotation.from_euler("ZX", [azimuth + 90, 90 - elevation], degrees=True)
    return points @ turn.as_matrix()


def _stacked(points: np.ndarray, view: Views) -> Iterator[tuple[np.ndarray, Any]]:
    """The projections for all eyes, one below the other. A shape in the plane z = 0 is seen from above."""
    if not points[:, 2].any():
        view = (90.0, -90.0)
    floor = 0.0
    for eye in np.reshape(view, (-1, 2)):
        flat = _project(points - points.mean(axis=0), eye)
        flat[:, 1] += floor - flat[:, 1].max()
        flat[:, 0] -= (flat[:, 0].max() + flat[:, 0].min()) / 2
        floor -= 1.08 * np.ptp(flat[:, 1])
        yield flat, eye


def paint(
    ax: Any,
    shape: Shape,
    colors: np.ndarray,
    view: Views,
    isolines: tuple[np.ndarray, np.ndarray] | None = None,
    size: float | None = None,
) -> None:
    """Draw shaded triangles with segments by `isolines_of`, or disks of an area, paler with distance, back to front."""
    points, faces = shape
    if faces is None:
        area = float(np.clip(60000 / len(points), 2, 60)) if size is None else size
        for flat, _ in _stacked(points, view):
            order = flat[:, 2].argsort()
            x, y = flat[order, :2].T
            pale = _faded(colors, flat)[order]
            ax.scatter(x, y, s=area, c=pale, linewidths=0, rasterized=True)
        return
    from matplotlib.collections import PolyCollection

    light = np.array(LIGHT) / np.linalg.norm(LIGHT)
    for flat, _ in _stacked(points, view):
        corners = flat[faces]  # (F, 3, 3)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        normal *= np.where(normal[:, 2:] < 0, -1, 1)  # light both sides
        shaded = colors.copy()
        shaded[:, :3] *= (0.45 + 0.55 * np.clip(normal @ light, 0, 1))[:, None]
        polygons, depth = list(corners[..., :2]), corners[..., 2].mean(axis=1)
        width = np.full(len(faces), 0.5)  # closes the seams between triangles
        if isolines is not None:
            edges, share = isolines
            ends = flat[edges[..., 0]] * (1 - share) + flat[edges[..., 1]] * share  # (S, 2, 3)
            polygons += list(ends[..., :2])
            above = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1).mean()
            depth = np.append(depth, ends[..., 2].mean(axis=1) + above)  # before triangles beside
            shaded = np.append(shaded, plain(INK, len(ends)), axis=0)
            width = np.append(width, np.full(len(ends), 0.8))
        order = depth.argsort()
        style: dict[str, Any] = {"facecolors": shaded[order], "edgecolors": shaded[order]}
        drawn = [polygons[i] for i in order]
        ax.add_collection(PolyCollection(drawn, linewidths=width[order], rasterized=True, **style))


def isolines_of(
    values: np.ndarray, faces: np.ndarray, levels: Sequence[float] | np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Segments where the linear interpolant has a level, none at NaN: edges of their ends, (S, 2, 2), and fractions."""
    finite, levels = faces[np.isfinite(values[faces]).all(axis=1)], np.asarray(levels)
    edges = np.stack([finite, np.roll(finite, -1, axis=1)], axis=-1)  # (F, 3, 2)
    start, end = np.moveaxis(values[edges] > levels[:, None, None, None], -1, 0)
    level, *place = np.nonzero(start != end)  # two edges of a triangle, or none
    crossed = edges[tuple(place)]
    start, end = values[crossed].T
    share = (levels[level] - start) / (end - start)
    return crossed.reshape(-1, 2, 2), share.reshape(-1, 2, 1)


def _faded(colors: np.ndarray, flat: np.ndarray) -> np.ndarray:
    """Colours paler with the distance from the eye; unchanged where all distances are equal up to rounding."""
    height = flat[:, 2]
    depth = (height.max() - height) / max(np.ptp(height), 1e-9 * np.ptp(flat), 1e-300)
    pale = colors.copy()
    pale[:, :3] += (1 - pale[:, :3]) * 0.5 * depth[:, None]
    return pale


def _evenly_spread(points: np.ndarray, count: int) -> tuple[np.ndarray, float]:
    """Indices of `count` points by farthest-point sampling, and the least distance between any two of them."""
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    spacing = float(distance.max())
    while len(chosen) < min(count, len(points)):
        spacing = float(distance.max())
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen), spacing


def draw_arrows(
    ax: Any, shape: Shape, field: np.ndarray, colors: np.ndarray, view: Views, count: int
) -> None:
    """Draw arrows at `count` points, back to front: on a mesh only visible ones, on a cloud paler with distance."""
    points, faces = shape
    tails, spacing = _evenly_spread(points, count)
    lengths = np.linalg.norm(field[tails], axis=1)
    drawn = np.isfinite(lengths) & (lengths > 0)
    if not drawn.any():
        return
    tails, scale = tails[drawn], 2 * spacing / lengths[drawn].max()
    options = {"angles": "xy", "scale_units": "xy", "scale": 1, "units": "dots", "width": 1.6}
    for flat, eye in _stacked(points, view):
        seen = tails if faces is None else tails[_visible(flat, faces, tails)]
        seen = seen[flat[seen, 2].argsort()]
        inks = (_faded(colors, flat) if faces is None else colors)[seen]
        x, y = flat[seen, :2].T
        u, v = scale * _project(field[seen], eye)[:, :2].T
        ax.quiver(x, y, u, v, color=inks, minlength=0.5, zorder=2, **options)
        ax.update_datalim(np.stack([x + u, y + v], axis=1))


def _visible(flat: np.ndarray, faces: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Mask of the chosen points that are visible: no triangle covers them in the picture and is nearer to the eye."""
    a, b, c = (flat[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    area = np.where(normal[:, 2] == 0, np.nan, normal[:, 2])  # edge-on triangles hide nothing
    slack = 1e-6 * np.ptp(flat[:, 2])  # tolerance for the triangles at the point itself
    visible = np.ones(len(chosen), dtype=bool)
    for i, point in enumerate(flat[chosen]):
        weights = [np.cross(q - p, point - p)[:, 2] / area for p, q in ((a, b), (b, c), (c, a))]
        covered = np.flatnonzero(np.minimum.reduce(weights) >= 0)
        fall = (normal[covered, :2] * (point - a[covered])[:, :2]).sum(axis=1) / area[covered]
        visible[i] = not (a[covered, 2] - fall > point[2] + slack).any()
    return visible
