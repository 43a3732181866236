"""The choices that a user makes of an operator, and what follows from those that are left open."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import get_args

from torchlb.errors import InputError
from torchlb.fits.rules import WeightsName
from torchlb.galerkin.pair import ELEMENTS
from torchlb.geometry.frames import Projection
from torchlb.operator.checks import check_options
from torchlb.stencils.conditions import CONDITIONS, PAIRED, Condition, ConditionName


@dataclass(frozen=True)
class Options:
    """The choices that a user makes, as given."""

    order: int
    normal_order: int | None
    projection: Projection
    weights: WeightsName
    num_neighbors: int | None
    condition: ConditionName | None
    weak_form: bool | None
    certify: bool | None

    @property
    def q(self) -> int:
        """Order of the tangent frames: p + 1 unless given."""
        return self.order + 1 if self.normal_order is None else self.normal_order

    @property
    def held(self) -> Condition | None:
        """The condition at the boundary, as what it does to rows."""
        return None if self.condition is None else CONDITIONS[self.condition]

    @property
    def elements(self) -> tuple[int, tuple[int, ...]]:
        """Degree of the elements and degrees of the fits of the weak pair, where there is to be one."""
        return ELEMENTS[min(self.order, max(ELEMENTS))] if self.weak_form else (0, ())

    def settled(self, cells: bool) -> Options:
        """With the choices that were left open: a pair where there can be one, the certificate where there is none."""
        if self.weak_form and not cells:
            raise InputError(
                "weak_form: only meshes, and clouds of curves, of surfaces in R² and R³ and of solids in R³, have one; "
                "leave it out, and the certificate makes the stencil stable instead"
            )
        weak = cells if self.weak_form is None else self.weak_form
        if (
            weak
            and self.held is not None
            and type(self.held) is not PAIRED.get(str(self.condition))
        ):
            raise InputError(
                f"condition: eigenpairs, heat and solves are of the weak pair, which has {list(PAIRED)} alone and "
                f"would ignore {self.condition!r}; weak_form=False builds the stencil, which has it"
            )
        return replace(
            self, weak_form=weak, certify=not weak if self.certify is None else self.certify
        )

    def check(self, num_points: int, ambient_dim: int, dim: int) -> None:
        """InputError for a choice that is none."""
        check_options(
            num_points,
            ambient_dim,
            dim,
            self.order,
            self.normal_order or 0,
            self.num_neighbors,
            projection=(self.projection, [*get_args(Projection)]),
            weights=(self.weights, [*get_args(WeightsName)]),
            condition=(self.condition or "neumann", [*CONDITIONS]),
        )
