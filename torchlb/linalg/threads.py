"""Threads of torch's for the many small tensors of a build."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

FEW = 20_000
"""Points whose tensors are not worth a second thread: on a busy machine it is waited for at every product."""


@contextmanager
def threads_for(num_points: int) -> Iterator[None]:
    """One thread inside, if there are few points; afterwards as many as before.

    >>> before = torch.get_num_threads()
    >>> with threads_for(100):
    ...     torch.get_num_threads()
    1
    >>> torch.get_num_threads() == before
    True
    """
    threads = torch.get_num_threads()
    if threads == 1 or num_points > FEW:
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
