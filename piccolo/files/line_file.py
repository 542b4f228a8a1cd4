"""A file of JSON lines that grows: each line whole on disk before the next begins, one process at a time.

A journal is such a file of the steps of a job, so that a stopped job goes on where it was.
"""

import fcntl
import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

from ..errors import InputError
from .atomic import replacing

BLOCK = 1 << 20  # [byte] read at a time
LINE_BEGINS = b'["'
Kept = TypeVar("Kept")
KEY = "job"  # name of the first step, which tells what job it is


def whole_size(path: Path, begins: bytes, what: str) -> int:
    """Return the size [byte] of a file of lines up to the end of its last whole one; 0 if there is no file.

    A last line that is torn, as it was being written, begins with `begins`. Raises InputError if the end of
    the file is no beginning of such a line: it is not `what`.
    """
    if not path.exists():
        return 0
    with path.open("rb") as file:
        size = end = file.seek(0, os.SEEK_END)
        torn = b""
        while end > 0 and b"\n" not in torn:
            begin = max(end - BLOCK, 0)
            file.seek(begin)
            torn = file.read(end - begin) + torn
            end = begin
    torn = torn[torn.rfind(b"\n") + 1 :]
    if torn[: len(begins)] != begins[: len(torn)]:
        raise InputError(f"{path}: its last line does not belong to {what}")
    return size - len(torn)


def whole_lines(path: Path, size: int, begin: int = 0) -> Iterator[bytes]:
    """Yield the lines in the first `size` bytes of a file, from one that begins at `begin`."""
    if size > begin:
        with path.open("rb") as file:
            file.seek(begin)
            while file.tell() < size:
                yield file.readline()


def write_line(handle: int, path: Path, line: str) -> None:
    """Write a whole line to what is open by a handle; an OSError names its path."""
    rest = memoryview(line.encode() + b"\n")
    try:
        while rest:
            rest = rest[os.write(handle, rest) :]
    except OSError as error:
        raise OSError(error.errno, os.strerror(error.errno or 0), str(path)) from error


class LineFile:
    """A file of lines that this process alone may write."""

    def __init__(self, path: Path, handle: int) -> None:
        self.path = path
        self._handle = handle

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return os.fstat(self._handle).st_size

    @property
    def is_in_place(self) -> bool:
        """False if the file was removed or replaced since it was opened."""
        with suppress(FileNotFoundError):
            return os.path.samestat(os.fstat(self._handle), self.path.stat())
        return False

    def cut(self, size: int) -> None:
        """Keep the first `size` bytes."""
        os.ftruncate(self._handle, size)

    def append(self, line: str) -> None:
        """Append a line at once; one that does not fit on the disk is taken back, the others stay whole."""
        begin = self.size
        try:
            write_line(self._handle, self.path, line)
            os.fsync(self._handle)
        except OSError:
            self.cut(begin)
            raise

    def rearrange(self, spans: Sequence[tuple[int, int]]) -> None:
        """Keep only these spans of bytes (begin, end), in this order; nobody sees a file between the two."""
        edges = [0, *(edge for span in spans for edge in span), self.size]
        if edges[::2] == edges[1::2]:
            return
        with replacing(self.path) as file:
            for begin, end in spans:
                file.write(os.pread(self._handle, end - begin, begin))


@contextmanager
def open_locked(path: Path) -> Iterator[LineFile]:
    """Yield a file of lines, made if there is none, and then removed at the end if nothing is in it.

    Raises InputError if another process is writing the file.
    """
    is_new = not path.exists()
    with path.open("a+b", buffering=0) as stream:
        try:
            fcntl.flock(stream.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(f"{path}: another process is writing it; wait for its end") from error
        file = LineFile(path, stream.fileno())
        if file.is_in_place:
            try:
                yield file
            finally:
                if is_new and file.size == 0 and file.is_in_place:
                    path.resolve().unlink()
            return
    with open_locked(path) as file:  # as it was removed or replaced by whoever had the lock before
        yield file


class Journal:
    """The steps that a job has done, in their order, each with a text; without a file nothing is kept."""

    def __init__(self, file: LineFile | None = None, key: str = "", ways: str = "") -> None:
        self._file = file
        self._key = key  # text of the first step
        self._ways = ways  # out of a file of something else
        self._earlier: list[tuple[str, str, int]] = []  # step, text, and end of its line [byte]
        self._num_recalled = 0

    @property
    def is_kept(self) -> bool:
        """True if the steps are on disk."""
        return self._file is not None

    def read(self, file: LineFile) -> None:
        """Read the steps of an earlier run; InputError for what are none."""
        size = whole_size(file.path, LINE_BEGINS, f"steps of a job: {self._ways}")
        end = 0
        for line in whole_lines(file.path, size):
            end += len(line)
            try:
                step, text = json.loads(line)
            except ValueError as error:
                raise self._damaged(error) from error
            self._earlier.append((str(step), str(text), end))

    def recall(self, steps: Iterable[str], take: Callable[[int, str], Kept]) -> list[Kept]:
        """Return what `take` makes of numbers and texts of the next steps, up to one that is not done.

        What an earlier run did instead, and after it, is forgotten. `take` raises ValueError for a damaged
        text.
        """
        taken: list[Kept] = []
        for number, step in enumerate(steps):
            if self._num_recalled == len(self._earlier) or self._earlier[self._num_recalled][0] != step:
                del self._earlier[self._num_recalled :]
                if self._file is not None:
                    self._file.cut(self._earlier[-1][2] if self._earlier else 0)
                break
            try:
                taken.append(take(number, self._earlier[self._num_recalled][1]))
            except ValueError as error:
                raise self._damaged(error) from error
            self._num_recalled += 1
        return taken

    def _damaged(self, error: ValueError) -> InputError:
        where = self._file.path if self._file else ""
        return InputError(f"{where}: found a damaged line ({type(error).__name__}); {self._ways}")

    def append(self, step: str, text: str) -> None:
        """Keep the text of a step that is done."""
        if self._file is None:
            return
        if not self._earlier:
            self._append(KEY, self._key)
        self._append(step, text)

    def _append(self, step: str, text: str) -> None:
        assert self._file is not None
        self._file.append(json.dumps([step, text]))
        self._earlier.append((step, "", self._file.size))
        self._num_recalled += 1


@contextmanager
def keeping_steps(path: Path | None, key: dict[str, Any], ways: str, is_new: bool) -> Iterator[Journal]:
    """Yield a journal in a file, with the steps of an earlier run of the same job, unless it begins anew.

    Raises InputError, with the `ways` out, for the file of another job.
    """
    if path is None:
        yield Journal()
        return
    with open_locked(path) as file:
        text = json.dumps(key, sort_keys=True)
        journal = Journal(file, text, ways)
        if not is_new:
            journal.read(file)
        if journal.recall([KEY], lambda _, found: found == text) == [False]:
            raise InputError(f"{path}: found a job with other settings, another scan or version; {ways}")
        yield journal
