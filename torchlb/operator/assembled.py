"""A finished operator before it is stored."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.certified.certificate import Certificate
from torchlb.cloud.surface import SurfaceSummary
from torchlb.galerkin.absorption import absorbing
from torchlb.galerkin.pair import WeakPair
from torchlb.geometry.boundary import boundary_faces
from torchlb.geometry.numbering import Numbering
from torchlb.stencils.conditions import condition_of
from torchlb.stencils.rows import Rows
from torchlb.stencils.shape import Shape


@dataclass(frozen=True)
class AssembledOperator:
    """A finished operator, in the user's numbering; None for what was not asked for or does not exist.

    Attributes
    ----------
    fit_counts
        (4, N), as in `PairPlan.counts`.
    plan
        A `Plan`.
    """

    rows: Rows
    points: Float[Tensor, "N n"]
    frames: Float[Tensor, "N n d"]
    normals: Float[Tensor, "N n"] | None
    normal_order: Int[Tensor, " N"]
    mass: Float[Tensor, " N"]
    on_boundary: Bool[Tensor, " N"] | None
    pair: WeakPair | None
    faces: Int[Tensor, "F v"]
    source: str
    options: dict[str, Any]
    fit_counts: Int[Tensor, "4 N"] | None = None
    certificate: Certificate | None = None
    surface: SurfaceSummary | None = None
    plan: Any = None

    @classmethod
    def of(
        cls,
        rows: Rows,
        shape: Shape,
        pair: WeakPair | None,
        source: str,
        options: dict[str, Any],
        fit_counts: Int[Tensor, "4 N"] | None = None,
        certificate: Certificate | None = None,
    ) -> AssembledOperator:
        """Collect the rows and the pair of a shape."""
        mask = None if shape.boundary is None else shape.boundary.mask
        of_shape = shape.points, shape.frames, shape.normals, shape.normal_order, shape.areas, mask
        faces = torch.zeros(0, shape.frames.shape[-1] + 1, dtype=torch.int64)
        kind = source, options, fit_counts, certificate
        return cls(rows, *of_shape, pair, faces, *kind)

    @property
    def whole_pair(self) -> WeakPair | None:
        """The weak pair with the term that the boundary condition adds to K."""
        condition = condition_of(self.options.get("condition"))
        share = None if condition is None else condition.share
        if self.pair is None or self.on_boundary is None or share is None:
            return self.pair
        at_boundary = torch.zeros_like(self.on_boundary)
        at_boundary[boundary_faces(self.faces).flatten()] = True
        return absorbing(self.pair, share * self.on_boundary.to(self.points), at_boundary)

    def restored(
        self, numbering: Numbering, points: Float[Tensor, "N n"], faces: Int[Tensor, "F v"]
    ) -> AssembledOperator:
        """The operator in the user's numbering, in which points, faces and pair are already."""
        names = "frames", "normals", "normal_order", "mass", "on_boundary"
        tensors = {name: getattr(self, name) for name in names}
        values = {name: numbering.restored(t) for name, t in tensors.items() if t is not None}
        if self.fit_counts is not None:
            values["fit_counts"] = self.fit_counts[:, numbering.here]
        rows = self.rows.restored(numbering)
        return replace(self, **values, rows=rows, points=points, faces=faces)
