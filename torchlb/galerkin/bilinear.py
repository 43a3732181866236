"""Bilinear forms of functions on elements: what they are, and their densities at the Gauss points."""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.galerkin.assembly import area_element, conductance, gradient_products, squares
from torchlb.galerkin.elements import Element
from torchlb.geometry.vectors import at
from torchlb.linalg.once import computed_again
from torchlb.linalg.precision import rows_at_once


class BilinearForm(NamedTuple):
    """Σ_k c_k w_kᵀA u_k of constant functions w, u (N, C) and numbers c (C,).

    A is K, "stiffness"; M, "mass"; ∫cwu of the potential c, "potential"; the sum of K, that, and the term of a
    condition, "energy"; the boundary mass B, "boundary"; or the mass of the vertices, "lumped". Of "stiffness" with
    components (k, l) `along`, the conductivity is multiplied by Π_kl of the projector onto the tangent plane.
    """

    name: Literal["stiffness", "mass", "potential", "energy", "boundary", "lumped"]
    w: Float[Tensor, "N C"]
    u: Float[Tensor, "N C"]
    c: Float[Tensor, " C"]
    along: tuple[int, int] | None = None


def outer(
    nodes: Int[Tensor, "T n"], values: list[Tensor], c: Float[Tensor, " C"]
) -> Float[Tensor, "T n_times_n"]:
    """Σ_k c_k w_k(i) u_k(j) for all pairs of nodes of each element."""
    one, two = values[0] * c, values[1]
    parts = nodes.split(rows_at_once(nodes.shape[1] * len(c)))
    return torch.cat([computed_again(_outer, one, two, part) for part in parts])


def _outer(one: Tensor, two: Tensor, nodes: Tensor) -> Tensor:
    return (at(one, nodes) @ at(two, nodes).mT).flatten(1)


def weighted_slopes(
    metric: Float[Tensor, "T Q S"],
    element: Element,
    blocks: Float[Tensor, "T n_times_n"],
    conductivity: Tensor | None,
) -> Float[Tensor, "T Q"]:
    """Quadrature weights times Σ_k c_k A∇w_k·∇u_k at the Gauss points."""
    entries = conductance(metric, conductivity).unbind(-1)
    crosses = gradient_products(element).unbind(1)
    total = [entry * (blocks @ cross.T) for entry, cross in zip(entries, crosses, strict=True)]
    return element.weights * torch.stack(total).sum(0)


def weighted_products(
    metric: Float[Tensor, "T Q S"],
    element: Element,
    blocks: Float[Tensor, "T n_times_n"],
    density: Tensor | None,
) -> Float[Tensor, "T Q"]:
    """Quadrature weights times Σ_k c_k ρ w_k u_k at the Gauss points."""
    found = element.weights * area_element(metric) * (blocks @ squares(element).T)
    return found if density is None else density * found
