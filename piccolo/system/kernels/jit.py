"""Numba's flags in one place, and compiled kernels on disk, one file a kernel and signature.

Importing a kernel compiles, reads and writes nothing: its file is opened when it is first called. A kernel is
serial and releases the GIL; whole poses or fixed blocks of points are spread over threads by
`piccolo.system.jobs.threads`.

Numba's own cache makes its folders when a module is imported, does not see that a kernel's callee in another
file has changed, never finds a kernel again that takes another from around it, parses the bitcode of each,
and loads machine code without a checksum. What is used here of Numba's insides may change with its releases:
its version has an upper bound, and whatever goes wrong, the kernel is compiled.
"""

import gc
import hashlib
import logging
import pickle
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar, cast

import llvmlite.binding as llvm  # comes with Numba, in the version that Numba wants
import numba
import numpy as np
from numba.core import compiler, serialize
from numba.core.runtime.nrt import rtsys
from numpy.typing import NDArray

from ..errors import InputError
from ..files.atomic import hold_lock, write_atomically
from ..files.cache import PRIVATE, WRITABLE, cache_root, in_words, is_own, mark_used, own_folder, own_names

Function = TypeVar("Function", bound=Callable[..., Any])
Scalar = float | np.floating[Any]  # a number in a kernel, of float64 or float32
NAME = own_names("kernel")
DIGEST_SIZE = hashlib.sha256().digest_size
# of numba.config: they change the code that is made
FLAGS = (
    "BOUNDSCHECK", "DEBUGINFO_DEFAULT", "DISABLE_INTEL_SVML", "ENABLE_AVX", "ENABLE_PROFILING",
    "EXTEND_VARIABLE_LIFETIMES", "LLVM_REFPRUNE_FLAGS", "LLVM_REFPRUNE_PASS", "LOOP_VECTORIZE", "OPT",
    "SLP_VECTORIZE",
)  # fmt: skip
COMPILE_TIME = "half a minute"  # of all kernels on one core
QUIET_S = 3.0  # between two lines on what is compiled, and before the first
POLL_S = 0.01  # while another process compiles
MOST_WAIT_S = 60.0  # for one kernel
KERNELS: dict[str, Any] = {}  # by their names, all that have been imported
log = logging.getLogger("piccolo")


@cache
def kernel_folder() -> Path | None:
    """Make and return the folder of compiled kernels; None, after a warning, where there can be none.

    Kernels are pickles, which run code: others must not be able to write there.
    """
    try:
        folder = own_folder(cache_root() / "kernels", NAME, PRIVATE)
        if is_own(folder.stat(), WRITABLE):
            return folder
        reason = f"{folder}: other users may write to it; delete it"
    except OSError as error:
        reason = in_words(error)
    warn_not_kept(reason)
    return None


@cache
def warn_not_kept(reason: str) -> None:
    """Warn once that the next run has to compile again."""
    log.warning("%s; compiled code is not kept, and each run takes %s longer", reason, COMPILE_TIME)


@cache
def warn_damaged(folder: Path) -> None:
    """Warn once, however many files are damaged."""
    log.warning("%s: damaged compiled code; it is compiled again", folder)


@cache
def sources_digest() -> str:
    """Return a digest of all sources that hold kernels, as one kernel is compiled into another."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[2].rglob("*.py")):
        source = path.read_bytes()
        if b"kernels.jit import" in source or path.parent == Path(__file__).parent:
            digest.update(source)
    return digest.hexdigest()


@cache
def own_digest(source: str) -> str:
    """Return a digest of a kernel's own source, which may lie outside this package; none of typed-in code."""
    path = Path(source)
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""


