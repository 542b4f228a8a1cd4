"""What is known of a file's whole content, kept for as long as the file stays as it is.

A fact goes by the file's identity: device, inode, size, times of the last change of content and of status.
Only the system sets the last: nobody who writes to a file can give it the identity of the old one.
"""

import hashlib
import os
from contextlib import suppress
from pathlib import Path

from .atomic import write_atomically
from .cache import mark_used, own_names, private_folder

NAME = own_names("fact")
MAX_SIZE = 200  # [byte] of a fact


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
