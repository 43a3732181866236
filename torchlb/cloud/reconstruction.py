"""Reconstruction of a complex through a cloud, by its dimension and that of the space."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchlb.cloud.complexes import Complex
from torchlb.cloud.curve import cloud_curve
from torchlb.cloud.solid import cloud_solid
from torchlb.cloud.surface import cloud_surface
from torchlb.cloud.tangential import cloud_stars
from torchlb.errors import InputError, first_few


def reconstruct(
    points: Any, dim: int | None = None, *, normals: Any = None, boundary: Any = None
) -> Complex:
    """Complex through a cloud of points, on which `LaplaceBeltrami.from_points` builds.

    Curves become chains of segments (Dey and Kumar 1999), solids Delaunay tetrahedra without those outside (an alpha
    shape), surfaces in R² and R³ triangles by the cocone and the poles of Amenta and Bern (`method.md`, section 12). In
    other shapes every point has the star of its tangent plane (Boissonnat and Ghosh 2014).

    Parameters
    ----------
    points
        (N, n) tensor or array, ℓ, without duplicates.
    dim
        Dimension d of the shape, n − 1 by default.
    normals
        (N, n), if known, to tell the outward side of surfaces in R³ and curves in R².
    boundary
        (N,) mask of points where the shape ends, whatever lies beyond.

    Returns
    -------
    Complex
        For a surface a `CloudSurface`, with normals, local stars in its gaps, and a summary.

    Raises
    ------
    InputError
        If points are not finite, span no shape of this dimension, or are far from all others.

    Examples
    --------
    >>> points = [[0.0, 0.0], [1.0, 0.0], [2.0, 0.1], [3.0, 0.3], [4.0, 0.7]]
    >>> reconstruct(points, dim=1).cells.sort(1).values.tolist()
    [[0, 1], [1, 2], [2, 3], [3, 4]]
    """
    space: Tensor = torch.as_tensor(points).detach().to("cpu", torch.float64)
    if space.ndim != 2:
        raise InputError(f"points: expected shape (N, n), got {tuple(space.shape)}")
    bad = (~space.isfinite()).any(1).nonzero()[:, 0]
    if len(bad):
        raise InputError(f"points: {len(bad)} are NaN or infinite ({first_few(bad)})")
    count, ambient = space.shape
    dim = max(ambient - 1, 1) if dim is None else dim
    if not 1 <= dim <= min(3, ambient) or count < dim + 1:
        raise InputError(
            f"dim: clouds of dimension 1, 2 and 3 have a complex, not {count} points of dimension {dim} in R^{ambient}"
        )
    given = None if normals is None else torch.as_tensor(normals).to("cpu", torch.float64)
    mask = None if boundary is None else torch.as_tensor(boundary).to("cpu")
    if dim == 1:
        return cloud_curve(space, normals=given, boundary=mask)
    if dim == ambient == 3:
        return cloud_solid(space)
    if dim == 3 or ambient > 3:
        return cloud_stars(space, dim)
    return cloud_surface(pad(space, (0, 3 - ambient)), normals=given, boundary=mask)