@dataclass
class Compiling:
    """The kernels that this process has compiled, reported as the log's INFO."""

    count: int = 0
    quiet_since: float = 0.0  # [s] when the first kernel was not found, or a line was last logged
    get_help: Callable[[], object] = str  # called when the first kernel is not found
    collects: bool = field(default_factory=gc.isenabled)  # cycles, while nothing is compiled
    depth: int = 0  # kernels that are begun, each compiled into the one before

    def start(self) -> None:
        """Note the time at which the first kernel was asked for and not found, and get help."""
        if not self.quiet_since:
            self.quiet_since = time.monotonic()
            self.get_help()

    def begin(self) -> None:
        """Begin a kernel. Until it is finished no cycles are collected: that takes an eighth of the time."""
        self.start()
        self.depth += 1
        gc.disable()

    def finish(self) -> None:
        """Finish a kernel, and count it."""
        self.depth -= 1
        if self.depth == 0 and self.collects:
            gc.enable()
        self.count += 1
        self.tell()

    def tell(self) -> None:
        """From time to time log how many kernels there are."""
        now = time.monotonic()
        if now - self.quiet_since >= QUIET_S:
            self.quiet_since = now
            log.info("compiling kernels (only once): %d so far, %s on one core", self.count, COMPILE_TIME)


compiling = Compiling()


def compute_digest(name: str, payload: bytes) -> bytes:
    """Return the checksum written before a payload: it detects damage, not malice."""
    return hashlib.sha256(name.encode() + payload).digest()


def read_whole(path: Path) -> bytes | None:
    """Return the compiled code in a file; None if there is none or, with a warning, if it is damaged."""
    try:
        content = path.read_bytes()
    except OSError:
        return None
    payload = content[DIGEST_SIZE:]
    if compute_digest(path.name, payload) != content[:DIGEST_SIZE]:
        warn_damaged(path.parent)
        return None
    mark_used(path)
    return payload


def find_captured(function: Any) -> list[Any]:
    """Return the functions in a function's closure, and those in theirs: they are compiled into it."""
    found = []
    for cell in getattr(function, "py_func", function).__closure__ or ():
        found += [cell.cell_contents, *find_captured(cell.cell_contents)]
    return found


def rebuild(
    target_context: Any, library: tuple[str, str, tuple[bytes, bytes]], description: Any, *others: object
) -> Any:
    """Make a compiled kernel from its pickled parts.

    Numba parses a kernel's bitcode, up to 1 MB, to learn the names in its machine code, and to compile other
    kernels that call it. For the former a stub with the names that Numba may ask for replaces the bitcode; it
    is parsed only for the latter.
    """
    name, kind, (machine_code, bitcode) = library
    names = description.llvm_func_name, description.llvm_cpython_wrapper_name
    stand_in = llvm.parse_assembly("".join(f'define void @"{each}"() {{ ret void }}\n' for each in names))
    stub_library = (name, kind, (machine_code, stand_in.as_bitcode()))
    make: Callable[..., Any] = compiler.CompileResult._rebuild  # Numba gives it no type
    compiled = make(target_context, stub_library, description, *others)
    compiled.library._get_module_for_linking = cache(partial(llvm.parse_bitcode, bitcode))
    return compiled


