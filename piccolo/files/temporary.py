"""Folders of temporary files, which a later process removes where a killed one left them."""

import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

PREFIX = "piccolo-temporary-"
YOUNG_S = 10.0  # a folder is made a moment before it is locked


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """Make a folder that is removed at the end, or else by the next process that makes one."""
    for left in Path(tempfile.gettempdir()).glob(f"{PREFIX}????????"):
        with suppress(OSError):  # it is in use, or not ours
            status = left.lstat()
            if status.st_uid == os.getuid() and time.time() - status.st_mtime > YOUNG_S:
                with _hold_lock(left):
                    shutil.rmtree(left)
    with tempfile.TemporaryDirectory(prefix=PREFIX) as name, _hold_lock(Path(name)):
        yield Path(name)


@contextmanager
def _hold_lock(folder: Path) -> Iterator[None]:
    """Hold a folder's lock, which ends with the process; OSError if another has it."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield
    finally:
        os.close(handle)
