"""Any operator by name: "stencil" or "cotangent", of a mesh or of a cloud, with its options as keywords."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any, Literal, get_args

import numpy as np
from torch import Tensor

from torchlb.errors import InputError, InputTypeError
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
    _check_operator(operator)
    if faces is None or np.prod(np.shape(faces)) == 0:
        if operator == "cotangent":
            raise InputError("the cotangent operator needs faces; operator='stencil' does not")
        return LaplaceBeltrami.from_points, check_points(vertices), None
    points = check_points(vertices, "vertices")
    corners = check_faces(faces, len(points))
    if operator == "cotangent":
        return LaplaceBeltrami.from_cotangent, points, corners
    return LaplaceBeltrami.from_mesh, points, corners


def complete_options(builder: Builder, options: dict[str, Any]) -> dict[str, Any]:
    """All options with their defaults, except `progress`, which changes no result; InputTypeError for unknown ones."""
    known = _defaults(builder)
    _check_names(builder.__name__, options, known)
    if options.get("reconstruct") is not None:
        raise InputError(
            "reconstruct: a function has no name in a cache; build with LaplaceBeltrami.from_points, and store the "
            "operator with save_operator"
        )
    return known | options


def check_options_of(operator: str, options: dict[str, Any]) -> None:
    """Raise InputError for an unknown operator, or for an option that it has neither for meshes nor for clouds."""
    _check_operator(operator)
    known = _defaults(LaplaceBeltrami.from_mesh) | _defaults(LaplaceBeltrami.from_points)
    known = _defaults(LaplaceBeltrami.from_cotangent) if operator == "cotangent" else known
    _check_names(f"operator {operator!r}", options, known)


def _check_operator(operator: str) -> None:
    if operator not in get_args(Operator):
        raise InputError(f"operator: expected one of {list(get_args(Operator))}, got {operator!r}")


def _defaults(builder: Builder) -> dict[str, Any]:
    parameters = inspect.signature(builder).parameters.values()
    known = {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}
    known.pop("progress", None)
    return known


def _check_names(owner: str, options: dict[str, Any], known: dict[str, Any]) -> None:
    unknown = options.keys() - known.keys()
    if unknown:
        raise InputTypeError(
            f"{owner} has no option {', '.join(sorted(unknown))}; its options are {', '.join(known) or 'none'}"
        )
