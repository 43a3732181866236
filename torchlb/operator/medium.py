"""The plan of an operator, and the elements of its weak pair: made again where they are not at hand."""

from __future__ import annotations

from typing import Any

from torch.utils.weak import WeakIdKeyDictionary

from torchlb.errors import InputError
from torchlb.galerkin.forms import Forms
from torchlb.operator.build import build_cloud, build_mesh
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.operator.options import Options
from torchlb.operator.plan import Plan

_FORMS: Any = WeakIdKeyDictionary()


def plan_of(lb: LaplaceBeltrami) -> Plan:
    """What is decided about an operator; copies and what comes from files decide anew.

    Raises
    ------
    InputError
        For batches, the cotangent operator, and operators with a certificate or without a weak pair.
    """
    if lb.plan is None and lb.source in ("mesh", "points") and lb.has_weak_form:
        points = lb.points.detach().cpu().double()
        settings: Any = {"boundary": lb.boundary, "progress": False}
        if lb.source == "mesh":
            built = build_mesh(points, lb.faces.cpu(), Options(**lb.options), **settings)
        else:
            normals = lb.normals if len(lb.normals) else None
            built = build_cloud(points, lb.dim, Options(**lb.options), normals=normals, **settings)
        lb.plan = built.plan
    if lb.plan is None:
        raise InputError(
            f"plan: an operator of kind {lb.source!r} has none, nor one with a certificate or without a weak pair; "
            "LaplaceBeltrami.from_mesh and from_points build operators that have"
        )
    return lb.plan


def forms_of(lb: LaplaceBeltrami) -> Forms:
    """The elements of an operator; made once, and kept as long as it.

    Raises
    ------
    InputError
        For batches, and operators without a weak pair.
    """
    if lb.values not in _FORMS:
        points = lb.points.detach().cpu().double()
        if lb.source == "cotangent":
            _FORMS[lb.values] = Forms.linear(points, lb.faces.cpu())
        elif lb.source == "batch":
            raise InputError(
                "conductivity: a batch has no elements; solve shape by shape, lb.unbatch()"
            )
        elif not lb.has_weak_form:
            raise InputError(
                "conductivity: this operator has no elements; build it with its weak pair, of a mesh if there is none "
                "of the points"
            )
        else:
            _FORMS[lb.values] = plan_of(lb).forms(points)
    return _FORMS[lb.values]
