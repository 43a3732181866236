"""The decisions behind an operator, and their evaluation at given points.

A `Plan` holds neighbours, degrees, which edges are curved, where the boundary is, and the points of every row: integers
and flags, nothing that has a unit of length. `evaluate` computes the operator by the same functions as a build: at the
points that the plan was made from it gives that operator, at points that moved a little that of the moved shape.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from io import BytesIO
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchlb.errors import DerivativeError, InputError, first_few, renumbered, warn
from torchlb.galerkin.boundary import BoundaryCurves, OnCurves, OnSurface
from torchlb.galerkin.creases import across_creases, creased_cells
from torchlb.galerkin.curving import BoundaryNodesPlan, CurvingPlan
from torchlb.galerkin.elements import edge_lengths, subsets
from torchlb.galerkin.forms import BilinearForm, Forms
from torchlb.galerkin.matrices import PairMatrices
from torchlb.galerkin.medium import Medium
from torchlb.galerkin.nodes import lagrange_nodes
from torchlb.galerkin.pair import PairPlan
from torchlb.galerkin.tangent import in_space
from torchlb.geometry.boundary import BoundaryPlan
from torchlb.geometry.local_fits import FitPlan, Neighborhoods
from torchlb.geometry.numbering import Numbering
from torchlb.geometry.thresholds import CREASE, FACTOR
from torchlb.geometry.vectors import Points
from torchlb.linalg.csr import Csr, Record
from torchlb.linalg.devices import default, moved
from torchlb.linalg.threads import threads_for
from torchlb.operator.report import FIELDS
from torchlb.stencils.assemble import Stencils
from torchlb.stencils.conditions import Condition
from torchlb.stencils.low_order import MeshLowOrder
from torchlb.stencils.options import Options
from torchlb.stencils.rows import Rows, RowsPlan
from torchlb.stencils.shape import Beside, Placed, Shape, ShapePlan
from torchlb.version import __version__

Parts = dict[str, Any]
"""Attributes of an operator by name."""


@dataclass(frozen=True)
class Plan:
    """The decisions behind an operator; points and cells are in the order of `numbering`, which leads to the user's.

    They were made at `points`, (N, n), ℓ, float64. There are plans of frames, normals and boundary, `shape`; of the
    stencils, `rows`, None with a certificate; and of the weak pair, a `PairPlan`, None without. `flips` lead to the
    Delaunay triangles of the low-order rows. `faces`, (F, d + 1), are the user's; `order`, (G,), has the index among
    these of each cell of the plan; `moved` are points of a noisy curve that were moved. `source` and `options` are
    those of the operator. `warned` are the lines of a program that were told of points that moved too far.
    """

    numbering: Numbering
    points: Points
    shape: ShapePlan
    rows: RowsPlan | None
    pair: Any
    flips: list[Tensor]
    faces: Int[Tensor, "F corners"]
    order: Int[Tensor, " G"]
    moved: Int[Tensor, " m"]
    source: str
    options: Options
    warned: set[Any] = field(default_factory=set)

    @cached_property
    def elsewhere(self) -> dict[torch.device, Plan]:
        """The plan on other devices, as long as it is there."""
        return {}

    def on(self, device: torch.device) -> Plan:
        """The plan with its tensors on a device."""
        if device == self.points.device:
            return self
        if device not in self.elsewhere:
            self.elsewhere[device] = moved(self, device)
        return self.elsewhere[device]

    def forms(self, points: Points) -> Forms:
        """The elements of the weak pair at the user's points, in the user's numbering."""
        here = self._sorted(points)
        _, fits = self.shape.at(here)
        forms = self.pair.forms(fits)
        fits.let_go(functions=False)
        return forms.restored(self.numbering, self.order, len(self.faces))

    def bilinear(
        self,
        points: Points,
        forms: Sequence[BilinearForm],
        medium: Medium,
        *,
        tangent: bool = False,
    ) -> Float[Tensor, ""]:
        """The sum of bilinear forms of functions at the user's points, differentiable in points and medium.

        The forms are of tangent fields if `tangent`, given by their components in the frames, (N d, C). Raises
        DerivativeError for a medium on the faces of coarse triangles, which flips mix.
        """
        own = self.on(points.device)
        if own is not self:
            return own.bilinear(points, forms, medium, tangent=tangent)

        @cache  # a function that stands in two forms is one
        def sort(f: Tensor) -> Tensor:
            return self.numbering.sorted(f.view(len(self.points), -1)).view_as(f)

        forms = [form._replace(w=sort(form.w), u=sort(form.u)) for form in forms]
        if any(f.on_faces for f in medium.values()) and bool(self.pair.curving.coarse.any()):
            raise DerivativeError(
                "points: some triangles are too coarse to be curved, and the medium on the faces is mixed there in a "
                "way that is not differentiated in the points; give it at the vertices"
            )
        order = self.numbering.given, self.order
        medium = {n: f._replace(values=f.values[order[f.on_faces]]) for n, f in medium.items()}
        placed, fits = self.shape.at(self._sorted(points))
        if not tangent:
            return self.pair.bilinear(fits, forms, medium)
        own = self.pair.curving.nodes.faces, self.creased(), placed.frames
        forms = in_space(forms, placed.frames)
        return self.pair.bilinear(fits, forms, medium, lambda x: across_creases(x, *own))

    def creased(self) -> Bool[Tensor, " G"]:
        """Cells at a crease of the shape that the plan was made of, for the derivatives of tangent fields."""
        points = self.numbering.sorted(self.points)
        return creased_cells(points, self.pair.curving.nodes.faces, self.pair.fits.functions)

    def rows_at(self, points: Points, mass: Float[Tensor, " N"]) -> list[Tensor]:
        """Values of Δ and of the derivatives in the frames, (1 + d, nnz), frames; normals and shape operators, if any.

        Differentiable in points and mass, but for a turn of each frame in its plane.
        """
        own = self.on(points.device)
        if own is not self:
            return own.rows_at(points, mass)
        placed, _ = self.shape.at(self._sorted(points))
        rows, _ = self._rows(placed, self.numbering.sorted(mass))
        found = [placed.frames]
        if placed.normals is not None:
            found += [placed.normals, shape_operators(placed, rows, self.shape.fits.order)]
        rows = rows.restored(self.numbering)
        values = torch.cat([rows.laplacian[None], rows.gradient.T])
        return [values, *(self.numbering.restored(each) for each in found)]

    def _rows(self, placed: Placed, areas: Float[Tensor, " N"]) -> tuple[Rows, Shape]:
        """Evaluate the rows of the stencils, and the shape that they are of."""
        if self.rows is None:
            raise InputError(
                "points: an operator with a certificate, which says something of these points alone, has no plan for "
                "others; build it again"
            )
        cells, options = self.shape.cells, self.options.taken(self.numbering)
        shape = Shape(
            **vars(placed),
            neighborhoods=None,
            mass=areas,
            low_order=MeshLowOrder(placed.points, cells, self.flips, self.shape.shares),
            condition=options.held or Condition(),
            on_mesh=self.source == "mesh" and cells.shape[1] == 3,
        )
        return Stencils(shape, options).evaluated(self.rows), shape

    def _sorted(self, points: Points) -> Points:
        if len(self.moved):
            raise InputError(
                f"points: {len(self.moved)} of the cloud were put elsewhere when the curve through it was found, since "
                "they are noisy, and there is no plan of that; build the operator again"
            )
        return self.numbering.sorted(points)


def evaluate(plan: Plan, points: Points) -> Parts:
    """An operator by its plan at points, float64, on their device; InputError with a certificate or moved points."""
    own = plan.on(points.device)
    with renumbered(own.numbering.given), threads_for(len(points)), default(points.device):
        placed, fits = own.shape.at(own._sorted(points))
        pair_plan, pair, mass = own.pair.at(fits, own.numbering, plan.warned)
        rows, shape = own._rows(placed, mass)
        parts = operator_parts(own, points, rows, shape, pair)
    if pair_plan is not own.pair:
        lowered = pair_plan.lowered.to(plan.points.device)
        plan = replace(plan, pair=replace(plan.pair, lowered=lowered))
    return parts | {"_plans": [plan]}


def operator_parts(
    plan: Plan, points: Points, rows: Rows, shape: Shape, pair: PairMatrices | None, **others: Any
) -> Parts:
    """What an operator stores, from rows and a shape in the order of the plan; points and pair are in the user's."""
    numbering, options = plan.numbering, plan.options
    given, bending = numbering.restored, points.new_zeros(0, 0, 0)
    if shape.normals is not None:
        bending = given(shape_operators(shape, rows, plan.shape.fits.order))
    rows = rows.restored(numbering)
    counts = rows.length.new_zeros(4, len(points))
    counts = counts if plan.pair is None else plan.pair.counts[:, numbering.here]
    report = {"num_neighbors": rows.length, "normal_order": given(plan.shape.fits.order)}
    report |= vars(rows) | dict(zip(FIELDS[-4:], counts, strict=True))
    values = torch.cat([rows.laplacian[None], rows.gradient.T])
    parts = others | {
        "source": plan.source,
        "options": {} if plan.source == "cotangent" else options.plain,
        "_plans": [None if plan.pair is None else plan],
        "points": points,
        "faces": plan.faces,
        "mass": given(shape.areas),
        "frames": given(shape.frames),
        "normals": points[:0] if shape.normals is None else given(shape.normals),
        "_shape_operators": bending,
        "stencil": Csr.with_transpose(rows.crow, rows.col, values),
        "_record": Record({name: report[name] for name in FIELDS}),
    }
    if shape.boundary is not None and shape.boundary.mask.any():
        parts["_on_boundary"] = given(shape.boundary.mask)
    if pair is not None:
        if options.held is not None and "_on_boundary" in parts:
            a = options.held.absorption(parts["_on_boundary"])
            pair = pair if a is None else pair.absorbing(points, plan.faces, a)
        parts["weak"] = pair
    return parts


