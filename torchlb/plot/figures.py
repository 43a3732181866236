"""Scalars, vectors and orders on a surface or cloud, and convergence, as pictures of matplotlib.

Surfaces are drawn by the painter's algorithm: triangles are projected, shaded and filled from back to front. That takes
a second for 20,000 of them, without a graphics card. Each function draws on the axes passed, or on new ones of
`matplotlib.pyplot`, and returns them; without matplotlib it raises ImportError. Nothing global is set.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, Num
from torch import Tensor

from torchlb.errors import InputError, InputTypeError, shown
from torchlb.operator.inputs import check_corners
from torchlb.plot.drawing import INK, VIEW, Shape, Views, draw_arrows, isolines_of, paint, plain

Vertices = Float[Tensor, "N 3"] | Float[np.ndarray, "N 3"]
Faces = Int[Tensor, "F 3"] | Int[np.ndarray, "F 3"]
Cloud = Float[Tensor, "N n"] | Float[np.ndarray, "N n"]
Scalar = Num[Tensor, " N"] | Num[np.ndarray, " N"]
ORDER_COLORS = ("#ece7dc", "#cfd6cf", "#abc1c4", "#7fa5b5", "#5485a0", "#33648a", "#1b446d")
"""Colours by order reached, low-order rows first, the last for all beyond: darker is higher, also in grey."""
LINE_COLORS = ("#d55e00", "#56b4e9", "#0072b2", "#000000", "#e69f00", "#009e73", "#cc79a7")
MARKERS = "osD^vP*"
MISSING = "0.6"
"""Colour of values that are NaN or infinite: grey."""
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
    ax, title, label
        Matplotlib axes, new ones by default, the title above them, and the label of the colour bar, such as the unit.
    cmap
        matplotlib's name; by default "RdBu_r" around zero, "viridis" otherwise, which the colour-blind can read.
    symmetric
        Whether zero is in the middle of the colours; by default if the values have both signs. The colours span the
        values except the outer 1 % at either end, for which the bar has a pointed end.
    limits, levels
        Least and greatest value of the colours instead; values at which isolines are drawn.
    view
        Elevation and azimuth of the eye, degrees; several views are drawn below one another. A shape in the plane z = 0
        is seen from above.

    Returns the axes. Raises ValueError for values or faces that do not fit the vertices.
    """
    ax = _axes(ax)
    points, corners = shape = _shape(vertices, faces)
    numbers = _values(values, points)
    shades = _color_map(numbers, cmap, symmetric, limits)
    assert corners is not None
    isolines = isolines_of(numbers, corners, levels)
    paint(ax, shape, shades.to_rgba(numbers[corners].mean(axis=1)), view, isolines)
    return _finish(ax, title, shades, label)


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
    ax = _axes(ax)
    places = _cloud(points)
    numbers = _values(values, places)
    shades = _color_map(numbers, cmap, symmetric, limits, "coolwarm")  # its middle is not white
    paint(ax, (places, None), shades.to_rgba(numbers), view, size=size)
    return _finish(ax, title, shades, label)


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
    ax = _axes(ax)
    shape, field = _shape(vertices, faces), _cloud(vectors, "vectors")
    places, corners = shape
    if field.shape != places.shape:
        raise InputError(f"vectors: expected {places.shape}, one a point, got {field.shape}")
    lengths = np.linalg.norm(field, axis=1)
    numbers = lengths if values is None else _values(values, places)
    shades = _color_map(numbers, cmap, symmetric, limits)
    painted = numbers if corners is None else numbers[corners].mean(axis=1)  # by dot or triangle
    ground = plain(PALE, len(painted)) if values is None else shades.to_rgba(painted)
    paint(ax, shape, ground, view)
    inks = shades.to_rgba(lengths) if values is None else plain(INK, len(places))
    draw_arrows(ax, shape, field, inks, view, count)
    return _finish(ax, title, shades, label)


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
    ax = _axes(ax)
    from matplotlib import colors
    from matplotlib.patches import Patch

    palette = colors.to_rgba_array(ORDER_COLORS)
    last = len(palette) - 1
    places, corners = shape = _shape(vertices, faces)
    reached = _values(order, places).astype(int)
    shown = reached if corners is None else reached[corners].min(axis=1)  # by dot or triangle
    paint(ax, shape, palette[shown.clip(0, last)], view)
    handles = []
    for p, count in reversed(list(enumerate(np.bincount(reached)))):
        if count:
            label = f"order {p}: {count:,}" if p else f"low order: {count:,}"
            handles.append(Patch(facecolor=palette[min(p, last)], edgecolor="0.6", label=label))
    ax.legend(handles=handles, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return _finish(ax, title)


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
    ax = _axes(ax)
    orders = []
    for i, (key, line) in enumerate(errors.items()):
        n, error = np.asarray(sizes, dtype=float), np.asarray(line, dtype=float)
        if n.shape != error.shape:
            raise InputError(f"errors[{key!r}]: expected {len(n)}, one for a size, got {len(line)}")
        good = np.isfinite(error) & (error > 0)
        n, error = n[good], error[good]
        label = key
        if len(n) > 1:
            orders.append(-dim * np.polyfit(np.log(n[-3:]), np.log(error[-3:]), 1)[0])
            label = f"{key}:  $h^{{{orders[-1]:.1f}}}$"
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


def _axes(ax: Any) -> Any:
    """Return the given axes, or new ones of `matplotlib.pyplot`; ImportError without matplotlib."""
    try:
        import matplotlib as mpl  # noqa: F401
    except ImportError as error:
        raise ImportError('pictures need matplotlib: pip install ".[plot]" in a clone') from error
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.subplots(figsize=(6.4, 4.8), layout="constrained")[1]


def _numpy(values: Any) -> np.ndarray:
    try:
        return torch.as_tensor(values).detach().cpu().double().numpy()
    except (TypeError, ValueError, RuntimeError) as error:
        raise InputTypeError(
            f"expected a tensor or array, got {shown(values)}; an operator has lb.points and lb.faces"
        ) from error


def _cloud(points: Any, name: str = "points") -> np.ndarray:
    """Points as (N, 3), with z = 0 for points of the plane."""
    places = _numpy(points)
    if places.ndim != 2 or places.shape[1] not in (2, 3):
        raise InputError(
            f"{name}: expected (N, 2) or (N, 3), got {places.shape}; choose the coordinates to draw, "
            "for example points[:, :3]"
        )
    return np.pad(places, ((0, 0), (0, 3 - places.shape[1])))


def _shape(points: Any, faces: Any) -> Shape:
    """Points in space and their triangles, checked."""
    points = _cloud(points)
    if faces is None:
        return points, None
    corners = check_corners(faces, len(points)).numpy()
    if corners.shape[1] != 3:
        raise InputError(f"faces: expected (F, 3), got {corners.shape}")
    return points, corners


def _values(values: Any, points: np.ndarray) -> np.ndarray:
    """One number for each point, (N,); ValueError for another count."""
    numbers = _numpy(values)
    if numbers.shape != points.shape[:1]:
        raise InputError(f"values: expected {points.shape[:1]}, one a point, got {numbers.shape}")
    return numbers


def _color_map(
    values: np.ndarray,
    cmap: str | None,
    symmetric: bool | None,
    limits: tuple[float, float] | None = None,
    diverging: str = "RdBu_r",
) -> Any:
    """The map from values to colours; its bar is pointed at the ends at which values exceed its range."""
    from matplotlib import cm, colormaps, colors

    finite = values[np.isfinite(values)]
    finite = finite if len(finite) else np.zeros(1)
    low, high = np.percentile(finite, [1, 99])
    symmetric = bool(low < 0 < high) if symmetric is None else symmetric
    if symmetric:
        high = max(abs(low), abs(high))
        low = -high
    if high <= low:
        low, high = low - 1, high + 1
    if limits is not None:
        low, high = limits
    slack = 0.02 * (high - low)  # point an end only where values are cut off
    beyond = finite.min() < low - slack, finite.max() > high + slack
    table = colormaps[cmap or (diverging if symmetric else "viridis")].with_extremes(bad=MISSING)
    table.colorbar_extend = ("neither", "min", "max", "both")[beyond[0] + 2 * beyond[1]]
    return cm.ScalarMappable(colors.Normalize(low, high), table)


def _finish(ax: Any, title: str | None, shades: Any = None, label: str | None = None) -> Any:
    """Give the axes equal aspect, no frame, a title and a colour bar, and return them."""
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set_axis_off()
    if shades is not None:
        ax.figure.colorbar(shades, ax=ax, shrink=0.6, pad=0.03, label=label or "")
    if title:
        ax.set_title(title)
    return ax
