"""A user's choices for an operator, and the defaults that follow from them."""

from __future__ import annotations

import operator
from dataclasses import dataclass, replace
from typing import Any, get_args

from torchlb.errors import InputError
from torchlb.fits.polynomials import num_monomials
from torchlb.fits.rules import WeightsName
from torchlb.galerkin.pair import ELEMENTS
from torchlb.geometry.frames import Projection
from torchlb.geometry.numbering import Numbering
from torchlb.stencils.conditions import Condition, ConditionName, condition_of


@dataclass(frozen=True)
class Options:
    """A user's choices, as passed."""

    order: int
    normal_order: int | None = None
    projection: Projection = "tangent"
    weights: WeightsName = "least_squares"
    num_neighbors: int | None = None
    condition: ConditionName | Condition | dict[str, Any] | None = "neumann"
    weak_form: bool | None = True
    certify: bool | None = False

    @property
    def q(self) -> int:
        """Order q of the tangent frames: p + 1 by default."""
        return self.order + 1 if self.normal_order is None else self.normal_order

    @property
    def plain(self) -> dict[str, Any]:
        """The options by name, in plain types."""
        return vars(self) | {"condition": self.held and self.held.plain}

    @property
    def held(self) -> Condition | None:
        """The boundary condition; InputError for an invalid one."""
        return condition_of(self.condition)

    def taken(self, numbering: Numbering) -> Options:
        """The options in another numbering of the points."""
        given = numbering.given
        return replace(self, condition=self.held and self.held.taken(given, len(given)))

    @property
    def elements(self) -> tuple[int, tuple[int, ...]]:
        """Degree of the elements and degrees of the fits of the weak pair; (0, ()) without one."""
        return ELEMENTS[min(self.order, max(ELEMENTS))] if self.weak_form else (0, ())

    def check(self, num_points: int, ambient_dim: int, dim: int) -> None:
        """Raise InputError for options out of range, and for fewer points than a stencil has polynomials."""
        for name, allowed in (("projection", Projection), ("weights", WeightsName)):
            if getattr(self, name) not in get_args(allowed):
                raise InputError(
                    f"{name}: expected one of {list(get_args(allowed))}, got {getattr(self, name)!r}"
                )
        numbers = {"dim": dim} | {
            n: getattr(self, n) for n in ("order", "normal_order", "num_neighbors")
        }
        for name, number in numbers.items():
            try:
                operator.index(number or 0)
            except TypeError as error:
                raise InputError(f"{name}: expected an integer, got {number!r}") from error
        if not 1 <= dim <= ambient_dim:
            raise InputError(
                f"dim: expected 1 … {ambient_dim} for points in R^{ambient_dim}, got {dim}"
            )
        if self.order < 1:
            raise InputError(f"order: expected an integer ≥ 1, got {self.order}")
        if self.q < 0:
            raise InputError(
                f"normal_order: expected an integer ≥ 1, or 0 to keep the initial frames, got {self.q}"
            )
        needed, count = num_monomials(dim, self.order + 1), self.num_neighbors
        if count is not None and count < needed:
            raise InputError(
                f"num_neighbors: order {self.order} in {dim} dimensions has {needed} polynomials and needs at least as "
                f"many neighbours (1.6 times as many, {-(-16 * needed // 10)}, is the default); got {count}"
            )
        if count is not None and count > num_points:
            raise InputError(
                f"num_neighbors: {count} are more than the {num_points} points; lower it, or leave it out"
            )
        of_surface = dim == 2 and ambient_dim == 3
        least = min(needed, 4) if of_surface else needed
        if num_points < least:
            what = (
                "a surface in R^3 needs" if of_surface else f"a stencil of order {self.order} needs"
            )
            fits = [p for p in range(1, self.order) if num_monomials(dim, p + 1) <= num_points]
            remedy = f"lower `order` to {max(fits)}" if fits else "add points"
            raise InputError(
                f"{num_points} points are fewer than the {least} that {what}; {remedy}"
            )
