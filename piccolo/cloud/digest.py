"""SHA-256 digests of what a scan is read from, in hexadecimal digits."""

import hashlib
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..files.file_facts import recall, remember

DIGEST, TICK_NS = "sha256", 50_000_000  # the clock of files moves on every 1 to 10 ms


def sha256_of_files(paths: Sequence[Path], remembers: bool = False) -> str:
    """A file's digest as sha256sum prints it; of several the digest of theirs, sorted, a line each.

    With `remembers`, a file that has stayed as it was when it was last read is not read again.
    """
    digests = sorted(_sha256_of_file(path, remembers) for path in paths)
    return digests[0] if len(digests) == 1 else hashlib.sha256("\n".join(digests).encode()).hexdigest()


def _sha256_of_file(path: Path, remembers: bool) -> str:
    with path.open("rb") as file:
        status = os.fstat(file.fileno())
        if remembers and (known := recall(DIGEST, status)) is not None:
            return known
        digest = hashlib.file_digest(file, "sha256").hexdigest()
        # A file that changed a moment ago may change again before the clock of its times moves on.
        is_same = os.fstat(file.fileno()).st_ctime_ns == status.st_ctime_ns
        is_settled = is_same and time.time_ns() - status.st_ctime_ns > TICK_NS
    if remembers and is_settled:
        remember(DIGEST, status, digest)
    return digest


def sha256_of_arrays(*arrays: NDArray[Any]) -> str:
    """The digest of arrays: of type, shape and bytes of each."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype.str} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array).view(np.uint8).data)
    return digest.hexdigest()
