"""Items worked on in processes of this machine, of which any may be killed.

Each process is a pool of its own (concurrent.futures), so that the end of one concerns no other.
"""

import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.process import BaseProcess
from typing import Any

from ..errors import InputError
from .arenas import share_arenas
from .tasks import Function, InFlight, Opening, WorkerLostError

ATTEMPTS = 2  # to work on an item, or to open
IN_FLIGHT = 4  # items a process, so that none waits for a slow one before
PARENT_LOST = 1  # exit code
POLL_S = 0.001
MAX_POLLS = 1000
# Not fork: the child would have the threads of this process stand still in the middle of their work.
CONTEXT = multiprocessing.get_context("spawn")
SIGNALS = {signal.SIGINT, signal.SIGTERM}  # are for this process, which ends the others
Worker = tuple[ProcessPoolExecutor, BaseProcess]  # a pool of one process, and this
LIBRARIES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


class Processes:
    """Works on items in processes, which begin as they are needed; each opens once what it works with.

    An item whose process is killed is tried once more in a new one.
    """

    def __init__(self, opening: Opening, num_processes: int, num_threads: int = 1) -> None:
        self.opening = opening
        self.num_processes = num_processes
        self.num_threads = num_threads
        self._own = threading.local()  # its `worker` is the process of each thread, and a pool of it alone
        self._children: list[BaseProcess] = []
        self._starting = threading.Lock()
        self._is_closed = False
        resource_tracker.ensure_running()  # which unblocks signals in the thread that begins it
        # What a thread blocks, its processes do from their first moment on.
        self._threads = ThreadPoolExecutor(num_processes, initializer=_block_signals)

    def values(self, items: Iterator[Any]) -> InFlight:
        """Begin with the items."""
        return InFlight(self._submit, items, IN_FLIGHT * self.num_processes)

    def close(self) -> None:
        """Kill the processes, whatever they are doing."""
        with self._starting:
            self._is_closed = True
            for child in self._children:
                child.kill()
        self._threads.shutdown(cancel_futures=True)

    def _submit(self, item: object) -> Future[Any]:
        return self._threads.submit(self._value_of, item)

    def _value_of(self, item: object) -> Any:
        """Ask this thread's process for a value."""
        for _ in range(ATTEMPTS):
            pool, child = self._worker()
            try:
                return pool.submit(_value_of, item).result()
            except BrokenProcessPool:
                end = self._end_of(child)
        raise WorkerLostError(f"each of {ATTEMPTS} processes at work on it {end}")

    def _worker(self) -> Worker:
        """Return the process of this thread, or a new one, when it has opened what it needs."""
        own: Worker | None = getattr(self._own, "worker", None)
        if own:
            return own
        for _ in range(ATTEMPTS):
            pool = ProcessPoolExecutor(1, CONTEXT, initializer=_begin, initargs=(self.opening,))
            with self._starting, library_threads(self.num_threads):
                if self._is_closed:
                    raise CancelledError
                opened = pool.submit(_open)
                (child,) = pool._processes.values()
                self._children.append(child)
            try:
                opened.result()
            except BrokenProcessPool:
                end = self._end_of(child)
                continue
            self._own.worker = pool, child
            return pool, child
        advice = "use fewer processes or more memory"
        raise InputError(f"`jobs`: a process {end} while it opened the scan; {advice}")

    def _end_of(self, child: BaseProcess) -> str:
        """Return how a process ended; raises CancelledError if that was by `close`."""
        with self._starting:
            if self._is_closed:
                raise CancelledError
            self._children.remove(child)
        vars(self._own).pop("worker", None)
        code = _exit_code_of(child)
        return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"


def _exit_code_of(child: BaseProcess) -> int:
    """Wait for a process; its pool's thread, which waits too, may have its exit code a moment earlier."""
    child.join()
    for _ in range(MAX_POLLS):
        if child.exitcode is not None:
            return child.exitcode
        time.sleep(POLL_S)
    return 0


def _block_signals() -> None:
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)


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
    """The opening and the function of this process."""

    opening: Opening
    function: Function


def _begin(opening: Opening) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    share_arenas()
    _Own.opening = opening


def _open() -> None:
    with _raising_what_can_be_sent():
        _Own.function = _Own.opening()


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
