"""Any operator by name: "stencil" or "cotangent", of a mesh or of a cloud, with its options as keywords."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from torch import Tensor

from torchlb.errors import InputError, InputTypeError
from torchlb.linalg.checks import check_choice
from torchlb.operator.checks import check_faces
from torchlb.operator.inputs import ArrayLike, check_points
from torchlb.operator.laplace_beltrami import LaplaceBeltrami

Operator = Literal["stencil", "cotangent"]
Builder = Callable[..., LaplaceBeltrami]


def build_operator(
    vertices: ArrayLike,
    faces: ArrayLike | None = None,
    *,
    operator: Operator = "stencil",
    progress: bool = True,
    **options: Any,
) -> LaplaceBeltrami:
    """Build the operator of a mesh, or of a cloud where `faces` is None or empty, by the builder that fits.

    Parameters as for `torchlb.load_or_build`. Raises the builder's errors, and InputTypeError for unknown options.
    """
    builder, _, faces = builder_of(vertices, faces, operator)
    options = complete_options(builder, options)
    if operator != "cotangent":
        options["progress"] = progress
    return builder(vertices, **({} if faces is None else {"faces": faces}), **options)


def builder_of(
    vertices: ArrayLike, faces: ArrayLike | None, operator: str
) -> tuple[Builder, Tensor, Tensor | None]:
    """The classmethod that builds the operator, and its input checked: float64 positions, int64 faces or None."""
    of_mesh, *of_cloud = _builders(operator)
    if faces is not None and np.prod(np.shape(faces)) > 0:
        points = check_points(vertices, "vertices")
        return of_mesh, points, check_faces(faces, len(points))
    if not of_cloud:
        raise InputError("the cotangent operator needs faces; operator='stencil' does not")
    return of_cloud[0], check_points(vertices), None


def complete_options(builder: Builder, options: dict[str, Any]) -> dict[str, Any]:
    """All options with their defaults, except `progress`, which changes no result; InputTypeError for unknown ones."""
    known = _known(builder.__name__, options, builder)
    if options.get("reconstruct") is not None:
        raise InputError(
            "reconstruct: a function has no name in a cache; build with LaplaceBeltrami.from_points, and store the "
            "operator with save_operator"
        )
    return known | options


def check_options_of(operator: str, options: dict[str, Any]) -> None:
    """Raise InputError for an unknown operator, or for an option that it has neither for meshes nor for clouds."""
    _known(f"operator {operator!r}", options, *_builders(operator))


def _builders(operator: str) -> list[Builder]:
    """The builders of an operator, on meshes and, if there is one, on clouds."""
    check_choice("operator", operator, Operator)
    if operator == "cotangent":
        return [LaplaceBeltrami.from_cotangent]
    return [LaplaceBeltrami.from_mesh, LaplaceBeltrami.from_points]


def _known(owner: str, options: dict[str, Any], *builders: Builder) -> dict[str, Any]:
    """The options of builders with their defaults; InputTypeError where more are given."""
    parameters = [p for each in builders for p in inspect.signature(each).parameters.values()]
    known = {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}
    known.pop("progress", None)
    unknown = options.keys() - known.keys()
    if unknown:
        raise InputTypeError(
            f"{owner} has no option {', '.join(sorted(unknown))}; its options are {', '.join(known) or 'none'}"
        )
    return known
