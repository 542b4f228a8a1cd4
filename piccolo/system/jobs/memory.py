"""Memory that may still be taken, asked before much is: a refusal in one line, not the kernel's kill.

psutil knows it of each system, but for containers, which only Linux has, and tells of in files. No library of
numbers is imported here, as `share_arenas` comes before these are.
"""

import ctypes
import os
import sys
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import psutil

from ..errors import InputError, ResourceError

GB = 1e9
DEFAULT_FRACTION = 0.8  # of what is free, where the user sets no limit
OWN_CGROUPS = Path("/proc/self/cgroup")  # of this process, by which CGROUPS has their limits
CGROUPS = Path("/sys/fs/cgroup")
V2 = ("", "memory.max", "memory.current", "inactive_file")
V1 = ("memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
OPENCV_NO_MEMORY = -4  # `code` of a cv2.error
LEAST_LEFT = 200e6  # [byte] of address space: with less, Python may abort where it should raise
M_ARENA_MAX = -8  # of glibc's mallopt(3)
MOST_ARENAS = 2  # each keeps what was freed in it
LIMIT: list[float] = []  # [byte] of this process, if the user sets one
KNOWN_SECONDS = 1.0  # for which what was left is taken as known
SMALL_PART = 0.02  # of what is left; for more it is measured again
KNOWN: list[tuple[float, float]] = []  # when what is left was measured last [s], and what it was [byte]
this_process = cache(psutil.Process)


def limit_memory(gigabytes: float | None) -> None:
    """Set the memory [10^9 byte] that this process may take in all; None for a part of what is free."""
    if gigabytes is not None and not gigabytes > 0.0:
        raise InputError(f"`max_memory`: found {gigabytes:g}, wanted gigabytes above 0")
    LIMIT[:] = [] if gigabytes is None else [gigabytes * GB]
    KNOWN.clear()


def check_memory(num_bytes: float, purpose: str, advice: str) -> None:
    """Refuse what needs more bytes than may still be taken; `purpose` begins the line, `advice` ends it.

    A small part of what was left less than a second ago is granted without measuring again.
    """
    now = time.monotonic()
    if any(now - at < KNOWN_SECONDS and num_bytes < SMALL_PART * left for at, left in KNOWN):
        return
    room = memory_left()
    KNOWN[:] = [(now, room)]
    if num_bytes > room:
        needs = f"{purpose} needs {num_bytes / GB:.2g} GB of memory"
        left = f"{max(room, 0.0) / GB:.2g} GB may be used"
        raise ResourceError(f"{needs}, {left}; {advice}, or raise `max_memory`")


def memory_left() -> float:
    """Bytes that this process may still take: of the user's limit, or a part of what is free."""
    free_of_containers = free_of_cgroup(OWN_CGROUPS, CGROUPS)
    free = min(float(psutil.virtual_memory().available), free_of_containers, free_of_process())
    return share_free(free, memory_taken(), LIMIT[0] if LIMIT else None)


def share_free(free: float, taken: float, limit: float | None) -> float:
    """Return what a process that has taken some bytes may still take: of its limit, or a part of the rest."""
    return DEFAULT_FRACTION * free if limit is None else min(limit - taken, free)


def memory_taken() -> float:
    """Bytes of memory that this process has."""
    return float(this_process().memory_info().rss)


def check_address_space() -> None:
    """Raise a MemoryError where `ulimit -v` leaves too little for errors to be raised as they should."""
    left = max(free_of_process(), 0.0)
    if left < LEAST_LEFT:
        raise MemoryError(f"ulimit -v leaves {left / GB:.2g} GB, wanted {LEAST_LEFT / GB:g} or more")


def limit_of_process() -> float:
    """Bytes of address space that `ulimit -v` allows; infinite without, and on systems that have none."""
    if not hasattr(psutil, "RLIMIT_AS"):
        return float("inf")
    soft, _ = this_process().rlimit(psutil.RLIMIT_AS)
    return float("inf") if soft == psutil.RLIM_INFINITY else float(soft)


def allow_files(wanted: int) -> int:
    """Let this process open `wanted` files at once, as far as `ulimit -n` can be raised; return how many."""
    if not hasattr(psutil, "RLIMIT_NOFILE"):
        return wanted
    soft, hard = this_process().rlimit(psutil.RLIMIT_NOFILE)
    most = wanted if hard == psutil.RLIM_INFINITY else min(wanted, hard)
    if psutil.RLIM_INFINITY != soft < most:
        this_process().rlimit(psutil.RLIMIT_NOFILE, (most, hard))
    return most


def free_of_process() -> float:
    """Bytes of address space that `ulimit -v` leaves; infinite without."""
    limit = limit_of_process()
    return limit if limit == float("inf") else limit - this_process().memory_info().vms


def free_of_cgroup(own: Path, cgroups: Path) -> float:
    """Bytes that the limits of containers leave, caches not counted; infinite without.

    The file `own` names those of this process, whose limits lie in the folder `cgroups`.
    """
    return min(_free_of_cgroups(own, cgroups), default=float("inf"))


def _free_of_cgroups(own: Path, cgroups: Path) -> Iterator[float]:
    """Bytes that each limited cgroup leaves, of version 2 and 1, from this process's own up to the root."""
    for line in _text(own).splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        root, limit, usage, cache = V1 if controllers else V2
        folder = cgroups / root / path.lstrip("/")
        while folder.is_relative_to(cgroups / root):
            most = _text(folder / limit).strip()
            used = _text(folder / usage).strip()
            if most.isdigit() and used.isdigit():
                stats = dict(line.split() for line in _text(folder / "memory.stat").splitlines())
                yield float(int(most) - int(used) + int(stats.get(cache, 0)))
            folder = folder.parent


def is_shortage(error: BaseException) -> bool:
    """Return True for what NumPy, OpenCV or Python raise where memory, or room for a thread, has run out."""
    if isinstance(error, MemoryError) or getattr(error, "code", None) == OPENCV_NO_MEMORY:
        return True
    if isinstance(error, SystemError):  # C code that gave up without saying why, under `ulimit -v`
        return limit_of_process() < float("inf") and "without exception set" in str(error)
    return isinstance(error, RuntimeError) and "can't start new thread" in str(error)


def _text(path: Path) -> str:
    """Return a file's text, empty where there is none."""
    try:
        return path.read_text()
    except OSError:
        return ""


def share_arenas() -> None:
    """Let all threads share two of glibc's arenas: a process of four keeps some 50 MB less.

    Unless MALLOC_ARENA_MAX or GLIBC_TUNABLES in the environment say how many. Other C libraries have none.
    """
    is_told = "MALLOC_ARENA_MAX" in os.environ or "arena_max" in os.environ.get("GLIBC_TUNABLES", "")
    if sys.platform == "linux" and not is_told and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        libc.mallopt(M_ARENA_MAX, MOST_ARENAS)
