"""Exit codes and error reporting of all commands."""

import argparse
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm

from ..errors import InputError
from .parser import as_started, parse
from .progress import log_shown

EXIT_BAD_USAGE, EXIT_BAD_INPUT, EXIT_INTERNAL = 2, 3, 4
EXIT_INTERRUPTED, EXIT_BROKEN_PIPE, EXIT_TERMINATED = 130, 141, 143


class UsageError(InputError):
    """The options are wrong, whatever the files hold."""


class Terminated(KeyboardInterrupt):
    """SIGTERM: a command ends as after Ctrl-C, so that no temporary file is left."""


def _terminate(*_: object) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once is enough: what cleans up is not to be stopped
    raise Terminated


@contextmanager
def terminating() -> Iterator[None]:
    """Within this, SIGTERM raises Terminated."""
    if threading.current_thread() is not threading.main_thread():  # which alone gets signals
        yield
        return
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


@contextmanager
def checking_options() -> Iterator[None]:
    """Within this, an InputError is a UsageError."""
    try:
        yield
    except InputError as error:
        raise UsageError(str(error)) from error


def run_command(
    parser: argparse.ArgumentParser, argv: list[str] | None, run: Callable[[argparse.Namespace], int]
) -> int:
    """The exit code of `run` with the options given, or of the error that ended it, which is printed."""
    arguments = parse(parser, argv)
    try:
        with log_shown(arguments.quiet), terminating():
            code = run(arguments)
            sys.stdout.flush()  # here, where a closed pipe is caught
        return code
    except KeyboardInterrupt as error:
        is_term = isinstance(error, Terminated)
        code = EXIT_TERMINATED if is_term else EXIT_INTERRUPTED
        return print_error(arguments, "terminated" if is_term else "interrupted", code)
    except UsageError as error:
        return print_error(arguments, str(error), EXIT_BAD_USAGE)
    except (OSError, InputError) as error:
        discard_stdout()
        if isinstance(error, BrokenPipeError) and not error.filename:  # stdout's reader has gone: say nothing
            return EXIT_BROKEN_PIPE
        return print_error(arguments, format_error(error), EXIT_BAD_INPUT)
    except Exception as error:  # the last line of defence: a code and one line for the shell
        return print_error(arguments, f"internal error: {error!r}; --debug shows where", EXIT_INTERNAL)


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
    tqdm.write(f"{arguments.program}: {as_started(text)}", file=sys.stderr)
    return exit_code


def print_note(arguments: argparse.Namespace, text: str) -> None:
    """One line on stderr, but not with --quiet."""
    if not arguments.quiet:
        tqdm.write(f"{arguments.program}: {text}", file=sys.stderr)


def format_error(error: OSError | InputError) -> str:
    """An error in one line: of the system's, the file and what went wrong."""
    if isinstance(error, OSError) and error.filename is not None and error.strerror:
        return f"{error.filename}: cannot be used ({error.strerror})"
    return str(error)
