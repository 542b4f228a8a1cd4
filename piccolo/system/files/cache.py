"""Caches kept between runs: the folders of compiled kernels and prepared maps, and facts of files.

Nothing is deleted but files that have a name of ours, in a folder that this program has made and marked.

A fact, such as a SHA-256 digest, goes by the file's identity: device, inode, size, times of the last change
of content and of status. Only the system sets the last: nobody who writes to a file can give it the identity
of the old one.
"""

import errno
import hashlib
import logging
import os
import re
import stat
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .atomic import IS_WINDOWS, temporary_prefix, write_atomically

STALE_AFTER_S = 30 * 24 * 3600.0
MARKED_FOR_S = 24 * 3600.0
PRIVATE = 0o700
ALL = 0o777
WRITABLE = 0o022  # by others
OPEN = 0o077  # by others in any way
TAG = "CACHEDIR.TAG"  # https://bford.info/cachedir/: backups leave such folders out
TAG_CONTENT = (
    b"Signature: 8a477f597d28d172789f06886806bc55\n# Made by PICCOLO, which deletes its own old files.\n"
)
log = logging.getLogger("piccolo")


@cache
def digest_of_sources(folders: tuple[str, ...]) -> str:
    """Digest of the sources in some of the package's folders: what they make is made anew when it changes."""
    digest = hashlib.sha256()
    for folder in folders:
        for path in sorted((Path(__file__).parents[2] / folder).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def caches_of_user() -> Path:
    """Return the folder in which programs of this system keep what they can make again."""
    chosen = Path(os.environ.get("LOCALAPPDATA" if IS_WINDOWS else "XDG_CACHE_HOME", ""))
    if chosen.is_absolute():
        return chosen
    return Path.home() / {"win32": "AppData/Local", "darwin": "Library/Caches"}.get(sys.platform, ".cache")


@cache
def cache_root() -> Path:
    """Return the user's folder for what is kept between runs (on Linux $XDG_CACHE_HOME/piccolo), made now.

    Where it can't be written, or others may write to it, a folder of the user's own among the temporary files
    takes its place; what lies there may hold code. OSError where that can't be trusted either.
    """
    temporary = Path(tempfile.gettempdir())
    with suppress(OSError, RuntimeError):  # Python's error where there is no home
        root = caches_of_user() / "piccolo"
        if not root.is_absolute():
            raise FileNotFoundError
        if is_own(make_writable(root).stat(), WRITABLE):
            return root
        log.warning("%s: other users may write to it, so it is not used; run chmod go-w on it", root)
    fallback = temporary / f"piccolo-{'user' if IS_WINDOWS else os.getuid()}"
    fallback.mkdir(PRIVATE, exist_ok=True)
    # One look, at the entry itself: where only its owner may rename it, what is found stays true.
    is_open = not IS_WINDOWS and temporary.stat().st_mode & (WRITABLE | stat.S_ISVTX) == WRITABLE
    if is_open or not is_own(fallback.lstat(), OPEN):
        raise PermissionError(errno.EACCES, "other users may write to it", str(fallback))
    return make_writable(fallback)


def make_writable(folder: Path) -> Path:
    """Return the folder, made if need be, private then; OSError if no file can be written into it."""
    folder.mkdir(PRIVATE, parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        return folder


def is_own(status: os.stat_result, forbidden: int) -> bool:
    """Return True for the user's own folder without the `forbidden` permissions; on Windows all are."""
    is_safe = IS_WINDOWS or (status.st_uid == os.getuid() and not status.st_mode & forbidden)
    return stat.S_ISDIR(status.st_mode) and is_safe


def own_names(ending: str) -> re.Pattern[str]:
    """Return names of our files in a folder, by digest, and of those that a killed process was writing."""
    name = f"{32 * '0'}.{ending}"
    either = f"{re.escape(name)}|{re.escape(temporary_prefix(name))}[0-9a-f]{{16}}"
    return re.compile(either.replace(32 * "0", "[0-9a-f]{32}"))


def own_folder(folder: Path, name: re.Pattern[str], mode: int = ALL) -> Path:
    """Return a folder of our files, made and marked if it is new; in a marked one stale ones are deleted."""
    folder.mkdir(mode, parents=True, exist_ok=True)
    tag = folder / TAG
    if not any(folder.iterdir()):
        write_atomically(tag, TAG_CONTENT)
    elif tag.is_file() and tag.read_bytes() == TAG_CONTENT:
        remove_stale(folder, name)
    return folder


@cache
def private_folder(name: str, files: re.Pattern[str]) -> Path | None:
    """Return a folder of the cache, made now, that nobody else can write to; None where that can't be."""
    with suppress(OSError):
        folder = own_folder(cache_root() / name, files, PRIVATE)
        return folder if is_own(folder.stat(), WRITABLE) else None
    return None


def remove_stale(folder: Path, name: re.Pattern[str]) -> None:
    """Delete the files of a folder that have a name of ours and have not been used for a month."""
    for entry in folder.iterdir():
        with suppress(OSError):  # another process was faster, or the file is not ours to delete
            status = entry.lstat()
            is_old = time.time() - status.st_mtime > STALE_AFTER_S
            if is_old and name.fullmatch(entry.name) and stat.S_ISREG(status.st_mode):
                entry.unlink()


def mark_used(path: Path) -> None:
    """Set a file's time to now, once a day, so that it stays; a file that may only be read keeps its time."""
    with suppress(OSError):
        if time.time() - path.stat().st_mtime > MARKED_FOR_S:
            os.utime(path)


def in_words(error: OSError) -> str:
    """Why a cache can't be used: the file, if it is known, and what the system says."""
    place = f"{error.filename}: " if error.filename else ""
    return f"{place}{error.strerror or error}"


FACT_NAME = own_names("fact")
TICK_NS = 50_000_000  # the clock of files moves on every 1 to 10 ms


def make_key(what: str, status: os.stat_result) -> str:
    """Return a name for `what` of a file of this status: another as soon as it changes."""
    identity = status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns
    return hashlib.sha256(repr((what, identity)).encode()).hexdigest()[:32]


def _path_of(what: str, status: os.stat_result) -> Path | None:
    """Return the file in which `what` is kept of a file of this status."""
    folder = private_folder("facts", FACT_NAME)
    return folder and folder / f"{make_key(what, status)}.fact"


def recall(what: str, status: os.stat_result) -> str | None:
    """Recall facts of a file by its status; None if none are kept, or the file has changed since."""
    path = _path_of(what, status)
    if path is None:
        return None
    with suppress(OSError, UnicodeDecodeError):
        with path.open("rb") as file:
            fact = file.read(200).decode()
        mark_used(path)
        return fact
    return None


def remember(what: str, status: os.stat_result, fact: str) -> None:
    """Keep a line about a file, by the status that it had before it was read; lost where that can't be."""
    if path := _path_of(what, status):
        with suppress(OSError):
            write_atomically(path, fact.encode())


def sha256_of_files(paths: Sequence[Path], remembers: bool = False) -> str:
    """Return a file's digest as sha256sum prints it; of several the digest of theirs, sorted, a line each.

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
    """Return the digest of arrays: of type, shape and bytes of each."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype.str} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array).view(np.uint8).data)
    return digest.hexdigest()
