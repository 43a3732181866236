"""Pictures with matplotlib (`pip install torchlb[plot]`): a scalar on a surface or cloud, orders, convergence.

Surfaces are drawn by the painter's algorithm: triangles projected, shaded and filled from back to front. That takes a
second for 20,000 of them, and no graphics card.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Num
from torch import Tensor

__all__ = ["plot_convergence", "plot_orders", "plot_points", "plot_surface"]

Vertices = Float[Tensor, "N 3"] | Float[np.ndarray, "N 3"]
Faces = Int[Tensor, "F 3"] | Int[np.ndarray, "F 3"]
Cloud = Float[Tensor, "N n"] | Float[np.ndarray, "N n"]
Scalar = Num[Tensor, " N"] | Num[np.ndarray, " N"]
Eye = tuple[float, float]
"""Elevation above the plane of x and y, and azimuth from x, of the eye, in degrees."""

VIEW: Eye = (25.0, -55.0)
LIGHT = (-0.35, 0.45, 0.82)
"""Direction of the light as the picture has it: right, up, towards the eye."""
ORDER_COLORS = ("#d55e00", "#e69f00", "#f0e442", "#56b4e9", "#009e73", "#0072b2", "#cc79a7")
"""By order reached, fallback first, the last for all beyond. Okabe and Ito's, distinct for the colour-blind too."""
LINE_COLORS = ("#d55e00", "#56b4e9", "#0072b2", "#000000", "#e69f00", "#009e73", "#cc79a7")
MARKERS = "osD^vP*"
MISSING = "0.6"
"""Colour of values that are NaN or infinite: grey."""


def plot_surface(
    vertices: Vertices,
    faces: Faces,
    values: Scalar,
    *,
    ax: Any = None,
    title: str | None = None,
    cmap: str | None = None,
    symmetric: bool | None = None,
    view: Eye | Sequence[Eye] = VIEW,
    label: str | None = None,
) -> Any:
    """A scalar on a triangulated surface, shaded, with a colour bar.

    Parameters
    ----------
    vertices : (N, 3) tensor or array.
    faces : (F, 3) indices.
    values : (N,); a triangle has the mean of its corners. Grey where not finite.
    ax : matplotlib axes; new ones by default.
    title : above the axes.
    cmap : matplotlib's name; by default "RdBu_r" around zero, "viridis" otherwise, which the colour-blind can read.
    symmetric : whether zero is in the middle of the colours; by default if the values have both signs. The colours
        span the values but for the outer 1 % at either end, which a pointed end of the bar stands for.
    view : elevation and azimuth of the eye, degrees; several are drawn below one another.
    label : of the colour bar, such as the unit.

    Returns
    -------
    The axes.

    Raises
    ------
    ImportError : without matplotlib.
    ValueError : for values or faces that do not fit the vertices.
    """
    ax = _axes(ax)
    points, corners = _mesh(vertices, faces)
    numbers = _values(values, points)
    shades, extend = _colors(numbers, cmap, symmetric)
    _paint(ax, points, corners, shades.to_rgba(numbers[corners].mean(axis=1)), view)
    _finish(ax, title, shades, extend, label)
    return ax


def plot_points(
    points: Cloud,
    values: Scalar,
    *,
    ax: Any = None,
    title: str | None = None,
    cmap: str | None = None,
    symmetric: bool | None = None,
    view: Eye | Sequence[Eye] = VIEW,
    label: str | None = None,
    size: float | None = None,
) -> Any:
    """A scalar on a cloud in the plane or in space: a disk for each point, the near ones on top, the far ones paler.

    Parameters
    ----------
    points : (N, 2) or (N, 3) tensor or array.
    values : (N,).
    size : area of a disk, in square points (1/72 inch); by default smaller the more there are.
    ax, title, cmap, symmetric, view, label : as for `plot_surface`.

    Returns
    -------
    The axes.

    Raises
    ------
    ImportError : without matplotlib.
    ValueError : for points of another dimension, or values that do not fit them.
    """
    ax = _axes(ax)
    places = _cloud(points)
    numbers = _values(values, places)
    shades, extend = _colors(numbers, cmap, symmetric, "coolwarm")  # whose middle is no white
    _dots(ax, places, shades.to_rgba(numbers), view, size)
    _finish(ax, title, shades, extend, label)
    return ax


