"""The elements behind an operator's weak pair, made again when a conductivity asks for them."""

from __future__ import annotations

from typing import Any

from torch.utils.weak import WeakIdKeyDictionary

from torchlb.errors import InputError
from torchlb.galerkin.medium import Medium
from torchlb.operator.build import numbered_mesh
from torchlb.operator.laplace_beltrami import LaplaceBeltrami
from torchlb.operator.options import Options
from torchlb.stencils.shape import mesh_shape

_MEDIA: Any = WeakIdKeyDictionary()


def medium_of(lb: LaplaceBeltrami) -> Medium:
    """The elements of a mesh's operator; made once, and kept as long as it.

    Raises
    ------
    InputError : for clouds, batches, and operators without a weak pair.
    """
    if lb.values not in _MEDIA:
        _MEDIA[lb.values] = _made(lb)
    return _MEDIA[lb.values]


def _made(lb: LaplaceBeltrami) -> Medium:
    if lb.source not in ("mesh", "cotangent") or not lb.has_weak_form:
        remedy = {
            "points": "build LaplaceBeltrami.from_mesh(lb.points, lb.faces) of the cloud's surface",
            "batch": "solve shape by shape, lb.unbatch()",
        }.get(lb.source, "build from a triangle mesh, with its weak pair")
        raise InputError(f"conductivity: this operator has no elements; {remedy}")
    points, given = lb.points.detach().cpu().double(), lb.faces.cpu()
    if lb.source == "cotangent":
        return Medium.linear(points, given)
    options = Options(**lb.options)
    degree, degrees = options.elements
    numbering, points, faces, order = numbered_mesh(points, given, flip=True)
    shape = mesh_shape(
        points,
        faces,
        options.q,
        num_neighbors=options.num_neighbors,
        condition=None,
        fit_degrees=degrees,
        progress=False,
    )
    assert shape.fits is not None
    held = None if lb.fixed is None else numbering.sorted(lb.fixed.cpu())
    medium = Medium.curved(points, faces, shape.fits, degree, held)
    return medium.restored(numbering, order, len(given))
