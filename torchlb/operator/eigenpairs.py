"""Derivatives of eigenpairs in points and medium (`method.md`, section 14)."""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad

from torchlb.galerkin.bilinear import BilinearForm
from torchlb.linalg.precision import ROOT_EPS
from torchlb.operator.batching import shapes_of
from torchlb.operator.systems import pair_system
from torchlb.operator.through import known, origins
from torchlb.spectral.eigenbasis import Eigenbasis, unstack_eigenbases

BEYOND = 10
"""Number of pairs beyond those asked for, which keep the solves for derivatives of eigenvectors well-conditioned."""


def through_eigenpairs(lb: Any, whole: Eigenbasis, k: int) -> Eigenbasis:
    """The first k pairs of a basis, differentiable in the variables of the operator.

    Of eigenvectors, what does not depend on the basis of an eigenspace (signatures, filters Φg(Λ)ΦᵀM, projectors) has
    exact gradients; so have symmetric functions of the eigenvalues of a cluster.
    """
    basis = whole.truncate(k)
    if origins(lb) is None:
        return basis
    shapes = shapes_of(lb) or (lb,)
    wholes = unstack_eigenbases(whole)

    def forms(*grads: Tensor) -> list[BilinearForm]:
        sizes = [shape.num_points for shape in shapes]
        values = grads[0].view(len(shapes), -1)
        rows = zip(
            shapes, wholes, values, grads[1].split(sizes), grads[2].split(sizes), strict=True
        )
        parts = [_of_shape(*row) for row in rows]
        most = max(part[0].shape[1] for part in parts)
        w, of_mass, u = (
            torch.cat([pad(part[i], (0, most - part[i].shape[1])) for part in parts])
            for i in range(3)
        )
        one = torch.ones(most, dtype=torch.float64)
        return [BilinearForm("energy", w, u, one), BilinearForm("mass", of_mass, u, one)]

    results = basis.eigenvalues, basis.eigenvectors, basis.left
    values, vectors, left = known(lb, results, forms)
    return Eigenbasis(values, vectors, lb.mass, left, basis.sizes, basis.relative_errors)


def _of_shape(
    lb: Any,
    whole: Eigenbasis,
    of_values: Float[Tensor, " k"],
    of_vectors: Float[Tensor, "N k"],
    of_left: Float[Tensor, "N k"],
) -> tuple[Float[Tensor, "N m"], Float[Tensor, "N m"], Float[Tensor, "N m"]]:
    """Functions w and v with the derivative Σ_i w_iᵀdK φ_i + v_iᵀdM φ_i of a result, and all known φ.

    Inside the span of the m known eigenvectors it takes differences of eigenvalues, broadened where they agree to
    rounding; outside, a solve for each vector (Nelson 1976).
    """
    phi, lam = whole.eigenvectors.double(), whole.eigenvalues.double()
    count = min(of_values.shape[0], len(lam))
    more, own = (0, len(lam) - count), of_values[:count] * phi[:, :count]
    w, v = pad(own, more), pad(-lam[:count] * own, more)
    if not (of_vectors.any() or of_left.any()):
        return w, v, phi
    solver = pair_system(lb)
    left = solver.inside(of_left[:, :count])  # MΦ is zero at Dirichlet points
    v += pad(left, more)
    gradient = of_vectors[:, :count] + solver.mass_product(left)
    inside = pad(phi.T @ gradient, more)  # φ_jᵀḡ_i
    gap = lam - lam[:, None]
    gap = gap / (gap.square() + (ROOT_EPS * lam[-1]) ** 2)
    turning = (inside - inside.T) * gap / 2
    w += phi @ turning
    v -= phi @ (turning * (lam + lam[:, None]) / 2 + (inside + inside.T) / 4)
    free = lb.num_points if lb.fixed is None else int((~lb.fixed).sum())
    if len(lam) >= free:
        return w, v, phi
    outside = solver.solve_beyond(gradient, lam[:count], phi, lam[-1])
    w -= pad(outside, more)
    v += pad(lam[:count] * outside, more)
    return w, v, phi
