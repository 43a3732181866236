"""A user's choices for an operator, and the defaults that follow from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, get_args

from torchlb.fits.rules import WeightsName
from torchlb.galerkin.pair import ELEMENTS
from torchlb.geometry.frames import Projection
from torchlb.geometry.numbering import Numbering
from torchlb.operator.checks import check_options
from torchlb.stencils.conditions import Condition, ConditionName, condition_of


@dataclass(frozen=True)
class Options:
    """A user's choices, as passed."""

    order: int
    normal_order: int | None
    projection: Projection
    weights: WeightsName
    num_neighbors: int | None
    condition: ConditionName | Condition | dict[str, Any] | None
    weak_form: bool | None = True
    certify: bool | None = False

    @property
    def q(self) -> int:
        """Order q of the tangent frames: p + 1 by default."""
        return self.order + 1 if self.normal_order is None else self.normal_order

    @property
    def plain(self) -> dict[str, Any]:
        """The options by name, in plain types."""
        condition = condition_of(self.condition)
        return vars(self) | {"condition": condition and condition.plain}

    def held(self, numbering: Numbering) -> Condition | None:
        """The boundary condition, in another numbering of the points; InputError for an invalid one."""
        condition = condition_of(self.condition)
        return condition and condition.taken(numbering.given, len(numbering.given))

    @property
    def elements(self) -> tuple[int, tuple[int, ...]]:
        """Degree of the elements and degrees of the fits of the weak pair; (0, ()) without one."""
        return ELEMENTS[min(self.order, max(ELEMENTS))] if self.weak_form else (0, ())

    def check(self, num_points: int, ambient_dim: int, dim: int) -> None:
        """Raise InputError for an invalid choice."""
        check_options(
            num_points,
            ambient_dim,
            dim,
            self.order,
            self.normal_order or 0,
            self.num_neighbors,
            projection=(self.projection, [*get_args(Projection)]),
            weights=(self.weights, [*get_args(WeightsName)]),
        )
