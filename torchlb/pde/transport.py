"""Tangent fields: their heat flow, and parallel transport (`method.md`, section 15)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal

import torch
from jaxtyping import Float, Int, Shaped
from torch import Tensor
from torch.nn.functional import normalize

from torchlb.errors import InputError, first_few, warn
from torchlb.geometry.complex import edges_of
from torchlb.linalg.checks import (
    as_floats,
    check_choice,
    check_operator,
    check_sources,
    check_tensor,
    takes_arrays,
)
from torchlb.linalg.precision import LOW, ROOT_EPS, ROUNDING, TINY
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.pde.geodesics import geodesic_distance, logarithmic_map
from torchlb.pde.heat import heat_flow
from torchlb.pde.solves import solved

Transport = Literal["paths", "heat"]

SHORT = 2.0
"""Time of transport over the square of the mean spacing: at half of it the source is hardly resolved."""
FARTHEST = -math.log(torch.finfo(torch.float32).tiny)
"""Largest distance over √t: what has decayed further is zero in float32, in which steps are preconditioned."""


@takes_arrays
def vector_heat_flow(
    lb: LaplaceBeltrami,
    v: Shaped[Tensor, "N n C"] | Shaped[Tensor, "N n"],
    t: float | Tensor,
    *,
    tolerance: float = ROOT_EPS,
) -> Tensor:
    """The tangential part of v after a time t of heat flow by the connection Laplacian, ∂_t v = −∇*∇v.

    Parameters
    ----------
    lb
        Operator of one shape, or of a batch.
    v
        Space vectors, (N, n) or (N, n, C).
    t, tolerance
        As for `heat_flow`.

    Differentiable in v, t, points and medium. Raises InputError for other shapes, and without a weak pair.

    >>> from torchlb.surfaces import Sphere
    >>> lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(500))
    >>> axis = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    >>> v = torch.linalg.cross(axis, lb.points)  # an eigenfield, λ = 1
    >>> bool((vector_heat_flow(lb, v, 0.5) - torch.exp(torch.tensor(-0.5)) * v).abs().max() < 1e-3)
    True
    """
    check_operator(lb)
    fields = lb.connection
    return fields.vectors(heat_flow(fields, fields.components(v), t, tolerance=tolerance))


def parallel_transport(
    lb: LaplaceBeltrami,
    sources: int | Sequence[int] | Int[Tensor, " S"],
    vectors: Shaped[Tensor, " n"] | Shaped[Tensor, "S n"] | Shaped[Tensor, "S n C"],
    *,
    method: Transport | None = None,
) -> Float[Tensor, "N n"] | Float[Tensor, "N n C"]:
    """Vectors at the sources, transported to all points along shortest paths from the nearest source.

    Parameters
    ----------
    lb
        Operator of one shape.
    sources
        Index of a point, or indices of several.
    vectors
        Their space vectors, of which the tangential part counts; with C channels so many fields.
    method
        "paths": a vector keeps its angle with a path, which leaves the source in the direction of `logarithmic_map` and
        arrives in that of the gradient of `geodesic_distance`. On smooth surfaces it is of second order. It is for
        oriented surfaces in space with triangles. "heat": the vector heat method (Sharp, Soliman, Crane 2019), for all
        shapes. The direction is that of an implicit step of the connection Laplacian, the length the ratio of two
        steps of functions. It mixes paths, and is of first order, but differentiable in points and medium; a warning
        names the points where the step is not positive. The step has the operator's condition, which should be
        Neumann's. By default "paths" for such surfaces without a medium or points that require gradients, else "heat".
        In the plane and in solids vectors stay as they are.

    Differentiable in the vectors. Zero where no path leads to a source. Raises InputError for indices out of range,
    vectors of other shapes, and a method that is not for this shape.

    >>> from torchlb.surfaces import Sphere
    >>> lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(500))
    >>> moved = parallel_transport(lb, 0, lb.frames[0, :, 0])
    >>> bool((moved.norm(dim=1) - 1).abs().max() < 1e-12)
    True
    """
    check_operator(lb)
    check_tensor(vectors, "vectors")
    index = check_sources(sources, lb.num_points).to(lb.device)
    vectors = as_floats(vectors, lb.dtype)
    given = vectors[None] if vectors.ndim == 1 else vectors
    if given.ndim not in (2, 3) or given.shape[:2] != (len(index), lb.points.shape[1]):
        raise InputError(
            f"vectors: expected shape (S, n) or (S, n, C) with S = {len(index)}, n = {lb.points.shape[1]}, got "
            f"{tuple(vectors.shape)}"
        )
    columns = given[..., None] if given.ndim == 2 else given
    local = torch.einsum("snd,snc->sdc", lb.frames[index].double(), columns.double())
    moved = _transport(lb, method)(lb, index, local)
    moved = torch.einsum("ind,idc->inc", lb.frames.double(), moved).to(vectors)
    return moved if given.ndim == 3 else moved[..., 0]


def _transport(lb: Any, method: Transport | None) -> Any:
    """The transport of components by a method, or the default one."""
    if method is not None:
        check_choice("method", method, Transport)
    if lb.dim == lb.points.shape[1] and method != "paths":
        return _in_flat_space
    differs = lb._in_medium or lb._carries or lb.points.requires_grad
    if method == "heat" or (method is None and differs):
        return _by_heat
    in_space = lb.dim == 2 and len(lb.normals) > 0 and len(lb.faces) > 0
    if in_space and not edges_of(lb.faces.cpu().numpy(), lb.num_points).against.any():
        return _by_paths
    if method == "paths":
        raise InputError(
            'method: "paths" is for oriented surfaces in space with triangles; "heat" is for all shapes'
        )
    return _by_heat


def _by_paths(lb: Any, index: Tensor, local: Float[Tensor, "S 2 C"]) -> Float[Tensor, "N 2 C"]:
    """Turn the components by the angle from the direction of a path at its source to that at its end."""
    leaving = logarithmic_map(lb, index).double()
    distance = leaving.norm(dim=1)
    nearest = distance.nan_to_num(torch.inf).argmin(1)
    arriving = lb.local_gradient(distance.nan_to_num().square())
    leaving, arriving = (
        torch.complex(*x[torch.arange(len(x)), :, nearest].double().unbind(1))
        for x in (leaving.nan_to_num(), arriving)
    )
    turn = (leaving.conj() * arriving).sgn().index_fill(0, index, 1.0)
    found = turn[:, None] * torch.complex(*local.unbind(1))[nearest]
    return torch.stack([found.real, found.imag], 1)


def _by_heat(lb: Any, index: Tensor, local: Float[Tensor, "S d C"]) -> Float[Tensor, "N d C"]:
    """Components by steps of heat, one of the fields and one of ones at the sources; of several also of lengths."""
    count, dim, width = lb.num_points, *local.shape[1:]
    distance, size = geodesic_distance(lb, index), local.norm(dim=1)
    t = SHORT * lb.mass.double().mean() ** (2 / lb.dim)
    far = (distance[distance.isfinite()].max().double() / (1 - LOW) / FARTHEST).square()
    t = far if bool(far > t) else t  # distances have no derivative in points
    marks = torch.ones_like(size[:, :1])
    if len(index) > 1:
        marks = torch.cat([marks, size], 1)
    spread = size.new_zeros(count, marks.shape[1]).index_add(0, index, marks)
    reached = _step(lb, spread, t)
    cold = ((reached[:, 0] <= 0) & distance.isfinite()).nonzero()[:, 0]
    if len(cold):
        warn(
            f"parallel_transport: at {len(cold)} points ({first_few(cold)}) a step of heat from the sources is not "
            'positive, as on coarse meshes, and vectors may be reversed there; method="paths", where it is possible, '
            "takes no such step"
        )
    start = local.new_zeros(count, dim, width).index_add(0, index, local)
    moved = _step(lb.connection, start.flatten(0, 1), t).unflatten(0, (count, dim))
    lengths = size.amin(0).expand(count, -1)
    if len(index) > 1:
        lengths = reached[:, 1:] / reached[:, :1].clamp_min(TINY)
        lengths = lengths.clamp(size.amin(0), size.amax(0))
    return normalize(moved, dim=1, eps=TINY) * lengths[:, None]


def _in_flat_space(lb: Any, index: Tensor, local: Float[Tensor, "S d C"]) -> Float[Tensor, "N d C"]:
    """The vector of the nearest source."""
    distance = geodesic_distance(lb, index, each=True)
    vectors = torch.einsum("snd,sdc->snc", lb.frames[index].double(), local)
    found = torch.einsum("ind,inc->idc", lb.frames.double(), vectors[distance.argmin(1)])
    return torch.where(distance.amin(1).isfinite()[:, None, None], found, 0.0)


def _step(fields: Any, b: Float[Tensor, "rows C"], t: Float[Tensor, ""]) -> Float[Tensor, "rows C"]:
    """(M + tK)⁻¹b, as exact as rounding allows, since values far away are tiny."""
    return solved(fields, b, t.to(b).expand(b.shape[1]), tolerance=ROUNDING)
