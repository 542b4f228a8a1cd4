"""Serial kernels on several threads: whole items are spread, and results come back in the items' order.

BLAS has one thread meanwhile: those of OpenBLAS spin for tens of milliseconds after each product, on the
cores that the next kernels want.
"""

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any, Generic, TypeVar

from threadpoolctl import OpenBLASController, ThreadpoolController

from ..errors import InputError
from .memory import check_address_space, this_process

Item = TypeVar("Item")
Value = TypeVar("Value")
MAX_THREADS = 512  # each has arrays of 0.1 GB for views


def num_cores() -> int:
    """Cores that this process may use, at most as many as threads are allowed."""
    process = this_process()
    cores = process.cpu_affinity() if hasattr(process, "cpu_affinity") else None  # macOS has no such limit
    return min(len(cores) if cores else os.cpu_count() or 1, MAX_THREADS)


_thread = threading.local()  # has `is_of_pool` in the threads of a pool
_idle: dict[int, list[ThreadPoolExecutor]] = {}  # pools by their number of threads
if hasattr(os, "register_at_fork"):  # not on Windows, which has no fork
    os.register_at_fork(after_in_child=_idle.clear)  # a child has none of its parent's threads


@contextmanager
def get_pool(num_threads: int) -> Iterator[ThreadPoolExecutor]:
    """Threads for one caller at a time, kept for the next: they keep their scratch, as fresh memory is slow.

    Callers in several threads have a pool each: none waits for what another's work keeps from being done.
    """
    idle = _idle.setdefault(num_threads, [])
    try:
        pool = idle.pop()
    except IndexError:
        pool = ThreadPoolExecutor(num_threads, "piccolo", setattr, (_thread, "is_of_pool", True))
    try:
        yield pool
    finally:
        # after a burst of callers only so many go on, as each thread's scratch may be 0.2 GB
        if (len(idle) + 1) * num_threads <= 2 * max(num_cores(), num_threads):
            idle.append(pool)
        else:
            pool.shutdown(wait=False)


# wraps values as tqdm does: how many there will be, None if unknown, and their label
Progress = Callable[[Iterator[Any], int | None, str], Iterator[Any]]


def no_progress(values: Iterator[Value], total: int | None, label: str) -> Iterator[Value]:
    """No progress: the values as they are."""
    return values


# is told what is being done, how many are done, and of how many, None if unknown
ProgressCallback = Callable[[str, int, int | None], None]


def report_progress(callback: ProgressCallback) -> Progress:
    """Progress that a callback is told of."""

    def watch(values: Iterator[Value], total: int | None, label: str) -> Iterator[Value]:
        for done, value in enumerate(values, start=1):
            callback(label, done, total)
            yield value

    return watch


def ignore_warning(warning: str) -> None:
    """Default warning handler: does nothing (warnings are also stored in the result)."""


@dataclass(frozen=True)
class Workers:
    """Thread count, progress and warning callbacks."""

    num_threads: int = 1
    show: Progress = no_progress  # progress
    warn: Callable[[str], None] = ignore_warning  # of what should be known before the work is done

    def __post_init__(self) -> None:
        if not 1 <= self.num_threads <= MAX_THREADS:
            raise InputError(f"`num_threads`: found {self.num_threads}, wanted 1 to {MAX_THREADS}")

    def map(self, function: Callable[[Item], Value], items: Sequence[Item], label: str) -> list[Value]:
        """Return function(item) of each item, in order; within another call's function one after another.

        Nothing is summed across items here, so results have the same bits for any number of threads. An error
        or Ctrl-C drops the items that have not begun.
        """
        check_address_space()
        values: list[Value] = []
        shown = self.show(iter(values), len(items), label)  # which is moved on as they come
        try:
            if self.num_threads == 1 or len(items) < 2 or hasattr(_thread, "is_of_pool"):
                for item in items:
                    values.append(function(item))
                    next(shown)
            else:
                with submit(self.num_threads, [partial(function, item) for item in items]) as futures:
                    for future in futures:
                        values.append(future.result())
                        next(shown)
        finally:
            next(shown, None)  # its end, which takes a bar off the screen before an error is printed
        return values

    @contextmanager
    def beside(self, *functions: Callable[[], object]) -> Iterator[None]:
        """Compute cached values on another thread, in order, while the block runs.

        Functions that have not begun at its end are left. Errors are raised where the value is asked for.
        """
        if self.num_threads == 1 or hasattr(_thread, "is_of_pool"):
            yield
            return
        with submit(1, functions):
            yield


@contextmanager
def submit(num_threads: int, tasks: Sequence[Callable[[], Value]]) -> Iterator[list[Future[Value]]]:
    """Tasks on so many threads; at the end, those that have not begun are dropped, and others waited for."""
    with get_pool(num_threads) as pool:
        futures = [pool.submit(task) for task in tasks]
        try:
            yield futures
        finally:
            for future in futures:
                future.cancel()
            wait(futures)


class Once(Generic[Value]):
    """A value that is worked out by the first thread that asks; others wait for it."""

    def __init__(self, function: Callable[..., Value], *given: object) -> None:
        """Remember the function with its first arguments, of which others of this class are asked then."""
        self._function: Callable[..., Value] | None = function
        self._given = given
        self._lock = threading.Lock()
        self._value: Value

    def __call__(self, *arguments: object) -> Value:
        """Return the function's value. What it raises is raised, and it is asked again by the next."""
        with self._lock:
            if self._function is not None:
                given = (one() if isinstance(one, Once) else one for one in self._given)
                self._value = self._function(*given, *arguments)
                self._function = None  # what it holds may be large
                self._given = ()
        return self._value


@dataclass
class Stopwatch:
    """Seconds of a work by the names of its stages."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time spent inside to the stage `name`."""
        begin = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin


_blas = cache(lambda: ThreadpoolController().select(user_api="blas"))  # that NumPy has loaded
_limiting = threading.Lock()
_limiters: list[Any] = []  # of the threads of BLAS, for each of those within `one_blas_thread`


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Within this, BLAS has one thread; several threads may be within at once."""
    with _limiting:
        _limiters.append(_limiters[0] if _limiters else _blas().limit(limits=1))
    try:
        yield
    finally:
        with _limiting:
            limiter = _limiters.pop()
            if not _limiters:
                OpenBLASController.clear_controlling_thread(force=True)  # another thread may have come first
                limiter.restore_original_limits()
                OpenBLASController.clear_controlling_thread()
