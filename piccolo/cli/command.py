"""Commands: options written as a help text shows them, and the `main` that parses and runs them."""

import argparse
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from ..jobs.memory import check_address_space
from .errors import UsageError, print_note, raising_signals, report_error
from .progress import showing_log
from .start import as_started, for_terminal

KINDS: dict[str, type] = {  # of the values, by the first metavar; of others text
    **dict.fromkeys(("FILE", "FOLDER", "JSONL", "PNG"), Path),
    **dict.fromkeys(("N", "PX", "FIRST", "W", "ROOM"), int),
    **dict.fromkeys(("X", "M", "S", "DEG", "X0", "MIN", "HZ", "FRACTION", "GB"), float),
}
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


def check_least(arguments: argparse.Namespace, **limits: float) -> None:
    """Refuse an option below its limit, by its name in `arguments`; one that is not there may be anything."""
    for name, limit in limits.items():
        value = getattr(arguments, name, None)
        if value is not None and not limit <= value < math.inf:
            raise UsageError(f"--{name.replace('_', '-')}: found {value}, wanted at least {limit}")


def check_alone(arguments: argparse.Namespace, what: str, others: Sequence[str]) -> None:
    """Refuse options, by their names in `arguments`, that do not go with what is asked for."""
    for name in others:
        if is_given(arguments, name):
            raise UsageError(f"--{name.replace('_', '-')}: not with {what}")


def check_only_with(arguments: argparse.Namespace, what: str, others: Sequence[str]) -> None:
    """Refuse options, by their names in `arguments`, that mean something only with what is not asked for."""
    for name in others:
        if is_given(arguments, name):
            raise UsageError(f"--{name.replace('_', '-')}: only with {what}")


def is_given(arguments: argparse.Namespace, name: str) -> bool:
    """Return True for an option without a default, by its name in `arguments`, that was given."""
    value = getattr(arguments, name)
    return value is not None and value is not False


def print_warnings(arguments: argparse.Namespace, warnings: Iterable[str]) -> None:
    """Print a line on stderr for each warning, unless --quiet."""
    for warning in warnings:
        print_note(arguments, f"warning: {warning}")


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
