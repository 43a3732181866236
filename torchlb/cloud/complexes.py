"""The result of a reconstruction, and places on it for reports and warnings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.geometry.complex import components
from torchlb.geometry.vectors import Coords, Mask, Nearest, lengths
from torchlb.linalg.precision import LOW

Places = tuple[tuple[float, ...], ...]
PLACES = 8
"""Largest number of places named in a report or a warning."""


@dataclass(frozen=True, kw_only=True)
class Complex:
    """Cells through a cloud of points.

    Attributes
    ----------
    points
        (N, n), ℓ: the points, moved onto the shape if the cloud is noisy.
    cells
        (F, d + 1), segments, triangles or tetrahedra.
    shares
        (F,), share of each cell that counts where cells overlap; None if all count and meet as those of a mesh.
    """

    points: Float[Tensor, "N n"]
    cells: Int[Tensor, "F corners"]
    shares: Float[Tensor, " F"] | None = None


def in_words(places: Places) -> str:
    """Coordinates as text: (x, y, …), one after the other."""
    return ", ".join(f"({', '.join(f'{x:g}' for x in place)})" for place in places)


def places_of(points: Coords, near: Nearest, marked: Mask) -> Places:
    """Centres of the largest groups of marked points, at most `PLACES` of them, ℓ."""
    i, j = np.arange(len(points)).repeat(near.shape[1] - 1), near[:, 1:].ravel()
    both = marked[i] & marked[j]
    group, width = components(i[both], j[both], len(points))[marked], np.ptp(points, axis=0).max()
    number, points = np.bincount(group)[group], points[marked]
    means: list[np.ndarray] = []
    while number.any() and len(means) < PLACES:
        first = group == group[number.argmax()]
        around = first | (lengths(points - points[first].mean(0)) < LOW * width)
        means.append(points[around & (number > 0)].mean(0))
        number[around] = 0
    digits = 3 - int(np.floor(np.log10(width)))
    found = [(np.round(mean, digits) + 0.0).tolist() for mean in means]  # and no −0
    return tuple(map(tuple, found))
