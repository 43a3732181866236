"""Collate samples that hold operators into one batch of a `DataLoader`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import default_collate

from torchlb.errors import InputError, shown
from torchlb.operator.laplace_beltrami import LaplaceBeltrami

INDICES = ("faces", "face_index", "edges")
"""Keys of tensors that hold indices of points, (·, corners)."""


def collate(samples: Sequence[Any]) -> Any:
    """`collate_fn` of a `DataLoader` whose samples, tuples or dicts, hold an operator each.

    Operators become one by `LaplaceBeltrami.batch`. Tensors with a row for every point of their sample's operator are
    concatenated, as every layer takes them; those under the keys "faces", "face_index" and "edges" are, too, their
    indices moved by ``lb.offsets``, and so are tensors with a row for each of their rows. The rest is torch's
    `default_collate`: a label for each shape, for example.

    Raises InputError for samples without an operator, and where `default_collate` fails; the key is named.

    >>> from torchlb.surfaces import Sphere
    >>> samples = [(LaplaceBeltrami.from_points(Sphere().points(n), order=1), torch.zeros(n, 3), n) for n in (40, 50)]
    >>> lb, features, labels = collate(samples)
    >>> lb.sizes, tuple(features.shape), labels.tolist()
    ((40, 50), (90, 3), [40, 50])
    """
    if not isinstance(samples, Sequence) or not samples:
        raise InputError(f"collate: expected a list of samples, got {shown(samples)}")
    first = samples[0]
    if isinstance(first, LaplaceBeltrami):
        return LaplaceBeltrami.batch(samples)
    named = hasattr(first, "_asdict")  # a namedtuple, whose fields are keys
    try:
        rows = [sample._asdict() for sample in samples] if named else samples
        keys = list(rows[0]) if isinstance(rows[0], Mapping) else range(len(first))
        columns = {key: [row[key] for row in rows] for key in keys}
    except (AttributeError, LookupError, TypeError) as error:
        raise InputError(
            f"collate: expected tuples, or dicts with the same keys, got {shown(samples)}"
        ) from error
    operators = [
        c for c in columns.values() if all(isinstance(each, LaplaceBeltrami) for each in c)
    ]
    if not operators:
        raise InputError(
            f"collate: expected samples that are tuples or dicts with a LaplaceBeltrami, got {type(first).__name__}"
        )
    counts = [[lb.num_points for lb in operators[0]]]
    for key in INDICES:
        if all(isinstance(each, Tensor) and each.ndim for each in columns.get(key, [None])):
            counts.append([len(each) for each in columns[key]])
    joined = {key: _joined(key, column, counts) for key, column in columns.items()}
    if named:
        return type(first)(*joined.values())
    return joined if isinstance(first, Mapping) else tuple(joined.values())


def _joined(key: Any, column: list[Any], counts: list[list[int]]) -> Any:
    """Join the values of one key; `counts` are the numbers of rows, of points and of indices, to concatenate by."""
    if isinstance(column[0], LaplaceBeltrami):
        return LaplaceBeltrami.batch(column)
    if all(isinstance(each, Tensor) and each.ndim > 0 for each in column):
        if key in INDICES:
            starts = accumulate([0, *counts[0][:-1]])
            return torch.cat([rows + start for rows, start in zip(column, starts, strict=True)])
        if [len(each) for each in column] in counts:
            return torch.cat(column)
    try:
        return default_collate(column)
    except (RuntimeError, TypeError) as error:
        raise InputError(
            f"collate: {key!r} has neither a row for each point, face or edge nor one shape in all samples ({error})"
        ) from error
