"""Stencil weights (`method.md`, section 2): derivatives at the centre of a fit, all by one factorisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.fits.polynomials import functionals, monomial_derivatives, monomials, num_monomials
from torchlb.linalg.once import once_differentiable
from torchlb.linalg.precision import SINGLE

Coords = Float[Tensor, "B neighbors d"]
"""Local coordinates of the neighbours of each centre of a batch, which is the origin and not among them."""
Heights = Float[Tensor, "B neighbors n"]
"""Heights of the neighbours over the tangent planes, ℓ."""


@dataclass(frozen=True)
class Weights:
    """Weights of the gradient, 1/ℓ, and of the Laplacian, 1/ℓ², at the centre of a batch of stencils, centre first.

    `radius` is ρ, ℓ, the distance of the farthest neighbour in local coordinates; `condition` that of `left_inverse`,
    above 1e10, or not finite, without full rank; `residual` the largest violation of the moment equations, in units of
    the largest right-hand side; `height_residual` the scatter of the heights about their fit, relative to the
    distances, 0 without heights; `slope` the degree of the gradient's fit where it has one of its own, else 0.
    """

    gradient: Float[Tensor, "B K d"]
    laplacian: Float[Tensor, "B K"]
    radius: Float[Tensor, " B"]
    condition: Float[Tensor, " B"]
    residual: Float[Tensor, " B"]
    height_residual: Float[Tensor, " B"]
    slope: Int[Tensor, " B"]

    def __getitem__(self, rows: Tensor) -> Weights:
        """The given stencils (a mask, or positions in any order)."""
        rows = rows.nonzero()[:, 0] if rows.dtype == torch.bool else rows
        return Weights(*(getattr(self, f.name).index_select(0, rows) for f in fields(Weights)))

    @staticmethod
    def stack(parts: Sequence[Weights]) -> Weights:
        """Concatenate batches of stencils of one size."""
        return Weights(*(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(Weights)))


def left_inverse(
    values: Float[Tensor, "B K M"], root: Float[Tensor, "B K"]
) -> tuple[Float[Tensor, "B M K"], Float[Tensor, " B"]]:
    """C = (VᵀΩV)⁻¹VᵀΩ, for which Cu are the coefficients of the weighted fit to u, and the condition.

    Modified Gram–Schmidt on √ω V = QR and back substitution give C = R⁻¹Qᵀ√ω, every row as accurate as by Householder's
    QR (`decisions.md`, *Compiled kernels*). Columns that are dependent to the last digit give non-finite results.

    V has K ≥ M rows, in float64; `root` is √ω. The condition is the Frobenius norm ‖R⁻¹‖ for columns of √ω V scaled to
    unit length; ‖R‖ is then between 1 and √M.

    >>> left_inverse(torch.ones(1, 4, 1, dtype=torch.float64), torch.ones(1, 4, dtype=torch.float64))[0].tolist()
    [[[0.25, 0.25, 0.25, 0.25]]]
    """
    return _LeftInverse.apply(values, root)  # pyright: ignore[reportReturnType]


class _LeftInverse(torch.autograd.Function):
    """C and its condition; the condition has no derivative.

    With A = VᵀΩV and H = A⁻¹C̄ derivatives are V̄ = Ω(H(I − VC)ᵀ)ᵀ − Cᵀ(C̄Cᵀ), and the column sums of H(I − VC)ᵀ ∘ Vᵀ
    for ω. As C Ω^{−½} = R⁻¹Qᵀ, it gives A⁻¹ = R⁻¹R⁻ᵀ without another factorisation.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor, root: Tensor) -> tuple[Tensor, Tensor]:  # pyright: ignore[reportIncompatibleMethodOverride]
        inverse, condition = _computed(values, root)
        ctx.save_for_backward(values, root, inverse)
        ctx.mark_non_differentiable(condition)
        return inverse, condition

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor, _: Tensor) -> tuple[Tensor, Tensor]:  # pyright: ignore[reportIncompatibleMethodOverride]
        values, root, inverse = ctx.saved_tensors
        half = torch.where(root[:, None] > 0, inverse / root[:, None], 0.0)
        h = half @ (half.mT @ grad)
        rest = h - (h @ inverse.mT) @ values.mT
        of_values = root[..., None].square() * rest.mT - inverse.mT @ (grad @ inverse.mT)
        return of_values, 2 * root * (rest * values.mT).sum(1)


