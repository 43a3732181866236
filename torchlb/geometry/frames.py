"""Tangent frames, and coordinates in the tangent plane (`method.md`, section 3).

The *initial* frame E_i (n × d, orthonormal) comes from principal components of the nearest neighbours, or from the
faces around a vertex. A fit of degree q to the heights over it gives the slope ∇H, and [I; ∇H], orthonormalised, is the
frame of order q.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.geometry.complex import seams
from torchlb.geometry.vectors import Frames, Points, at, dot
from torchlb.linalg.once import once_differentiable
from torchlb.linalg.precision import ROUNDING

Projection = Literal["tangent", "normal"]
PROJECTIONS = get_args(Projection)


def mesh_frames(vertices: Points, faces: Int[Tensor, "F v"]) -> Frames:
    """Initial frames of a mesh of d-simplices: at each vertex the plane closest to those of its faces.

    Of a curve in the plane and a surface in space it is orthogonal to the area-weighted mean of the normals. In other
    codimensions, and where normals cancel or faces are wound against each other, it spans the leading eigenvectors of
    the area-weighted mean of the projectors onto the planes. The error is O(h) on a smooth surface.
    """
    count, n = vertices.shape
    frames = vertices.new_zeros(count, n, faces.shape[1] - 1)
    opposed = torch.ones(count, dtype=torch.bool)
    if faces.shape[1] == n <= 3:
        total, bound = summed_normals(vertices, faces)
        length = total.norm(dim=1)
        opposed = seams(faces, count) | ~(length > ROUNDING * bound)
        normal = total[~opposed] / length[~opposed, None]
        own = complete_frames(normal.detach())
        frames[~opposed] = orthonormalized(own - normal[..., None] * (normal[:, None] @ own))
    if opposed.any():
        planes = summed_projectors(vertices, faces)[opposed]
        frames[opposed] = _Leading.apply(planes, faces.shape[1] - 1)  # pyright: ignore[reportArgumentType]
    return frames


def summed_projectors(vertices: Points, faces: Int[Tensor, "F v"]) -> Float[Tensor, "N n n"]:
    """Sums at each vertex of the projectors onto the planes of its faces, weighted by d! times their areas."""
    corners = at(vertices, faces)
    edges = corners[:, 1:] - corners[:, :1]
    if vertices.requires_grad:  # simplices without volume have no weight, and no derivative
        sound = torch.linalg.det(edges.detach() @ edges.detach().mT) > 0
        faces, edges = faces[sound], edges[sound]
    basis, triangle = torch.linalg.qr(edges.mT)
    area = torch.diagonal(triangle, dim1=-2, dim2=-1).prod(-1).abs()
    projector = (area[:, None, None] * (basis @ basis.mT)).repeat_interleave(faces.shape[1], dim=0)
    total = vertices.new_zeros(len(vertices), *projector.shape[1:])
    return total.index_add_(0, faces.reshape(-1), projector)


class _Leading(torch.autograd.Function):
    """Eigenvectors of the largest eigenvalues, with the derivatives of what does not depend on a turn of them."""

    @staticmethod
    def forward(ctx: Any, matrix: Tensor, dim: int) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        values, vectors = torch.linalg.eigh(matrix)
        ctx.save_for_backward(values, vectors)
        ctx.dim = dim
        return vectors[..., -dim:].clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        values, vectors = ctx.saved_tensors
        leading, rest = vectors[..., -ctx.dim :], vectors[..., : -ctx.dim]
        gap = values[..., None, -ctx.dim :] - values[..., : -ctx.dim, None]
        # zero where a frame is not used, as on creases, where the gap may be zero, too
        turn = rest.mT @ grad
        half = rest @ torch.where(turn == 0, 0.0, turn / gap) @ leading.mT
        return (half + half.mT) / 2, None


def orthonormalized(frames: Float[Tensor, "B n d"]) -> Float[Tensor, "B n d"]:
    """Columns orthonormalised by Gram–Schmidt; they are far from dependent.

    >>> orthonormalized(torch.tensor([[[2.0, 1.0], [0.0, 3.0]]])).tolist()
    [[[1.0, 0.0], [0.0, 1.0]]]
    """
    found: list[Tensor] = []
    for column in frames.unbind(-1):
        for other in found:
            column = column - dot(column, other)[..., None] * other
        found.append(column / dot(column, column).sqrt()[..., None])
    return torch.stack(found, -1)


def local_offsets(
    points: Points, frames: Frames, index: Int[Tensor, "B K"], projection: str
) -> Float[Tensor, "B neighbors d"]:
    """Coordinates y of the neighbours in the centre's tangent plane, in its frame; `index` has the centre first.

    `"tangent"`: y = E_iᵀ e, the orthogonal projection of the offset e. `"normal"`: y = (E_kᵀ E_i)⁻¹ E_kᵀ e, the
    projection along the neighbour's normals, as in the note (with its sign corrected). Both give order p; see
    `method.md`, section 3.
    """
    centers, neighbors = index[:, 0], index[:, 1:]
    offset = at(points, neighbors) - at(points, centers)[:, None]
    if projection == "tangent":
        return offset @ at(frames, centers)
    theirs = at(frames, neighbors).mT  # (B, K, d, n)
    product, right = theirs @ frames[centers, None], theirs @ offset[..., None]
    solution, _ = torch.linalg.solve_ex(product, right)  # not finite where planes are orthogonal
    return solution[..., 0]


def local_heights(
    points: Points, frames: Frames, index: Int[Tensor, "B K"], coords: Tensor
) -> Float[Tensor, "B neighbors n"]:
    """Heights e − E_i y of the neighbours over their coordinates y in the centre's tangent plane, as vectors in Rⁿ."""
    offset = at(points, index[:, 1:]) - at(points, index[:, 0])[:, None]
    return offset - coords @ at(frames, index[:, 0]).mT


