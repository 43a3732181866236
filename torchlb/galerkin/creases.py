"""Tangent fields across creases (`method.md`, section 15).

A field that is prolonged as vectors of space loses across a crease what points out of the planes beside it: the crease
would be a wall. Triangles at creases are therefore flat elements whose corners have the vectors turned into the plane
of the triangle, by the least rotation between the tangent planes. Along an edge the two sides agree then, as parallel
transport has it (Knöppel et al. 2013).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from torch import Tensor

from torchlb.galerkin.assembly import Elements
from torchlb.galerkin.delaunay import sound_lengths
from torchlb.galerkin.elements import edge_lengths
from torchlb.galerkin.forms import Forms, times
from torchlb.galerkin.medium import orthonormal
from torchlb.geometry.complex import consistently_wound
from torchlb.geometry.frames import summed_normals, summed_projectors, vertex_normals
from torchlb.geometry.local_fits import Neighborhoods
from torchlb.geometry.thresholds import LEVEL
from torchlb.geometry.vectors import Frames, Points, at, dot
from torchlb.linalg.precision import TINY


def creased_cells(
    points: Points, cells: Int[Tensor, "F corners"], fits: Sequence[Neighborhoods] = ()
) -> Bool[Tensor, " F"]:
    """Triangles with a corner at a crease, or with one whose fit of functions reaches such a point.

    At a crease the mean squared sine of the angles between two of the planes around, by area, is as at a fold of 45°:
    2 − tr P² > ½ sin² 45°, for the mean P of the projectors onto them. Where the triangles tell the sides of a surface
    in R³ folds beyond 135° are seen by the mean of the normals. None of other cells than triangles.
    """
    if cells.shape[1] != 3 or len(cells) == 0:
        return torch.zeros(len(cells), dtype=torch.bool)
    total = summed_projectors(points, cells)
    size = (total.diagonal(dim1=1, dim2=2).sum(1) / 2).clamp_min(TINY)
    spread = 2 - total.square().sum((1, 2)) / size.square()
    if points.shape[1] == 3 and consistently_wound(cells):
        normal, _ = summed_normals(points, cells)
        spread = spread.maximum(1 - dot(normal, normal) / size.square())
    at_crease = spread > (1 - LEVEL**2) / 2
    reached = at_crease.clone()
    for block in fits:
        reached[block.vertices] |= at_crease[block.points].any(1)
    return reached[cells].any(1)


def across_creases(
    forms: Forms, cells: Int[Tensor, "F corners"], creased: Bool[Tensor, " F"], frames: Frames
) -> Forms:
    """The elements for the derivatives of fields: in the place of the creased cells, flat ones with `turns`."""
    if not creased.any():
        return forms
    gone, curved, share = creased.double(), forms.lots[0], 1.0
    if isinstance(curved.share, Tensor):  # cells that overlap
        share = times(curved.mix.T, curved.share)[creased]
    lots = [
        lot if lot.mix is None else replace(lot, share=lot.share * (1 - times(lot.mix, gone)))
        for lot in forms.lots
    ]
    own, points = cells[creased], forms.places[: len(frames)]
    lengths = sound_lengths(edge_lengths(points, own), own)
    mix: Any = sparse.eye_array(len(cells), format="csr")
    flat = Elements.flat(own, lengths, share=share, mix=mix[creased.cpu().numpy()])
    a = orthonormal(flat.slopes(points)[:, 0]).mT[:, None] @ at(frames, own)
    turns = _nearest(a, _sides(points, cells, frames, own)) @ at(frames, own).mT
    lots.append(replace(flat, turns=turns))
    return replace(forms, lots=lots, linear=replace(forms.linear, share=lots[0].share))


def _sides(
    points: Points, cells: Int[Tensor, "F 3"], frames: Frames, own: Int[Tensor, "T 3"]
) -> Float[Tensor, "T 3"]:
    """1 where the frame at a corner is oriented as the cells are, −1 where it is not, 0 where nothing tells."""
    if points.shape[1] != 3 or not consistently_wound(cells):
        return points.new_zeros(own.shape)
    across = torch.linalg.cross(frames[..., 0], frames[..., 1])
    return dot(across, vertex_normals(points, cells)).sign().detach()[own]


def _nearest(a: Float[Tensor, "T 3 2 2"], side: Float[Tensor, "T 3"]) -> Float[Tensor, "T 3 2 2"]:
    """The rotation (side 1) or reflection (−1) nearest to each matrix, for 0 the nearer of the two.

    Of the projection of one plane into another this is the least rotation of space between them, also beyond a right
    angle if the sides are known.
    """
    xx, xy, yx, yy = a.flatten(2).unbind(2)
    rotation = torch.stack([xx + yy, yx - xy], -1)
    reflection = torch.stack([xx - yy, yx + xy], -1)
    nearer = torch.where(dot(rotation, rotation) >= dot(reflection, reflection), 1.0, -1.0)
    side = torch.where(side == 0, nearer.detach(), side)
    chosen = torch.where((side > 0)[..., None], rotation, reflection)
    c, s = (chosen / dot(chosen, chosen).clamp_min(TINY).sqrt()[..., None]).unbind(-1)
    return torch.stack([torch.stack([c, -side * s], -1), torch.stack([s, side * c], -1)], -2)
