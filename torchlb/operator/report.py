"""The order that each point's stencil reached, to be read before the operator is trusted."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.cloud.surface import SurfaceSummary
from torchlb.fits.rules import WEIGHT_RULES, reference
from torchlb.geometry.fit_search import REASONS
from torchlb.stencils.rows import Reason


@dataclass(frozen=True, eq=False, repr=False)
class StencilReport:
    """Figures of each point's stencil (`method.md`, section 4). `print(lb.report)` for a summary.

    Attributes
    ----------
    requested_order
        Order p asked for.
    dim
        Dimension d of the manifold.
    order
        (N,), order of accuracy reached; 0 for a low-order row.
    normal_order
        (N,), degree q behind the tangent frame; 0 where it stayed the initial one.
    num_neighbors
        (N,), points of the stencil, its centre included.
    growth
        (N,), ρ² Σ|w|: the factor of the a-priori error bound.
    condition
        (N,), condition number of the scaled weighted Vandermonde matrix; NaN in a low-order row.
    off_diagonal_ratio
        (N,), Σ_{j≠i}|w_ij| / |w_ii|; 1 for an M-matrix row.
    rule
        (N,), index of the weights' rule in `WEIGHT_RULES`; their number for a low-order row.
    reason
        (N,), `Reason` for a row below the requested order.
    fit_degree
        (N,), degree of the surface of the weak pair; 0 where it is left flat.
    fit_reason
        (N,), reason why that degree is not higher, an index in `REASONS`.
    edges, curved_edges
        (N,), number of edges at each vertex, and of curved ones; zero without a weak pair.
    surface
        Summary of the surface through a cloud; None on a mesh.
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
    fit_degree: Int[Tensor, " N"]
    fit_reason: Int[Tensor, " N"]
    edges: Int[Tensor, " N"]
    curved_edges: Int[Tensor, " N"]
    surface: SurfaceSummary | None = None

    @property
    def curved_share(self) -> float:
        """Share of curved edges in the weak pair; 0 where there is none."""
        return float(self.curved_edges.sum() / self.edges.sum().clamp_min(1))

    @property
    def fit_counts(self) -> dict[int, int]:
        """Number of vertices by the degree of their fit, highest first; 0 for those left flat."""
        counts = torch.bincount(self.fit_degree).tolist()
        return {m: counts[m] for m in range(len(counts) - 1, -1, -1) if counts[m]}

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

    @property
    def summary(self) -> dict[str, int | float]:
        """The summary as numbers, with medians and maxima over the stencils, and the growth of a good stencil."""
        reached = int((self.order >= self.requested_order).sum()) if self.requested_order else 0
        numbers: dict[str, int | float] = {
            "points": len(self.order),
            "requested_order": self.requested_order,
            "at_requested_order": reached,
            "low_order": int((self.order == 0).sum()),
        }
        for name, (middle, _, most) in self._quantiles().items():
            numbers |= {f"median_{name}": middle, f"max_{name}": most}
        if self.requested_order:
            numbers["reference_growth"] = reference(self.dim, self.requested_order + 1).growth
        return numbers

    def _quantiles(self) -> dict[str, tuple[float, float, float]]:
        """Median, 95 % quantile and maximum over the stencils, low-order rows excluded."""
        found = {}
        for name in ("num_neighbors", "growth", "condition", "off_diagonal_ratio"):
            values = getattr(self, name)[self.order > 0].double().sort().values
            if len(values):
                places = len(values) // 2, int(0.95 * (len(values) - 1)), -1
                found[name] = tuple(float(values[place]) for place in places)
        return found

    def __repr__(self) -> str:
        """Numbers of points by order reached, and reasons for lower orders, as a text of one screen."""
        total = len(self.order)

        def counted(name: str, count: int) -> str:
            return f"  {name:<31}{count:>9}  {100 * count / total:6.2f} %"

        lines = [f"{total} points, order {self.requested_order} requested"]
        for order, count in self.order_counts.items():
            if count:
                name = f"order {order}" if order else "low order (first at best)"
                lines.append(counted(name, count))
        if self.reason_counts:
            lines.append("why below the requested order")
            lines += [f"  {text:<38}{count:>9}" for text, count in self.reason_counts.items()]
        splines = int((self.rule == list(WEIGHT_RULES).index("polyharmonic")).sum())
        if splines:
            lines.append(counted("weights of polyharmonic splines", splines))
        if quantiles := self._quantiles():
            lines.append("stencils                      median      95 %       max")
            for name, (middle, high, most) in quantiles.items():
                lines.append(f"  {name:<22}{middle:12.4g}{high:10.4g}{most:10.4g}")
            if (good := self.summary.get("reference_growth")) is not None:
                lines.append(f"  (growth of a good stencil of the requested order: {good:.3g})")
        if self.edges.any():
            lines.append(f"weak pair: {100 * self.curved_share:.2f} % of the edges curved")
            for degree, count in self.fit_counts.items():
                lines.append(counted(f"surface of degree {degree}" if degree else "flat", count))
            below = torch.bincount(self.fit_reason, minlength=len(REASONS)).tolist()
            reasons = list(zip(REASONS, below, strict=True))[1:]
            lines += [f"  {text:<39}{count:>8}" for text, count in reasons if count]
        if self.surface is not None:
            lines.append(str(self.surface))
        return "\n".join(lines)


FIELDS = tuple(each.name for each in fields(StencilReport))[2:-1]
"""The figures of each point, the last four of them of the weak pair."""
