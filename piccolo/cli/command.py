"""Commands: options written as a help text shows them, and the `main` that parses and runs them."""

import argparse
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from ..errors import InputError, text_of
from ..jobs.memory import check_address_space, is_shortage
from .checks import UsageError
from .start import EXIT_INTERRUPTED, EXIT_TERMINATED, as_started, for_terminal
from .terminal import EXIT_BAD_INPUT, print_error, showing_log

KINDS: dict[str, type] = {  # of the values, by the first metavar; of others text
    **dict.fromkeys(("FILE", "FOLDER", "JSONL", "PNG"), Path),
    **dict.fromkeys(("N", "PX", "FIRST", "W", "ROOM"), int),
    **dict.fromkeys(("X", "M", "S", "DEG", "X0", "MIN", "HZ", "FRACTION", "GB"), float),
}
EXIT_BAD_USAGE = 2
EXIT_INTERNAL = 4
EXIT_BROKEN_PIPE = 141
RETRY = 0.1  # [s] after which a signal is sent again
SHORTAGE = "not enough memory ({}); lower --max-memory or --threads, or thin the scan"
EXIT_CODES = "2 wrong usage, 3 bad input, 4 internal error, 130 interrupted, 143 terminated."
Main = Callable[..., int]  # runs a command line, by default this program's, and returns its exit code


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Prints the epilog as it stands, and the names of commands as they were started."""

    def format_help(self) -> str:
        """Return the usage or the whole help."""
        return for_terminal(super().format_help())


def new_parser(
    name: str, description: str | None, epilog: str, exit_codes: str = "0 done"
) -> argparse.ArgumentParser:
    """Return a parser of the command `name` with the options of all; `exit_codes` are its own, below 2."""
    program = as_started(f"{name}.py")
    epilog += f"exit codes: {exit_codes}, {EXIT_CODES}"
    parser = argparse.ArgumentParser(program, None, description, epilog, formatter_class=HelpFormatter)
    parser.set_defaults(program=program, quiet=False, debug=False)
    add_run_options(parser)
    return parser


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Add --quiet and --debug to a parser, or to one of its subcommands."""
    unless_given = argparse.SUPPRESS  # a subcommand keeps what stood before it
    option(parser, "--quiet", "print only errors to stderr", default=unless_given)
    option(parser, "--debug", "print the traceback of an error", default=unless_given)


def parse(parser: argparse.ArgumentParser, argv: list[str] | None) -> argparse.Namespace:
    """Return the options given; argparse alone would take the value of `--up -y` for an option."""
    words: list[str] = []
    for word in sys.argv[1:] if argv is None else argv:
        if words[-1:] == ["--up"]:
            words[-1] = f"--up={word}"
        else:
            words.append(word)
    return parser.parse_args(words)


def option(group: argparse._ActionsContainer, usage: str, text: str = "", **more: Any) -> None:
    """Add an option by its usage, such as `--quiet`, `--step M`, `--near X Y Z`, or `--cloud FILE ...`.

    `text` is its help, to which a default is added; `more` goes to argparse.
    """
    name, *metavars = usage.removesuffix(" ...").split()
    if metavars:
        metavar = metavars[0] if len(metavars) == 1 else tuple(metavars)
        more = {"type": KINDS.get(metavars[0], str), "metavar": metavar, **more}
    elif "choices" not in more:
        more = {"action": "store_true", **more}
    if usage.endswith("..."):
        more.setdefault("nargs", "+")
    elif len(metavars) > 1:
        more["nargs"] = len(metavars)
    if (default := more.get("default")) not in (None, [], False, argparse.SUPPRESS):
        shown = " ".join(map(str, default)) if isinstance(default, list | tuple) else default
        text = f"{text} (default {shown})".lstrip()
    group.add_argument(name, help=text, **more)


def command(
    file: str,
    description: str | None,
    epilog: str,
    add_options: Callable[[argparse.ArgumentParser], None],
    exit_codes: str = "0 done",
) -> Callable[[Callable[[argparse.Namespace], int]], Main]:
    """Make a function of the options given, which returns an exit code, the `main` of a command.

    The command is named after its source `file`; `exit_codes` are its own, below 2.
    """

    def decorate(run: Callable[[argparse.Namespace], int]) -> Main:
        def main(argv: list[str] | None = None) -> int:
            parser = new_parser(Path(file).stem, description, epilog, exit_codes)
            add_options(parser)
            arguments = parse(parser, argv)
            lost: list[KeyboardInterrupt] = []
            try:
                with showing_log(arguments.quiet), raising_signals(lost):
                    check_address_space()
                    exit_code = run(arguments)
                    sys.stdout.flush()  # here, where a closed pipe is caught
                    return exit_code
            except (Exception, KeyboardInterrupt) as error:
                return report_error(arguments, error, lost)

        return main

    return decorate


class Terminated(KeyboardInterrupt):
    """SIGTERM: a command ends as after Ctrl-C, so that no temporary file is left."""


def report_error(
    arguments: argparse.Namespace, error: Exception | KeyboardInterrupt, lost: list[KeyboardInterrupt]
) -> int:
    """Print the error that ended a command, and return its exit code; `lost` is that of raising_signals."""
    is_foreseen = isinstance(error, OSError | InputError)
    if lost and isinstance(error, Exception) and not is_foreseen:
        error = lost[0]  # what was called back by C has failed for it
    if isinstance(error, Terminated):
        return print_error(arguments, "terminated", EXIT_TERMINATED)
    if isinstance(error, KeyboardInterrupt):
        return print_error(arguments, "interrupted", EXIT_INTERRUPTED)
    if isinstance(error, OSError | InputError):
        discard_stdout()
        if isinstance(error, BrokenPipeError) and not error.filename:  # stdout's reader has gone: say nothing
            return EXIT_BROKEN_PIPE
        code = EXIT_BAD_USAGE if isinstance(error, UsageError) else EXIT_BAD_INPUT
        return print_error(arguments, text_of(error), code)
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


def discard_stdout() -> None:
    """Drop what can't be written to stdout, so that it is not tried again at exit."""
    try:
        if sys.stdout:
            sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
