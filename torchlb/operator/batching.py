"""Several operators side by side as one block-diagonal operator, and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from torchlb.errors import InputError
from torchlb.galerkin.matrices import PairMatrices
from torchlb.linalg.csr import Csr, Record, starts, tensors_of
from torchlb.operator.plan import Parts
from torchlb.operator.storage import BY_POINT, OperatorStorage


def check_alike(shapes: Sequence[OperatorStorage]) -> None:
    """Raise InputError for shapes that differ in dimension, in floating type or in device."""
    kinds = [
        f"of dimension {s.dim} in R^{s.points.shape[1]}, {s.dtype}, on {s.device}" for s in shapes
    ]
    for i, kind in enumerate(kinds):
        if kind != kinds[0]:
            raise InputError(
                f"batch: shape {i} is {kind}, and shape 0 {kinds[0]}; one dimension, floating type and device are "
                "needed: use lb.to(…)"
            )


def joined_parts(shapes: Sequence[OperatorStorage]) -> Parts:
    """The tensors, matrices and records of the block-diagonal operator, from those of its shapes."""
    parts: Parts = {}
    for name in BY_POINT:
        tensors = [getattr(s, name) for s in shapes]
        if name == "_on_boundary" and any(len(mask) for mask in tensors):
            tensors = [s.mass < 0 if s.boundary is None else s.boundary for s in shapes]
        if all(len(tensor) for tensor in tensors):
            parts[name] = torch.cat(tensors)
    first = starts([s.num_points for s in shapes])
    parts["faces"] = torch.cat([s.faces + start for s, start in zip(shapes, first, strict=True)])
    parts["_record"] = Record.join([s._record for s in shapes])
    parts["_plans"] = [plan for s in shapes for plan in s._known_plans]
    parts["stencil"] = Csr.join([s.stencil for s in shapes])
    parts["weak"] = PairMatrices.join([s.weak for s in shapes])
    return parts


def split_parts(batch: OperatorStorage, sizes: Sequence[int]) -> list[Parts]:
    """Inverse of `joined_parts`."""
    whole = Record({n: getattr(batch, n) for n in BY_POINT if len(getattr(batch, n))})
    shapes: list[Parts] = [tensors_of(part) for part in whole.split(sizes)]
    first = batch.faces.new_tensor(starts(sizes))
    of_shape = torch.bucketize(batch.faces[:, 0].contiguous(), first[1:], right=True)
    faces = batch.faces.split(torch.bincount(of_shape, minlength=len(sizes)).tolist())
    columns = {"stencil": batch.stencil.split(sizes), "weak": batch.weak.split(sizes)}
    columns["faces"] = [own - start for own, start in zip(faces, first, strict=True)]
    if len(batch._record.order):  # PyG data carry no report
        columns["_record"] = batch._record.split(sizes)
    columns["_plans"] = [[plan] for plan in batch._known_plans]
    for shape, *row in zip(shapes, *columns.values(), strict=True):
        shape.update(zip(columns, row, strict=True))
        if "_on_boundary" in shape and not shape["_on_boundary"].any():
            del shape["_on_boundary"]
    return shapes


def remember_shapes(batch: OperatorStorage, shapes: Sequence[OperatorStorage]) -> None:
    """Let the caches of the shapes (their factors, for example) serve the batch."""
    batch.cache.shapes = tuple((shape, shape.weak.values) for shape in shapes)


def shapes_of(batch: Any) -> tuple[Any, ...]:
    """The operators that a batch was made of, while none of them has been copied, cast, moved or loaded; else none.

    Of batches of batches the single shapes, as far as these are known.
    """
    known = batch.cache.shapes
    same = all(shape.weak.values is values for shape, values in known)
    parts = (shapes_of(shape) or (shape,) for shape, _ in known)
    return tuple(part for own in parts for part in own) if same else ()


def join_states(states: Sequence[dict[str, Any]], sizes: Sequence[int]) -> dict[str, Any]:
    """The extra state of a batch, with those of its shapes and the options that all shapes share."""
    first, *options = (state["options"] for state in states)
    parts = [part for state in states for part in state.get("parts") or [state]]
    return {
        "source": "batch",
        "options": {k: v for k, v in first.items() if all(o.get(k, ...) == v for o in options)},
        "certificate": _joined_certificate([state["certificate"] for state in states]),
        "sizes": list(sizes),
        "parts": parts,
        "medium": any(part.get("medium") for part in parts),
    }


def _joined_certificate(certificates: Sequence[dict[str, Any] | None]) -> dict[str, Any] | None:
    """Join certificates: the worst of each figure and the sum of each count; None where one shape has none."""
    known = [each for each in certificates if each is not None]
    if len(known) < len(certificates):
        return None
    how: Any = {"holds": all, "min_pi": min, "max_s": lambda x: float(np.max(x)), "rounds": max}
    return {key: how.get(key, sum)([each[key] for each in known]) for key in known[0]}
