"""The elements of an operator's weak pair, made when a conductivity asks for them."""

from __future__ import annotations

from typing import Any

from torch.utils.weak import WeakIdKeyDictionary

from torchlb.errors import InputError
from torchlb.galerkin.forms import Forms
from torchlb.operator.laplace_beltrami import LaplaceBeltrami

_FORMS: Any = WeakIdKeyDictionary()


def forms_of(lb: LaplaceBeltrami) -> Forms:
    """The elements of an operator; made once, and kept as long as it.

    Raises
    ------
    InputError
        For batches, and operators without a weak pair.
    """
    if lb.values not in _FORMS:
        if lb.source == "batch" or not lb.has_weak_form:
            remedy = "solve shape by shape, lb.unbatch()"
            if lb.source != "batch":
                remedy = "build it with its weak pair, from_mesh if there is none of the points"
            raise InputError(f"conductivity: this operator has no elements; {remedy}")
        points = lb.points.detach().cpu().double()
        linear = lb.source == "cotangent"
        made = Forms.linear(points, lb.faces.cpu()) if linear else lb.plan.forms(points)
        _FORMS[lb.values] = made
    return _FORMS[lb.values]