def shape_operators(placed: Placed, rows: Rows, order: Int[Tensor, " N"]) -> Float[Tensor, "N d d"]:
    """Those of the fits; where these are of an order below 2, derivatives of the normals by the rows of ∇."""
    found, normals = placed.shape_operators, placed.normals
    assert found is not None
    assert normals is not None
    rough = (order < 2).nonzero()[:, 0]
    if len(rough) == 0:
        return found
    some = rows[rough]
    own, near = normals[rough][some.row], normals[some.col]
    # a neighbour's normal on the side of that of the row: surfaces without sides have curvatures, too
    near = torch.where(((own * near).sum(1) < -CREASE)[:, None], -near, near)
    slopes = normals.new_zeros(len(rough), normals.shape[1], found.shape[1])
    slopes = slopes.index_add(0, some.row, near[..., None] * some.gradient[:, None])
    slopes = placed.frames[rough].mT @ slopes
    return found.index_copy(0, rough, (slopes + slopes.mT) / 2)


def check_fit(plan: Plan, after: Points) -> None:
    """Warn, once a line of a program, of edges that changed by more than `FACTOR`; InputError for inverted cells."""
    here = plan.on(after.device)
    before, cells = here.points, here.faces
    edges = cells[:, torch.tensor(subsets(cells.shape[1] - 1, 2))]
    one, two = (edge_lengths(x, cells) for x in (before, after))
    stretch = torch.where(one > 0, two / one, 1.0)
    change = stretch / stretch.median()
    if len(changed := edges[(change > FACTOR) | (change < 1 / FACTOR)].unique()):
        warn(
            f"at: {len(changed)} points ({first_few(changed)}) have edges that grew or shrank by more than "
            f"{FACTOR:.0f} times against the others since neighbours, degrees and cells were decided; build the "
            "operator of these points anew",
            once=plan.warned,
        )
    if cells.shape[1] == before.shape[1] + 1:
        corners = torch.stack([before, after])[:, cells]
        turned = torch.linalg.det(corners[:, :, 1:] - corners[:, :, :1]).sign().prod(0)
        if len(inverted := cells[turned * turned.sum().sign() < 0].unique()):
            raise InputError(
                f"points: cells at {len(inverted)} of them ({first_few(inverted)}) are turned inside out; smaller "
                "steps, or other cells, are needed"
            )


PARTS = [
    *(Plan, Options, Numbering, ShapePlan, Beside, RowsPlan, PairPlan, CurvingPlan, lagrange_nodes),
    *(BoundaryNodesPlan, OnCurves, BoundaryCurves, OnSurface, BoundaryPlan, FitPlan, Neighborhoods),
]
"""Classes and functions that a packed plan is made of."""


def packed(plans: Sequence[Plan | None]) -> Tensor:
    """The plans as bytes, (B,), on the CPU."""
    plain = [p and replace(p, options=Options(**p.options.plain), warned=set()) for p in plans]
    file = BytesIO()
    torch.save((__version__, plain), file)
    return torch.frombuffer(bytearray(file.getvalue()), dtype=torch.uint8)


def unpacked(data: Tensor) -> list[Plan | None]:
    """Inverse of `packed`, which runs no code from the data; InputError for those of another version."""
    with torch.serialization.safe_globals(PARTS):
        version, plans = torch.load(BytesIO(data.cpu().numpy().tobytes()), weights_only=True)
    if version != __version__:
        raise InputError(
            f"plan: it was made by torchlb {version}, and torchlb {__version__} does not read it; build the operator "
            "again"
        )
    return plans
