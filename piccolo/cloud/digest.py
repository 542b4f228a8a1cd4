"""SHA-256 digests of what a scan is read from, in hexadecimal digits."""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


def sha256_of_files(paths: Sequence[Path]) -> str:
    """A file's digest as sha256sum prints it; of several the digest of theirs, sorted, a line each."""
    digests = sorted(map(_sha256_of_file, paths))
    return digests[0] if len(digests) == 1 else hashlib.sha256("\n".join(digests).encode()).hexdigest()


def _sha256_of_file(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sha256_of_arrays(*arrays: NDArray[Any]) -> str:
    """The digest of arrays: of type, shape and bytes of each."""
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype.str} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array).view(np.uint8).data)
    return digest.hexdigest()
