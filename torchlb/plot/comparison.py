"""The operator beside libigl's cotangent on one shape: spectra as a table and a picture, with the map of orders."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.plot.figures import LINE_COLORS, MARKERS, plot_orders

SIDES = [(20.0, -55.0), (20.0, 125.0)]


def spectrum_table(values: Mapping[str, Float[Tensor, " k"]]) -> str:
    """Table of eigenvalues; from the second operator on with the difference from the first, in per cent.

    >>> print(spectrum_table({"a": torch.tensor([0.0, 2.0]), "b": torch.tensor([0.0, 2.1])}))
       k           a           b
       0           0           0
       1           2         2.1  +5.00 %
    """
    lines = ["   k" + "".join(f"{name:>12}" for name in values)]
    first, *others = values.values()
    for i in range(len(first)):
        line = f"{i:4}{first[i]:12.5g}"
        for other in others:
            change = 100 * float(other[i] / first[i] - 1) if first[i] > 0 else None
            line += f"{other[i]:12.5g}" + ("" if change is None else f"{change:+7.2f} %")
        lines.append(line)
    return "\n".join(lines)


def plot_spectrum(values: Mapping[str, Float[Tensor, " k"]], ax: Any) -> Any:
    """Plot eigenvalues of the first operator on axes, which it returns, and the others' differences in % beside."""
    from matplotlib.ticker import MaxNLocator

    (name, first), *others = values.items()
    style = {"marker": MARKERS[0], "markersize": 4, "linewidth": 1}
    ax.plot(first.numpy(), color=LINE_COLORS[2], **style)
    ax.set(xlabel="number k", ylabel=f"eigenvalue of −Δ, {name}, 1/length²", title="spectrum")
    ax.yaxis.label.set_color(LINE_COLORS[2])
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.spines[["top", "right"]].set_visible(False)
    for name, line in others:
        right, change = ax.twinx(), 100 * (line / first.where(first > 0, torch.nan) - 1)
        right.plot(change.numpy(), color=LINE_COLORS[0], **style)
        right.set_ylabel(f"{name}, difference in %", color=LINE_COLORS[0])
        right.spines[["top", "left"]].set_visible(False)
    return ax


def draw_comparison(
    lb: LaplaceBeltrami,
    faces: Tensor | None,
    values: Mapping[str, Float[Tensor, " k"]],
    path: str | Path,
    title: str,
) -> None:
    """Write a picture (PNG, or the format of the ending): the order that each point reached, and the eigenvalues.

    For points in more than three dimensions it has the spectra only. Raises ImportError without matplotlib, OSError
    where the file cannot be written.
    """
    from matplotlib.figure import Figure  # without pyplot, which would choose a backend

    seen = lb.points.shape[1] == 3 and lb.dim == 2
    figure = Figure(figsize=(11, 5.5) if seen else (6, 4.5), layout="constrained")
    axes = figure.subplots(1, 2 if seen else 1, squeeze=False)
    plot_spectrum(values, axes[0, -1])
    if seen:
        order = lb.report.order.to(torch.int64)
        plot_orders(lb.points.double(), faces, order, ax=axes[0, 0], view=SIDES)
    figure.suptitle(title)
    figure.savefig(path, dpi=130)
