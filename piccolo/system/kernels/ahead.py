"""Kernels compiled by helping processes, from the last that a photo needs to the first, or all beforehand.

`python -m piccolo.system.kernels.ahead` compiles all that localizing needs, with every core, for a machine
that has to be ready: a container, a cluster's node. A command gets help by itself when it has to compile.
"""

import os
import re
import subprocess
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from pydoc import locate
from typing import Any

from numba.core import types
from numba.core.registry import cpu_target

from ..errors import InputError
from ..files.atomic import hold_lock
from ..jobs.threads import num_cores
from . import jit

LISTED = Path(__file__).with_name("signatures.txt")
PACKAGES = Path(__file__).parents[3]  # from which a process imports this one
IMPORTS = "piccolo.api.scan"  # imports all of them
TOKEN = re.compile(r"[\w.]*\(|\)|[\w.]+(?:\[\w+\])?")
TYPES: Any = types  # Numba gives them none
HELPS = "helps"  # argument of a process that helps
helping: list[subprocess.Popen[bytes]] = []  # kept, as its end would close what they wait on


def describe_type(kind: Any) -> str:
    """Return a type of Numba in words that `parse` reads: float32[2C] is an array of two axes in C order."""
    if isinstance(kind, types.Array):
        return f"{kind.dtype}[{kind.ndim}{kind.layout}]"
    if isinstance(kind, TYPES.BaseTuple):
        made = getattr(kind, "instance_class", None)
        name = f"{made.__module__}.{made.__qualname__}" if made else ""
        return f"{name}({' '.join(describe_type(inner) for inner in kind)})"
    return str(kind)


def parse_types(text: str) -> tuple[Any, ...]:
    """Return the types of Numba that a text describes."""
    within: list[tuple[str, list[Any]]] = [("", [])]
    for token in TOKEN.findall(text):
        if token.endswith("("):
            within.append((token[:-1], []))
        elif token == ")":
            name, inner = within.pop()
            within[-1][1].append(TYPES.NamedTuple(inner, locate(name)) if name else TYPES.Tuple(inner))
        else:
            name, _, axes = token.rstrip("]").partition("[")
            kind = getattr(TYPES, name)
            within[-1][1].append(TYPES.Array(kind, int(axes[0]), axes[1]) if axes else kind)
    return tuple(within[0][1])


def list_kernels() -> Iterator[tuple[Any, tuple[Any, ...]]]:
    """Yield the kernels of the list, each with the types of its arguments."""
    import_module(IMPORTS)
    for line in LISTED.read_text(encoding="utf-8").splitlines():
        if line and not line.startswith("#"):
            name, _, arguments = line.partition(" | ")
            yield jit.KERNELS[name], parse_types(arguments)


def compile_missing(kernels: Iterable[tuple[Any, Any]]) -> None:
    """Compile kernels, given with the types of their arguments, that nobody has compiled or is compiling."""
    codegen = cpu_target.target_context.codegen()
    for dispatcher, arguments in kernels:
        path = dispatcher._cache.file(arguments, codegen)
        if path is None:
            return
        with suppress(InputError):  # another process has it
            with hold_lock(path):
                is_missing = not path.exists()
            if is_missing:
                dispatcher.compile(arguments)


def start_helpers(count: int) -> list[subprocess.Popen[bytes]]:
    """Start so many processes that compile; each ends by itself, and with the one that started it."""
    return [
        subprocess.Popen(
            [sys.executable, "-m", "piccolo.system.kernels.ahead", HELPS],
            cwd=PACKAGES,
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for _ in range(count)
    ]


def get_help() -> None:
    """Start helpers as soon as this process has to compile: as many as it has further cores."""
    jit.compiling.get_help = lambda: helping.extend(start_helpers(num_cores() - 1))


def _end_with_parent() -> None:
    os.read(sys.stdin.fileno(), 1)  # not through a buffer, at whose lock an exit would abort
    os._exit(0)


def main() -> int:
    """Compile the list; returns the exit code."""
    helpers: list[subprocess.Popen[bytes]] = []
    if HELPS in sys.argv[1:]:
        threading.Thread(target=_end_with_parent, daemon=True).start()
    else:
        helpers = start_helpers(num_cores() - 1)
    compile_missing(list_kernels())
    return max([0, *(abs(helper.wait()) for helper in helpers)])


if __name__ == "__main__":
    sys.exit(main())
