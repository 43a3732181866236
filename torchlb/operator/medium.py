"""The weak pair of an operator in a medium: what a medium may be, and its matrices (`method.md`, section 14)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from scipy import sparse
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
        medium, weak = plain(medium), lb.weak
        elements = elements.in_medium(medium)
        values = {name: elements.values(field) for name, field in medium.items()}
        whole = _stored(elements.matrix, values, weak, elements.given, _boundary(elements, weak))
        linear = None
        if weak.linear.num_rows:
            rest = _channels(weak.linear)
            linear = _stored(elements.near, values, weak.linear, elements.given, rest)
    return PairMatrices(whole.crow, whole.col, whole.values, linear)


def _boundary(elements: Forms, weak: PairMatrices) -> list[Any]:
    """B, and what Robin's condition adds to K, with the prolongation of the elements."""
    fits, numbering = elements.fits, elements.numbering
    if fits is None or not weak.has_boundary:
        return _channels(weak)
    p, root = elements.prolongation, weak.root_of_absorption
    b = boundary_mass(fits.curving, fits.mesh, p, numbering)
    if root is None:
        return [b]
    scale: Any = sparse.diags_array(root[:, 0].cpu().numpy())
    return [b, scale @ b @ scale]


def _channels(pair: Csr) -> list[Any]:
    """B, and what a condition adds to K, of a pair that has them."""
    return [pair.to_scipy(channel) for channel in range(2, min(len(pair.values), 4))]


def _stored(
    matrix: Any, fields: dict[str, list[Tensor]], pair: Csr, given: Tensor, rest: list[Any]
) -> Csr:
    """K and M in a medium from upper triangles, with the `rest`, and what the potential adds to K."""
    kappa, rho, c = (fields.get(name) for name in ("conductivity", "density", "potential"))
    upper = matrix(kappa, rho)
    pattern = Pattern.of(upper, given)
    found = pattern.pair(upper).beside(rest)
    values = found.values
    if c is not None:
        potential = torch.from_numpy(pattern.whole(matrix(None, c).data.imag))
        values = torch.cat([pad(values, (0, 0, 0, 4 - len(values))), potential[None]])
    return Csr(found.crow, found.col, values).to(pair.values)
