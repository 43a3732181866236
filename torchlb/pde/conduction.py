"""An operator with the stiffness of div κ∇, for the solves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from scipy import sparse
from torch import Tensor

from torchlb.errors import InputError, first_few
from torchlb.galerkin.forms import Forms
from torchlb.galerkin.pair import Pattern
from torchlb.linalg.checks import check_tensor
from torchlb.linalg.csr import Csr
from torchlb.linalg.sparse import to_scipy
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.operator.parts import OperatorCache, PairMatrices


@dataclass(frozen=True, eq=False)
class WithConductivity:
    """(K(κ), M) of an operator, with the term that its condition adds to K, and the derivative of K in κ."""

    lb: LaplaceBeltrami
    forms: Forms
    weak: PairMatrices
    cache: OperatorCache

    def __getattr__(self, name: str) -> Any:
        """Return an attribute of the operator that does not depend on κ."""
        return getattr(self.lb, name)

    def slope(
        self, conductivity: Tensor, w: Float[Tensor, "N C"], u: Float[Tensor, "N C"]
    ) -> Tensor:
        """∂/∂κ of Σ_c w_cᵀK(κ)u_c, of the shape of κ."""
        density = self.forms.sensitivity(w.detach().cpu(), u.detach().cpu())
        with torch.enable_grad():
            kappa = conductivity.detach().cpu().double().requires_grad_()
            parts = zip(self.forms.conductivities(kappa), density, strict=True)
            total = torch.stack([(values * slope).sum() for values, slope in parts]).sum()
        return torch.autograd.grad(total, kappa)[0].to(conductivity)


def elements_of(lb: LaplaceBeltrami) -> Forms:
    """The elements of an operator's weak pair, cached with it; InputError for batches and without a weak pair."""
    if lb.cache.elements is None:
        if lb.source == "batch" or not lb.has_weak_form:
            remedy = "solve shape by shape, lb.unbatch()"
            if lb.source != "batch":
                remedy = "build it with its weak pair, from_mesh if there is none of the points"
            raise InputError(f"conductivity: this operator has no elements; {remedy}")
        points = lb.points.detach().cpu().double()
        linear = lb.source == "cotangent"
        made = Forms.linear(points, lb.faces.cpu()) if linear else lb.plan.forms(points)
        lb.cache.elements = made
    return lb.cache.elements


def with_conductivity(lb: LaplaceBeltrami, conductivity: Tensor) -> WithConductivity:
    """The operator with the stiffness of div κ∇, for κ > 0 at the vertices (N,) or on the faces (F,).

    Raises InputError for another shape, values that are not positive, and operators without elements.
    """
    check_tensor(conductivity, "conductivity")
    forms = elements_of(lb)
    kappa = conductivity.detach().cpu().double()
    if kappa.shape not in ((lb.num_points,), (forms.num_faces,)):
        raise InputError(
            f"conductivity: expected one of each vertex, ({lb.num_points},), or face, ({forms.num_faces},), got "
            f"{tuple(kappa.shape)}"
        )
    bad = (~((kappa > 0) & kappa.isfinite())).nonzero()[:, 0]
    if len(bad):
        raise InputError(
            f"conductivity: expected finite, positive values, got {float(kappa[bad[0]]):.3g}, … at {len(bad)} of "
            f"{len(kappa)} vertices or faces ({first_few(bad)})"
        )
    values = forms.conductivities(kappa)
    linear = _with_rest(lb.weak.linear, forms.near(values)) if lb.weak.linear.num_rows else None
    whole = _with_rest(lb.weak, forms.matrix(values))
    weak = PairMatrices(whole.crow, whole.col, whole.values, linear)
    return WithConductivity(lb, forms, weak, OperatorCache(weak.values))


def _with_rest(pair: Csr, matrix: Any) -> Csr:
    """K(κ) with M, and with the term of the condition, which does not depend on κ."""
    shape = pair.num_rows, pair.num_rows
    _, mass, *rest = (to_scipy(pair.crow, pair.col, v.double(), shape) for v in pair.values)
    upper = matrix.real + 1j * sparse.triu(mass, format="csr")
    return Csr(**vars(Pattern.of(upper).pair(upper, *rest))).to(pair.values.device)
