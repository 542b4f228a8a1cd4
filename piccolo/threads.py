"""Serial kernels on several threads: whole items are spread, and results come back in the items' order."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Value = TypeVar("Value")


def num_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0))


def in_order(
    function: Callable[[Item], Value], items: Iterable[Item], num_threads: int
) -> Iterator[Value]:
    """Yield function(item) for each item, in order, computed on `num_threads` threads.

    Nothing is summed across items here, so results have the same bits for any number of threads. An error or
    Ctrl-C drops the items that have not begun.
    """
    if num_threads == 1:
        yield from map(function, items)
        return
    pool = ThreadPoolExecutor(num_threads)
    try:
        yield from pool.map(function, items)
    finally:
        pool.shutdown(cancel_futures=True)
