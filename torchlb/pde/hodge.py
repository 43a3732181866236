"""The Helmholtz–Hodge decomposition of a tangent field on a surface (`method.md`, section 15)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Int, Shaped
from torch import Tensor

from torchlb.errors import InputError, first_few, warn
from torchlb.galerkin.tangent import WeakGradient
from torchlb.geometry.complex import edges_of
from torchlb.linalg.checks import as_floats, check_operator, check_tensor
from torchlb.linalg.csr import Csr
from torchlb.operator.cleaning import turned_faces
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.operator.medium import elements_of
from torchlb.operator.stencil_methods import check_surface
from torchlb.operator.through import without
from torchlb.pde.solves import solved


@dataclass(frozen=True)
class HodgeParts:
    """v = ∇u + ν × ∇w + h, for a field (N, 3) or (N, 3, C) on a surface with normals ν.

    Attributes
    ----------
    gradient, rotated, harmonic
        ∇u, which has no curl; ν × ∇w, which has no divergence; the rest h, with neither; each of the shape of v.
    potential, stream
        u and w, (N,) or (N, C), units of v by ℓ. Their means are zero on every component; with a boundary w is zero
        along it instead.
    """

    gradient: Tensor
    rotated: Tensor
    harmonic: Tensor
    potential: Tensor
    stream: Tensor


def hodge_decomposition(
    lb: LaplaceBeltrami, v: Shaped[Tensor, "N n C"] | Shaped[Tensor, "N n"]
) -> HodgeParts:
    """The gradient, the rotated gradient and the harmonic part of the tangential part of v; they add up to it.

    ∇u is closest to v, and so is ν × ∇w, in the mean square of the prolonged fields: two Poisson solves, and two more
    for what they leave. At the vertices they are the fields whose prolongation is closest to theirs, and orthogonal in
    ``lb.connection.mass_matrix``, up to the fourth power of its error. With a boundary, whatever the condition of the
    operator is, u is free and w zero along it; h is then tangent to it. On spheres and disks h is the error of the
    other two. A surface needs two sides, and at most two triangles at an edge: a warning names the points where it is
    otherwise, as the rotated part is wrong there, and on a one-sided surface everywhere.

    Differentiable in v. Raises InputError for another shape, for operators in a medium, of batches, and for those that
    are not of surfaces in R³.

    >>> from torchlb.surfaces import Sphere
    >>> lb = LaplaceBeltrami.from_mesh(*Sphere().mesh(500))
    >>> parts = hodge_decomposition(lb, lb.gradient(lb.points[:, 2]))
    >>> bool((parts.potential - lb.points[:, 2]).abs().max() < 1e-3)
    True
    """
    check_operator(lb)
    check_tensor(v, "v")
    v = as_floats(v, lb.dtype)
    check_surface(lb, "hodge_decomposition")
    if lb.sizes is not None or lb._in_medium:
        raise InputError(
            "hodge_decomposition: expected one shape without a medium; lb.unbatch() has those of a batch"
        )
    _warn_of_seams(lb.faces.cpu(), lb.num_points)
    columns = v[..., None] if v.ndim == 2 else v
    fields, boundary, found = _constant(lb.connection), lb._boundary_points(), []
    c = fields.components(columns.double())
    elements, normals = elements_of(lb), lb.normals.detach().cpu().double()
    free = _constant(lb)
    held = _constant(lb, boundary) if bool(boundary.any()) else free
    for turned, functions in ((None, free), (normals, held)):
        form, part, total = WeakGradient.of(elements, turned), torch.zeros_like(c), 0.0
        for _ in range(
            2
        ):  # what the first leaves at the vertices has a part, too, of the error of the prolongation
            u = solved(functions, form.divergence(fields.vectors(c - part).cpu()).to(c))
            slope = fields.components(form.gradient(u.cpu()).to(c))
            total, part = total + u, part + solved(fields, slope, torch.zeros_like(slope[0]))
        found.append((total, part))
    (u, gradient), (w, rotated) = found
    parts = [fields.vectors(x) for x in (gradient, rotated, c - gradient - rotated)]
    results = [without(lb, x, "Hodge parts").to(v) for x in (*parts, u, w)]
    return HodgeParts(*(x if v.ndim == 3 else x[..., 0] for x in results))


def _warn_of_seams(faces: Int[Tensor, "F 3"], count: int) -> None:
    """Warn of edges across which a surface has no sides, or at which more than two triangles meet."""
    faces = torch.where(turned_faces(faces)[:, None], faces.flip(1), faces)
    edges = edges_of(faces.numpy(), count)
    seam = np.concatenate([edges.twins[0][edges.against], np.flatnonzero(edges.uses[edges.of] > 2)])
    points = np.unique([end[seam] for end in edges.ends])
    if len(points):
        warn(
            f"hodge_decomposition: at {len(points)} points ({first_few(points)}) the surface has no two sides, or more "
            "than two triangles meet; the rotated part is wrong there, and on a one-sided surface everywhere"
        )


def _constant(lb: Any, held: Tensor | None = None) -> Any:
    """The pair of an operator without its condition, media and gradients; functions are zero where they are held."""
    own = lb._alias()
    own._cache, own._carries = None, False
    own.points, own.frames, own.mass = lb.points.detach(), lb.frames.detach(), lb.mass.detach()
    own._on_boundary = lb._on_boundary[:0] if held is None else held
    own.options = {**lb.options, "condition": "dirichlet"}
    near = lb.weak.linear
    near = Csr(near.crow, near.col, near.values[:2]) if near.num_rows else None
    own.weak = type(lb.weak)(lb.weak.crow, lb.weak.col, lb.weak.values[:2].detach(), near)
    return own
