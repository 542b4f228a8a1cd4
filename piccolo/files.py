"""Files that are either whole or not there."""

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from .errors import InputError


def check_output(path: Path, inputs: list[Path]) -> None:
    """Refuse, before any work is done, a file that could not be written or that is one of the inputs."""
    folder = path.parent
    if not folder.is_dir():
        raise InputError(f"{path}: found no folder {folder}, wanted one that exists")
    if path.is_dir():
        raise InputError(f"{path}: found a folder, wanted a file name")
    if not os.access(folder, os.W_OK):
        raise InputError(f"{path}: found a folder without write permission, wanted one that can be written")
    if path.exists() and any(other.exists() and path.samefile(other) for other in inputs):
        raise InputError(f"{path}: found an input as the output, wanted another name")


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """A file to write under a temporary name in the same folder, renamed to `path` at the end.

    Nobody sees half a file, and after an error nothing is left.
    """
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w+b") as file:
            yield file
        umask = os.umask(0)
        os.umask(umask)
        Path(temporary).chmod(0o666 & ~umask)  # mkstemp's files are private
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


def write_atomically(path: Path, content: bytes) -> None:
    """Write `content` to `path`, whole or not at all."""
    with replacing(path) as file:
        file.write(content)
