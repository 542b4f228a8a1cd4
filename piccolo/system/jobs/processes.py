"""A function over many items, its values in the items' order: here, in processes of which any may be killed.

What works elsewhere is given as an `Opening`, called once where items are worked on: it opens what the
function needs, a scan for example, and returns the function. Each process is a pool of its own
(concurrent.futures), so that the end of one concerns no other.
"""

import multiprocessing
import os
import pickle
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess
from typing import Any

from ..errors import InputError
from .memory import share_arenas

ATTEMPTS = 2  # to work on an item, or to open
MOST_OPENING = 10.0  # times the seconds of an item may be spent on opening
IN_FLIGHT = 4  # items a process, so that none waits for a slow one before
PARENT_LOST = 1  # exit code
# Not fork: the child would have the threads of this process stand still in the middle of their work.
CONTEXT = multiprocessing.get_context("spawn")
SIGNALS = {signal.SIGINT, signal.SIGTERM}  # are for this process, which ends the others
HAS_MASKS = hasattr(signal, "pthread_sigmask")  # not on Windows
# in a thread, and so, from their first moment on, in the processes that it starts
block_signals = partial(signal.pthread_sigmask, signal.SIG_BLOCK, SIGNALS) if HAS_MASKS else None
Worker = tuple[ProcessPoolExecutor, BaseProcess]  # a pool of one process, and this
LIBRARIES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
Function = Callable[[Any], Any]  # of an item
Opening = Callable[[], Function]  # pickled for other processes
# an item, and what waits for its value; or for what the function raised, or WorkerLostError, and raises it
Pair = tuple[Any, Callable[[], Any]]


class WorkerLostError(Exception):
    """The processes at work on an item were killed, as often as it was tried; the text says how."""


class OpeningError(InputError):
    """A process could not open what it works with; the text says why."""


class TooSlowError(Exception):
    """An item took longer than it may; its process was killed. The text says how long that is."""


@dataclass
class Here:
    """Works on one item after another in this process, on each when its value is asked for."""

    function: Function
    items: Iterable[Any] = ()

    def values(self, items: Iterator[Any]) -> "Here":
        """Begin with the items."""
        return Here(self.function, items)

    def __iter__(self) -> Iterator[Pair]:
        """Yield each, taken when it is asked for."""
        return ((item, partial(self.function, item)) for item in self.items)

    def take_finished(self) -> Iterator[Pair]:
        """Yield nothing."""
        return iter(())


class InFlight:
    """Values of items that are worked on elsewhere, at most so many begun before the first of them is taken.

    A thread reads the items, so a slow standard input does not delay values that are ready.
    """

    def __init__(self, submit: Callable[[Any], Any], items: Iterator[Any], limit: int) -> None:
        self._submit = submit
        self._items = items
        self._room = threading.Semaphore(limit)
        self._begun = threading.Semaphore(0)
        self._pairs = deque[tuple[Any, Any] | None]()  # an item and its future; None is the end
        threading.Thread(target=self._feed, daemon=True).start()

    def _feed(self) -> None:
        try:
            for item in self._items:
                self._room.acquire()
                self._put((item, self._submit(item)))
        except BaseException as error:  # of the items, or the executor is closed: for who takes the values
            failed = Future[Any]()
            failed.set_exception(error)
            self._put((None, failed))
        self._put(None)

    def _put(self, pair: tuple[Any, Any] | None) -> None:
        self._pairs.append(pair)
        self._begun.release()

    def __iter__(self) -> Iterator[Pair]:
        """Yield each, begun as soon as there is an item and room for it."""
        while self._begun.acquire() and (pair := self._pairs.popleft()) is not None:
            yield pair[0], pair[1].result
            self._room.release()

    def take_finished(self) -> Iterator[Pair]:
        """Yield what is done already of those that come next."""
        while self._pairs and (pair := self._pairs[0]) is not None and pair[1].done():
            self._pairs.popleft()
            yield pair[0], pair[1].result


