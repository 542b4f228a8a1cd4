"""A file of JSON lines that grows: each line whole on disk before the next begins, one process at a time.

A journal is such a file of the steps of a job, so that a stopped job goes on where it was.
"""

import json
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, TypeVar

from ..errors import InputError
from .atomic import hold_lock, replacing

LINE_BEGINS = b'["'
Kept = TypeVar("Kept")
KEY = "job"  # name of the first step, which tells what job it is


def whole_size(path: Path, begins: bytes, what: str) -> int:
    """Return the size [byte] of a file of lines up to the end of its last whole one; 0 if there is no file.

    A last line that is torn, as it was being written, begins with `begins`. Raises InputError if the end of
    the file is no beginning of such a line: it is not `what`.
    """
    if not path.exists() or path.stat().st_size == 0:
        return 0
    with path.open("rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as content:
        size = content.rfind(b"\n") + 1
        torn = content[size : size + len(begins)]
    if torn != begins[: len(torn)]:
        raise InputError(f"{path}: its last line does not belong to {what}")
    return size


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

    def __init__(self, path: Path) -> None:
        self.path = path
        self.stream = path.open("a+b", buffering=0)

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return os.fstat(self.stream.fileno()).st_size

    def cut(self, size: int) -> None:
        """Keep the first `size` bytes."""
        self.stream.truncate(size)

    def read(self, begin: int, end: int) -> bytes:
        """Return a span of bytes."""
        self.stream.seek(begin)
        return self.stream.read(end - begin)

    def append(self, line: str) -> None:
        """Append a line at once; one that does not fit on the disk is taken back, the others stay whole."""
        begin = self.size
        try:
            write_line(self.stream.fileno(), self.path, line)
            os.fsync(self.stream.fileno())
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
                file.write(self.read(begin, end))
            self.stream.close()  # Windows replaces no open file
        self.stream = self.path.open("a+b", buffering=0)


@contextmanager
def open_locked(path: Path) -> Iterator[LineFile]:
    """Yield a file of lines, made if there is none, and then removed at the end if nothing is in it.

    Raises InputError if another process is writing the file.
    """
    with hold_lock(path):
        is_new = not path.exists()
        file = LineFile(path)
        try:
            yield file
        finally:
            file.stream.close()
            if is_new and path.exists() and path.stat().st_size == 0:
                path.resolve().unlink()


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
        first = [] if self._earlier else [(KEY, self._key)]
        for line in (*first, (step, text)):
            self._file.append(json.dumps(line))
            self._earlier.append((line[0], "", self._file.size))
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
