"""Drawing in three dimensions with matplotlib, for `plot`: projection, the painter's algorithm, colours, axes.

What the functions take has been read by `cloud_of`, `mesh_of` and `values_of`: NumPy arrays of float64 that fit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

__all__ = [
    "VIEW",
    "Eye",
    "axes_of",
    "cloud_of",
    "color_map",
    "draw_dots",
    "finish",
    "mesh_of",
    "paint",
    "values_of",
]

Eye = tuple[float, float]
"""Elevation above the plane of x and y, and azimuth from x, of the eye, in degrees."""

VIEW: Eye = (25.0, -55.0)
LIGHT = (-0.35, 0.45, 0.82)
"""Direction of the light as the picture has it: right, up, towards the eye."""
MISSING = "0.6"
"""Colour of values that are NaN or infinite: grey."""


def axes_of(ax: Any) -> Any:
    """The given axes, or new ones."""
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError("pictures need matplotlib: pip install torchlb[plot]") from error
    return plt.subplots(figsize=(6.4, 4.8), layout="constrained")[1] if ax is None else ax


def _numpy(values: Any) -> np.ndarray:
    return torch.as_tensor(values).detach().cpu().double().numpy()


def cloud_of(points: Any) -> np.ndarray:
    """As (N, 3), the plane as z = 0."""
    places = _numpy(points)
    if places.ndim != 2 or places.shape[1] not in (2, 3):
        raise ValueError(
            f"points: expected (N, 2) or (N, 3), got {places.shape}; choose the coordinates to draw, "
            "for example points[:, :3]"
        )
    return np.pad(places, ((0, 0), (0, 3 - places.shape[1])))


def mesh_of(vertices: Any, faces: Any) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (N, 3) and the indices of their triangles (F, 3); ValueError if they are no mesh."""
    points = _numpy(vertices)
    corners = torch.as_tensor(faces).detach().cpu().numpy()
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"vertices: expected (N, 3), got {points.shape}")
    if corners.ndim != 2 or corners.shape[1] != 3 or len(corners) == 0:
        raise ValueError(f"faces: expected (F, 3), at least one, got {corners.shape}")
    if corners.min() < 0 or corners.max() >= len(points):
        raise ValueError(
            f"faces: expected indices 0 … {len(points) - 1}, got {corners.min()} … {corners.max()}"
        )
    return points, corners


def values_of(values: Any, points: np.ndarray) -> np.ndarray:
    """One number for each point, (N,); ValueError for another count."""
    numbers = _numpy(values)
    if numbers.shape != points.shape[:1]:
        raise ValueError(f"values: expected {points.shape[:1]}, one a point, got {numbers.shape}")
    return numbers


def color_map(
    values: np.ndarray, cmap: str | None, symmetric: bool | None, diverging: str = "RdBu_r"
) -> tuple[Any, str]:
    """The map from values to colours, and at which ends values lie beyond it."""
    from matplotlib import cm, colormaps, colors

    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        finite = np.zeros(1)
    low, high = np.percentile(finite, [1, 99])
    if symmetric is None:
        symmetric = bool(low < 0 < high)
    if symmetric:
        high = max(abs(low), abs(high))
        low = -high
    if high <= low:
        low, high = low - 1, high + 1
    slack = 0.02 * (high - low)  # an end is pointed only where the colours hide something
    beyond = finite.min() < low - slack, finite.max() > high + slack
    extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[beyond]
    table = colormaps[cmap or (diverging if symmetric else "viridis")].with_extremes(bad=MISSING)
    return cm.ScalarMappable(colors.Normalize(low, high), table), extend


def _project(points: np.ndarray, view: Eye) -> np.ndarray:
    """Coordinates (N, 3) as the picture has them: right, up, towards the eye."""
    elevation, azimuth = np.radians(view)
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    ahead = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    eye = np.cos(elevation) * ahead + np.sin(elevation) * np.array([0.0, 0.0, 1.0])
    return points @ np.stack([right, np.cross(eye, right), eye], axis=1)


def _stacked(points: np.ndarray, view: Eye | Sequence[Eye]) -> list[np.ndarray]:
    """The projections of all views, each below the one before."""
    views = [view] if isinstance(view[0], int | float) else view
    seen, floor = [], 0.0
    for one in views:
        flat = _project(points - points.mean(axis=0), one)  # type: ignore[arg-type]
        height = np.ptp(flat[:, 1])
        flat[:, 1] += floor - flat[:, 1].max()
        flat[:, 0] -= (flat[:, 0].max() + flat[:, 0].min()) / 2
        floor -= 1.08 * height
        seen.append(flat)
    return seen


def paint(
    ax: Any, points: np.ndarray, faces: np.ndarray, colors: np.ndarray, view: Eye | Sequence[Eye]
) -> None:
    """Shaded triangles, back to front."""
    from matplotlib.collections import PolyCollection

    light = np.array(LIGHT) / np.linalg.norm(LIGHT)
    for flat in _stacked(points, view):
        corners = flat[faces]  # (F, 3, 3)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
        normal *= np.where(normal[:, 2:] < 0, -1, 1)  # either side is lit
        shaded = colors.copy()
        shaded[:, :3] *= (0.45 + 0.55 * np.clip(normal @ light, 0, 1))[:, None]
        order = corners[..., 2].mean(axis=1).argsort()
        triangles = PolyCollection(
            list(corners[order, :, :2]),
            facecolors=shaded[order],
            edgecolors=shaded[order],
            linewidths=0.2,  # closes the seams between triangles
            rasterized=True,
        )
        ax.add_collection(triangles)


def draw_dots(
    ax: Any, points: np.ndarray, colors: np.ndarray, view: Eye | Sequence[Eye], size: float | None
) -> None:
    """A disk for each point, back to front, paler with distance."""
    flat_cloud = not points[:, 2].any()
    area = float(np.clip(60000 / len(points), 2, 60)) if size is None else size
    for flat in _stacked(points, (90.0, -90.0) if flat_cloud else view):
        order = flat[:, 2].argsort()
        depth = (flat[:, 2].max() - flat[:, 2]) / max(np.ptp(flat[:, 2]), 1e-300)
        pale = colors.copy()
        pale[:, :3] += (1 - pale[:, :3]) * 0.5 * depth[:, None]
        x, y = flat[order, :2].T
        ax.scatter(x, y, s=area, c=pale[order], linewidths=0, rasterized=True)


def finish(
    ax: Any,
    title: str | None,
    shades: Any = None,
    extend: str = "neither",
    label: str | None = None,
) -> None:
    """Equal aspect, no frame, a title and a colour bar."""
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()
    if shades is not None:
        ax.figure.colorbar(shades, ax=ax, shrink=0.6, pad=0.03, extend=extend, label=label or "")
    if title:
        ax.set_title(title)