class Processes:
    """Works on items in processes, which begin as they are needed; each opens once what it works with.

    An item whose process is killed is tried once more in a new one, if there are two `attempts`; one that
    takes more than `seconds` is given up.
    """

    def __init__(
        self,
        opening: Opening,
        num_processes: int,
        num_threads: int = 1,
        seconds: float | None = None,
        attempts: int = ATTEMPTS,
    ) -> None:
        self.opening = opening
        self.num_processes = num_processes
        self.num_threads = num_threads
        self.seconds = seconds
        self.attempts = attempts
        self._own = threading.local()  # its `worker` is the process of each thread, and a pool of it alone
        self._children: list[BaseProcess] = []
        self._starting = threading.Lock()
        self._is_closed = False
        if block_signals:
            resource_tracker.ensure_running()  # which unblocks signals in the thread that begins it
        self._threads = ThreadPoolExecutor(num_processes, initializer=block_signals)

    def values(self, items: Iterator[Any]) -> InFlight:
        """Begin with the items."""
        return InFlight(self.submit, items, IN_FLIGHT * self.num_processes)

    def submit(self, item: object, num: int = 1) -> Future[Any]:
        """Begin with an item as soon as a process is free; its future raises what `Pair` says.

        An item that is `num` items in one may take so many times as long.
        """
        return self._threads.submit(self._value_of, item, num)

    def close(self) -> None:
        """Kill the processes, whatever they are doing."""
        with self._starting:
            self._is_closed = True
            for child in self._children:
                child.kill()
        self._threads.shutdown(cancel_futures=True)

    def _value_of(self, item: object, num: int) -> Any:
        """Ask this thread's process for a value."""
        seconds = self.seconds and num * self.seconds
        for _ in range(self.attempts):
            pool, child = self._worker()
            try:
                future = pool.submit(_value_of, item)
                return future.result(seconds)
            except BrokenProcessPool:
                end = self._end_of(pool, child)
            except TimeoutError:
                if future.done():  # the function's own
                    raise
                child.kill()
                self._end_of(pool, child)
                raise TooSlowError(f"it took more than {seconds} s") from None
        who = "the process" if self.attempts == 1 else f"each of {self.attempts} processes"
        raise WorkerLostError(f"{who} at work on it {end}")

    def _worker(self) -> Worker:
        """Return the process of this thread, or a new one, when it has opened what it needs."""
        own: Worker | None = getattr(self._own, "worker", None)
        if own:
            return own
        for _ in range(ATTEMPTS):
            pool = ProcessPoolExecutor(1, CONTEXT, initializer=_begin)
            with self._starting, library_threads(self.num_threads):
                if self._is_closed:
                    raise CancelledError
                opened = pool.submit(_open, self.opening)
                (child,) = pool._processes.values()
                self._children.append(child)
            try:
                opened.result(self.seconds and MOST_OPENING * self.seconds)
            except BrokenProcessPool:
                end = self._end_of(pool, child)
                continue
            except TimeoutError:
                child.kill()
                end = self._end_of(pool, child)
                continue
            except InputError as error:
                raise OpeningError(str(error)) from error
            self._own.worker = pool, child
            return pool, child
        advice = "use fewer processes or more memory"
        raise OpeningError(f"`jobs`: a process {end} while it opened the scan; {advice}")

    def _end_of(self, pool: ProcessPoolExecutor, child: BaseProcess) -> str:
        """Return how a process ended; raises CancelledError if that was by `close`."""
        with self._starting:
            if self._is_closed:
                raise CancelledError
            self._children.remove(child)
        vars(self._own).pop("worker", None)
        pool.shutdown()  # whose thread waits for the process, and then has its exit code
        code = child.exitcode or 0
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"


@contextmanager
def library_threads(count: int) -> Iterator[None]:
    """Within this, processes start with so many threads in BLAS and OpenCV, but for what the user set."""
    added = {name: str(count) for name in LIBRARIES if name not in os.environ}
    os.environ.update(added)
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


class _Own:
    """The function of this process."""

    function: Function


def _begin() -> None:
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    share_arenas()


def _open(opening: Opening) -> None:
    with _raising_what_can_be_sent():
        _Own.function = opening()


def _value_of(item: object) -> Any:
    with _raising_what_can_be_sent():
        return _Own.function(item)


@contextmanager
def _raising_what_can_be_sent() -> Iterator[None]:
    """Raise RuntimeError with its words in place of an exception that can't be pickled and made again."""
    try:
        yield
    except Exception as error:
        try:
            pickle.loads(pickle.dumps(error))
        except Exception:
            raise RuntimeError(repr(error)) from None
        raise


def _end_with_parent() -> None:
    """End this process at once when the one that started it has ended, even by SIGKILL."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(PARENT_LOST)
