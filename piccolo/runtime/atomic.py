"""Files that are either whole or not there."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from ..errors import InputError


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


def check_output_folder(path: Path) -> None:
    """Refuse, before any work is done, a folder that could not be made or that has something in it."""
    if path.is_dir() and not any(path.iterdir()):
        return
    if path.exists():
        kind = "a folder that is not empty" if path.is_dir() else "a file"
        raise InputError(f"{path}: found {kind}, wanted a folder that is new or empty")
    if not path.parent.is_dir():
        raise InputError(f"{path}: found no folder {path.parent}, wanted one that exists")
    if not os.access(path.parent, os.W_OK):
        raise InputError(
            f"{path}: found {path.parent} without write permission, wanted one that can be written"
        )


@contextmanager
def replacing(path: Path) -> Iterator[IO[bytes]]:
    """A file to write under a temporary name in the same folder, renamed to `path` at the end.

    Nobody sees half a file, and after an error nothing is left.
    """
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "w+b") as file:
            yield file
        _open_to_umask(Path(temporary), 0o666)
        Path(temporary).replace(path)
    except BaseException:
        Path(temporary).unlink(missing_ok=True)
        raise


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """A folder to fill under a temporary name beside `path`, which is new or empty, renamed to it at the end.

    Nobody sees it half full, and after an error nothing is left.
    """
    temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
    try:
        yield temporary
        _open_to_umask(temporary, 0o777)
        temporary.replace(path)
    except BaseException:
        shutil.rmtree(temporary)
        raise


def _open_to_umask(path: Path, mode: int) -> None:
    """Temporary files and folders are private; what they become is not."""
    umask = os.umask(0)
    os.umask(umask)
    path.chmod(mode & ~umask)


def write_atomically(path: Path, content: bytes) -> None:
    """Write `content` to `path`, whole or not at all."""
    with replacing(path) as file:
        file.write(content)
