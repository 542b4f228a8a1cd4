"""BLAS on one thread while a photo is localized: the threads are `Workers`'.

Those of OpenBLAS spin for tens of milliseconds after each product, on the cores that the next kernels want.
"""

import threading
from contextlib import ContextDecorator
from functools import cache
from typing import Any

from threadpoolctl import OpenBLASController, ThreadpoolController


@cache
def _controller() -> ThreadpoolController:
    """Of the BLAS that NumPy has loaded."""
    return ThreadpoolController().select(user_api="blas")


class _OneBlasThread(ContextDecorator):
    """A context, and a decorator, within which BLAS has one thread; several threads may be within at once."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._depth = 0
        self._limiter: Any = None

    def __enter__(self) -> None:
        """Take the threads, if this is the first one in."""
        with self._lock:
            self._depth += 1
            if self._depth == 1:
                self._limiter = _controller().limit(limits=1)

    def __exit__(self, *_: object) -> None:
        """Give the threads back, if this is the last one out."""
        with self._lock:
            self._depth -= 1
            if self._depth == 0:
                OpenBLASController.clear_controlling_thread(force=True)  # another thread may have come first
                self._limiter.restore_original_limits()
                OpenBLASController.clear_controlling_thread()


one_blas_thread = _OneBlasThread()
