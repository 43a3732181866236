"""Tangent frames and normals of a cloud, and the signs of the normals, which tell the two sides of a thin shape apart.

Signs are propagated along a spanning tree (Hoppe et al. 1992). Across an edge a surface is taken for an arc: the normal
at one end is the mirror image of that at the other in the plane that bisects the edge. So the sign is carried round a
crease, where the normals turn, and straight through a thin sheet, whose two sides face away from each other.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

from torchlb.errors import first_few, warn
from torchlb.fits.polynomials import monomials
from torchlb.fits.weights import window
from torchlb.geometry.compatibility import compatible_neighbors, planes_of
from torchlb.geometry.complex import components, tree_sides
from torchlb.geometry.frames import complete_frames
from torchlb.geometry.thresholds import CREASE, KINK, RING
from torchlb.geometry.vectors import Frames, Near, Points, at, dot
from torchlb.linalg.precision import AT_ONCE, LOW, ROUNDING, TINY

ASTRAY = 3 / 4
"""Share of contradicting neighbours above which a normal is flipped; a half suffices where the field has no side."""


def cloud_frames(points: Points, candidates: Near, dim: int, rounds: int = 3) -> Frames:
    """Initial frames of a cloud: distance-weighted principal components of the nearer half of the candidates.

    Each further round takes the nearest candidates that are compatible by the frames before, so that the other side of
    a thin sheet drops out. The error is O(h) on a smooth surface.
    """
    planes, frames, parts = None, torch.empty(0), candidates.split(AT_ONCE)
    for _ in range(rounds):
        frames = torch.cat([_principal_directions(points, part, planes, dim) for part in parts])
        planes = planes_of(frames)
    return frames


def _principal_directions(
    points: Points, index: Int[Tensor, "B K"], planes: Frames | Points | None, dim: int
) -> Float[Tensor, "B n d"]:
    """Leading eigenvectors of the weighted covariance of the nearer half of the compatible points.

    All points count where the compatible ones are too few for a plane, as at a corner whose neighbours stand across it.
    """
    offset = points[index] - points[index[:, :1]]
    distance = offset.norm(dim=-1)
    good = torch.ones_like(index, dtype=torch.bool)
    if planes is not None:
        good = compatible_neighbors(points, planes, index)
        good |= good.sum(1, keepdim=True) <= dim
    near = good & (good.cumsum(1) <= (index.shape[1] + 1) // 2)
    reach = (distance * near).amax(1, keepdim=True).clamp_min(torch.finfo(distance.dtype).tiny)
    weight = window((distance / reach).clamp_max(1.1)) * near
    weight = weight / weight.sum(1, keepdim=True)
    centered = offset - (weight[..., None] * offset).sum(1, keepdim=True)
    covariance = centered.mT @ (weight[..., None] * centered)
    return torch.linalg.eigh(covariance).eigenvectors[..., -dim:]


def refined_normals(
    points: Points,
    normals: Points,
    candidates: Near,
    centers: Tensor | None = None,
    rounds: int = 1,
) -> Points:
    """Unit normals, at `centers` from quadratics through compatible candidates, with error O(h²); not oriented.

    The quadratics need not pass through the point itself, which lessens the effect of noise on the slope.
    """
    centers = torch.arange(len(points)) if centers is None else centers
    parts = centers.split(AT_ONCE)
    for _ in range(rounds):
        found = [_slopes_removed(points, normals, candidates[part]) for part in parts]
        normals = normals.index_put((centers,), torch.cat(found))
    return normals


def _slopes_removed(points: Points, normals: Points, index: Int[Tensor, "B K"]) -> Tensor:
    """Normals at the first point of each row, turned by the slope of a quadratic through its neighbours."""
    own = normals[index[:, 0]]
    found, _, radius, count = local_polynomials(points, normals, index, 2, weighted=True)
    slope = (found[:, 1:3] @ own[..., None])[..., 0] / radius[:, None]
    turned = normalize(own - (complete_frames(own) @ slope[..., None])[..., 0])
    return torch.where(((count > 7) & (slope.norm(dim=1) < 1))[:, None], turned, own)


def local_polynomials(
    points: Points, planes: Points | Frames, index: Int[Tensor, "B K"], degree: int, weighted: bool
) -> tuple[Tensor, Tensor, Float[Tensor, " B"], Int[Tensor, " B"]]:
    """Polynomials of heights over the plane of the first point of each row, through its compatible points.

    The result is (coefficients of the coordinates over the radius, the constant first; residuals; radius of the
    neighbourhood, ℓ; number of its points). The polynomials need not pass through the point itself.
    """
    offset, own = points[index] - points[index[:, :1]], planes[index[:, 0]]
    frames = complete_frames(own) if planes.ndim == 2 else own
    good = compatible_neighbors(points, planes, index)
    good[:, 0] = True
    distance = offset.norm(dim=-1)
    radius = (distance * good).amax(1).clamp_min(TINY)
    weight = window((distance / radius[:, None]).clamp_max(1.1)) * good if weighted else good
    coords = offset @ frames
    heights = (offset - coords @ frames.mT) * weight[..., None]
    terms = monomials(coords / radius[:, None, None], degree).mT
    terms = torch.cat([torch.ones_like(terms[:, :1]), terms], 1) * weight[:, None]
    square = terms @ terms.mT
    trace = square.diagonal(dim1=-2, dim2=-1).sum(-1)
    square += ROUNDING * trace[:, None, None] * torch.eye(square.shape[-1]).to(square)
    coefficients = torch.linalg.solve(square, terms @ heights)
    return coefficients, heights - terms.mT @ coefficients, radius, good.sum(1)


def nearest_pairs(candidates: Near) -> tuple[Int[Tensor, " P"], Int[Tensor, " P"]]:
    """Pairs (i, j), i < j, of points one of which is among the candidates of the other, each pair once."""
    num_points, size = candidates.shape
    i = torch.arange(num_points).repeat_interleave(size - 1)
    j = candidates[:, 1:].reshape(-1)
    code = (torch.minimum(i, j) * num_points + torch.maximum(i, j)).numpy()
    code.sort()  # takes a tenth of the time of `np.unique`, which hashes
    code = code[np.flatnonzero(np.diff(code, prepend=-1))]
    low, high = map(torch.from_numpy, np.divmod(code, num_points))
    return low[low != high], high[low != high]


def _across(
    points: Points, normals: Points, i: Int[Tensor, " P"], j: Int[Tensor, " P"]
) -> tuple[Float[Tensor, " P"], Bool[Tensor, " P"]]:
    """(cosine between n_j and the mirror image of n_i; whether the edge is the chord of an arc).

    The chord of an arc falls below one tangent plane and rises to the other, if the normals agree. Where it does not,
    the ends may lie on the two sides of a thin sheet.
    """
    edge, ends = at(points, j) - at(points, i), [at(normals, end) for end in (i, j)]
    edge = edge / edge.norm(dim=1, keepdim=True)
    rise_i, rise_j = (dot(edge, end) for end in ends)
    cosine = dot(*ends) - 2 * rise_i * rise_j
    return cosine, cosine * rise_i * rise_j <= 0


def _carried(
    points: Points, normals: Points, candidates: Near
) -> tuple[Float[Tensor, " N"], Int[Tensor, " N"]]:
    """(signs that make normals consistent with that of the root of their component, along a spanning tree; the roots).

    The root is the extreme point of a component (largest last coordinate); the most certain edges enter the tree first.
    """
    pairs = nearest_pairs(candidates)
    cosine, _ = _across(points, normals, *pairs)
    order = (1 - cosine.abs()).argsort(stable=True)
    i, j = (end[order].numpy() for end in pairs)
    turned = tree_sides(i, j, (cosine[order] < 0).numpy(), len(points))
    component = components(i, j, len(points))
    # The extreme point of each component, which a lexicographic order puts last.
    last = np.lexsort((points[:, -1].numpy(), component))
    root = last[np.append(np.diff(component[last]) > 0, True)][component]
    sign = np.where(turned ^ turned[root], -1.0, 1.0)
    return torch.from_numpy(sign).to(points), torch.from_numpy(root)


def mended_normals(
    points: Points, normals: Points, candidates: Near
) -> tuple[Points, Bool[Tensor, " N"]]:
    """(normals of a user with the signs of those around them; points where these have no side).

    Normals that most neighbours contradict are flipped, repeatedly; or signs are propagated along a spanning tree, to
    the side of the majority of a component, if that leaves fewer contradictions, also among normals within 20°. If many
    contradict, and the sides are as even as chance makes them (three deviations), the component faces outward.
    """
    i, j = nearest_pairs(candidates[:, : RING + 1])
    cosine, arc = _across(points, normals, i, j)
    told = (arc & (cosine.abs() >= CREASE)).to(points)
    if not (told * (cosine < 0)).any():
        return normals, torch.zeros(len(points), dtype=torch.bool)
    sign, root = _carried(points, normals, candidates)

    def contradicted(told: Tensor, side: Tensor, group: Tensor) -> Tensor:
        """Share of contradicting pairs at the points of each group."""
        wrong = told * (cosine * side[i] * side[j] < 0)
        total = torch.zeros(2, len(points), dtype=points.dtype)
        for end in (i, j):
            total.index_add_(1, group[end], torch.stack([wrong, told]))
        return (total[0] / total[1].clamp_min(1))[group]

    side, own = torch.ones_like(sign), torch.arange(len(points))
    many = contradicted(told, side, root) > LOW
    for _ in range(RING):
        astray = contradicted(told, side, own) > torch.where(many, 0.5, ASTRAY)
        side = torch.where(astray, -side, side)
    better = torch.ones_like(many)
    for pairs in (told, told * (cosine.abs() >= KINK)):
        better &= contradicted(pairs, sign, root) < contradicted(pairs, side, root)
    votes, number = torch.zeros(2, len(points), dtype=points.dtype).index_add(
        1, root, torch.stack([sign, torch.ones_like(sign)])
    )
    even = (many | better) & (votes.abs() <= 3 * number.sqrt())[root]
    most = torch.where(even, normals[root, -1], votes[root])
    carried = torch.where(most < 0, -sign, sign)
    return normals * torch.where(better | even, carried, side)[:, None], even


def settled_normals(points: Points, normals: Points, candidates: Near) -> tuple[Points, bool]:
    """(normals consistent with their neighbours; whether their side is the user's). Warnings say what was changed."""
    mended, even = mended_normals(points, normals, candidates)
    turned = (((mended * normals).sum(1) < 0) & ~even).nonzero()[:, 0]
    if even.any():
        warn(
            f"normals: the signs at {int(even.sum())} points contradict those of their neighbours, and neither side "
            "has a majority; they are turned outward, as without `normals`: orient them first if the side matters"
        )
    if len(turned):
        warn(
            f"normals: {len(turned)} face the other way than those around them ({first_few(turned)}) and are turned "
            "round, so that neighbours agree"
        )
    return mended, not even.all()
