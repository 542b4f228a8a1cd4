"""The folder for what is kept between runs: compiled kernels and prepared maps."""

import os
import re
import stat
import tempfile
import time
from contextlib import suppress
from functools import cache
from pathlib import Path

STALE_AFTER_S = 30 * 24 * 3600.0
PRIVATE = 0o700


@cache
def cache_root() -> Path:
    """The folder for everything this program keeps between runs (XDG base directory specification), made now.

    Where it can't be written, a folder of the user's own among the temporary files takes its place; what lies
    there may hold code, so it belongs to nobody else and nobody else may write to it.
    """
    home = os.environ.get("XDG_CACHE_HOME") or str(Path("~/.cache").expanduser())
    root = Path(home) / "piccolo"
    if _is_writable_folder(root):
        return root
    fallback = Path(tempfile.gettempdir()) / f"piccolo-{os.getuid()}"
    return fallback if _is_private_folder(fallback) else Path(tempfile.mkdtemp(prefix="piccolo-"))


def _is_writable_folder(folder: Path) -> bool:
    """True if the folder is there, made if need be, and a file can be written into it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def _is_private_folder(folder: Path) -> bool:
    """True if the folder, made if need be, is the user's own and closed to others; no link is followed."""
    try:
        folder.mkdir(mode=PRIVATE, exist_ok=True)
        status = folder.lstat()
    except OSError:
        return False
    return (
        stat.S_ISDIR(status.st_mode)
        and status.st_uid == os.getuid()
        and stat.S_IMODE(status.st_mode) == PRIVATE
    )


def mark_used(path: Path) -> None:
    """Set a file's time to now, so that it stays; a file that may only be read keeps its time."""
    with suppress(OSError):
        os.utime(path)


def remove_stale(folder: Path, name: re.Pattern[str]) -> None:
    """Delete the files of a folder that have a name of ours and have not been used for a month."""
    for entry in folder.iterdir():
        try:
            is_old = time.time() - entry.stat().st_mtime > STALE_AFTER_S
            if is_old and name.fullmatch(entry.name) and entry.is_file():
                entry.unlink()
        except FileNotFoundError:  # another process was faster
            continue
