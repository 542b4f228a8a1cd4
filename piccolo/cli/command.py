"""Commands: options written as a help text shows them, checks before any work, and the `main` that runs."""

import argparse
import json
import math
import os
import signal
import stat
import sys
import threading
import traceback
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

from tqdm import tqdm

from ..system.arguments import PICTURES
from ..system.errors import InputError, printable, text_of
from ..system.files.atomic import check_output, is_stdout, is_stream
from ..system.jobs.memory import check_address_space, is_shortage
from ..system.jobs.threads import Progress, Workers, num_cores
from .start import EXIT_INTERRUPTED, EXIT_TERMINATED, for_terminal, load, name_of, quit_at_once
from .terminal import LOG, progress_bar, showing_log

KINDS: dict[str, type] = {  # of the values, by the first metavar; of others text
    **dict.fromkeys(("FILE", "FOLDER", "JSONL", "PNG"), Path),
    **dict.fromkeys(("N", "PX", "FIRST", "W", "ROOM"), int),
    **dict.fromkeys(("X", "M", "S", "DEG", "X0", "MIN", "HZ", "FRACTION", "GB"), float),
}
EXIT_BAD_USAGE = 2
EXIT_BAD_INPUT = 3
EXIT_INTERNAL = 4
EXIT_BROKEN_PIPE = 141
RETRY = 0.1  # [s] after which a signal is sent again
# os.kill wakes the main thread, wherever it waits; on Windows it would end the process at once
send_signal = signal.raise_signal if sys.platform == "win32" else partial(os.kill, os.getpid())
SHORTAGE = "not enough memory ({}); lower --max-memory or --threads, or thin the scan"
EXIT_CODES = "2 wrong usage, 3 bad input, 4 internal error, 130 interrupted, 143 terminated."
Outputs = Mapping[str, Path | None]  # by option; None where it is not given
Main = Callable[..., int]  # runs a command line, by default this program's, and returns its exit code


class UsageError(InputError):
    """The options are wrong, whatever the files hold."""


class Arguments(argparse.Namespace):
    """The options given to a command. It prints what is no result as --quiet and --debug say."""

    def error(self, text: str, exit_code: int = EXIT_BAD_INPUT) -> int:
        """Print a line on stderr, with --debug after the traceback of the error at hand; return the code."""
        if self.debug and sys.exc_info()[0]:
            traceback.print_exc()
        tqdm.write(f"{self.program}: {for_terminal(printable(text))}", file=sys.stderr)
        return exit_code

    def note(self, text: str) -> None:
        """Print a line on stderr, but not with --quiet."""
        if not self.quiet:
            tqdm.write(f"{self.program}: {for_terminal(printable(text))}", file=sys.stderr)

    def warn(self, warnings: Iterable[str]) -> None:
        """Print a line on stderr for each warning, unless --quiet."""
        for warning in warnings:
            self.note(f"warning: {warning}")

    def report(self, outputs: Outputs, report: Mapping[str, object] | str) -> None:
        """Print JSON, or text, on stdout; on stderr, without --quiet, where one of the outputs is stdout."""
        text = report if isinstance(report, str) else f"{json.dumps(report, allow_nan=False)}\n"
        if not any(path and is_stdout(path) for path in outputs.values()):
            print(text, end="")
        elif not self.quiet:
            print(text, end="", file=sys.stderr)

    def progress(self) -> Progress:
        """Return a function that wraps values in a progress bar, or in nothing with --quiet."""
        return progress_bar(self.quiet)

    def workers(self, num_threads: int | None = None) -> Workers:
        """Return workers, by default one a core, that show progress, unless --quiet, and log warnings.

        If this process has to compile kernels, others help.
        """
        from ..system.kernels import ahead  # noqa: PLC0415  # Numba is imported where it is used

        ahead.get_help()
        return Workers(num_threads or num_cores(), self.progress(), LOG.warning)

    def check_least(self, **limits: float) -> None:
        """Refuse an option below its limit, by its name; one that is not there may be anything."""
        for name, limit in limits.items():
            value = getattr(self, name, None)
            if value is not None and not limit <= value < math.inf:
                raise UsageError(f"--{name.replace('_', '-')}: found {value}, wanted at least {limit}")

    def refuse_given(self, options: Sequence[str], why: str) -> None:
        """Refuse options without a default that are given, by their names."""
        for name in options:
            value = getattr(self, name)
            if value is not None and value is not False:
                raise UsageError(f"--{name.replace('_', '-')}: {why}")


class HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Prints the epilog as it stands, and the names of commands as they were started."""

    def format_help(self) -> str:
        """Return the usage or the whole help."""
        return for_terminal(super().format_help())


def new_parser(
    name: str, description: str | None, epilog: str, exit_codes: str = "0 done"
) -> argparse.ArgumentParser:
    """Return a parser of the command `name` with the options of all; `exit_codes` are its own, below 2."""
    program = name_of(name)
    epilog += f"exit codes: {exit_codes}, {EXIT_CODES}"
    parser = argparse.ArgumentParser(program, None, description, epilog, formatter_class=HelpFormatter)
    parser.set_defaults(program=program, quiet=False, debug=False)
    add_run_options(parser)
    return parser


def add_command(
    commands: "argparse._SubParsersAction[argparse.ArgumentParser]", name: str, **more: Any
) -> Any:
    """Return the parser of a subcommand; `more` goes to argparse."""
    parser = commands.add_parser(name, formatter_class=HelpFormatter, **more)
    add_run_options(parser)
    return parser


def add_run_options(parser: argparse.ArgumentParser) -> None:
    """Add --quiet and --debug to a parser, or to one of its subcommands."""
    unless_given = argparse.SUPPRESS  # a subcommand keeps what stood before it
    option(parser, "--quiet", "print only errors to stderr", default=unless_given)
    option(parser, "--debug", "print the traceback of an error", default=unless_given)


def parse(parser: argparse.ArgumentParser, argv: list[str] | None) -> Arguments:
    """Return the options given; argparse alone would take the value of `--up -y` for an option."""
    words: list[str] = []
    for word in sys.argv[1:] if argv is None else argv:
        if words[-1:] == ["--up"]:
            words[-1] = f"--up={word}"
        else:
            words.append(word)
    return parser.parse_args(words, Arguments())


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
) -> Callable[[Callable[[Arguments], int] | str], Main]:
    """Make a function of the options given, which returns an exit code, the `main` of a command.

    The command is named after its source `file`; `exit_codes` are its own, below 2. A function that is named
    as `module:function` is imported when the options are right: --help need not wait for it.
    """

    def decorate(run: Callable[[Arguments], int] | str) -> Main:
        def main(argv: list[str] | None = None) -> int:
            parser = new_parser(Path(file).stem, description, epilog, exit_codes)
            add_options(parser)
            arguments = parse(parser, argv)
            work = import_function(run) if isinstance(run, str) else run
            lost: list[KeyboardInterrupt] = []
            try:
                with showing_log(arguments.quiet), raising_signals(lost):
                    check_address_space()
                    warn_of_two_opencvs()
                    exit_code = work(arguments)
                    sys.stdout.flush()  # here, where a closed pipe is caught
                    return exit_code
            except (Exception, KeyboardInterrupt) as error:
                return report_error(arguments, error, lost)

        return main

    return decorate


def import_function(name: str) -> Callable[[Arguments], int]:
    """Import the function of a command that is named as `module:function`."""
    module, _, function = name.partition(":")
    found: Callable[[Arguments], int] = getattr(load(module), function)
    return found


def warn_of_two_opencvs() -> None:
    """Warn where two packages have written into one folder, of which each may be half overwritten."""
    from importlib import metadata  # noqa: PLC0415  # --help need not wait for it

    with suppress(metadata.PackageNotFoundError):
        metadata.distribution("opencv-python")
        metadata.distribution("opencv-python-headless")
        both = "opencv-python and opencv-python-headless"
        LOG.warning("found %s, which overwrite each other; uninstall both, then install one again", both)


class Terminated(KeyboardInterrupt):
    """SIGTERM: a command ends as after Ctrl-C, so that no temporary file is left."""


def report_error(
    arguments: Arguments, error: Exception | KeyboardInterrupt, lost: list[KeyboardInterrupt]
) -> int:
    """Print the error that ended a command, and return its exit code; `lost` is that of raising_signals."""
    is_foreseen = isinstance(error, OSError | InputError)
    if lost and isinstance(error, Exception) and not is_foreseen:
        error = lost[0]  # what was called back by C has failed for it
    if isinstance(error, Terminated):
        return arguments.error("terminated", EXIT_TERMINATED)
    if isinstance(error, KeyboardInterrupt):
        return arguments.error("interrupted", EXIT_INTERRUPTED)
    if isinstance(error, OSError | InputError):
        discard_stdout()
        if isinstance(error, BrokenPipeError) and not error.filename:  # stdout's reader has gone: say nothing
            return EXIT_BROKEN_PIPE
        code = EXIT_BAD_USAGE if isinstance(error, UsageError) else EXIT_BAD_INPUT
        return arguments.error(text_of(error), code)
    if is_shortage(error):
        text = " ".join(str(error).split()) or "none is left"
        return arguments.error(SHORTAGE.format(text))
    return arguments.error(f"internal error: {error!r}; --debug shows where", EXIT_INTERNAL)


@contextmanager
def raising_signals(lost: list[KeyboardInterrupt]) -> Iterator[None]:
    """Within this, SIGTERM raises Terminated in the main thread, and SIGINT KeyboardInterrupt.

    Code that is called back from C, as by LLVM while a kernel is compiled, can't pass an exception on: it is
    added to `lost`, and the signal is sent again a moment later. So is each that is raised, as a library may
    make another error of it.
    """
    if threading.current_thread() is not threading.main_thread():  # where no handler can be set
        yield
        return
    timers: list[threading.Timer] = []

    def send_again(unraisable: "sys.UnraisableHookArgs") -> None:
        if isinstance(unraisable.exc_value, KeyboardInterrupt):
            lost.append(unraisable.exc_value)
            number = signal.SIGTERM if isinstance(unraisable.exc_value, Terminated) else signal.SIGINT
            timers.append(threading.Timer(RETRY, send_signal, (number,)))
            timers[-1].start()
        else:
            sys.__unraisablehook__(unraisable)

    def interrupt(number: int, frame: FrameType | None) -> None:
        lost.append(Terminated() if number == signal.SIGTERM else KeyboardInterrupt())
        raise lost[-1]

    before = {signal.SIGTERM: signal.signal(signal.SIGTERM, interrupt)}
    if signal.getsignal(signal.SIGINT) in (quit_at_once, signal.default_int_handler):
        before[signal.SIGINT] = signal.signal(signal.SIGINT, interrupt)
    hook = sys.unraisablehook
    sys.unraisablehook = send_again
    try:
        yield
    finally:
        for timer in timers:
            timer.cancel()
        for number, handler in before.items():
            signal.signal(number, handler)
        sys.unraisablehook = hook


def discard_stdout() -> None:
    """Drop what can't be written to stdout, so that it is not tried again at exit."""
    try:
        if sys.stdout:
            sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@contextmanager
