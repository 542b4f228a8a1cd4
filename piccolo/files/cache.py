"""The folders for what is kept between runs: compiled kernels and prepared maps.

Nothing is deleted but files that have a name of ours, in a folder that this program has made and marked.
"""

import errno
import hashlib
import logging
import os
import re
import stat
import tempfile
import time
from contextlib import suppress
from functools import cache
from pathlib import Path

from .atomic import temporary_prefix, write_atomically

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
        for path in sorted((Path(__file__).parents[1] / folder).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


@cache
def cache_root() -> Path:
    """The folder for everything this program keeps between runs (XDG base directory specification), made now.

    Where it can't be written, or others may write to it, a folder of the user's own among the temporary files
    takes its place; what lies there may hold code. OSError where that can't be trusted either.
    """
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")  # noqa: PTH111  # never raises
    root = Path(home) / "piccolo"
    temporary = Path(tempfile.gettempdir())
    with suppress(OSError):
        if not root.is_absolute():
            raise FileNotFoundError
        if is_own(make_writable(root).stat(), WRITABLE):
            return root
        log.warning("%s: others may write to it, and nothing there is trusted; chmod go-w it", root)
    fallback = temporary / f"piccolo-{os.getuid()}"
    fallback.mkdir(PRIVATE, exist_ok=True)
    # One look, at the entry itself: where only its owner may rename it, what is found stays true.
    if not is_own(fallback.lstat(), OPEN) or temporary.stat().st_mode & (WRITABLE | stat.S_ISVTX) == WRITABLE:
        raise PermissionError(errno.EACCES, "others may write to it", str(fallback))
    return make_writable(fallback)


def make_writable(folder: Path) -> Path:
    """The folder, made if need be, private then; OSError if no file can be written into it."""
    folder.mkdir(PRIVATE, parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder):
        return folder


def is_own(status: os.stat_result, forbidden: int) -> bool:
    """True for the user's own folder without the `forbidden` permissions."""
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & forbidden


def own_names(ending: str) -> re.Pattern[str]:
    """The names of our files in a folder, by digest, and of those that a killed process was writing."""
    name = f"{32 * '0'}.{ending}"
    either = f"{re.escape(name)}|{re.escape(temporary_prefix(name))}[0-9a-f]{{16}}"
    return re.compile(either.replace(32 * "0", "[0-9a-f]{32}"))


def own_folder(folder: Path, name: re.Pattern[str], mode: int = ALL) -> Path:
    """A folder for files of ours, made and marked if it is new; stale files of a marked one are deleted."""
    folder.mkdir(mode, parents=True, exist_ok=True)
    tag = folder / TAG
    if not any(folder.iterdir()):
        write_atomically(tag, TAG_CONTENT)
    elif tag.is_file() and tag.read_bytes() == TAG_CONTENT:
        remove_stale(folder, name)
    return folder


@cache
def private_folder(name: str, files: re.Pattern[str]) -> Path | None:
    """A folder of the user's cache that nobody else can write to, made now; None where that can't be."""
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
