"""The operators that code written for DiffusionNet expects: swap one import, keep the rest.

    from diffusion_net.geometry import get_operators      # before
    from torchlb.interop.diffusion_net import get_operators  # after

Names, arguments and the 7-tuple are those of the original (github.com/nmwsharp/diffusion-net, `geometry.py`), whose
data sets find ours after ``diffusion_net.geometry.get_operators = get_operators``.

=====================================================  =============  =====================  =====================
promise of the original                                "cotangent"    a mesh                 a cloud
=====================================================  =============  =====================  =====================
frames (V, 3, 3): rows X, Y, normal, right-handed      kept           kept, order p + 1      kept, order p + 1
mass (V,) > 0, sums to the area                        kept, Voronoi  kept, curved area      kept, curved area
L (V, V) weak, positive semidefinite, rows sum to 0    kept           kept: the stiffness    kept: the stiffness
L symmetric                                            kept           kept                   kept
(L x) / mass is −Δx at a point                         kept           with symmetric=False   with symmetric=False
evals (k,) ≥ 0, ascending, the first is 0              kept, exactly  kept, exactly          kept, exactly
evecs (V, k), evecsᵀ M evecs = I, the first constant   kept           kept; M = diag(mass)   kept; M = diag(mass)
gradX, gradY (V, V): rows sum to 0, components in      kept           kept, order p + 1      kept, order p + 1
the rows X, Y of the frames
coalesced COO, type and device of verts                kept           kept                   kept
=====================================================  =============  =====================  =====================

With ``symmetric=False`` L is −ΠΔ of the certified stencil, L / mass the Laplacian at a point at order p. A cloud has
the stiffness of the surface through it.

Intended differences, beside those in `docs/from_diffusion_net.md`: NaN and duplicates in a cloud are errors that say
what to do; normals of a cloud are those of the surface through it, and face out.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchlb.cloud.frames import settled_normals
from torchlb.errors import InputError
from torchlb.geometry.neighbors import nearest_neighbors
from torchlb.geometry.thresholds import NEAREST
from torchlb.io.cache import load_or_build
from torchlb.operator.dispatch import Operator, build_operator
from torchlb.operator.inputs import warn_of_gradients
from torchlb.operator.laplace_beltrami import LaplaceBeltrami

__all__ = ["compute_operators", "get_all_operators", "get_operators"]

Operators = tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]
STEEP = 0.9
"""The X axis of a frame is e₁ in the tangent plane unless the normal is closer to ±e₁ than this cosine."""


def get_operators(
    verts: Tensor,
    faces: Tensor | None,
    k_eig: int = 128,
    op_cache_dir: str | Path | None = None,
    normals: Tensor | None = None,
    overwrite_cache: bool = False,
    truncate_cache: bool = False,
    *,
    operator: Operator = "stencil",
    symmetric: bool = True,
    **options: Any,
) -> Operators:
    """(frames, mass, L, evals, evecs, gradX, gradY) of a mesh or cloud, as the table at the head of this module says.

    Parameters
    ----------
    verts, faces
        (V, 3) tensor, ℓ, and (F, 3) tensor, None or empty for a point cloud. The results are constants (a warning says
        so if verts requires a gradient).
    k_eig
        Number of eigenpairs, 0 for none.
    op_cache_dir, overwrite_cache
        Folder of a cache (`load_or_build`), or None, and whether to compute anew.
    normals
        (V, 3). Made consistent, they orient the frames; on a cloud they are the first guess of the tangent planes.
    truncate_cache
        Argument of the original; without effect, since a file with more pairs serves already.
    operator, symmetric
        "stencil" or "cotangent"; whether L is symmetric, see above.
    **options
        Options of `LaplaceBeltrami.from_mesh` or `from_points`, such as ``order=3``.

    Raises ValueError for bad input.
    """
    verts, faces = torch.as_tensor(verts), None if faces is None else torch.as_tensor(faces)
    cloud = faces is None or faces.numel() == 0
    if verts.ndim != 2 or verts.shape[1] != 3:
        raise InputError(f"verts: expected shape (V, 3), got {tuple(verts.shape)}")
    arguments: dict[str, Any] = {"operator": operator, "progress": False, **options}
    if operator == "stencil" and not symmetric:
        arguments.setdefault("certify", True)
    if cloud and normals is not None:
        arguments["normals"] = normals
    warn_of_gradients(verts, "verts")
    shape = verts.detach().double(), None if cloud else faces
    if op_cache_dir is None:
        lb = build_operator(*shape, **arguments)
    else:
        arguments |= {"cache": op_cache_dir, "k": k_eig, "overwrite": overwrite_cache}
        lb = load_or_build(*shape, **arguments)
    side = None if cloud else normals  # the normals of a cloud's operator are oriented by them
    return _tuple(lb, k_eig, side, symmetric, verts)


def compute_operators(
    verts: Tensor, faces: Tensor | None, k_eig: int, normals: Tensor | None = None, **options: Any
) -> Operators:
    """As `get_operators`, without a cache; `options` are its keywords."""
    return get_operators(verts, faces, k_eig, normals=normals, **options)


def get_all_operators(
    verts_list: Sequence[Tensor],
    faces_list: Sequence[Tensor | None],
    k_eig: int,
    op_cache_dir: str | Path | None = None,
    normals: Sequence[Tensor | None] | None = None,
    **options: Any,
) -> tuple[list[Tensor], ...]:
    """Seven lists with one entry for each shape, in the order of `verts_list`; arguments as for `get_operators`.

    To fill a cache with all cores first: `torchlb.precompute_operators`.
    """
    if len(verts_list) != len(faces_list):
        raise InputError(f"{len(verts_list)} verts, but {len(faces_list)} faces")
    given = [None] * len(verts_list) if normals is None else normals
    found = [
        get_operators(verts, faces, k_eig, op_cache_dir, direction, **options)
        for verts, faces, direction in zip(verts_list, faces_list, given, strict=True)
    ]
    return tuple([operators[i] for operators in found] for i in range(7))


def _tuple(
    lb: LaplaceBeltrami, k_eig: int, normals: Tensor | None, symmetric: bool, like: Tensor
) -> Operators:
    """The seven results for an operator in float64, in the type and on the device of `like`."""
    frames = _frames(lb, normals)
    turn = torch.einsum("vxn,vnd->vxd", frames[:, :2], lb.frames)  # change of tangent basis
    row = lb.stencil.row
    index = torch.stack([row, lb.stencil.col])
    gradient = torch.einsum("exd,de->xe", turn[row], lb.stencil.values[1:])
    place, weak = index, -lb.mass[row] * lb.stencil.values[0]
    if symmetric and lb._has_weak_form:
        place, weak = torch.stack([lb.weak.row, lb.weak.col]), lb.weak.pair[2][0]
    elif symmetric:
        place, weak = torch.cat([index, index.flip(0)], 1), torch.cat([weak, weak]) / 2
    values, vectors = lb.mass.new_zeros(0), lb.mass.new_zeros(lb.num_points, 0)
    if k_eig > 0:
        values, vectors = lb.eigenbasis(k_eig)
        # From orthonormal in M to orthonormal in the diagonal mass by Gram–Schmidt; the first stays constant.
        lower = torch.linalg.cholesky(vectors.mT @ (lb.mass[:, None] * vectors))
        vectors = torch.linalg.solve_triangular(lower, vectors.mT, upper=False).mT
    frames, mass, values, vectors = (t.to(like) for t in (frames, lb.mass, values, vectors))
    x, y = (_coo(index, part, like) for part in gradient)
    return frames, mass, _coo(place, weak, like), values, vectors, x, y


def _frames(lb: LaplaceBeltrami, side: Tensor | None) -> Float[Tensor, "V 3 3"]:
    """Rows X, Y, normal: X is e₁ projected on the tangent plane, or e₂ where e₁ is steep, and Y = normal × X."""
    normal = lb.normals
    if side is not None:
        near = nearest_neighbors(lb.points, min(NEAREST, len(normal)))
        side, known = settled_normals(lb.points, side.detach().cpu().double(), near)
        flip = (normal * side).sum(1, keepdim=True) < 0
        normal = torch.where(flip & known, -normal, normal)
    axis = torch.eye(3, dtype=normal.dtype)[(normal[:, 0].abs() >= STEEP).long()]
    x = torch.nn.functional.normalize(axis - (axis * normal).sum(1, keepdim=True) * normal)
    return torch.stack([x, torch.linalg.cross(normal, x), normal], dim=1)


def _coo(index: Tensor, values: Tensor, like: Tensor) -> Tensor:
    matrix = torch.sparse_coo_tensor(index, values, (len(like),) * 2, check_invariants=False)
    return matrix.coalesce().to(like.device, like.dtype)
