"""One way to ask for any operator: "stencil" or "cotangent", of a mesh or of a cloud, with its options by name."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
from torch import Tensor

from torchlb.errors import InputError
from torchlb.operator.checks import check_faces, check_points
from torchlb.operator.laplace_beltrami import LaplaceBeltrami

__all__ = ["OPERATORS", "build_operator", "builder_of", "check_options_of", "complete_options"]

OPERATORS = ("stencil", "cotangent")
Options = dict[str, Any]


def build_operator(
    vertices: Any,
    faces: Any = None,
    *,
    operator: str = "stencil",
    progress: bool = True,
    **options: Any,
) -> LaplaceBeltrami:
    """The operator of a mesh, or of a cloud where `faces` is None or empty, by whichever builder fits.

    Parameters are those of `torchlb.load_or_build`; raises what the builder raises, and TypeError for an option that
    it does not have.
    """
    builder, _, faces = builder_of(vertices, faces, operator)
    options = complete_options(builder, options)
    if operator != "cotangent":
        options["progress"] = progress
    return builder(vertices, **({} if faces is None else {"faces": faces}), **options)


def builder_of(
    vertices: Any, faces: Any, operator: str
) -> tuple[Callable[..., LaplaceBeltrami], Tensor, Tensor | None]:
    """The classmethod that builds the operator, and its input checked: float64 positions, int64 faces or None."""
    if operator not in OPERATORS:
        raise InputError(f"operator: expected one of {list(OPERATORS)}, got {operator!r}")
    if faces is None or np.prod(np.shape(faces)) == 0:
        if operator == "cotangent":
            raise InputError("the cotangent operator needs faces; operator='stencil' does not")
        return LaplaceBeltrami.from_points, check_points(vertices), None
    points = check_points(vertices, "vertices")
    corners = check_faces(faces, len(points))
    if operator == "cotangent":
        return LaplaceBeltrami.from_cotangent, points, corners
    return LaplaceBeltrami.from_mesh, points, corners


def _defaults(builder: Callable[..., LaplaceBeltrami]) -> Options:
    parameters = inspect.signature(builder).parameters.values()
    known = {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}
    known.pop("progress", None)
    return known


def complete_options(builder: Callable[..., LaplaceBeltrami], options: Options) -> Options:
    """All options with their defaults, but `progress`, which changes nothing; TypeError for one that is none."""
    known = _defaults(builder)
    unknown = options.keys() - known.keys()
    if unknown:
        raise TypeError(
            f"{builder.__name__} has no option {', '.join(sorted(unknown))}; its options are "
            f"{', '.join(known) or 'none'}"
        )
    return known | options


def check_options_of(operator: str, options: Options) -> None:
    """ValueError or TypeError for what is no operator, or an option of it for neither meshes nor clouds."""
    if operator not in OPERATORS:
        raise InputError(f"operator: expected one of {list(OPERATORS)}, got {operator!r}")
    known = _defaults(LaplaceBeltrami.from_mesh) | _defaults(LaplaceBeltrami.from_points)
    known = _defaults(LaplaceBeltrami.from_cotangent) if operator == "cotangent" else known
    unknown = options.keys() - known.keys()
    if unknown:
        raise TypeError(
            f"operator {operator!r} has no option {', '.join(sorted(unknown))}; its options are "
            f"{', '.join(known) or 'none'}"
        )
