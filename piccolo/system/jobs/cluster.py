"""Items worked on by a Dask cluster, whose scheduler gives what a lost worker had to others."""

import json
import pickle
import socket
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from functools import lru_cache, partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

from ... import __version__
from ..errors import InputError, import_optional
from .processes import IN_FLIGHT, Function, InFlight, Opening, WorkerLostError

TIMEOUT = 10.0  # [s] for a scheduler to answer, and for a first worker to be there
LEAST_IN_FLIGHT = 64  # as workers may come later
KEPT_OPEN = 2  # functions of a worker, when several commands use it
LOGGING = dict.fromkeys(("distributed", "distributed.client", "distributed.gc"), "critical")
NO_SCHEDULER = f"`dask` {{}}: no scheduler answers there within {TIMEOUT:.0f} s ({{}}); wanted "
NO_SCHEDULER += "its address, such as tcp://host:8786, or the file that it has written"
_opening = threading.Lock()


@contextmanager
def connect(address: str) -> Iterator["Cluster"]:
    """Yield the cluster of a scheduler's address or file.

    Raises InputError if dask.distributed is missing, or no scheduler or worker of this version answers.
    """
    import_optional("`dask`", "dask", "cluster").config.set({"logging": LOGGING})
    distributed = import_optional("`dask`", "distributed", "cluster")
    scheduler = _scheduler_at(address)
    try:
        client = distributed.Client(scheduler, timeout=TIMEOUT, set_as_default=False)
    except OSError as error:
        raise InputError(NO_SCHEDULER.format(address, error)) from error
    with client:
        cluster = Cluster(address, client, distributed)
        cluster.check_workers()
        try:
            yield cluster
        finally:
            cluster.forget()


def _scheduler_at(address: str) -> str:
    """Return the URL at which the scheduler of an address, or of the file that it wrote, listens."""
    try:
        if Path(address).is_file():
            address = str(json.loads(Path(address).read_bytes())["address"])
        url = urlsplit(address if "://" in address else f"tcp://{address}")
        with socket.create_connection((url.hostname, url.port or 0), TIMEOUT) as connection:
            if url.scheme == "tcp" and not connection.recv(1):  # for which a client would wait for ever
                raise OSError("it says nothing")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(NO_SCHEDULER.format(address, error)) from error
    return url.geturl()


class Cluster:
    """Workers of a Dask scheduler; each process opens the scan once."""

    def __init__(self, address: str, client: Any, distributed: Any) -> None:
        self.address = address
        self._client = client
        self._distributed = distributed
        self._opening = b""  # pickled
        self._sent: list[str] = []  # names of files

    def check_workers(self) -> None:
        """Refuse a cluster without workers, or with one of another version."""
        try:
            self._client.wait_for_workers(1, TIMEOUT)
            versions = set(self._client.run(_version).values())
        except TimeoutError as error:
            text = f"found a scheduler without workers for {TIMEOUT:.0f} s, wanted one at least"
            raise InputError(f"`dask` {self.address}: {text}") from error
        except Exception as error:  # of a worker, in words
            text = f"a worker can't run piccolo ({error}); install version {__version__} there"
            raise InputError(f"`dask` {self.address}: {text}") from error
        if odd := sorted(versions - {__version__}):
            text = f"found a worker with piccolo {odd[0]}, wanted {__version__} as here"
            raise InputError(f"`dask` {self.address}: {text}")

    def has_files(self, paths: Sequence[Path]) -> bool:
        """Return True if all workers see the files."""
        return all(self._client.run(_are_files, [str(path) for path in paths]).values())

    def send_file(self, path: Path) -> None:
        """Send a file to each worker, those that come later too: `sent_file` finds it there by its name."""
        plugin = self._distributed.diagnostics.plugin.UploadFile(str(path), load=False)
        self._client.register_plugin(plugin, name=path.name)
        self._sent.append(path.name)

    def forget(self) -> None:
        """Let the workers, which go on, drop what was sent and opened; nothing if they are lost."""
        if self._client.status == "running":
            with suppress(OSError, self._distributed.client.FutureCancelledError):
                for name in self._sent:
                    self._client.unregister_worker_plugin(name)
                self._client.run(_forget, self._sent)
                self._sent.clear()

    def executor(self, opening: Opening) -> "Cluster":
        """Return what works on items by the function that `opening` gives."""
        self._opening = pickle.dumps(opening)
        return self

    def values(self, items: Iterator[Any]) -> InFlight:
        """Begin with the items."""
        num_threads = sum(self._client.nthreads().values())
        return InFlight(self._submit, items, max(LEAST_IN_FLIGHT, IN_FLIGHT * num_threads))

    def _submit(self, item: object) -> SimpleNamespace:
        future = self._client.submit(value_of, self._opening, item, pure=False)
        return SimpleNamespace(done=future.done, result=partial(self._result_of, future))

    def _result_of(self, future: Any) -> Any:
        """Wait for a value; or for what the function raised, or WorkerLostError, which are raised."""
        try:
            return future.result()
        except self._distributed.scheduler.KilledWorker as error:
            count = error.allowed_failures + 1
            raise WorkerLostError(f"each of {count} workers of the cluster was lost at work on it") from error
        except (self._distributed.client.FutureCancelledError, CancelledError) as error:
            text = f"`dask` {self.address}: the scheduler was lost; the same command continues from here"
            raise InputError(text) from error


def find_sent_file(name: str) -> Path:
    """Return where a worker has what `Cluster.send_file` has sent it."""
    worker = import_optional("`dask`", "distributed", "cluster").get_worker()
    return Path(worker.local_directory) / name


@lru_cache(KEPT_OPEN)
def _function(opening: bytes) -> Function:
    opened: Function = pickle.loads(opening)()
    return opened


def value_of(opening: bytes, item: object) -> Any:
    """Return the value of an item, at a worker."""
    with _opening:  # once, however many threads the worker has
        function = _function(opening)
    return function(item)


def _forget(names: Sequence[str], dask_worker: Any) -> None:
    _function.cache_clear()
    for name in names:
        (Path(dask_worker.local_directory) / name).unlink(missing_ok=True)


def _version() -> str:
    return __version__


def _are_files(paths: Sequence[str]) -> bool:
    return all(Path(path).is_file() for path in paths)