def plot_orders(
    vertices: Cloud,
    faces: Faces | None,
    order: Int[Tensor, " N"] | Int[np.ndarray, " N"],
    *,
    ax: Any = None,
    title: str | None = "order reached",
    view: Eye | Sequence[Eye] = VIEW,
) -> Any:
    """Map of the order that each point reached (`lb.report.order`), with the number of points in the legend.

    Parameters
    ----------
    vertices : (N, 3); also (N, 2) for a cloud.
    faces : (F, 3), or None for a cloud. A triangle takes the lowest order of its corners.
    order : (N,), 0 for a fallback row.
    ax, title, view : as for `plot_surface`.

    Returns
    -------
    The axes.

    Raises
    ------
    ImportError : without matplotlib.
    ValueError : for orders or faces that do not fit the vertices.
    """
    ax = _axes(ax)
    from matplotlib import colors
    from matplotlib.patches import Patch

    palette = colors.to_rgba_array(ORDER_COLORS)
    last = len(palette) - 1
    places = _cloud(vertices)
    reached = _values(order, places).astype(int)
    if faces is None:
        _dots(ax, places, palette[reached.clip(0, last)], view, None)
    else:
        points, corners = _mesh(vertices, faces)
        _paint(ax, points, corners, palette[reached[corners].min(axis=1).clip(0, last)], view)
    counts = np.bincount(reached)
    handles = [
        Patch(color=palette[min(p, last)], label=f"{f'order {p}' if p else 'fallback'}: {count:,}")
        for p, count in reversed(list(enumerate(counts)))
        if count
    ]
    ax.legend(handles=handles, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    _finish(ax, title)
    return ax


def plot_convergence(
    sizes: Sequence[int],
    errors: Mapping[str, Sequence[float]],
    *,
    dim: int = 2,
    ax: Any = None,
    title: str | None = None,
    ylabel: str = "relative error of Δf",
) -> Any:
    """Error against the number of points, doubly logarithmic, with the measured order of each line in the legend.

    Grey lines fall like whole powers of the spacing h ~ N^(−1/d), to compare with.

    Parameters
    ----------
    sizes : numbers of points N, ascending.
    errors : for each method its errors at these sizes; zeros and NaN are left out.
    dim : d of the manifold. The measured order is the slope against h over the three finest sizes.
    ax, title : as for `plot_surface`.
    ylabel : of the vertical axis.

    Returns
    -------
    The axes.

    Raises
    ------
    ImportError : without matplotlib.
    ValueError : for no errors that are positive, or another number of them than of sizes.
    """
    ax = _axes(ax)
    orders = []
    for i, (name, line) in enumerate(errors.items()):
        n, error = np.asarray(sizes, dtype=float), np.asarray(line, dtype=float)
        if n.shape != error.shape:
            raise ValueError(
                f"errors[{name!r}]: expected {len(n)}, one for a size, got {len(error)}"
            )
        good = np.isfinite(error) & (error > 0)
        n, error = n[good], error[good]
        label = name
        if len(n) > 1:
            orders.append(-dim * np.polyfit(np.log(n[-3:]), np.log(error[-3:]), 1)[0])
            label = f"{name}:  $h^{{{orders[-1]:.1f}}}$"
        color, marker = LINE_COLORS[i % len(LINE_COLORS)], MARKERS[i % len(MARKERS)]
        ax.loglog(n, error, color=color, marker=marker, markersize=5, label=label)
    _references(ax, sizes, orders, dim)
    ax.set_xticks(list(sizes), [f"{n:,}" for n in sizes])
    ax.minorticks_off()
    ax.set(xlabel="number of points N", ylabel=ylabel)
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(loc="lower left", frameon=False)
    if title:
        ax.set_title(title)
    return ax


def _references(ax: Any, sizes: Sequence[int], orders: list[float], dim: int) -> None:
    """A grey fan of the whole powers of h near the measured ones, from the largest error on, named at its ends."""
    drawn = [y for line in ax.lines for y in line.get_ydata()]
    if not drawn:
        raise ValueError("errors: expected some that are positive, got none")
    low, high = min(drawn) / 2, max(drawn) * 1.5
    first, last = min(sizes), max(sizes)
    for power in sorted({max(round(order), 1) for order in orders}):
        end = min(last, first * (high / low) ** (dim / power))  # where it leaves the axes
        fall = (end / first) ** (-power / dim)
        ax.loglog([first, end], [high, high * fall], color="0.75", lw=1, ls="--", zorder=0)
        name = "$h$" if power == 1 else f"$h^{{{power}}}$"
        place = {"xytext": (4, 0), "textcoords": "offset points", "va": "center"}
        ax.annotate(name, (end, high * fall), color="0.45", annotation_clip=False, **place)
    ax.set_ylim(low, 1.2 * high)


def _axes(ax: Any) -> Any:
    """The given axes, or new ones."""
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError("pictures need matplotlib: pip install torchlb[plot]") from error
    return plt.subplots(figsize=(6.4, 4.8), layout="constrained")[1] if ax is None else ax


def _numpy(values: Any) -> np.ndarray:
    return torch.as_tensor(values).detach().cpu().double().numpy()


def _cloud(points: Any) -> np.ndarray:
    """As (N, 3), the plane as z = 0."""
    places = _numpy(points)
    if places.ndim != 2 or places.shape[1] not in (2, 3):
        raise ValueError(
            f"points: expected (N, 2) or (N, 3), got {places.shape}; choose the coordinates to draw, "
            "for example points[:, :3]"
        )
    return np.pad(places, ((0, 0), (0, 3 - places.shape[1])))


def _mesh(vertices: Any, faces: Any) -> tuple[np.ndarray, np.ndarray]:
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


def _values(values: Any, points: np.ndarray) -> np.ndarray:
    numbers = _numpy(values)
    if numbers.shape != points.shape[:1]:
        raise ValueError(f"values: expected {points.shape[:1]}, one a point, got {numbers.shape}")
    return numbers


def _colors(
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


def _paint(
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


def _dots(
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


def _finish(
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