class KernelCache:
    """One kernel's files, which Numba asks for compiled code. A damaged file is compiled again."""

    def __init__(self, function: Any) -> None:
        """Remember which kernel; nothing is opened."""
        self.name = " ".join(f"{f.__module__}.{f.__qualname__}" for f in (function, *find_captured(function)))
        self.source: str = function.__code__.co_filename
        self.cache_path = None  # Numba's `stats` shows it
        self.claims: dict[Path, ExitStack] = {}  # files that this process is to write

    def file(self, signature: object, codegen: Any) -> Path | None:
        """Return the file for a signature on this machine's processor."""
        versions = numba.__version__, np.__version__, sys.version_info[:2], sys.byteorder
        how = versions, codegen.magic_tuple(), [getattr(numba.config, flag, None) for flag in FLAGS]
        key = repr((self.name, str(signature), how, sources_digest(), own_digest(self.source)))
        folder = kernel_folder()
        return folder and folder / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.kernel"

    def load_overload(self, signature: object, target_context: Any) -> Any:
        """Read compiled code; None if there is none that can be trusted."""
        try:
            rtsys.initialize(target_context)
            path = self.file(signature, target_context.codegen())
            if payload := path and (read_whole(path) or self._claim(path)):
                return rebuild(target_context, *pickle.loads(payload))
        except Exception as error:  # Numba's insides are not as they were
            warn_not_kept(f"Numba {numba.__version__}: {error!r}")
        compiling.begin()
        return None

    def _claim(self, path: Path) -> bytes | None:
        """Claim a kernel, so that no other process compiles it; wait for one that does, and return its code.

        One kernel is compiled into another, never into itself: none waits for one that waits for it. Where
        nothing can be locked, or another process stands still, each compiles by itself.
        """
        end = time.monotonic() + MOST_WAIT_S
        while path not in self.claims and time.monotonic() < end:
            try:
                with ExitStack() as claim:
                    claim.enter_context(hold_lock(path))
                    payload = read_whole(path)
                    if payload is None:
                        self.claims[path] = claim.pop_all()
                    return payload
            except InputError:  # another process has it
                compiling.start()
                compiling.tell()
                time.sleep(POLL_S)
            except OSError:
                return None
        return None

    def save_overload(self, signature: object, compiled: Any) -> None:
        """Write compiled code whole; where that can't be done it is compiled again by the next run."""
        compiling.finish()
        try:
            if path := self.file(signature, compiled.codegen):
                dump: Callable[[Any], bytes] = serialize.dumps  # Numba gives it no type
                payload = dump(compiled._reduce())
                with self.claims.pop(path, ExitStack()):
                    write_atomically(path, compute_digest(path.name, payload) + payload)
        except OSError as error:
            warn_not_kept(f"{kernel_folder()}: {error.strerror or error}")
        except Exception as error:  # as above
            warn_not_kept(f"Numba {numba.__version__}: {error!r}")

    def flush(self) -> None:
        """Do nothing: nothing is held in memory."""


# Without error_model="numpy" every float division carries a branch that raises ZeroDivisionError, and that
# branch alone stops LLVM vectorising a loop. "nnan" and "ninf" stay off: a point at the camera divides by 0.
FASTMATH = {"nsz", "arcp", "contract", "afn", "reassoc"}

F0 = np.float32(0.0)
F1 = np.float32(1.0)
HALF = np.float32(0.5)


# A function of scalars that kernels call. Always inlined, as are kernels in kernels: a call would go to
# whichever copy of the callee was loaded first, and a first run had other last bits than the runs after it.
_compile: Callable[..., Any] = partial(  # whose type does not know that wrappers are options
    numba.njit, nogil=True, error_model="numpy", fastmath=FASTMATH, forceinline=True, no_cfunc_wrapper=True
)


def inline_kernel(function: Function) -> Function:
    """Compile a function of arrays and scalars as part of each kernel that calls it.

    It gets no wrapper for Python, which takes a sixth of the time: Python calls a kernel of its own.
    """
    dispatcher: Any = _compile(function, no_cpython_wrapper=True)
    alone = cache(lambda: kernel(function))
    dispatcher._insert = lambda *_: None  # it would be called without its wrapper, and crash
    dispatcher._compile_for_args = lambda *_: alone()
    return cast(Function, dispatcher)


@inline_kernel
def whole(u: Scalar) -> np.int32:
    """Return the whole part of a pixel coordinate; 0 for NaN, which would be an index out of any array."""
    return np.int32(u) if u >= F0 else np.int32(0)


@inline_kernel
def copy_to(target: NDArray[Any], source: NDArray[Any]) -> None:
    """Write an array into another of its shape, both contiguous.

    An assignment of slices compiles the text of the error that it might raise into the kernel, for seconds.
    """
    for k in range(target.size):
        target.flat[k] = source.flat[k]


def kernel(function: Function) -> Function:
    """Compile a function of arrays and scalars on its first call; KernelCache keeps it between runs."""
    dispatcher: Any = _compile(function)  # Numba gives it no type
    if hasattr(dispatcher, "enable_caching"):  # not with NUMBA_DISABLE_JIT=1
        dispatcher._cache = KernelCache(function)
        KERNELS[dispatcher._cache.name] = dispatcher
    return cast(Function, dispatcher)
