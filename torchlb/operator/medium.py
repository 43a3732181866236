"""The weak pair of an operator in a medium: what a medium may be, and its matrices (`method.md`, section 14)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from torchlb.errors import InputError, first_few
from torchlb.galerkin.forms import Forms
from torchlb.galerkin.matrices import PairMatrices
from torchlb.galerkin.medium import Field, Medium
from torchlb.galerkin.pair import Pattern, boundary_mass
from torchlb.linalg.checks import check_tensor
from torchlb.linalg.csr import Csr
from torchlb.linalg.precision import ROOT_EPS, ROUNDING
from torchlb.operator.inputs import ArrayLike
from torchlb.operator.parts import MediumFields
from torchlb.operator.storage import OperatorStorage
from torchlb.stencils.conditions import condition_of

Given = Mapping[str, ArrayLike | float | None]


def elements_of(lb: Any) -> Any:
    """The elements of the weak pair of one shape or its fields, in the user's numbering, cached with the operator."""
    if lb.cache.elements is None:
        points, mass = (x.detach().cpu().double() for x in (lb.points, lb.mass))
        linear = lb.source == "cotangent"
        made = Forms.flat(points, lb.faces.cpu(), mass) if linear else lb.plan.forms(points)
        lb.cache.elements = made
    return lb.cache.elements


def checked_fields(lb: OperatorStorage, given: Given) -> MediumFields:
    """The fields that are given, on the device of the operator, which carry gradients; InputError for bad ones."""
    fields = {name: x for name, x in given.items() if x is not None}
    if not fields:
        raise InputError("with_medium: expected a conductivity, a density or a potential, got none")
    if not lb.weak.num_rows:
        raise InputError("with_medium: this operator has no weak pair; build it with one")
    found = {}
    for name, x in fields.items():
        if not isinstance(x, int | float | np.ndarray):
            check_tensor(x, name)
        dtype = torch.float64 if isinstance(x, int | float) else None
        x = torch.as_tensor(x, dtype=dtype, device=lb.device)
        x = x.expand(lb.num_points) if x.ndim == 0 else x
        n, counts = lb.points.shape[1], (lb.num_points, len(lb.faces))
        tensors = name == "conductivity" and x.shape[1:] == (n, n)
        if len(x) not in counts or not (x.ndim == 1 or tensors):
            more = f", or symmetric space tensors (…, {n}, {n})" if name == "conductivity" else ""
            raise InputError(
                f"{name}: expected one of each vertex, ({counts[0]},), or face, ({counts[1]},){more}, got "
                f"{tuple(x.shape)}"
            )
        _check_values(name, x.detach().cpu().double())
        x = x.clone() if x.is_inference() else x  # a medium may be trained
        found[name] = x.to(lb.points.dtype)
    return MediumFields(found)


def split_fields(batch: Any, shapes: Sequence[Any], given: Given) -> list[dict[str, Any]]:
    """What of the fields of a batch is given to each of its shapes; numbers are given to all of them."""
    found: dict[str, Sequence[Any]] = {}
    counts = {len(batch.faces): [len(shape.faces) for shape in shapes]}
    counts[batch.num_points] = [shape.num_points for shape in shapes]
    for name, x in given.items():
        x = torch.from_numpy(x) if isinstance(x, np.ndarray) else x
        found[name] = [x] * len(shapes)
        if isinstance(x, Tensor) and x.ndim:
            if len(x) not in counts:
                raise InputError(
                    f"{name}: expected one of each vertex or face of the shapes, {' or '.join(map(str, counts))}, got "
                    f"{tuple(x.shape)}"
                )
            if len(x) != batch.num_points and any(len(s.faces) == s.num_points for s in shapes):
                raise InputError(
                    f"{name}: a shape has as many faces as vertices; give the field at the vertices"
                )
            found[name] = x.split(counts[len(x)])
    return [dict(zip(found, row, strict=True)) for row in zip(*found.values(), strict=True)]


