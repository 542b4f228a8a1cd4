"""Ctrl-C and SIGTERM in a batch: the photo at work is finished first."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

SIGNALS: dict[int, str] = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}


@dataclass
class Interruption:
    """Whether the batch is to end; `number` is the signal's."""

    number: int = 0
    is_at_work: bool = False

    @property
    def exit_code(self) -> int:
        """What a shell expects of a program that a signal has ended."""
        return 128 + self.number

    @contextmanager
    def postponed(self) -> Iterator[None]:
        """Within this a first signal is only noted, a second one ends the work at once."""
        self.is_at_work = True
        try:
            yield
        finally:
            self.is_at_work = False


class Stopped(KeyboardInterrupt):
    """A signal came while nothing was at work, or for the second time."""


@contextmanager
def interruptible() -> Iterator[Interruption]:
    """Within this, signals end the batch as Interruption says; raises Stopped where that is at once."""
    interruption = Interruption()

    def handle(number: int, _frame: FrameType | None) -> None:
        is_second = interruption.number != 0
        interruption.number = interruption.number or number
        if is_second or not interruption.is_at_work:
            raise Stopped
        os.write(2, f"\n{SIGNALS[number]}: the photo at work is finished; again to stop now\n".encode())

    before = {number: signal.signal(number, handle) for number in SIGNALS}
    try:
        yield interruption
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