def checking_options() -> Iterator[None]:
    """Within this, an InputError is a UsageError."""
    try:
        yield
    except InputError as error:
        raise UsageError(str(error)) from error


def check_outputs(outputs: Outputs, inputs: Iterable[Path] = ()) -> None:
    """Refuse output files as check_distinct does (exit code 2), and those that can't be written (3)."""
    check_distinct(outputs, inputs)
    for path in filter(None, outputs.values()):
        check_output(path)


def check_distinct(outputs: Outputs, inputs: Iterable[Path] = ()) -> None:
    """Refuse outputs, files or folders, of which two are one or lie in each other, or one is an input.

    Links, also hard ones, count as what they lead to. An input folder stands for the pictures in it: the
    faces of a cube, or masks.
    """
    given = {name: path for name, path in outputs.items() if path and os.path.realpath(path) != os.devnull}
    earlier: dict[str, Path] = {}
    for name, path in given.items():
        for other, other_path in earlier.items():
            if _are_one(path, other_path):
                raise UsageError(f"{path}: found the same output as {other} for {name}, wanted two")
        earlier[name] = path
    existing = {identity: path for path in given.values() if (identity := _identity(path))}
    for file in _files_of(inputs) if existing else ():
        if (identity := _identity(file)) in existing:
            raise UsageError(f"{existing[identity]}: found an input as the output, wanted another name")


def _are_one(path: Path, other: Path) -> bool:
    """Return True if what is written to one would replace the other, or stands in it."""
    if is_stdout(path) or is_stdout(other):
        return is_stdout(path) and is_stdout(other)
    if path.exists() and other.exists() and path.samefile(other):
        return True
    real = Path(os.path.realpath(path))
    other_real = Path(os.path.realpath(other))
    return real.is_relative_to(other_real) or other_real.is_relative_to(real)


def _identity(path: Path) -> tuple[int, int] | None:
    """Device and inode of a regular file; None for all else."""
    try:
        status = path.stat()
    except (OSError, ValueError):  # of a name that no file can have
        return None
    return (status.st_dev, status.st_ino) if stat.S_ISREG(status.st_mode) else None


def _files_of(inputs: Iterable[Path]) -> Iterator[Path]:
    """Yield the inputs, of folders their pictures; those that can't be read are left to their readers."""
    for path in inputs:
        if os.path.isdir(path) and os.access(path, os.R_OK | os.X_OK):  # noqa: PTH112  # Path's raises for long
            yield from (file for file in path.iterdir() if file.suffix.lower() in PICTURES)
        else:
            yield path


def check_suffix(option: str, path: Path | None, suffixes: tuple[str, ...]) -> None:
    """Refuse an output whose name ends with none of the suffixes ("" is a folder's); a stream has none."""
    if path and not is_stream(path) and path.suffix.lower() not in suffixes:
        wanted = ", ".join(filter(None, suffixes)) + (", or a folder's name" if "" in suffixes else "")
        raise UsageError(f"{option} {path.name}: wanted a name that ends with {wanted}")


def check_folder_name(option: str, path: Path | None) -> None:
    """Refuse stdout and devices where a folder is wanted."""
    if path and is_stream(path):
        raise UsageError(f"{option} {path}: found stdout or a device, wanted a folder's name")
