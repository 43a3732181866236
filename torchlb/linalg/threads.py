"""Threads for shapes of few points: one of torch's for the many small tensors, and work beside other work."""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from typing import ParamSpec, TypeVar

import torch

FEW = 20_000
"""Points up to which a second thread does not pay: on a busy machine every product waits for it."""

Inputs = ParamSpec("Inputs")
Result = TypeVar("Result")
_spare: ContextVar[bool] = ContextVar("spare", default=False)


@contextmanager
def threads_for(num_points: int) -> Iterator[None]:
    """Context with one thread if there are few points; the former number is restored afterwards.

    For no points at all there is none to spare, either.

    >>> before = torch.get_num_threads()
    >>> with threads_for(100):
    ...     torch.get_num_threads()
    1
    >>> torch.get_num_threads() == before
    True
    """
    threads = torch.get_num_threads()
    few = (
        threads > 1 and num_points <= FEW
    )  # with one, other threads may be about to restore theirs
    spare = _spare.set(few and num_points > 0)
    if few:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        _spare.reset(spare)
        if few:
            torch.set_num_threads(threads)


def beside(
    function: Callable[Inputs, Result], *inputs: Inputs.args, **options: Inputs.kwargs
) -> Callable[[], Result]:
    """Compute beside what follows if `threads_for` has left a thread to spare, else at once; calling it is waiting.

    The function must not warn, since warnings name the line that called the package, nor need gradients. Where what
    follows fails it goes on to its end.

    >>> found = beside(sum, [1, 2])
    >>> found()
    3
    """
    if not _spare.get():
        result = function(*inputs, **options)
        return lambda: result
    pool = ThreadPoolExecutor(1)
    future = pool.submit(copy_context().run, function, *inputs, **options)
    pool.shutdown(wait=False)
    return future.result
