"""A function over many items, its values in the items' order: here, in processes, or on a cluster.

What works elsewhere is given as an `Opening`, called once where items are worked on: it opens what the
function needs, a scan for example, and returns the function.
"""

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from functools import partial
from typing import Any

Function = Callable[[Any], Any]  # of an item
Opening = Callable[[], Function]  # pickled for other processes
# an item, and what waits for its value; or for what the function raised, or WorkerLostError, and raises it
Pair = tuple[Any, Callable[[], Any]]


class WorkerLostError(Exception):
    """The processes at work on an item were killed, as often as it was tried; the text says how."""


class Here:
    """Works on one item after another in this process, on each when its value is asked for."""

    def __init__(self, function: Function, items: Iterable[Any] = ()) -> None:
        self.function = function
        self.items = items

    def values(self, items: Iterator[Any]) -> "Here":
        """Begin with the items."""
        return Here(self.function, items)

    def __iter__(self) -> Iterator[Pair]:
        """Yield each, taken when it is asked for."""
        return ((item, partial(self.function, item)) for item in self.items)

    def take_finished(self) -> Iterator[Pair]:
        """Yield nothing."""
        return iter(())


class InFlight:
    """Values of items that are worked on elsewhere, at most so many begun before the first of them is taken.

    A thread reads the items, so a slow standard input does not delay values that are ready.
    """

    def __init__(self, submit: Callable[[Any], Any], items: Iterator[Any], limit: int) -> None:
        self._submit = submit
        self._items = items
        self._room = threading.Semaphore(limit)
        self._begun = threading.Semaphore(0)
        self._pairs = deque[tuple[Any, Any] | None]()  # an item and its future; None is the end
        threading.Thread(target=self._feed, daemon=True).start()

    def _feed(self) -> None:
        try:
            for item in self._items:
                self._room.acquire()
                self._put((item, self._submit(item)))
        except BaseException as error:  # of the items, or the executor is closed: for who takes the values
            failed = Future[Any]()
            failed.set_exception(error)
            self._put((None, failed))
        self._put(None)

    def _put(self, pair: tuple[Any, Any] | None) -> None:
        self._pairs.append(pair)
        self._begun.release()

    def __iter__(self) -> Iterator[Pair]:
        """Yield each, begun as soon as there is an item and room for it."""
        while self._begun.acquire() and (pair := self._pairs.popleft()) is not None:
            yield pair[0], pair[1].result
            self._room.release()

    def take_finished(self) -> Iterator[Pair]:
        """Yield what is done already of those that come next."""
        while self._pairs and (pair := self._pairs[0]) is not None and pair[1].done():
            self._pairs.popleft()
            yield pair[0], pair[1].result