def _check_values(name: str, x: Tensor) -> None:
    """Raise InputError unless a field is finite, and positive as it has to be."""
    least, what, bad, remedy = x, "positive", ~(x > 0), ""
    if x.ndim == 3:
        size = x.abs().amax((1, 2))
        skew = (x - x.mT).abs().amax((1, 2)) > ROOT_EPS * size
        safe = torch.where((x.isfinite().all(2).all(1) & ~skew)[:, None, None], x, 0.0)
        least, what = torch.linalg.eigvalsh(safe)[:, 0], "symmetric, positive"
        bad = least <= ROUNDING * size
        remedy = "; tensors of tangent directions alone need nnᵀ, too, n the normal"
    elif name == "potential":
        what, bad = "nonnegative", ~(x >= 0)
        remedy = "; with c + μρ in place of c the eigenvalues are λ + μ"
    if len(bad := (bad | ~least.isfinite()).nonzero()[:, 0]):
        raise InputError(
            f"{name}: expected finite, {what} values, got {x[bad[0]].tolist()}, … at {len(bad)} of {len(x)} vertices "
            f"or faces ({first_few(bad)}){remedy}"
        )


def plain(medium: Medium, device: str | torch.device = "cpu") -> dict[str, Field]:
    """The fields in float64 on a device, as leaves that require a gradient."""
    return {
        name: f._replace(values=f.values.detach().to(device).double().requires_grad_())
        for name, f in medium.items()
    }


def pair_in(lb: OperatorStorage, medium: Medium) -> PairMatrices:
    """The weak pair of one shape in a medium: K and M of its conductivity and density, and C of its potential."""
    elements = elements_of(lb)
    if any(lot.mix is None for lot in elements.lots):
        faces = [name for name, field in medium.items() if field.on_faces]
        if faces:
            raise InputError(
                f"{faces[0]}: some points of this cloud have local triangles beside the faces; give it at the vertices"
            )
    with torch.no_grad():
        medium = plain(medium)
        elements = elements.in_medium(medium)
        values = {name: elements.values(field) for name, field in medium.items()}
        rest = _boundary(elements, lb.weak)
        found = [_matrices(elements.matrix, values, elements.given, rest)]
        if lb.weak.linear.num_rows:
            found.append(_matrices(elements.near, values, elements.given, []))
        (whole, *near), potentials = zip(*found, strict=True)
        pair = PairMatrices(whole.crow, whole.col, whole.values, *near)
        condition = condition_of(lb.condition)
        if condition is not None and len(lb._on_boundary):
            a = condition.absorption(lb._on_boundary.cpu())
            points = lb.points.detach().cpu().double()
            pair = pair if a is None else pair.absorbing(points, lb.faces.cpu(), a)
    parts = [pair, pair.linear][: len(found)]
    parts = [_with_potential(*each) for each in zip(parts, potentials, strict=True)]
    whole, *near = (part.to(lb.weak.values) for part in parts)
    return PairMatrices(whole.crow, whole.col, whole.values, *near)


def _with_potential(pair: Csr, potential: Tensor | None) -> Csr:
    """Matrices of a pair, with what the potential adds to K."""
    values = pair.values
    if potential is not None:
        values = torch.cat([pad(values, (0, 0, 0, 4 - len(values))), potential[None]])
    return Csr(pair.crow, pair.col, values)


def _boundary(elements: Forms, weak: PairMatrices) -> list[Any]:
    """B with the prolongation of the elements, if there is a boundary."""
    fits = elements.fits
    if not weak.has_boundary:
        return []
    if fits is None:
        return [weak.to_scipy(2)]
    return [boundary_mass(fits.curving, fits.mesh, elements.prolongation, elements.numbering)]


def _matrices(
    matrix: Any, fields: dict[str, list[Tensor]], given: Tensor, rest: list[Any]
) -> tuple[Csr, Tensor | None]:
    """K, M and the rest in a medium, from upper triangles; and the matrix of the potential, on the same pattern."""
    kappa, rho, c = (fields.get(name) for name in ("conductivity", "density", "potential"))
    upper = matrix(kappa, rho)
    pattern = Pattern.of(upper, given)
    potential = None if c is None else torch.from_numpy(pattern.whole(matrix(None, c).data.imag))
    return pattern.pair(upper).beside(rest), potential
