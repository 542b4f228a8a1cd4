"""Items worked on in processes of this machine, of which any may be killed.

Each process has a pipe of its own, so that its end is seen at once, whatever it was doing, and concerns no
other: with a queue that all share, one that is killed may keep the lock for ever.
"""

import multiprocessing
import os
import pickle
import signal
import threading
import traceback
from collections.abc import Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple

from ..errors import InputError
from .arenas import share_arenas
from .tasks import Function, InFlight, Opening, WorkerLostError

ATTEMPTS = 2  # to work on an item, or to open
IN_FLIGHT = 4  # items a process, so that none waits for a slow one before
PARENT_LOST = 1  # exit code
GRACE = 10.0  # [s] for a process that has closed its pipe to end
# Not fork: the child would have the threads of this process stand still in the middle of their work.
CONTEXT = multiprocessing.get_context("spawn")
SIGNALS = {signal.SIGINT, signal.SIGTERM}  # are for this process, which ends the others
LIBRARIES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")


class Worker(NamedTuple):
    """A process, and our end of its pipe."""

    process: BaseProcess
    connection: Connection


class Processes:
    """Works on items in processes, which begin as they are needed; each opens once what it works with.

    An item whose process is killed is tried once more in a new one.
    """

    def __init__(self, opening: Opening, num_processes: int, num_threads: int = 1) -> None:
        self.opening, self.num_processes, self.num_threads = opening, num_processes, num_threads
        self._own = threading.local()  # its `worker` is the process of each thread
        self._workers: list[Worker] = []
        self._starting, self._is_closed = threading.Lock(), False
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
            for worker in self._workers:
                worker.process.kill()
        self._threads.shutdown(cancel_futures=True)
        for worker in self._workers:
            _bury(worker)

    def _submit(self, item: object) -> Future[Any]:
        return self._threads.submit(self._value_of, item)

    def _value_of(self, item: object) -> Any:
        """Ask this thread's process for a value."""
        ends = []
        for _ in range(ATTEMPTS):
            worker = self._worker()
            try:
                worker.connection.send(item)
                value, error = worker.connection.recv()
            except (EOFError, OSError):
                ends.append(self._end_of(worker))
                continue
            if error is not None:
                raise error
            return value
        raise WorkerLostError(f"each of {ATTEMPTS} processes at work on it {ends[-1]}")

    def _worker(self) -> Worker:
        """The process of this thread, or a new one, when it has opened what it needs."""
        own: Worker | None = getattr(self._own, "worker", None)
        if own:
            return own
        for _ in range(ATTEMPTS):
            worker = self._start()
            try:
                error = worker.connection.recv()
            except (EOFError, OSError):
                end = self._end_of(worker)
                continue
            if error is not None:
                raise error
            self._own.worker = worker
            return worker
        raise InputError(f"--jobs: a process {end} while it opened the scan; wanted fewer, or more memory")

    def _start(self) -> Worker:
        with self._starting, library_threads(self.num_threads):
            if self._is_closed:
                raise CancelledError
            ours, theirs = CONTEXT.Pipe()
            process = CONTEXT.Process(target=_work, args=(self.opening, theirs), daemon=True)
            process.start()
            theirs.close()
            self._workers.append(Worker(process, ours))
        return self._workers[-1]

    def _end_of(self, worker: Worker) -> str:
        """How a process ended, of which nothing is left then."""
        with self._starting:
            if self._is_closed:
                raise CancelledError
            self._workers.remove(worker)
        self._own.worker = None
        return _bury(worker)


def _bury(worker: Worker) -> str:
    worker.connection.close()
    worker.process.join(GRACE)
    worker.process.kill()  # where it hangs in its exit
    worker.process.join()
    code = worker.process.exitcode or 0
    return f"was killed by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"


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


def _work(opening: Opening, connection: Connection) -> None:
    """What a process does: open, say so, then a value or an error for each item, until the pipe is closed."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    share_arenas()
    with suppress(EOFError, OSError):  # the pipe is closed
        try:
            function = opening()
        except BaseException as error:
            connection.send(_with_traceback(error))
            return
        connection.send(None)
        while True:
            connection.send(_outcome(function, connection.recv()))


def _outcome(function: Function, item: object) -> tuple[Any, BaseException | None]:
    try:
        return function(item), None
    except BaseException as error:
        return None, _with_traceback(error)


def _with_traceback(error: BaseException) -> BaseException:
    """An error that can be pickled, with its traceback as a note, which --debug shows."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # whatever its own code raises
        error = RuntimeError(repr(error))
    error.add_note(f"in a process of --jobs:\n{traceback.format_exc()}")
    return error


def _end_with_parent() -> None:
    """End this process at once when the one that started it has ended, even by SIGKILL."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(PARENT_LOST)
