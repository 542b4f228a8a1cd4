"""Compiled kernels on disk, one file a kernel and signature, opened when a kernel is first called.

Numba's own cache makes its folders when a module is imported, does not see that a kernel's callee in another
file has changed, and loads machine code without a checksum.
"""

import hashlib
import logging
import pickle
import sys
from functools import cache, partial
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba
from numba.core import compiler, serialize
from numba.core.runtime.nrt import rtsys

from .atomic import write_atomically
from .cache import PRIVATE, WRITABLE, cache_root, in_words, is_own, mark_used, own_folder, own_names

NAME = own_names("kernel")
DIGEST_SIZE = hashlib.sha256().digest_size
log = logging.getLogger("piccolo")


@cache
def kernel_folder() -> Path | None:
    """The folder of compiled kernels, made now; None, after a warning, where there can be none.

    Kernels are pickles, which run code: others must not be able to write there.
    """
    try:
        folder = own_folder(cache_root() / "kernels", NAME, PRIVATE)
        if is_own(folder.stat(), WRITABLE):
            return folder
        reason = f"{folder}: others may write to it; delete it"
    except OSError as error:
        reason = in_words(error)
    warn_not_kept(reason)
    return None


@cache
def warn_not_kept(reason: str) -> None:
    """Warn once that the next run has to compile again."""
    log.warning("%s; compiled code is not kept, and each run takes a minute more", reason)


@cache
def warn_damaged(folder: Path) -> None:
    """Warn once, however many files are damaged."""
    log.warning("%s: damaged compiled code; it is compiled anew", folder)


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
    """True while no kernel has been compiled on this machine, where any can be kept."""
    folder = kernel_folder()
    return folder is not None and not any(NAME.fullmatch(entry.name) for entry in folder.iterdir())


def digest_of(name: str, payload: bytes) -> bytes:
    """What stands before a payload in the file of this name: it tells damage, not malice."""
    return hashlib.sha256(name.encode() + payload).digest()


def read_whole(path: Path) -> bytes | None:
    """The compiled code in a file, as written; None if there is none or (with a warning) if it is damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    payload = content[DIGEST_SIZE:]
    if digest_of(path.name, payload) != content[:DIGEST_SIZE]:
        warn_damaged(path.parent)
        return None
    mark_used(path)
    return payload


def captured_by(function: Any) -> list[Any]:
    """The functions that a function takes from around it, and those that these take: they are compiled in."""
    found = []
    for cell in getattr(function, "py_func", function).__closure__ or ():
        found += [cell.cell_contents, *captured_by(cell.cell_contents)]
    return found


def rebuilt(
    target_context: Any, library: tuple[str, str, tuple[bytes, bytes]], description: Any, *others: object
) -> Any:
    """A compiled kernel from its pickled parts.

    Numba parses a kernel's bitcode, up to 1 MB, to learn which names its machine code has, and to compile
    others that call it. Here the names that may be asked for stand in; it is parsed only for the latter.
    """
    name, kind, (machine_code, bitcode) = library
    wrappers = description.llvm_cpython_wrapper_name, description.llvm_cfunc_wrapper_name
    names = description.llvm_func_name, *wrappers
    stand_in = llvm.parse_assembly("".join(f'define void @"{each}"() {{ ret void }}\n' for each in names))
    parts = (name, kind, (machine_code, stand_in.as_bitcode())), description
    compiled = compiler.CompileResult._rebuild(target_context, *parts, *others)
    compiled.library._get_module_for_linking = cache(partial(llvm.parse_bitcode, bitcode))
    return compiled


class KernelCache:
    """What Numba asks for compiled code: one kernel's files. A file that is damaged is compiled anew."""

    def __init__(self, function: Any) -> None:
        """Remember which kernel; nothing is opened."""
        self.name = " ".join(f"{f.__module__}.{f.__qualname__}" for f in (function, *captured_by(function)))
        self.cache_path = None  # Numba's `stats` shows it

    def _file(self, signature: object, codegen: Any) -> Path | None:
        """The file for a signature on this machine's processor."""
        versions = numba.__version__, sys.version_info[:2], sys.byteorder, codegen.magic_tuple()
        key = repr((self.name, str(signature), versions, sources_digest()))
        folder = kernel_folder()
        return folder and folder / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.kernel"

    def load_overload(self, signature: object, target_context: Any) -> Any:
        """Read compiled code; None if there is none that can be trusted."""
        rtsys.initialize(target_context)
        path = self._file(signature, target_context.codegen())
        payload = path and read_whole(path)
        return payload and rebuilt(target_context, *pickle.loads(payload))

    def save_overload(self, signature: object, compiled: Any) -> None:
        """Write compiled code whole; where that can't be done it is compiled again by the next run."""
        if path := self._file(signature, compiled.codegen):
            payload = serialize.dumps(compiled._reduce())
            try:
                write_atomically(path, digest_of(path.name, payload) + payload)
            except OSError as error:
                warn_not_kept(f"{path.parent}: {error.strerror or error}")

    def flush(self) -> None:
        """Nothing is held in memory."""