def complete_frames(normals: Points) -> Frames:
    """Orthonormal frames of the hyperplanes orthogonal to `normals`, of any length but zero."""
    if normals.shape[1] != 3:
        return torch.linalg.qr(normals[..., None], mode="complete")[0][..., 1:]
    steep = normals[:, :1].abs() < normals[:, 2:].abs()
    axis = torch.where(steep, normals.new_tensor([1.0, 0, 0]), normals.new_tensor([0, 0, 1.0]))
    first = torch.linalg.cross(normals, axis)
    return orthonormalized(torch.stack([first, torch.linalg.cross(normals, first)], -1))


def normals_of_frames(frames: Frames) -> Points:
    """Unit normal of each frame with d = n − 1, such that [frame, normal] is right-handed."""
    n = frames.shape[1]
    if n == 3:
        return torch.linalg.cross(*frames.unbind(-1))
    minors = [frames[:, [row for row in range(n) if row != i]].det() for i in range(n)]
    return torch.stack([(-1) ** (n - 1 + i) * minor for i, minor in enumerate(minors)], 1)


def summed_normals(
    vertices: Points, faces: Int[Tensor, "F n"]
) -> tuple[Points, Float[Tensor, " N"]]:
    """(sums of the normals of the faces at every vertex, weighted by (n − 1)! times their areas; bound of its size)."""
    corners = at(vertices, faces)
    edges = corners[:, 1:] - corners[:, :1]
    if vertices.shape[1] == 3:
        normal = torch.linalg.cross(edges[:, 0], edges[:, 1])
    else:
        normal = torch.stack([edges[:, 0, 1], -edges[:, 0, 0]], dim=-1)
    total, size = torch.zeros_like(vertices), torch.zeros_like(vertices[:, 0])
    for corner in faces.T:
        total.index_add_(0, corner, normal)
        size.index_add_(0, corner, edges.norm(dim=-1).prod(1))
    return total, size


def vertex_normals(vertices: Points, faces: Int[Tensor, "F n"]) -> Points:
    """Unit mean of the normals of the faces (segments in R², triangles in R³) at every vertex, weighted by area.

    Counter-clockwise triangles face the viewer, counter-clockwise polygons outward. Zero where the mean vanishes up to
    the rounding of the faces.
    """
    total, size = summed_normals(vertices, faces)
    length = total.norm(dim=1)
    return torch.where((length > ROUNDING * size)[:, None], total / length[:, None], 0.0)
