"""What became of every point's stencil, to be looked at before the operator is trusted."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.fits.rules import reference
from torchlb.stencils.rows import Reason, Rows

__all__ = ["StencilReport"]


@dataclass(frozen=True)
class StencilReport:
    """Free numbers of each point's stencil (`method.md`, section 4). `print(lb.report)` for a summary.

    Attributes
    ----------
    requested_order : p asked for.
    dim : d of the manifold.
    order : (N,), order of accuracy reached; 0 for a low-order row.
    normal_order : (N,), degree q behind the tangent frame; 0 where it stayed poor.
    num_neighbors : (N,), points of the stencil, itself included.
    growth : (N,), ρ² Σ|w|: the factor of the a-priori error bound.
    condition : (N,), of the scaled weighted Vandermonde matrix; NaN in a low-order row.
    off_diagonal_ratio : (N,), Σ_{j≠i}|w_ij| / |w_ii|; 1 for an M-matrix row.
    rule : (N,), place of the rule for the weights in `WEIGHT_RULES`; their number for a low-order row.
    reason : (N,), why the row is below the requested order, a `Reason`.
    """

    requested_order: int
    dim: int
    order: Int[Tensor, " N"]
    normal_order: Int[Tensor, " N"]
    num_neighbors: Int[Tensor, " N"]
    growth: Float[Tensor, " N"]
    condition: Float[Tensor, " N"]
    off_diagonal_ratio: Float[Tensor, " N"]
    rule: Int[Tensor, " N"]
    reason: Int[Tensor, " N"]

    @staticmethod
    def of(rows: Rows, normal_order: Int[Tensor, " N"], requested_order: int) -> StencilReport:
        """Report of an assembled stencil."""
        return StencilReport(
            requested_order,
            rows.gradient.shape[1],
            rows.order,
            normal_order,
            rows.length,
            rows.growth,
            rows.condition,
            rows.off_diagonal_ratio,
            rows.rule,
            rows.reason,
        )

    @property
    def order_counts(self) -> dict[int, int]:
        """Number of points by order reached, highest first, zeros included."""
        counts = torch.bincount(self.order, minlength=self.requested_order + 1).tolist()
        return dict(sorted(enumerate(counts), reverse=True))

    @property
    def reason_counts(self) -> dict[str, int]:
        """Number of points below the requested order, by reason."""
        counts = torch.bincount(self.reason, minlength=len(Reason)).tolist()
        return {reason.text: counts[reason] for reason in Reason if reason and counts[reason]}

    def __str__(self) -> str:
        """Summary of a screenful."""
        total = len(self.order)
        lines = [f"{total} points, order {self.requested_order} requested"]
        for order, count in self.order_counts.items():
            if count:
                name = f"order {order}" if order else "fallback (first order at best)"
                lines.append(f"  {name:<31}{count:>9}  {100 * count / total:6.2f} %")
        if self.reason_counts:
            lines.append("why below the requested order")
            lines += [f"  {text:<38}{count:>9}" for text, count in self.reason_counts.items()]
        stencil = self.order > 0
        if stencil.any():
            lines.append("stencils                      median      95 %       max")
            for name in ("num_neighbors", "growth", "condition", "off_diagonal_ratio"):
                values = getattr(self, name)[stencil].double().sort().values
                middle, high = values[len(values) // 2], values[int(0.95 * (len(values) - 1))]
                lines.append(f"  {name:<22}{middle:12.4g}{high:10.4g}{values[-1]:10.4g}")
            good = reference(self.dim, self.requested_order + 1).growth
            lines.append(f"  (growth of a good stencil of the requested order: {good:.3g})")
        return "\n".join(lines)
