"""From input to a finished operator: check, shape, stencils, certificate."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchlb.baseline.cotangent import cotangent_laplacian
from torchlb.errors import InputError, warn
from torchlb.geometry.frames import PROJECTIONS
from torchlb.operator.checks import (
    check_boundary,
    check_dimension,
    check_distinct,
    check_faces,
    check_normals,
    check_options,
    check_points,
    check_scale,
    mended_faces,
)
from torchlb.stability.certificate import Certificate
from torchlb.stability.enforce import certify
from torchlb.stencils.assemble import Stencils, assemble
from torchlb.stencils.conditions import CONDITIONS
from torchlb.stencils.rows import Rows, matrix_rows
from torchlb.stencils.shape import Shape, cloud_shape, mesh_shape

__all__ = ["Built", "Options", "build_cloud", "build_cotangent", "build_mesh"]

WEIGHTS = ["least_squares", "polyharmonic"]


@dataclass(frozen=True)
class Options:
    """The choices that a user makes, as given."""

    order: int
    normal_order: int | None
    projection: str
    weights: str
    num_neighbors: int | None
    certify: bool

    @property
    def q(self) -> int:
        """Order of the tangent frames: p + 1 unless given."""
        return self.order + 1 if self.normal_order is None else self.normal_order

    def check(self, num_points: int, ambient_dim: int, dim: int) -> None:
        """ValueError for a choice that is none."""
        check_options(
            num_points,
            ambient_dim,
            dim,
            self.order,
            self.normal_order or 0,
            self.num_neighbors,
            projection=(self.projection, list(PROJECTIONS)),
            weights=(self.weights, WEIGHTS),
        )


@dataclass(frozen=True)
class Built:
    """A finished operator; `geometry.areas` is its mass, and `certificate` is None where none was asked for."""

    rows: Rows
    geometry: Shape
    kind: str
    options: dict[str, Any]
    certificate: Certificate | None


def build_cloud(
    points: Any,
    dim: int | None,
    options: Options,
    *,
    normals: Any,
    boundary: Any,
    condition: str,
    progress: bool,
) -> Built:
    """Operator on a point cloud; arguments as for `LaplaceBeltrami.from_points`."""
    points = check_points(points)
    check_scale(points)
    ambient = points.shape[1]
    d = check_dimension(points, dim, hypersurface=normals is not None)
    options.check(len(points), ambient, d)
    check_distinct(points)
    if condition not in CONDITIONS:
        raise InputError(f"condition: expected one of {list(CONDITIONS)}, got {condition!r}")
    if normals is not None:
        if d != ambient - 1:
            raise InputError(f"normals: only hypersurfaces have them, not dim={d} in R^{ambient}")
        normals = check_normals(normals, points)
    geometry = cloud_shape(
        points,
        d,
        options.q,
        num_neighbors=options.num_neighbors,
        normals=normals,
        boundary=check_boundary(boundary, len(points)),
        condition=CONDITIONS[condition],
        progress=progress,
    )
    built = _finished(geometry, "points", options, progress)
    if not (built.rows.order > 0).any():
        warn(
            f"no point has a stencil, only rows of last resort: do the points lie on a manifold of dimension {d}? "
            "If not, pass its dimension as `dim`; else `report` says what is wrong",
        )
    return built


def build_mesh(
    vertices: Any, faces: Any, options: Options, *, boundary: str | None, progress: bool
) -> Built:
    """Operator on a mesh; arguments as for `LaplaceBeltrami.from_mesh`."""
    vertices = check_points(vertices, "vertices")
    check_scale(vertices)
    faces = check_faces(faces, len(vertices))
    options.check(len(vertices), vertices.shape[1], faces.shape[1] - 1)
    faces = mended_faces(vertices, faces)
    if boundary not in (*CONDITIONS, None):
        raise InputError(f"boundary: expected one of {list(CONDITIONS)} or None, got {boundary!r}")
    geometry = mesh_shape(
        vertices,
        faces,
        options.q,
        num_neighbors=options.num_neighbors,
        condition=None if boundary is None else CONDITIONS[boundary],
        progress=progress,
    )
    return _finished(geometry, "mesh", options, progress)


def build_cotangent(vertices: Any, faces: Any) -> Built:
    """The cotangent operator with its mass; arguments as for `LaplaceBeltrami.from_cotangent`."""
    vertices = check_points(vertices, "vertices")
    check_scale(vertices)
    faces = check_faces(faces, len(vertices))
    if faces.shape[1] != 3:
        raise InputError(f"faces: the cotangent operator needs triangles, got {tuple(faces.shape)}")
    faces = mended_faces(vertices, faces)
    matrix, mass = cotangent_laplacian(vertices, faces)
    geometry = mesh_shape(vertices, faces, 0, condition=None, areas=mass)
    everything: Tensor = torch.arange(len(vertices))
    rows = matrix_rows(matrix, geometry.points, geometry.frames, everything)
    return Built(rows, geometry, "cotangent", {}, None)


def _finished(geometry: Shape, kind: str, options: Options, progress: bool) -> Built:
    """Rows of the shape, certified if asked for."""
    stencils = Stencils(
        geometry,
        options.order,
        projection=options.projection,
        weights=options.weights,
        num_neighbors=options.num_neighbors,
    )
    rows = assemble(stencils, progress=progress)
    if not options.certify:
        return Built(rows, geometry, kind, asdict(options), None)
    rows, mass, certificate = certify(
        rows,
        geometry.areas,
        stencils.rows,
        len(stencils.candidates),
        outflow=not geometry.condition.conserves,
        progress=progress,
    )
    return Built(rows, replace(geometry, areas=mass), kind, asdict(options), certificate)
