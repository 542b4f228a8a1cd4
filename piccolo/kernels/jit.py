"""Numba's flags in one place. Importing a kernel compiles, reads and writes nothing.

A kernel is serial and releases the GIL; whole poses or fixed blocks of points are spread over threads
by `piccolo.jobs.threads`.
"""

from collections.abc import Callable
from typing import Any

import numba
import numpy as np

from .kernel_cache import KernelCache

# Without error_model="numpy" every float division carries a branch that raises ZeroDivisionError, and that
# branch alone stops LLVM vectorising a loop. "nnan" and "ninf" stay off: a point at the camera divides by 0.
FASTMATH = {"nsz", "arcp", "contract", "afn", "reassoc"}

F0 = np.float32(0.0)
F1 = np.float32(1.0)
HALF = np.float32(0.5)


# A function of scalars that kernels call. Always inlined, as are kernels in kernels: a call would go to
# whichever copy of the callee was loaded first, and a first run had other last bits than the runs after it.
inline_kernel = numba.njit(nogil=True, error_model="numpy", fastmath=FASTMATH, forceinline=True)


@inline_kernel
def copy_to(target, source):
    """Write an array into another of its shape, both contiguous.

    An assignment of slices compiles the text of the error that it might raise into the kernel, for seconds.
    """
    for k in range(target.size):
        target.flat[k] = source.flat[k]


def kernel(function: Callable[..., Any]) -> Any:  # a Numba dispatcher, which has no type
    """Compile a function of arrays and scalars on its first call; kept between runs by KernelCache."""
    dispatcher: Any = inline_kernel(function)
    if hasattr(dispatcher, "enable_caching"):  # not with NUMBA_DISABLE_JIT=1
        dispatcher._cache = KernelCache(function)
    return dispatcher
