"""A file of JSON lines that grows: each line whole on disk before the next begins, one process at a time."""

import fcntl
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from ..errors import InputError

BLOCK = 1 << 20  # [byte] read at a time


def whole_size(path: Path, begins: bytes, what: str) -> int:
    """The size [byte] of a file of lines up to the end of its last whole one; 0 if there is no file.

    A last line that is torn, as it was being written, begins with `begins`.

    Raises
    ------
    InputError
        The end of the file is no beginning of such a line: it is not `what`.
    """
    if not path.exists():
        return 0
    with path.open("rb") as file:
        size = end = file.seek(0, os.SEEK_END)
        torn = b""
        while end > 0 and b"\n" not in torn:
            begin = max(end - BLOCK, 0)
            file.seek(begin)
            torn, end = file.read(end - begin) + torn, begin
    torn = torn[torn.rfind(b"\n") + 1 :]
    if torn[: len(begins)] != begins[: len(torn)]:
        raise InputError(f"{path}: its end is no line of {what}")
    return size - len(torn)


def whole_lines(path: Path, size: int) -> Iterator[bytes]:
    """The lines in the first `size` bytes of a file."""
    if size:
        with path.open("rb") as file:
            while file.tell() < size:
                yield file.readline()


@contextmanager
def appending(path: Path, size: int | None) -> Iterator[Callable[[str], None]]:
    """A function that appends one line at once, to a file that is made or first cut to `size` bytes.

    It should have its whole lines within `size`; None begins it anew, whatever is in it.

    A line that does not fit on the disk is taken back: the lines before stay whole.

    Raises
    ------
    InputError
        Another process is writing the file, or has since it was read.
    OSError
        The file can't be written.
    """
    is_new = not path.exists()
    handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(f"{path}: another process is writing it; wait for its end") from error
        if size is not None and b"\n" in os.pread(handle, os.fstat(handle).st_size, size):
            raise InputError(f"{path}: another process has written it since; start again")
        os.ftruncate(handle, size or 0)

        def append(line: str) -> None:
            begin, rest = os.fstat(handle).st_size, memoryview(line.encode() + b"\n")
            try:
                while rest:
                    rest = rest[os.write(handle, rest) :]
                os.fsync(handle)
            except OSError as error:
                os.ftruncate(handle, begin)
                raise OSError(error.errno, os.strerror(error.errno or 0), str(path)) from error

        yield append
        if is_new and os.fstat(handle).st_size == 0:
            path.resolve().unlink()
    finally:
        os.close(handle)
