"""Geodesic distance by the heat method (Crane, Weischedel, Wardetzky 2013), with the weak pair and the stencil."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float
from scipy import sparse
from torch import Tensor
from torch.nn.functional import normalize

from torchlb.errors import InputError
from torchlb.linalg.factor import cholesky
from torchlb.linalg.sparse import to_scipy
from torchlb.nn.systems import connected, system
from torchlb.operator.laplace_beltrami import LaplaceBeltrami


def geodesic_distance(
    lb: LaplaceBeltrami, sources: int | Sequence[int] | Tensor, *, t: float | None = None
) -> Float[Tensor, " N"]:
    """Distance along the surface to the nearest of the sources, ℓ; infinite where no path leads to one.

    An implicit step of heat from the sources has gradients that point at them along geodesics; the function whose
    gradients have these directions and length one is the distance. Far away the heat is 1e-30, which no iteration
    resolves relative to its maximum: the step is taken with the linear pair, lumped, by its Cholesky factor, whose
    errors are relative to each value, and the direction is that of its logarithm, which is smooth. It is first order in
    the mean spacing near sources and the cut locus, and smoothed there.

    Parameters
    ----------
    lb : operator of one shape, or of a batch with sources in each.
    sources : number of a point, numbers of several, or a mask (N,).
    t : time of the step, ℓ²; the square of the mean edge length by default. Longer is smoother.

    Raises
    ------
    InputError : for no sources, or numbers out of range.

    Examples
    --------
    >>> from torchlb.surfaces import Sphere
    >>> vertices, faces = Sphere().mesh(500)
    >>> distance = geodesic_distance(LaplaceBeltrami.from_mesh(vertices, faces), 0)
    >>> exact = torch.acos((vertices @ vertices[0]).clamp(-1, 1))
    >>> bool((distance - exact).abs().mean() < 0.02)
    True
    """
    points = _sources(lb, sources)
    start = torch.zeros(lb.num_points, dtype=torch.float64, device=lb.values.device)
    start[points] = 1.0
    heat, component = _heat(lb, start, t)
    reached = torch.isin(component, component[points])
    smallest = heat[heat > 0].min()
    direction = normalize(lb.gradient(-heat.clamp_min(smallest).log()).double(), dim=1)
    distance = _potential(lb, direction)
    distance = (distance - _offset(lb, distance, start > 0, component)).clamp_min(0)
    distance[points] = 0.0
    return torch.where(reached, distance, torch.inf).to(lb.values.dtype)


def _sources(lb: LaplaceBeltrami, sources: int | Sequence[int] | Tensor) -> Tensor:
    index = torch.as_tensor(sources, device=lb.values.device)
    if index.dtype == torch.bool and index.shape == (lb.num_points,):
        index = index.nonzero()[:, 0]
    index = index.reshape(-1)
    whole = not (index.is_floating_point() or index.dtype == torch.bool)
    if len(index) == 0 or not whole or bool(((index < 0) | (index >= lb.num_points)).any()):
        raise InputError(
            f"sources: expected numbers of points from 0 to {lb.num_points - 1}, or a mask of them with at least one, "
            f"got {sources!r}"
        )
    return index.long()


def _heat(lb: LaplaceBeltrami, start: Tensor, t: float | None) -> tuple[Tensor, Tensor]:
    """The implicit step of the start, and the component of each point."""
    if lb.has_weak_form:
        crow, col, (stiffness, mass, *_) = lb.linear_pair
        k, m = (to_scipy(crow, col, v.double(), lb.shape) for v in (stiffness, mass))
        lumped = sparse.diags_array(m.sum(axis=1))
    else:
        k, lumped = -lb.to_scipy(), sparse.eye_array(lb.num_points)
    if t is None:
        row, col = _edges(lb)
        t = float((lb.points[row] - lb.points[col]).norm(dim=1).mean()) ** 2
    return cholesky(lumped + t * k).solve(start), connected(lb)[0]


def _offset(lb: LaplaceBeltrami, distance: Tensor, source: Tensor, component: Tensor) -> Tensor:
    """Of every point, the mean over the neighbours of its component's sources of what is too much there."""
    row, col = _edges(lb)
    beside = source[row] & ~source[col]
    row, col = row[beside], col[beside]
    length = (lb.points[row] - lb.points[col]).norm(dim=1).double()
    total, number = torch.zeros(2, int(component.max()) + 1).to(distance)
    total.index_add_(0, component[col], distance[col] - length)
    number.index_add_(0, component[col], torch.ones_like(length))
    return (total / number.clamp_min(1))[component]


def _edges(lb: LaplaceBeltrami) -> tuple[Tensor, Tensor]:
    """Pairs of neighbours: the edges of the mesh, or of the stencils."""
    crow, col = lb.linear_pair[:2] if lb.has_weak_form else (lb.crow, lb.col)
    row = torch.arange(lb.num_points, device=col.device).repeat_interleave(crow.diff())
    return row[row != col], col[row != col]


def _potential(lb: LaplaceBeltrami, field: Float[Tensor, "N n"]) -> Float[Tensor, " N"]:
    """φ with ∫∇φ·∇v = ∫X·∇v for all v: the stencil's gradient of v, its transpose on X in the mass."""
    local = torch.einsum("ind,in->id", lb.frames.double(), field)
    mass = lb.mass.double()
    weighted = lb.mass_matrix.double() @ local if lb.has_weak_form else mass[:, None] * local
    right = torch.stack(
        [
            lb._apply_rows(values.double(), c, transposed=True)
            for values, c in zip(lb.gradient_values, weighted.T.contiguous(), strict=True)
        ]
    ).sum(0)
    right = right if lb.has_weak_form else right / mass
    return system(lb, None, natural=True).solve(right[:, None], 1e-8)[:, 0]
