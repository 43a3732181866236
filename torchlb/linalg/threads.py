"""Number of torch threads for the many small tensors of a build."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

FEW = 20_000
"""Points up to which a second thread does not pay: on a busy machine every product waits for it."""


@contextmanager
def threads_for(num_points: int) -> Iterator[None]:
    """Context with one thread if there are few points; the former number is restored afterwards.

    >>> before = torch.get_num_threads()
    >>> with threads_for(100):
    ...     torch.get_num_threads()
    1
    >>> torch.get_num_threads() == before
    True
    """
    threads = torch.get_num_threads()
    if threads == 1 or num_points > FEW:  # other threads may be about to restore theirs
        yield
        return
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
