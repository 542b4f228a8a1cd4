"""What makes a module a command: options written as a help text shows them, and the `main` that runs it."""

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from .errors import UsageError, print_note, run_command
from .parser import add_run_options, new_parser

KINDS: dict[str, type] = {  # of the values, by the first metavar; of others text
    **dict.fromkeys(("FILE", "FOLDER", "JSONL", "PNG"), Path),
    **dict.fromkeys(("N", "PX", "FIRST", "W", "ROOM"), int),
    **dict.fromkeys(("X", "M", "DEG", "X0", "MIN", "HZ", "FRACTION"), float),
}
Main = Callable[..., int]  # runs a command line, by default this program's, and returns its exit code


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
    if (default := more.get("default")) not in (None, [], False):
        shown = " ".join(map(str, default)) if isinstance(default, list | tuple) else default
        text = f"{text} (default {shown})".lstrip()
    group.add_argument(name, help=text, **more)


def check_least(arguments: argparse.Namespace, **limits: int) -> None:
    """Refuse an option below its limit, by its name in `arguments`; one that is not there may be anything."""
    for name, limit in limits.items():
        value = getattr(arguments, name, None)
        if value is not None and value < limit:
            raise UsageError(f"--{name.replace('_', '-')}: found {value}, wanted at least {limit}")


def print_warnings(arguments: argparse.Namespace, warnings: Iterable[str]) -> None:
    """A line on stderr for each warning, unless --quiet."""
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
            add_run_options(parser)
            return run_command(parser, argv, run)

        return main

    return decorate
