"""Build an operator on a point cloud: checks, a complex through the points, the operator on that complex."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchlb.cloud.complexes import Complex
from torchlb.cloud.doubts import (
    on_rim,
    warn_of_buried,
    warn_of_layers,
    warn_of_near_duplicates,
)
from torchlb.cloud.reconstruction import reconstruct
from torchlb.cloud.surface import CloudSurface
from torchlb.errors import InputError, renumbered
from torchlb.galerkin.flips import flipped
from torchlb.geometry.neighbors import nearest_neighbors
from torchlb.geometry.numbering import Numbering
from torchlb.geometry.thresholds import NEAREST
from torchlb.linalg.precision import SINGLE
from torchlb.linalg.threads import threads_for
from torchlb.operator.build import finished, on_cells
from torchlb.operator.checks import (
    check_boundary,
    check_dimension,
    check_distinct,
    check_faces,
    check_normals,
    check_scale,
    mended_faces,
)
from torchlb.operator.inputs import ArrayLike, check_points
from torchlb.operator.options import Options
from torchlb.operator.plan import Parts, Plan, evaluate
from torchlb.operator.storage import OperatorStorage
from torchlb.stencils.conditions import condition_of
from torchlb.stencils.shape import surface_shape

Reconstruction = Callable[[Tensor], ArrayLike | Complex]
"""Function from points, (N, n) float64, to cells through them."""


def build_cloud(
    points: ArrayLike,
    dim: int | None,
    options: Options,
    *,
    normals: ArrayLike | None,
    boundary: ArrayLike | str | None,
    reconstruction: Reconstruction | None,
    progress: bool,
) -> Parts:
    """Build an operator on a point cloud; arguments as for `LaplaceBeltrami.from_points`."""
    points = check_points(points)
    check_scale(points)
    check_distinct(points)
    ambient, found = points.shape[1], None
    if reconstruction is None:
        d = check_dimension(points, dim, hypersurface=normals is not None)
    else:
        found = _given_complex(points, reconstruction, dim)
        d = found.cells.shape[1] - 1
    options.check(len(points), ambient, d)
    where = check_boundary(boundary, len(points))
    held = condition_of(options.condition)
    if where is None and held is not None and not held.conserves:
        raise InputError(
            f"boundary: condition={held!r} holds at boundary points; pass a mask of them, or 'detect'"
        )
    if normals is not None:
        if d != ambient - 1:
            raise InputError(f"normals: only hypersurfaces have them, not dim={d} in R^{ambient}")
        normals = check_normals(normals, points)
    index, progress = torch.arange(len(points)), progress and sys.stderr.isatty()
    numbering = Numbering.along_tree(points) if found is None else Numbering(index, index)
    here = numbering.sorted(points)
    mask = numbering.sorted(where) if isinstance(where, Tensor) else None
    normals = None if normals is None else numbering.sorted(normals)
    with renumbered(numbering.given), threads_for(len(points)):
        if found is None:
            found = reconstruct(here, d, normals=normals, boundary=mask)
        if found.shares is not None and held and not held.conserves and not held.fixes:
            raise InputError(
                f"condition={held!r}: the boundary of a cloud of dimension {d} in R^{ambient} is that of a mask, which "
                "has no measure; 'neumann' and 'dirichlet' can hold there, and from_mesh takes every condition"
            )
        if mask is not None and found.shares is None:
            warn_of_buried(found.cells, mask)
        if isinstance(found, CloudSurface):
            return _on_surface(here, found, options, mask, numbering, progress)
        if d == 1:
            warn_of_near_duplicates(here, nearest_neighbors(here, min(NEAREST, len(here))), 1)
    cells, edge = numbering.given[found.cells], None
    if isinstance(where, Tensor):
        edge = where if found.shares is not None else where & on_rim(cells, len(points))
    places = numbering.restored(found.points)
    rest = options, edge, "points", progress
    return on_cells(points, places, cells, *rest, shares=found.shares)


def _given_complex(
    points: Float[Tensor, "N n"], reconstruction: Reconstruction, dim: int | None
) -> Complex:
    """The complex that a user's function makes of the points, checked."""
    found = reconstruction(points.clone())
    if isinstance(found, CloudSurface):
        return found
    if isinstance(found, Complex) and found.shares is not None:
        return found
    places, cells = (found.points, found.cells) if isinstance(found, Complex) else (points, found)
    places = check_points(places)
    cells = mended_faces(places, check_faces(cells, len(points)))
    if places.shape != points.shape or dim not in (None, cells.shape[1] - 1):
        raise InputError(
            f"reconstruct: expected cells through the {len(points)} points, of dimension {dim or 'any'}, got some of "
            f"shape {tuple(cells.shape)} through {tuple(places.shape)}"
        )
    return Complex(points=places, cells=cells)


