"""Progress of a command, which vanishes, and what the package logs, on stderr."""

import logging
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

from ..system.errors import printable
from ..system.jobs.threads import Progress
from .start import for_terminal

DELAY = 0.5  # seconds: what takes less needs no bar
COUNTED = "{desc}: {percentage:3.0f} % |{bar:20}| {remaining} left"
UNCOUNTED = "{desc}: {n_fmt} in {elapsed}"
# of a map, when its scan has been read
STEPS = {"find free space": 1, "render views": 2}
LOG = logging.getLogger("piccolo")
tqdm.monitor_interval = 0  # no thread of tqdm's own, which might not start, for bars that stand still


def show_progress(values: Iterable[Any], is_quiet: bool, **form: Any) -> Iterator[Any]:
    """Yield the values, with a progress bar on stderr if that is a terminal."""
    yield from tqdm(values, disable=True if is_quiet else None, file=sys.stderr, **form)


def progress_bar(is_quiet: bool) -> Progress:
    """Return a function that wraps values in a progress bar, or in nothing."""

    def show(values: Iterator[Any], total: int | None, label: str) -> Iterator[Any]:
        title = f"prepare, {STEPS[label]} of {len(STEPS)}: {label}" if label in STEPS else label
        form = {"bar_format": UNCOUNTED if total is None else COUNTED, "delay": DELAY, "leave": False}
        return show_progress(values, is_quiet, desc=title, total=total, **form)

    return show


class LogHandler(logging.Handler):
    """Prints what is logged: news and warnings, each once however often it comes."""

    def __init__(self) -> None:
        super().__init__(logging.INFO)
        self.printed: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        """Print a record."""
        text = record.getMessage()
        if record.levelno >= logging.WARNING:
            text = f"warning: {for_terminal(printable(text))}"
        if text not in self.printed:
            self.printed.add(text)
            tqdm.write(text, file=sys.stderr)


@contextmanager
def showing_log(is_quiet: bool) -> Iterator[None]:
    """Within this, what the package logs is printed, or nothing at all."""
    handler = logging.NullHandler() if is_quiet else LogHandler()
    level = LOG.level
    LOG.addHandler(handler)
    LOG.setLevel(logging.INFO)
    try:
        yield
    finally:
        LOG.removeHandler(handler)
        LOG.setLevel(level)
