"""Numba's flags, and the folder in which compiled kernels are kept, in one place.

A kernel is serial and releases the GIL; whole poses or fixed blocks of points are spread over threads
by `piccolo.threads`.
"""

import hashlib
import os
import shutil
import tempfile
import time
from pathlib import Path

import numba
import numpy as np

# Without error_model="numpy" every float division carries a branch that raises ZeroDivisionError, and that
# branch alone stops LLVM vectorising a loop. "nnan" and "ninf" stay off: a point at the camera divides by 0.
FASTMATH = {"nsz", "arcp", "contract", "afn", "reassoc"}
STALE_AFTER_S = 30 * 24 * 3600.0

kernel = numba.njit(nogil=True, cache=True, error_model="numpy", fastmath=FASTMATH)
scalar = numba.njit(nogil=True, cache=True, error_model="numpy", fastmath=FASTMATH, inline="never")

F0 = np.float32(0.0)
F1 = np.float32(1.0)
HALF = np.float32(0.5)


def _source_digest() -> str:
    """Digest of the sources with kernels: Numba does not see that a kernel's callee in another file changed."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        source = path.read_bytes()
        if b"runtime.jit import" in source:
            digest.update(source)
    return digest.hexdigest()[:16]


def _is_writable_folder(folder: Path) -> bool:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def cache_root() -> Path:
    """The folder for everything this program keeps between runs (XDG base directory specification)."""
    home = os.environ.get("XDG_CACHE_HOME") or str(Path("~/.cache").expanduser())
    root = Path(home) / "piccolo"
    if _is_writable_folder(root):
        return root
    return Path(tempfile.gettempdir()) / f"piccolo-{os.getuid()}"


def remove_stale(folder: Path) -> None:
    """Delete what lies in a folder of the cache and has not been used for a month."""
    for entry in folder.iterdir():
        try:
            if time.time() - entry.stat().st_mtime > STALE_AFTER_S:
                shutil.rmtree(entry) if entry.is_dir() else entry.unlink()
        except FileNotFoundError:  # another process was faster
            continue


SOURCE_DIGEST = _source_digest()


def _prepare_kernel_folder() -> Path:
    folder = cache_root() / "kernels" / SOURCE_DIGEST
    folder.mkdir(parents=True, exist_ok=True)
    folder.touch()
    remove_stale(folder.parent)
    return folder


KERNEL_FOLDER = Path(os.environ.get("NUMBA_CACHE_DIR") or _prepare_kernel_folder())
numba.config.CACHE_DIR = str(KERNEL_FOLDER)  # type: ignore[attr-defined]  # made at import


def is_first_use() -> bool:
    """True while no kernel of this version has been compiled on this machine."""
    return next(KERNEL_FOLDER.rglob("*.nbc"), None) is None
