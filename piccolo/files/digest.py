"""SHA-256 digests of files and arrays, and other facts of a file, kept for as long as it stays as it is.

A fact goes by the file's identity: device, inode, size, times of the last change of content and of status.
Only the system sets the last: nobody who writes to a file can give it the identity of the old one.
"""

import hashlib
import os
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .atomic import write_atomically
from .cache import mark_used, own_names, private_folder

NAME = own_names("fact")
MAX_SIZE = 200  # [byte] of a fact
TICK_NS = 50_000_000  # the clock of files moves on every 1 to 10 ms


def key_of(what: str, status: os.stat_result) -> str:
    """A name for `what` of a file of this status: another as soon as it changes."""
    identity = status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
    return hashlib.sha256(repr((what, identity)).encode()).hexdigest()[:32]


def _path(what: str, status: os.stat_result) -> Path | None:
    """The file in which `what` is kept of a file of this status."""
    folder = private_folder("facts", NAME)
    return folder and folder / f"{key_of(what, status)}.fact"


def recall(what: str, status: os.stat_result) -> str | None:
    """What was remembered of a file by its status; None if nothing was, or the file has changed since."""
    path = _path(what, status)
    if path is None:
        return None
    with suppress(OSError, UnicodeDecodeError):
        with path.open("rb") as file:
            fact = file.read(MAX_SIZE).decode()
        mark_used(path)
        return fact
    return None


def remember(what: str, status: os.stat_result, fact: str) -> None:
    """Keep a line about a file, by the status that it had before it was read; lost where that can't be."""
    if path := _path(what, status):
        with suppress(OSError):
            write_atomically(path, fact.encode())


def sha256_of_files(paths: Sequence[Path], remembers: bool = False) -> str:
    """A file's digest as sha256sum prints it; of several the digest of theirs, sorted, a line each.

    With `remembers`, a file that has stayed as it was when it was last read is not read again.
    """
    digests = sorted(_sha256_of_file(path, remembers) for path in paths)
    return digests[0] if len(digests) == 1 else hashlib.sha256("\n".join(digests).encode()).hexdigest()


def _sha256_of_file(path: Path, remembers: bool) -> str:
    with path.open("rb") as file:
        status = os.fstat(file.fileno())
        if remembers and (known := recall("sha256", status)) is not None:
            return known
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        # A file that changed a moment ago may change again before the clock of its times moves on.
        is_same = os.fstat(file.fileno()).st_ctime_ns == status.st_ctime_ns
        is_settled = is_same and time.time_ns() - status.st_ctime_ns > TICK_NS
    if remembers and is_settled:
        remember("sha256", status, digest)
    return digest


def sha256_of_arrays(*arrays: NDArray[Any]) -> str:
    """The digest of arrays: of type, shape and bytes of each."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype.str} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array).view(np.uint8).data)
    return digest.hexdigest()