def _on_surface(
    points: Float[Tensor, "N n"],
    surface: CloudSurface,
    options: Options,
    boundary: Bool[Tensor, " N"] | None,
    numbering: Numbering,
    progress: bool,
) -> Parts:
    """Build an operator on a cloud in R² or R³ by the surface through it."""
    placed = surface.points[:, : points.shape[1]]
    warn_of_near_duplicates(
        torch.where(surface.lone[:, None], placed, points), surface.neighbors, 2
    )
    if points.shape[1] == 3:
        warn_of_layers(points)
    surface = replace(surface, cells=flipped(surface.points, surface.cells))
    shape = surface_shape(
        points,
        surface,
        options.q,
        num_neighbors=options.num_neighbors,
        boundary=boundary,
        condition=options.held(numbering),
        fit_degrees=options.elements[1],
        progress=progress,
    )
    faces, every = numbering.given[surface.cells], torch.arange(len(surface.cells))
    places = numbering.restored(points), faces, every, every[:0]
    rest = "points", options, numbering, progress
    return finished(shape, surface.cells, places, *rest, surface)


def plan_again(lb: OperatorStorage) -> Plan:
    """Decide on a mesh or a cloud again, from the points of the decisions, faces and options.

    Raises InputError where the result differs: where points of a noisy curve were moved, or where cells through a cloud
    came from normals or from a user's function.
    """
    points, options = lb._decided_points, Options(**lb.options)
    boundary, cells = None if lb.boundary is None else lb.boundary.cpu(), lb.faces.cpu()
    if lb.surface is None and (lb.source == "mesh" or lb.dim < 3 or lb.points.shape[1] == 3):
        built = on_cells(points, points, cells, options, boundary, lb.source, progress=False)
    else:
        rest: Any = dict.fromkeys(("normals", "reconstruction"))
        built = build_cloud(points, lb.dim, options, boundary=boundary, progress=False, **rest)
    ours, theirs = (faces.sort(1).values.numpy() for faces in (built["faces"], cells))
    rows = [torch.from_numpy(np.lexsort(faces.T)) for faces in (ours, theirs)]
    same = np.array_equal(ours[rows[0]], theirs[rows[1]])
    place = torch.empty_like(rows[0]).index_copy(0, *rows)  # index of each face among the user's
    plan, mass = built["_plan"], built["mass"]
    if same:
        plan = replace(plan, faces=cells, order=place[plan.order])
        if not torch.equal(points.to(lb.points), lb.points):  # moved since
            mass = evaluate(plan, lb.points.detach().cpu().double())["mass"]
    rtol = max(SINGLE, torch.finfo(lb.dtype).eps)
    if not same or not torch.allclose(mass, lb.mass.cpu().double(), rtol=rtol, atol=0):
        raise InputError(
            "plan: it was not kept, and what is decided anew by the points alone is not what the operator is of, where "
            "`normals`, `reconstruct`, noise of a curve, rounding or another version had a part; build it again"
        )
    return plan