def _computed(values: Tensor, root: Tensor) -> tuple[Tensor, Tensor]:
    """C and its condition, by compiled loops on the CPU, by the same ones over columns on other devices."""
    if values.device.type == "cpu":
        from torchlb.linalg import kernels

        columns, weights = values.mT.contiguous().numpy(), root.contiguous().numpy()
        inverse, condition = kernels.left_inverse(columns, weights)
        return torch.from_numpy(inverse), torch.from_numpy(condition)
    q = (root[..., None] * values).mT.clone()  # batched QR of CUDA takes one matrix after the other
    lengths, r = q.norm(dim=2), q.new_zeros(len(q), q.shape[1], q.shape[1])
    for j in range(q.shape[1]):
        r[:, j, j] = q[:, j].norm(dim=1)
        q[:, j] /= r[:, j, j, None]
        r[:, j, j + 1 :] = (q[:, j + 1 :] @ q[:, j, :, None])[..., 0]
        q[:, j + 1 :] -= r[:, j, j + 1 :, None] * q[:, j, None]
    inverse = torch.linalg.solve_triangular(r, q, upper=True)
    # rows of R⁻¹Qᵀ are as long as those of R⁻¹
    return inverse * root[:, None], (lengths[..., None] * inverse).norm(dim=(1, 2))


