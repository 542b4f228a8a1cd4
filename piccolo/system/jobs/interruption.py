"""Ctrl-C and SIGTERM, which end a batch after the item at work."""

import os
import signal
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import TypeVar

SIGNALS: dict[int, str] = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}
Item = TypeVar("Item")


class Stopped(KeyboardInterrupt):
    """A signal came while nothing was at work, or for the second time."""


@dataclass
class Interruption:
    """Whether Ctrl-C or SIGTERM is to end a batch, whose photo at work is finished first."""

    number: int = 0  # of the signal
    is_at_work: bool = False

    def each(self, items: Iterable[Item], after: Iterable[Item] = ()) -> Iterator[Item]:
        """Yield items until a signal ends it, and then those `after`.

        While one is at work, a first signal is only noted, a second one ends the work at once.
        """
        try:
            for item in items:
                self.is_at_work = True
                yield item
                self.is_at_work = False
                if self.number:
                    break
            self.is_at_work = True
            yield from after
        finally:
            self.is_at_work = False

    def handle(self, number: int, _frame: FrameType | None) -> None:
        """Note a signal; raises Stopped where it ends the work at once."""
        is_second = self.number != 0
        self.number = self.number or number
        if is_second or not self.is_at_work:
            raise Stopped
        os.write(2, f"\n{SIGNALS[number]}: the current photo will be finished; repeat to stop now\n".encode())


@contextmanager
def interruptible() -> Iterator[Interruption]:
    """Within this, signals end the batch as Interruption says; one that ends it at once ends the context."""
    interruption = Interruption()
    before = {number: signal.signal(number, interruption.handle) for number in SIGNALS}
    try:
        yield interruption
    except Stopped:
        pass
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
