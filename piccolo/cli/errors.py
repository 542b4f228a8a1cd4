"""Exit codes and error reporting of all commands."""

import argparse
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

from tqdm import tqdm

from ..errors import InputError, printable, text_of
from ..jobs.memory import is_shortage
from .start import EXIT_INTERRUPTED, EXIT_TERMINATED, for_terminal

EXIT_BAD_USAGE = 2
EXIT_BAD_INPUT = 3
EXIT_INTERNAL = 4
EXIT_BROKEN_PIPE = 141
RETRY = 0.1  # [s] after which a signal is sent again
SHORTAGE = "not enough memory ({}); lower --max-memory or --threads, or thin the scan"


class UsageError(InputError):
    """The options are wrong, whatever the files hold."""


class Terminated(KeyboardInterrupt):
    """SIGTERM: a command ends as after Ctrl-C, so that no temporary file is left."""


@contextmanager
def checking_options() -> Iterator[None]:
    """Within this, an InputError is a UsageError."""
    try:
        yield
    except InputError as error:
        raise UsageError(str(error)) from error


def report_error(
    arguments: argparse.Namespace, error: Exception | KeyboardInterrupt, lost: list[KeyboardInterrupt]
) -> int:
    """Print the error that ended a command, and return its exit code; `lost` is that of raising_signals."""
    if isinstance(error, KeyboardInterrupt):
        return _report_stop(arguments, error)
    if not isinstance(error, OSError | InputError):
        return _report_unforeseen(arguments, error, lost)  # the last line of defence: a code and one line
    discard_stdout()
    if isinstance(error, BrokenPipeError) and not error.filename:  # stdout's reader has gone: say nothing
        return EXIT_BROKEN_PIPE
    code = EXIT_BAD_USAGE if isinstance(error, UsageError) else EXIT_BAD_INPUT
    return print_error(arguments, text_of(error), code)


def _report_unforeseen(arguments: argparse.Namespace, error: Exception, lost: list[KeyboardInterrupt]) -> int:
    if lost:  # what was called back by C has failed for it
        return _report_stop(arguments, lost[0])
    if is_shortage(error):
        text = " ".join(str(error).split()) or "none is left"
        return print_error(arguments, SHORTAGE.format(text), EXIT_BAD_INPUT)
    return print_error(arguments, f"internal error: {error!r}; --debug shows where", EXIT_INTERNAL)


@contextmanager
def raising_signals(lost: list[KeyboardInterrupt]) -> Iterator[None]:
    """Within this, SIGTERM raises Terminated in the main thread, as SIGINT raises KeyboardInterrupt.

    Code that is called back from C, as by LLVM while a kernel is compiled, can't pass an exception on: it is
    added to `lost`, and the signal is sent again a moment later.
    """
    if threading.current_thread() is not threading.main_thread():  # where no handler can be set
        yield
        return
    timers: list[threading.Timer] = []

    def send_again(unraisable: "sys.UnraisableHookArgs") -> None:
        if isinstance(unraisable.exc_value, KeyboardInterrupt):
            lost.append(unraisable.exc_value)
            number = signal.SIGTERM if isinstance(unraisable.exc_value, Terminated) else signal.SIGINT
            timers.append(threading.Timer(RETRY, os.kill, (os.getpid(), number)))
            timers[-1].start()
        else:
            sys.__unraisablehook__(unraisable)

    before = signal.signal(signal.SIGTERM, _terminate)
    hook = sys.unraisablehook
    sys.unraisablehook = send_again
    try:
        yield
    finally:
        for timer in timers:
            timer.cancel()
        signal.signal(signal.SIGTERM, before)
        sys.unraisablehook = hook


def _terminate(signum: int, frame: FrameType | None) -> None:
    raise Terminated


def _report_stop(arguments: argparse.Namespace, stop: KeyboardInterrupt) -> int:
    if isinstance(stop, Terminated):
        return print_error(arguments, "terminated", EXIT_TERMINATED)
    return print_error(arguments, "interrupted", EXIT_INTERRUPTED)


def discard_stdout() -> None:
    """Drop what can't be written to stdout, so that it is not tried again at exit."""
    try:
        if sys.stdout:
            sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def print_error(arguments: argparse.Namespace, text: str, exit_code: int) -> int:
    """One line on stderr, with --debug after the traceback of the error at hand; returns the exit code."""
    if arguments.debug and sys.exc_info()[0]:
        traceback.print_exc()
    tqdm.write(f"{arguments.program}: {for_terminal(printable(text))}", file=sys.stderr)
    return exit_code


def print_note(arguments: argparse.Namespace, text: str) -> None:
    """One line on stderr, but not with --quiet."""
    if not arguments.quiet:
        tqdm.write(f"{arguments.program}: {for_terminal(printable(text))}", file=sys.stderr)