def window(radius: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Weight ω(r) = (1 − (r/1.1)²)⁴ of a neighbour at r = |y|/ρ ∈ [0, 1].

    >>> window(torch.tensor([0.0, 1.1])).tolist()
    [1.0, 0.0]
    """
    return _root_window(radius).square()


def _root_window(radius: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """√ω."""
    return (1 - (radius / 1.1).square()).clamp_min(0).square()


@dataclass(frozen=True)
class CenteredFit:
    """Batch of fits u(y) = u_i + Σ_α y^α Σ_j coefficients[α, j] (u_j − u_i), y in units of the radius ρ, ℓ.

    Coefficients with |α| = 1, divided by the radius, are the weights of the gradient. `values` are the monomials V at
    the neighbours, `root` is √ω.
    """

    coefficients: Float[Tensor, "B M neighbors"]
    radius: Float[Tensor, " B"]
    values: Float[Tensor, "B neighbors M"]
    root: Float[Tensor, "B neighbors"]
    condition: Float[Tensor, " B"]
    degree: int

    @classmethod
    def of(cls, radius: Tensor, values: Tensor, root: Tensor, degree: int) -> CenteredFit:
        """Solve the system of `scaled_system`."""
        coefficients, condition = left_inverse(values, root)
        return cls(coefficients, radius, values, root, condition, degree)

    def residual(self, dim: int) -> Float[Tensor, " B"]:
        """Largest violation of the moment equations of the `dim` first derivatives."""
        wanted = torch.eye(self.values.shape[-1])[:dim].to(self.values)
        return (self.coefficients[:, :dim] @ self.values - wanted).abs().amax((1, 2))

    def lebesgue(self, places: Float[Tensor, "B P d"], degree: int) -> Float[Tensor, " B"]:
        """Lebesgue constant, over these places (ℓ), of the terms up to a degree."""
        kept = self.coefficients[:, : num_monomials(places.shape[2], degree) - 1]
        rows = cardinal(kept, places / self.radius[:, None, None], degree)
        return rows.abs().sum(-1).amax(1)

    def apart(
        self, heights: Heights, graph: Float[Tensor, "B M n"]
    ) -> Float[Tensor, "B neighbors"]:
        """Distances √ω |h − V c| of the heights from the polynomials `graph` fitted to them, ℓ."""
        # a product with few long rows takes half the time of one with few long columns
        left = heights - (graph.mT @ self.values.mT).mT
        return self.root * left.norm(dim=-1)

    def scatter(
        self, heights: Heights, apart: Float[Tensor, "B neighbors"], dim: int
    ) -> Float[Tensor, " B"]:
        """Scatter of the heights about their fit, of which they are `apart`, over root mean square distance.

        It is per degree of freedom; the first `dim` monomials are the coordinates.
        """
        count, terms = self.values.shape[1:]
        flat = self.radius[:, None] * self.values[..., :dim].norm(dim=-1)
        square = flat.square() + heights.norm(dim=-1).square()
        size = max(count - terms, 1) / count * (self.root.square() * square).sum(1)
        return apart.norm(dim=1) / size.sqrt()

    def weights(
        self, weights: Float[Tensor, "B K F"], residual: Tensor, dim: int, heights: Heights | None
    ) -> Weights:
        """Weights in units of length, from those in units of the radius."""
        left, rho = torch.zeros_like(self.radius), self.radius[:, None, None]
        if heights is not None:
            apart = self.apart(heights, self.coefficients @ heights)
            left = self.scatter(heights, apart, dim)
        return Weights(
            gradient=weights[..., :dim] / rho,
            laplacian=weights[..., dim] / rho[..., 0].square(),
            radius=self.radius,
            condition=self.condition,
            residual=residual,
            height_residual=left,
            slope=torch.zeros_like(left, dtype=torch.int64),
        )


def scaled_system(
    coords: Coords, degree: int, keep: Bool[Tensor, "B neighbors"] | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """Radius ρ of the kept neighbours, the monomials V of y/ρ, and √ω."""
    distance = coords.norm(dim=-1)
    radius = (distance if keep is None else distance * keep).amax(-1)
    root = _root_window(distance / radius[:, None])
    values = monomials(coords / radius[:, None, None], degree)
    return radius, values, root if keep is None else root * keep


def centered_fit(
    coords: Coords, degree: int, keep: Bool[Tensor, "B neighbors"] | None = None
) -> CenteredFit:
    """Fits of degree m to K − 1 ≥ M − 1 neighbours; those outside `keep` have zero coefficients.

    >>> line = torch.tensor([[[-1.0], [1.0]]], dtype=torch.float64)
    >>> centered_fit(line, 2).coefficients.round(decimals=12).tolist()
    [[[-0.5, 0.5], [0.5, 0.5]]]
    """
    return CenteredFit.of(*scaled_system(coords, degree, keep), degree)


def cardinal(
    coefficients: Float[Tensor, "B M neighbors"], places: Float[Tensor, "B P d"], degree: int
) -> Float[Tensor, "B P K"]:
    """Cardinal functions of a fit, that of the centre first, at places in units of its radius.

    >>> line = centered_fit(torch.tensor([[[-1.0], [1.0]]], dtype=torch.float64), 2)
    >>> cardinal(line.coefficients, torch.tensor([[[0.5]]], dtype=torch.float64), 2).round(decimals=12).tolist()
    [[[0.75, -0.125, 0.375]]]
    """
    others = monomials(places, degree) @ coefficients
    return torch.cat([1 - others.sum(-1, keepdim=True), others], -1)


def least_squares_weights(
    coords: Coords,
    degree: int,
    flux: Float[Tensor, "B K d"] | None = None,
    share: float | Float[Tensor, "B K"] = 0.0,
    heights: Heights | None = None,
) -> Weights:
    r"""Centre-constrained moving least squares, by coordinates of K − 1 ≥ M − 1 neighbours without the centre.

    For every functional D among the first derivatives and Δ,

    .. math:: \min \sum_{j \ne i} w_j^2 / \omega_j \quad\text{subject to}\quad
              \sum_{j \ne i} w_j y_j^\alpha = (D y^\alpha)(0), \quad 1 \le |\alpha| \le m, \qquad
              w_i = -\sum_{j \ne i} w_j .

    The polynomial passes through the centre's value, so that the operator is stable (`method.md`, section 2). Solved by
    `left_inverse` in coordinates scaled by ρ: w = Cᵀb. Without full rank `condition` is large; nothing is raised.

    `flux` (centre first) is the conormal at each point on a boundary with the datum ∂_ν f + a f = 0, and zero at the
    others; `share` is a, 1/ℓ. Each such point adds an unknown v_b: minimise Σ w²/ω + Σ v²/ω subject to Σ w_j y_j^α +
    Σ v_b (∂_ν + a) y^α(y_b) = (D y^α)(0), and w_i = −Σ w_j − a Σ v_b (`method.md`, section 6). Only w is returned.
    `heights` over the tangent plane, ℓ, are not for systems with `flux`.

    >>> line = torch.tensor([[[-1.0], [1.0]]], dtype=torch.float64)
    >>> least_squares_weights(line, 2).laplacian.round(decimals=12).tolist()
    [[-2.0, 1.0, 1.0]]
    """
    radius, values, root = scaled_system(coords, degree)
    scaled, constant = coords / radius[:, None, None], torch.ones_like(root)
    if flux is not None:
        share = torch.as_tensor(share).to(coords).expand(flux.shape[:2]) * radius[:, None]
        values, constant, root = _with_data(scaled, values, root, flux, share, degree)
    fit = CenteredFit.of(radius, values, root, degree)
    exact = functionals(coords.shape[-1], degree).to(coords)
    rows = exact.mT @ fit.coefficients
    residual = (rows @ values - exact.mT).abs().amax((1, 2)) / exact.abs().max()
    if flux is not None:
        # The data would hide that points on a line, or in one place, do not determine derivatives across it.
        spread = torch.linalg.svdvals(scaled.nan_to_num())
        residual = torch.where(spread[:, -1] <= SINGLE * spread[:, 0], torch.inf, residual)
    center = -(constant[..., None] * rows.mT).sum(1, keepdim=True)
    weights = torch.cat([center, rows.mT[:, : coords.shape[1]]], dim=1)
    return fit.weights(weights, residual, coords.shape[2], heights)


def _with_data(
    scaled: Float[Tensor, "B neighbors d"],
    values: Float[Tensor, "B neighbors M"],
    root: Float[Tensor, "B neighbors"],
    flux: Float[Tensor, "B K d"],
    share: Float[Tensor, "B K"],
    degree: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Append rows (∂_ν + a) y^α for the boundary points of a stencil; return them, their values for 1, and √ω.

    ω = 0 pads stencils with fewer boundary points; `share` is aρ, since coordinates are scaled by ρ.
    """
    nodes = torch.cat([torch.zeros_like(scaled[:, :1]), scaled], dim=1)
    on_boundary = flux.square().sum(-1) > 0
    most = int(on_boundary.sum(1).max()) if len(flux) else 0
    place = on_boundary.byte().argsort(dim=1, descending=True, stable=True)[:, :most]
    nodes, flux = (x.take_along_dim(place[..., None], dim=1) for x in (nodes, flux))
    on_boundary = on_boundary.gather(1, place)
    share = share.gather(1, place) * on_boundary
    data = (monomial_derivatives(nodes, degree) * flux[:, :, None]).sum(-1)
    data = data + share[..., None] * monomials(nodes, degree)
    weight = torch.cat([torch.ones_like(root[:, :1]), root], dim=1).gather(1, place) * on_boundary
    constant = torch.cat([torch.ones_like(root), share], dim=1)
    return torch.cat([values, data], dim=1), constant, torch.cat([root, weight], dim=1)
