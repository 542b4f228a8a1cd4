"""Compiled kernels on disk, one file a kernel and signature, opened when a kernel is first called.

Numba's own cache makes its folders when a module is imported, does not see that a kernel's callee in another
file has changed, and loads machine code without a checksum.
"""

import hashlib
import logging
import pickle
import re
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numba
from numba.core import compiler, serialize

from .atomic import write_atomically
from .cache import cache_root, mark_used, remove_stale

NAME = re.compile(r"[0-9a-f]{32}\.kernel")
DIGEST_SIZE = hashlib.sha256().digest_size
log = logging.getLogger("piccolo")


@cache
def kernel_folder() -> Path:
    """The folder of compiled kernels, made now; those of a month ago are deleted."""
    folder = cache_root() / "kernels"
    folder.mkdir(exist_ok=True)
    remove_stale(folder, NAME)
    return folder


@cache
def sources_digest() -> str:
    """Digest of the sources that hold kernels, as one kernel is compiled into another."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        source = path.read_bytes()
        if b"runtime.jit import" in source or path.parent == Path(__file__).parent:
            digest.update(source)
    return digest.hexdigest()


def is_first_use() -> bool:
    """True while no kernel has been compiled on this machine."""
    return not any(NAME.fullmatch(entry.name) for entry in kernel_folder().iterdir())


class KernelCache:
    """What Numba asks for compiled code: one kernel's files. A file that is damaged is compiled anew."""

    def __init__(self, function: Any) -> None:
        """Remember which kernel; nothing is opened."""
        captured = [cell.cell_contents for cell in function.__closure__ or ()]
        self.name = " ".join(f"{f.__module__}.{f.__qualname__}" for f in (function, *captured))
        self.cache_path = None  # Numba's `stats` shows it

    def _file(self, signature: object, codegen: Any) -> Path:
        """The file for a signature on this machine's processor."""
        versions = numba.__version__, sys.version_info[:2], sys.byteorder, codegen.magic_tuple()
        key = repr((self.name, str(signature), versions, sources_digest()))
        return kernel_folder() / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.kernel"

    def load_overload(self, signature: object, target_context: Any) -> Any:
        """Read compiled code; None if there is none that can be trusted."""
        target_context.refresh()
        path = self._file(signature, target_context.codegen())
        try:
            content = path.read_bytes()
        except OSError:
            return None
        payload = content[DIGEST_SIZE:]
        if hashlib.sha256(payload).digest() != content[:DIGEST_SIZE]:
            log.warning("%s: damaged compiled code; it is compiled anew", path)
            return None
        mark_used(path)
        return compiler.CompileResult._rebuild(target_context, *pickle.loads(payload))

    def save_overload(self, signature: object, compiled: Any) -> None:
        """Write compiled code whole; where that can't be done it is compiled again by the next run."""
        payload = serialize.dumps(compiled._reduce())
        path = self._file(signature, compiled.codegen)
        try:
            write_atomically(path, hashlib.sha256(payload).digest() + payload)
        except OSError as error:
            log.warning("%s: compiled code can't be kept: %s", path.parent, error.strerror)

    def flush(self) -> None:
        """Nothing is held in memory."""
