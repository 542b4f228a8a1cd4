"""What a long work has done so far, on disk, so that it goes on where its process was killed.

A part is a file of the arrays made from some items in a row. It has a digest, and lies where only the user
may write: what is read is what was written.
"""

import hashlib
import os
import re
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .atomic import replacing
from .cache import private_folder

# of a part, and of one that was being written
NAME = re.compile(r"[0-9a-f]{32}-[0-9a-f]{16}-\d+\.part|\.[0-9a-f]{32}-[0-9a-f]{7}\.[0-9a-f]{16}")
DIGEST_SIZE = hashlib.sha256().digest_size
EVERY_S = 5.0  # of work are lost at most, in each stage
Arrays = tuple[NDArray[Any], ...]


def parts_folder() -> Path | None:
    """The user's folder of parts; None where there can be none."""
    return private_folder("unfinished", NAME)


def digest_from_here(file: Any, path: Path) -> bytes:
    """What stands before the rest of a file: it tells damage, and another file's content."""
    return hashlib.file_digest(file, lambda: hashlib.sha256(path.name.encode())).digest()


class Unfinished:
    """The parts of one work, which its key tells from all others; without a key nothing is kept."""

    def __init__(self, key: str = "") -> None:
        self.key, self.is_begun = key, False

    def _path(self, name: str) -> Path | None:
        folder = parts_folder() if self.key else None
        return folder and folder / f"{hashlib.sha256(self.key.encode()).hexdigest()[:32]}-{name}.part"

    def stage(self, label: str, about: Sequence[NDArray[Any]]) -> "Stage":
        """One stage of the work, told from others by its label and by all that its items depend on."""
        self.is_begun, digest = True, hashlib.sha256(label.encode())
        for array in about:
            digest.update(np.ascontiguousarray(array).view(np.uint8).data)
        return Stage(self, digest.hexdigest()[:16])

    def read(self, name: str) -> list[Arrays]:
        """The arrays of a part; none if it is not there or damaged."""
        path, arrays = self._path(name), list[NDArray[Any]]()
        with suppress(OSError):
            if path is None:
                return []
            with path.open("rb") as file:
                digest = file.read(DIGEST_SIZE)
                if digest_from_here(file, path) == digest:
                    end = file.seek(0, os.SEEK_END)
                    file.seek(DIGEST_SIZE)
                    while file.tell() < end:
                        arrays.append(np.load(file, allow_pickle=False))
        size = int(arrays.pop()) if arrays else 1
        return [tuple(arrays[k : k + size]) for k in range(0, len(arrays), size)]

    def write(self, name: str, values: Sequence[Arrays]) -> None:
        """Keep a part; lost where that can't be."""
        if path := self._path(name):
            with suppress(OSError), replacing(path) as file:
                file.write(bytes(DIGEST_SIZE))
                for array in (*(array for value in values for array in value), np.array(len(values[0]))):
                    np.save(file, array, allow_pickle=False)
                file.seek(DIGEST_SIZE)
                digest = digest_from_here(file, path)
                file.seek(0)
                file.write(digest)

    def finish(self) -> None:
        """Remove all parts, also half written ones: the work is done."""
        if self.is_begun and (path := self._path("")):
            prefix = path.name.partition("-")[0]
            for part in (*path.parent.glob(f"{prefix}-*"), *path.parent.glob(f".{prefix}-*")):
                part.unlink(missing_ok=True)


class Stage:
    """What one stage makes of its items, in their order."""

    def __init__(self, work: Unfinished, name: str) -> None:
        self.work, self.name = work, name
        self.since = time.monotonic()
        self.done: list[Arrays] = []
        self.num_kept = 0

    def read(self) -> None:
        """Take what an earlier process has done."""
        while part := self.work.read(f"{self.name}-{len(self.done)}"):
            self.done += part
        self.num_kept = len(self.done)

    def add(self, value: Arrays) -> None:
        """What was made of the next item; every few seconds what is new is kept."""
        self.done.append(value)
        if time.monotonic() - self.since > EVERY_S:
            self.work.write(f"{self.name}-{self.num_kept}", self.done[self.num_kept :])
            self.num_kept, self.since = len(self.done), time.monotonic()
