"""Output of a command: results on stdout; errors, warnings and progress, which vanishes, on stderr."""

import json
import logging
import sys
import traceback
from argparse import Namespace
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from ..errors import printable
from ..files.atomic import is_stdout
from ..jobs.threads import Progress, Workers, num_cores
from .start import for_terminal

EXIT_BAD_INPUT = 3
Outputs = Mapping[str, Path | None]  # by option; None where it is not given
DELAY = 0.5  # seconds: what takes less needs no bar
COUNTED = "{desc}: {percentage:3.0f} % |{bar:20}| {remaining} left"
UNCOUNTED = "{desc}: {n_fmt} in {elapsed}"
# of a map, when its scan has been read
STEPS = {"find free space": 1, "render views": 2, "find features": 3, "sort features": 4}
LOG = logging.getLogger("piccolo")
tqdm.monitor_interval = 0  # no thread of tqdm's own, which might not start, for bars that stand still


def print_error(arguments: Namespace, text: str, exit_code: int) -> int:
    """One line on stderr, with --debug after the traceback of the error at hand; returns the exit code."""
    if arguments.debug and sys.exc_info()[0]:
        traceback.print_exc()
    tqdm.write(f"{arguments.program}: {for_terminal(printable(text))}", file=sys.stderr)
    return exit_code


def print_note(arguments: Namespace, text: str) -> None:
    """One line on stderr, but not with --quiet."""
    if not arguments.quiet:
        tqdm.write(f"{arguments.program}: {for_terminal(printable(text))}", file=sys.stderr)


def print_warnings(arguments: Namespace, warnings: Iterable[str]) -> None:
    """Print a line on stderr for each warning, unless --quiet."""
    for warning in warnings:
        print_note(arguments, f"warning: {warning}")


def print_report(arguments: Namespace, outputs: Outputs, report: Mapping[str, object] | str) -> None:
    """Print JSON, or text, on stdout; on stderr, without --quiet, where one of the outputs is stdout."""
    text = report if isinstance(report, str) else f"{json.dumps(report, allow_nan=False)}\n"
    if not any(path and is_stdout(path) for path in outputs.values()):
        print(text, end="")
    elif not arguments.quiet:
        print(text, end="", file=sys.stderr)


def workers_from(arguments: Namespace, num_threads: int | None = None) -> Workers:
    """Return workers, by default one a core, that show progress, but not with --quiet, and log warnings."""
    return Workers(num_threads or num_cores(), progress_bar(arguments.quiet), LOG.warning)


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
