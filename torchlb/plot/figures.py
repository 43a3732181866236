"""Scalars, vectors and orders on a surface or cloud, and convergence, as pictures of matplotlib.

Surfaces are drawn by the painter's algorithm: triangles are projected, shaded and filled from back to front. That takes
a second for 20,000 of them, without a graphics card. Each function draws on the axes passed, or on new ones of
`matplotlib.pyplot`, and returns them; without matplotlib it raises ImportError. Nothing global is set.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Num
from torch import Tensor

from torchlb.errors import InputError
from torchlb.plot.drawing import (
    INK,
    VIEW,
    Views,
    axes_of,
    cloud_of,
    color_map,
    draw_arrows,
    finish,
    isolines_of,
    paint,
    plain,
    shape_of,
    values_of,
)

Vertices = Float[Tensor, "N 3"] | Float[np.ndarray, "N 3"]
Faces = Int[Tensor, "F 3"] | Int[np.ndarray, "F 3"]
Cloud = Float[Tensor, "N n"] | Float[np.ndarray, "N n"]
Scalar = Num[Tensor, " N"] | Num[np.ndarray, " N"]
ORDER_COLORS = ("#ece7dc", "#cfd6cf", "#abc1c4", "#7fa5b5", "#5485a0", "#33648a", "#1b446d")
"""Colours by order reached, low-order rows first, the last for all beyond: darker is higher, also in grey."""
LINE_COLORS = ("#d55e00", "#56b4e9", "#0072b2", "#000000", "#e69f00", "#009e73", "#cc79a7")
MARKERS = "osD^vP*"
PALE = "0.88"
"""Colour of a shape on which only the arrows are coloured."""


def plot_surface(
    vertices: Vertices,
    faces: Faces,
    values: Scalar,
    *,
    ax: Any = None,
    title: str | None = None,
    cmap: str | None = None,
    symmetric: bool | None = None,
    limits: tuple[float, float] | None = None,
    levels: Sequence[float] | Float[np.ndarray, " L"] = (),
    view: Views = VIEW,
    label: str | None = None,
) -> Any:
    """A scalar on a triangulated surface, shaded, with a colour bar.

    Parameters
    ----------
    vertices, faces, values
        (N, 3), (F, 3) and (N,), tensors or arrays; a triangle has the mean of its corners. Grey where not finite.
    ax, title
        Matplotlib axes, new ones by default, and the title above them.
    cmap
        matplotlib's name; by default "RdBu_r" around zero, "viridis" otherwise, which the colour-blind can read.
    symmetric
        Whether zero is in the middle of the colours; by default if the values have both signs. The colours span the
        values except the outer 1 % at either end, for which the bar has a pointed end.
    limits
        Least and greatest value of the colours instead.
    levels
        Values at which isolines are drawn.
    view
        Elevation and azimuth of the eye, degrees; several views are drawn below one another. A shape in the plane z = 0
        is seen from above.
    label
        Label of the colour bar, such as the unit.

    Returns the axes. Raises ValueError for values or faces that do not fit the vertices.
    """
    ax = axes_of(ax)
    points, corners = shape_of(vertices, faces)
    numbers = values_of(values, points)
    shades = color_map(numbers, cmap, symmetric, limits)
    assert corners is not None
    isolines = isolines_of(numbers, corners, levels)
    paint(ax, points, corners, shades.to_rgba(numbers[corners].mean(axis=1)), view, isolines)
    return finish(ax, title, shades, label)


def plot_points(
    points: Cloud,
    values: Scalar,
    *,
    ax: Any = None,
    title: str | None = None,
    cmap: str | None = None,
    symmetric: bool | None = None,
    limits: tuple[float, float] | None = None,
    view: Views = VIEW,
    label: str | None = None,
    size: float | None = None,
) -> Any:
    """A scalar on a cloud in the plane or in space: a disk for each point, near ones on top, far ones paler.

    Parameters
    ----------
    points, values
        (N, 2) or (N, 3), and (N,), tensors or arrays.
    size
        Area of a disk, in square points (1/72 inch); by default smaller the more there are.
    ax, title, cmap, symmetric, limits, view, label
        As for `plot_surface`.

    Returns the axes. Raises ValueError for points of another dimension, or values that do not fit them.
    """
    ax = axes_of(ax)
    places = cloud_of(points)
    numbers = values_of(values, places)
    # The middle of "coolwarm" is not white.
    shades = color_map(numbers, cmap, symmetric, limits, "coolwarm")
    paint(ax, places, None, shades.to_rgba(numbers), view, size=size)
    return finish(ax, title, shades, label)


def plot_vectors(
    vertices: Cloud,
    faces: Faces | None,
    vectors: Cloud,
    values: Scalar | None = None,
    *,
    ax: Any = None,
    title: str | None = None,
    cmap: str | None = None,
    symmetric: bool | None = None,
    limits: tuple[float, float] | None = None,
    view: Views = VIEW,
    label: str | None = None,
    count: int = 400,
) -> Any:
    """A vector field as arrows at evenly spread points of a surface or cloud, such as ``lb.gradient(f)``.

    Arrows behind the surface are left out. The longest one is twice as long as the distance between two arrows.

    Parameters
    ----------
    vertices, faces
        (N, 3) and (F, 3); (N, 2) or (N, 3) and None for a cloud.
    vectors
        (N, 3), or (N, 2) in the plane. Vectors that are zero or not finite are not drawn.
    values
        (N,), a scalar beneath black arrows. Without it the arrows are coloured by length.
    count
        Number of arrows, on all sides of the shape.
    ax, title, cmap, symmetric, limits, view, label
        As for `plot_surface`.

    Returns the axes. Raises ValueError for vectors, values or faces that do not fit the vertices.
    """
    ax = axes_of(ax)
    (places, corners), field = shape_of(vertices, faces), cloud_of(vectors, "vectors")
    if field.shape != places.shape:
        raise InputError(f"vectors: expected {places.shape}, one a point, got {field.shape}")
    lengths = np.linalg.norm(field, axis=1)
    numbers = lengths if values is None else values_of(values, places)
    shades = color_map(numbers, cmap, symmetric, limits)
    painted = numbers if corners is None else numbers[corners].mean(axis=1)  # by dot or triangle
    ground = plain(PALE, len(painted)) if values is None else shades.to_rgba(painted)
    paint(ax, places, corners, ground, view)
    inks = shades.to_rgba(lengths) if values is None else plain(INK, len(places))
    draw_arrows(ax, places, corners, field, inks, view, count)
    return finish(ax, title, shades, label)


def plot_orders(
    vertices: Cloud,
    faces: Faces | None,
    order: Int[Tensor, " N"] | Int[np.ndarray, " N"],
    *,
    ax: Any = None,
    title: str | None = "order reached",
    view: Views = VIEW,
) -> Any:
    """Map of the order that each point reached (`lb.report.order`), with the number of points in the legend.

    Parameters
    ----------
    vertices, faces
        As for `plot_vectors`.
    order
        (N,), 0 for a low-order row. Darker is higher. A triangle takes the lowest order of its corners.
    ax, title, view
        As for `plot_surface`.

    Returns the axes. Raises ValueError for orders or faces that do not fit the vertices.
    """
    ax = axes_of(ax)
    from matplotlib import colors
    from matplotlib.patches import Patch

    palette = colors.to_rgba_array(ORDER_COLORS)
    last = len(palette) - 1
    places, corners = shape_of(vertices, faces)
    reached = values_of(order, places).astype(int)
    shown = reached if corners is None else reached[corners].min(axis=1)  # by dot or triangle
    paint(ax, places, corners, palette[shown.clip(0, last)], view)
    handles = []
    for p, count in reversed(list(enumerate(np.bincount(reached)))):
        if count:
            label = f"order {p}: {count:,}" if p else f"low order: {count:,}"
            handles.append(Patch(facecolor=palette[min(p, last)], edgecolor="0.6", label=label))
    ax.legend(handles=handles, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return finish(ax, title)


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

    Grey reference lines fall like whole powers of the spacing h ~ N^(−1/d).

    Parameters
    ----------
    sizes, errors
        Numbers of points N, ascending, and the errors at these, by method; zeros and NaN are left out.
    dim
        d of the manifold. The measured order is the slope against h over the three finest sizes.
    ax, title, ylabel
        As for `plot_surface`, and the label of the vertical axis.

    Returns the axes. Raises ValueError if no error is positive, or if their number is not that of the sizes.
    """
    ax = axes_of(ax)
    orders = []
    for i, (name, line) in enumerate(errors.items()):
        n, error = np.asarray(sizes, dtype=float), np.asarray(line, dtype=float)
        if n.shape != error.shape:
            raise InputError(
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
    """Grey lines for the whole powers of h near the measured ones, from the largest error on, labelled."""
    drawn = [y for line in ax.lines for y in line.get_ydata()]
    if not drawn:
        raise InputError("errors: expected some that are positive, got none")
    low, high = min(drawn) / 2, max(drawn) * 1.5
    first, last = min(sizes), max(sizes)
    for power in sorted({max(round(order), 1) for order in orders}):
        end = min(last, first * (high / low) ** (dim / power))  # end of the line within the axes
        fall = (end / first) ** (-power / dim)
        ax.loglog([first, end], [high, high * fall], color="0.75", lw=1, ls="--", zorder=0)
        name = "$h$" if power == 1 else f"$h^{{{power}}}$"
        at = (first * (end / first) ** 0.94, high * fall**0.94)
        box = {"facecolor": ax.get_facecolor(), "edgecolor": "none", "pad": 1}
        ax.annotate(name, at, color="0.45", ha="center", va="center", bbox=box, zorder=0)
    ax.set_ylim(low, 1.2 * high)
