"""Several operators side by side as one block-diagonal operator, and back: what becomes of each stored tensor."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import accumulate
from math import isnan
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad
from torch.utils.weak import WeakIdKeyDictionary

from torchlb.errors import InputError
from torchlb.operator.storage import PAIRS, no_pairs

Buffers = dict[str, Tensor]
BY_POINT = ("mass", "points", "frames", "normals", "on_boundary")
BY_ENTRY = ("col", "values", "col_t", "order_t")
PARTS = ("crow", "col", "values")
_SHAPES: Any = WeakIdKeyDictionary()


def join_buffers(shapes: Sequence[Buffers]) -> Buffers:
    """Stored tensors of the block-diagonal operator, from those of the shapes.

    Raises
    ------
    InputError
        If the shapes differ in dimension, in floating type or in device.
    """
    first = shapes[0]
    for name in ("frames", "values"):
        for i, other in enumerate(shapes):
            ours, theirs = (
                (t.shape[1:] if name == "frames" else (), t.dtype, t.device)
                for t in (first[name], other[name])
            )
            if ours != theirs:
                raise InputError(
                    f"batch: shape {i} has {name} of {theirs}, shape 0 of {ours}; one dimension, floating type and "
                    "device are needed: use lb.to(…)"
                )
    by_point = [n for n in first if n in BY_POINT or n.startswith("report_")]
    joined = {n: torch.cat([s[n] for s in shapes]) for n in (*by_point, "values")}
    joined["gradient_values"] = torch.cat([s["gradient_values"] for s in shapes], dim=1)
    if not all(len(s["normals"]) for s in shapes):
        joined["normals"] = first["normals"][:0]
    if len(joined["on_boundary"]):
        masks = [s["on_boundary"] for s in shapes]
        empty = [torch.zeros_like(s["mass"], dtype=torch.bool) for s in shapes]
        pairs = zip(masks, empty, strict=True)
        joined["on_boundary"] = torch.cat([mask if len(mask) else none for mask, none in pairs])
    points = _starts([len(s["mass"]) for s in shapes])
    entries = _starts([len(s["col"]) for s in shapes])
    for suffix in ("", "_t"):
        crows = [s["crow" + suffix][1:] + e for s, e in zip(shapes, entries, strict=True)]
        joined["crow" + suffix] = torch.cat([first["crow" + suffix][:1], *crows])
        cols = [s["col" + suffix] + p for s, p in zip(shapes, points, strict=True)]
        joined["col" + suffix] = torch.cat(cols)
    orders = [s["order_t"] + e for s, e in zip(shapes, entries, strict=True)]
    joined["order_t"] = torch.cat(orders)
    joined["faces"] = torch.cat([s["faces"] + p for s, p in zip(shapes, points, strict=True)])
    return joined | _join_pairs(shapes)


def _join_pairs(shapes: Sequence[Buffers]) -> Buffers:
    """The weak pairs, if all shapes have one, and, if any shape has one of its own, the linear ones."""
    if not all(len(s["weak_crow"]) for s in shapes):
        shapes = [s | no_pairs(s["values"]) for s in shapes]
    joined = {}
    points = _starts([len(s["mass"]) for s in shapes])
    for pair in PAIRS:
        if not any(len(s[f"{pair}_crow"]) for s in shapes):
            joined |= {f"{pair}_{part}": shapes[0][f"{pair}_{part}"] for part in PARTS}
            continue
        names = [pair if len(s[f"{pair}_crow"]) else "weak" for s in shapes]
        blocks = [[s[f"{name}_{p}"] for p in PARTS] for s, name in zip(shapes, names, strict=True)]
        entries = _starts([len(col) for _, col, _ in blocks])
        crows = [crow[i > 0 :] + entries[i] for i, (crow, _, _) in enumerate(blocks)]
        joined[f"{pair}_crow"] = torch.cat(crows)
        joined[f"{pair}_col"] = torch.cat([b[1] + p for b, p in zip(blocks, points, strict=True)])
        most = max(len(values) for _, _, values in blocks)  # the more, the more some shape has
        padded = [pad(values, (0, 0, 0, most - len(values))) for _, _, values in blocks]
        joined[f"{pair}_values"] = torch.cat(padded, dim=1)
    return joined


def trimmed(values: Tensor) -> Tensor:
    """Without the last matrices where they are zero: those of the boundary, and of what a condition adds."""
    return values[: 4 if values[3:].any() else 3 if values[2:].any() else 2]


def remember_shapes(batch: Any, shapes: Sequence[Any]) -> None:
    """So that what is kept of the shapes (factors, say) serves their batch, too."""
    _SHAPES[batch.values] = tuple((shape, shape.values) for shape in shapes)


def shapes_of(batch: Any) -> tuple[Any, ...]:
    """The operators that a batch was made of, as long as neither has been copied, cast, moved or loaded; else none."""
    known = _SHAPES.get(batch.values, ())
    same = all(shape.values is values for shape, values in known)
    return tuple(shape for shape, _ in known) if same else ()


def _starts(counts: Sequence[int]) -> list[int]:
    return [0, *accumulate(counts)][: len(counts)]


def split_buffers(joined: Buffers, sizes: Sequence[int]) -> list[Buffers]:
    """The inverse of `join_buffers`."""
    shapes = []
    corner, starts = joined["faces"][:, 0].contiguous(), joined["faces"].new_tensor(_starts(sizes))
    of_shape = torch.bucketize(corner, starts[1:], right=True)
    faces = joined["faces"].split(torch.bincount(of_shape, minlength=len(sizes)).tolist())
    for start, size, corners in zip(_starts(sizes), sizes, faces, strict=True):
        point = slice(start, start + size)
        first, last = joined["crow"][[start, start + size]].tolist()
        entry = slice(first, last)
        by_point = [n for n in joined if n in BY_POINT or n.startswith("report_")]
        shape = {n: joined[n][point] for n in by_point} | {n: joined[n][entry] for n in BY_ENTRY}
        shape["gradient_values"] = joined["gradient_values"][:, entry]
        shape["faces"] = corners - start
        for name, shift in (("col", start), ("col_t", start), ("order_t", first)):
            shape[name] = shape[name] - shift
        for name in ("crow", "crow_t"):
            shape[name] = joined[name][start : start + size + 1] - first
        for pair in PAIRS:
            crow, col, values = (joined[f"{pair}_{part}"] for part in PARTS)
            if len(crow):
                first, last = crow[[start, start + size]].tolist()
                crow, col = crow[start : start + size + 1] - first, col[first:last] - start
                values = trimmed(values[:, first:last])
            shape |= dict(
                zip((f"{pair}_{part}" for part in PARTS), (crow, col, values), strict=True)
            )
        if all(torch.equal(shape[f"weak_{part}"], shape[f"linear_{part}"]) for part in PARTS):
            shape |= {n: t for n, t in no_pairs(shape["values"]).items() if n.startswith("linear")}
        if not shape["on_boundary"].any():
            shape["on_boundary"] = shape["on_boundary"][:0]
        shapes.append({name: tensor.clone() for name, tensor in shape.items()})
    return shapes


def join_states(states: Sequence[dict[str, Any]], sizes: Sequence[int]) -> dict[str, Any]:
    """What `OperatorStorage.get_extra_state` has beside the tensors, for the batch; it keeps those of the shapes.

    Its options are those that the shapes share.
    """
    known, options = ([state[key] for state in states] for key in ("radius", "options"))
    first = options[0]
    parts = [part for state in states for part in state.get("parts") or [state]]
    return {
        "source": "batch",
        "options": {k: v for k, v in first.items() if all(o.get(k, ...) == v for o in options)},
        "certificate": _joined_certificate([state["certificate"] for state in states]),
        "sizes": list(sizes),
        "radius": None if any(each is None for each in known) else max(known),
        "parts": parts,
    }


def _joined_certificate(certificates: Sequence[dict[str, Any] | None]) -> dict[str, Any] | None:
    """The worst of each figure, and the sum of each count; None where one shape has none."""
    known = [each for each in certificates if each is not None]
    if len(known) < len(certificates):
        return None
    worst = {
        "holds": all(each["holds"] for each in known),
        "min_pi": min(each["min_pi"] for each in known),
        "max_s": max((each["max_s"] for each in known), key=lambda s: (isnan(s), s)),
        "rounds": max(each["rounds"] for each in known),
    }
    return {key: worst[key] if key in worst else sum(c[key] for c in known) for key in known[0]}
