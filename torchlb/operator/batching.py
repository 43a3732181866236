"""Several operators side by side as one block-diagonal operator: what happens to each of the stored tensors."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan
from typing import Any

import torch
from torch import Tensor

from torchlb.errors import InputError
from torchlb.stability.certificate import Certificate

__all__ = ["join_buffers", "join_certificates"]

Buffers = dict[str, Tensor]
BY_POINT = ("mass", "points", "frames")


def join_buffers(shapes: Sequence[Buffers]) -> Buffers:
    """Stored tensors of the block-diagonal operator, from those of the shapes.

    Raises
    ------
    ValueError : if the shapes differ in dimension, in floating type or in device.
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
    joined = {name: torch.cat([s[name] for s in shapes]) for name in BY_POINT}
    joined |= {n: torch.cat([s[n] for s in shapes]) for n in first if n.startswith("report_")}
    joined["values"] = torch.cat([s["values"] for s in shapes])
    joined["gradient_values"] = torch.cat([s["gradient_values"] for s in shapes], dim=1)
    oriented = all(len(s["normals"]) for s in shapes)
    joined["normals"] = torch.cat([s["normals"] if oriented else s["normals"][:0] for s in shapes])
    points = _starts([len(s["mass"]) for s in shapes])
    entries = _starts([len(s["col"]) for s in shapes])
    for suffix in ("", "_t"):
        crows = [s["crow" + suffix][1:] + e for s, e in zip(shapes, entries, strict=True)]
        joined["crow" + suffix] = torch.cat([first["crow" + suffix][:1], *crows])
        cols = [s["col" + suffix] + p for s, p in zip(shapes, points, strict=True)]
        joined["col" + suffix] = torch.cat(cols)
    orders = [s["order_t"] + e for s, e in zip(shapes, entries, strict=True)]
    joined["order_t"] = torch.cat(orders)
    return joined


def _starts(counts: list[int]) -> list[int]:
    return [sum(counts[:i]) for i in range(len(counts))]


def join_certificates(certificates: Sequence[Certificate | None]) -> Certificate | None:
    """The worst of each figure; None where one shape has none."""
    known: list[Any] = [c for c in certificates if c is not None]
    if len(known) < len(certificates):
        return None
    return Certificate(
        holds=all(c.holds for c in known),
        min_pi=min(c.min_pi for c in known),
        max_s=max((c.max_s for c in known), key=lambda s: (isnan(s), s)),
        components=sum(c.components for c in known),
        rounds=max(c.rounds for c in known),
        lowered=sum(c.lowered for c in known),
        widened=sum(c.widened for c in known),
    )
