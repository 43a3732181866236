"""What is decided about an operator, and what follows from it at given points.

A `Plan` holds neighbours, degrees, which edges are curved, where the boundary is, and the points of every row: integers
and flags, nothing that has a unit of length. `evaluate` makes numbers of it, by the same functions as a build: at the
points that the plan was made from those of the operator, at points that moved a little those of the moved shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchlb.errors import InputError, renumbered
from torchlb.galerkin.forms import Forms
from torchlb.galerkin.pair import BilinearForm, PairPlan
from torchlb.geometry.numbering import Numbering
from torchlb.linalg.threads import threads_for
from torchlb.operator.assembled import AssembledOperator
from torchlb.operator.options import Options
from torchlb.stencils.assemble import Stencils
from torchlb.stencils.conditions import Condition
from torchlb.stencils.low_order import MeshLowOrder
from torchlb.stencils.rows import RowsPlan
from torchlb.stencils.shape import Shape, ShapePlan


@dataclass(frozen=True)
class Plan:
    """What is decided about an operator with a weak pair; points and cells are in the order of `numbering`.

    Attributes
    ----------
    numbering
        From the user's order of the points, and back.
    shape, rows, pair
        Frames, normals and boundary; the stencils, None with a certificate; the weak pair.
    flips
        Those that make the triangles Delaunay which low-order rows are of.
    faces, order
        (F, d + 1), the cells as the user has them, in the user's numbers; (G,), of each of those here its place there.
    on_mesh
        Whether they are given, and not a surface through a cloud.
    moved
        Points of a noisy curve, which were put elsewhere.
    source, options
        As of the operator.
    """

    numbering: Numbering
    shape: ShapePlan
    rows: RowsPlan | None
    pair: PairPlan
    flips: list[Tensor]
    faces: Int[Tensor, "F corners"]
    order: Int[Tensor, " G"]
    on_mesh: bool
    moved: Int[Tensor, " m"]
    source: str
    options: Options

    @property
    def num_points(self) -> int:
        """N."""
        return len(self.numbering.given)

    def forms(self, points: Float[Tensor, "N n"]) -> Forms:
        """The elements of the weak pair at the user's points, in the user's numbers."""
        here = self._sorted(points)
        _, fits = self.shape.at(here)
        return self.pair.forms(fits).restored(self.numbering, self.order, len(self.faces))

    def gradient(
        self, points: Float[Tensor, "N n"], forms: Sequence[BilinearForm]
    ) -> Float[Tensor, "N n"]:
        """The derivative in the user's points of the sum of bilinear forms of functions at the user's points."""
        sort = cache(self.numbering.sorted)  # a function that stands in two forms is one
        forms = [form._replace(w=sort(form.w), u=sort(form.u)) for form in forms]
        with torch.enable_grad():
            x = points.requires_grad_()
            _, fits = self.shape.at(self._sorted(x))
            return torch.autograd.grad(self.pair.bilinear(fits, forms), x)[0]

    def _sorted(self, points: Float[Tensor, "N n"]) -> Float[Tensor, "N n"]:
        if len(self.moved):
            raise InputError(
                f"points: {len(self.moved)} of the cloud were put elsewhere when the curve through it was found, since "
                "they are noisy, and there is no plan of that; build the operator again"
            )
        return self.numbering.sorted(points)


def evaluate(plan: Plan, points: Float[Tensor, "N n"]) -> AssembledOperator:
    """The operator that follows from a plan at these points, float64 on the CPU.

    Raises InputError where stencils are certified, or points of a noisy curve were moved.
    """
    here, options = plan._sorted(points), plan.options
    if plan.rows is None:
        raise InputError(
            "points: an operator with a certificate, which says something of these points alone, has no plan for "
            "others; build it again"
        )
    with renumbered(plan.numbering.given), threads_for(len(points)):
        placed, fits = plan.shape.at(here)
        pair = plan.pair.at(fits, plan.numbering)
        assert pair.mass is not None
        shape = Shape(
            **vars(placed),
            normal_order=plan.shape.fits.order,
            neighborhoods=None,
            areas=pair.mass,
            low_order=MeshLowOrder(fits.points, plan.shape.cells, plan.flips, plan.shape.shares),
            condition=options.held(plan.numbering) or Condition(),
            on_mesh=plan.on_mesh,
        )
        rows = stencils_of(shape, options).evaluated(plan.rows)
    built = AssembledOperator.of(rows, shape, pair, plan.source, options.plain, plan.pair.counts)
    return built.restored(plan.numbering, points, plan.faces)


def stencils_of(shape: Shape, options: Options) -> Stencils:
    """What decides rows, and evaluates them."""
    return Stencils(
        shape,
        options.order,
        projection=options.projection,
        weights=options.weights,
        num_neighbors=options.num_neighbors,
    )
