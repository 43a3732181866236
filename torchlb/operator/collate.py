"""Samples that hold operators, as one batch of a `DataLoader`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import default_collate

from torchlb.errors import InputError
from torchlb.operator.laplace_beltrami import LaplaceBeltrami


def collate(samples: Sequence[Any]) -> Any:
    """`collate_fn` of a `DataLoader` whose samples, tuples or dicts, hold an operator each.

    Operators become one by `LaplaceBeltrami.batch`. Tensors with a row for every point of their sample's operator go
    below each other, as every layer takes them; those under the key "faces" or "face_index" do too, their indices moved
    by ``lb.offsets``. The rest is torch's `default_collate`: a label for each shape, say.

    >>> from torchlb.surfaces import Sphere
    >>> samples = [(LaplaceBeltrami.from_points(Sphere().points(n), order=1), torch.zeros(n, 3), n) for n in (40, 50)]
    >>> lb, features, labels = collate(samples)
    >>> lb.sizes, tuple(features.shape), labels.tolist()
    ((40, 50), (90, 3), [40, 50])
    """
    first = samples[0]
    if isinstance(first, LaplaceBeltrami):
        return LaplaceBeltrami.batch(samples)
    keys = list(first) if isinstance(first, Mapping) else range(len(first))
    columns = {key: [sample[key] for sample in samples] for key in keys}
    operators = [c for c in columns.values() if isinstance(c[0], LaplaceBeltrami)]
    if not operators:
        raise InputError(
            f"collate: expected samples that are tuples or dicts with a LaplaceBeltrami, got {type(first).__name__}"
        )
    joined = {key: _joined(key, column, operators[0]) for key, column in columns.items()}
    return joined if isinstance(first, Mapping) else tuple(joined.values())


def _joined(key: Any, column: list[Any], operators: list[LaplaceBeltrami]) -> Any:
    if isinstance(column[0], LaplaceBeltrami):
        return LaplaceBeltrami.batch(column)
    if not all(isinstance(each, Tensor) for each in column):
        return default_collate(column)
    sizes = [lb.num_points for lb in operators]
    if key in ("faces", "face_index"):
        starts = torch.tensor([0, *sizes[:-1]]).cumsum(0).tolist()
        return torch.cat([faces + start for faces, start in zip(column, starts, strict=True)])
    by_point = [each.ndim > 0 and len(each) == n for each, n in zip(column, sizes, strict=True)]
    return torch.cat(column) if all(by_point) else default_collate(column)
