"""Exit codes and error reporting of all commands."""

import argparse
import os
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm

from ..errors import InputError
from .parser import as_started, parse
from .progress import log_shown

EXIT_BAD_USAGE, EXIT_BAD_INPUT, EXIT_INTERNAL, EXIT_INTERRUPTED, EXIT_BROKEN_PIPE = 2, 3, 4, 130, 141


class UsageError(InputError):
    """The options are wrong, whatever the files hold."""


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
        with log_shown(arguments.quiet):
            code = run(arguments)
        sys.stdout.flush()  # here, where a closed pipe is caught
        return code
    except BrokenPipeError:  # the reader of stdout has gone: say nothing, not even at the flush at exit
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_BROKEN_PIPE
    except KeyboardInterrupt:
        return print_error(arguments, "interrupted", EXIT_INTERRUPTED)
    except UsageError as error:
        return print_error(arguments, str(error), EXIT_BAD_USAGE)
    except (OSError, InputError) as error:
        return print_error(arguments, format_error(error), EXIT_BAD_INPUT)
    except Exception as error:  # the last line of defence: a code and one line for the shell
        return print_error(arguments, f"internal error: {error!r}; --debug shows where", EXIT_INTERNAL)


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
