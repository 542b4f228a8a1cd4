"""Memory arenas of the threads of a process. It imports no library, as it is asked before these are."""

import ctypes
import os

M_ARENA_MAX = -8  # of glibc's mallopt(3)
MOST_ARENAS = 2  # each keeps what was freed in it


def share_arenas() -> None:
    """Let all threads share two of glibc's arenas: a process of four keeps some 50 MB less.

    Unless MALLOC_ARENA_MAX or GLIBC_TUNABLES in the environment say how many. Other C libraries have none.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    is_told = "MALLOC_ARENA_MAX" in os.environ or "arena_max" in os.environ.get("GLIBC_TUNABLES", "")
    if mallopt is not None and not is_told:
        mallopt(M_ARENA_MAX, MOST_ARENAS)
