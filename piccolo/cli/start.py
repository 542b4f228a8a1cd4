"""The beginning of a command: signals and streams, before the libraries are imported, for a second."""

import os
import re
import signal
import sys
from importlib import import_module
from types import FrameType
from typing import Any

from ..system.jobs.memory import limit_of_process, share_arenas

# a command in a text, by the script of the checkout
SCRIPT = re.compile(r"(?:python )?(?:\b(localize)|tools/(\w+))\.py\b")
# a parameter of the API in a message, the unit in its name, and those whose flag has another name
PARAMETER = re.compile("`([a-z][a-z0-9_]*)`")
UNIT = re.compile("_(deg|px|world)$")
FLAGS = {
    "num_threads": "--threads",
    "radius": "RADIUS of --near",
    "heading_tolerance_deg": "the tolerance of --heading",
    "cube_order": "the order of cube faces",
    "use_gps": "GPS",
}
# [byte] below it LLVM and OpenBLAS crash or wait for ever, where NumPy raises; each core has a thread
LEAST_ADDRESS_SPACE = 1_000_000_000 + 250_000_000 * (os.cpu_count() or 1)
EXIT_CANNOT_START = 3
EXIT_INTERRUPTED = 130
EXIT_TERMINATED = 143


def for_terminal(text: str) -> str:
    """Return a message in the words of the command line: parameters in backticks become flags."""
    return PARAMETER.sub(
        lambda m: FLAGS.get(m[1]) or f"--{UNIT.sub('', m[1]).replace('_', '-')}", as_started(text)
    )


def as_started(text: str) -> str:
    """Return a text that names commands as scripts, as installed commands if one of these was started."""
    return SCRIPT.sub(lambda match: name_of(match[1] or match[2]), text) if is_installed() else text


def is_installed() -> bool:
    """Return True if an installed command was started, no script of a checkout."""
    return os.path.basename(sys.argv[0]).startswith("piccolo-")  # noqa: PTH119


def name_of(command: str) -> str:
    """Return the name under which a command is started."""
    return f"piccolo-{command.replace('_', '-')}" if is_installed() else f"{command}.py"


def run(module: str) -> int:
    """Import the `module` of a command and run its `main`; returns the exit code, or raises it as `load`."""
    open_closed_streams()
    share_arenas()
    space = limit_of_process()
    if space < LEAST_ADDRESS_SPACE:
        wanted = f"wanted {LEAST_ADDRESS_SPACE >> 10} or more on this machine"
        print_line(f"found ulimit -v {int(space) >> 10}, {wanted}")
        return EXIT_CANNOT_START
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # not ignored by nohup, or a shell's &
        signal.signal(signal.SIGINT, quit_at_once)
    signal.signal(signal.SIGTERM, quit_at_once)
    return int(load(module).main())


def load(module: str) -> Any:
    """Import a module with its libraries; SystemExit, after a line, without one or memory for it."""
    try:
        return import_module(module)
    except (ImportError, MemoryError, OSError) as error:
        print_line(f"the libraries cannot be loaded ({' '.join(str(error).split()) or 'not enough memory'})")
        raise SystemExit(EXIT_CANNOT_START) from error


def open_closed_streams() -> None:
    """Put /dev/null in place of stdin, stdout and stderr if closed, so that no other file gets their number.

    Reading finds the end; what is written to stderr is dropped; writing to stdout fails, so that no result is
    lost unseen. Names of files that can't be encoded are escaped.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_WRONLY if name == "stderr" else os.O_RDONLY)  # takes the lowest number
            setattr(sys, name, open(number, mode, errors="backslashreplace", closefd=False))  # noqa: SIM115
        else:
            if name != "stdin":
                getattr(sys, name).reconfigure(errors="backslashreplace")


def print_line(text: str) -> None:
    """One line on stderr, past Python's streams, after the name that the program was started by."""
    os.write(2, f"{os.path.basename(sys.argv[0])}: {text}\n".encode(errors="backslashreplace"))  # noqa: PTH119


def quit_at_once(signum: int, frame: FrameType | None) -> None:
    """End before the work: nothing is to be cleaned up, an exception would pass through half-made modules."""
    is_interrupt = signum == signal.SIGINT
    print_line("interrupted" if is_interrupt else "terminated")
    os._exit(EXIT_INTERRUPTED if is_interrupt else EXIT_TERMINATED)
