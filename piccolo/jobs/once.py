"""A value that is worked out once, by whoever asks for it first; others wait for it."""

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

Value = TypeVar("Value")


class Once(Generic[Value]):
    """What a function without arguments returns, which is called by the first thread that asks."""

    def __init__(self, function: Callable[[], Value]) -> None:
        self._function: Callable[[], Value] | None = function
        self._lock = threading.Lock()
        self._value: Value

    def __call__(self) -> Value:
        """The value. What the function raises is raised, and it is asked again by the next."""
        with self._lock:
            if self._function is not None:
                self._value = self._function()
                self._function = None  # what it holds may be large
        return self._value
