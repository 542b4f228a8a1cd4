"""The kernels with which BENCHMARK.md was made, as a list: each with a digest of what it computes.

A test compares the list with the kernels that there are. Names, comments and types do not count.
"""

import ast
import hashlib
import importlib
import inspect
import sys
import textwrap
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import piccolo
from piccolo.system.kernels import jit

MEASURED = Path(__file__).with_name("kernels.txt")
HEADING = "# Kernels with which BENCHMARK.md was made, at commit "
NUM_DIGITS = 16  # of a digest


def digest_text(text: str) -> str:
    """Return the digest of a text."""
    return hashlib.sha256(text.encode()).hexdigest()[:NUM_DIGITS]


def describe_value(value: object) -> str:
    """Return a word for what a kernel takes from around it: for another kernel its digest."""
    function = getattr(value, "py_func", value)
    if isinstance(function, FunctionType):
        return digest_kernel(function)
    if isinstance(value, ModuleType):
        return value.__name__
    if isinstance(value, type):
        return f"{value.__name__}{getattr(value, '_fields', '')}"
    return repr(value)


class Renaming(ast.NodeTransformer):
    """Replaces names: the n-th local one by n, all others by what they stand for. Types are left out."""

    def __init__(self, function: FunctionType) -> None:
        self.words = {name: f"v{n}" for n, name in enumerate(function.__code__.co_varnames)}
        around = inspect.getclosurevars(function)
        for names in (around.builtins, around.globals, around.nonlocals):
            self.words |= {name: describe_value(value) for name, value in names.items()}

    def visit_Name(self, node: ast.Name) -> ast.Name:
        """Replace a name."""
        return ast.Name(self.words.get(node.id, node.id), node.ctx)

    def visit_arg(self, node: ast.arg) -> ast.arg:
        """Replace the name of an argument."""
        return ast.arg(self.words[node.arg])


@cache
def digest_kernel(function: FunctionType) -> str:
    """Return a digest of what a function computes, whatever the names in it, its comments and its types."""
    [definition] = ast.parse(textwrap.dedent(inspect.getsource(function))).body
    assert isinstance(definition, ast.FunctionDef)
    definition.decorator_list = []
    definition.returns = None
    definition.name = "kernel"
    if ast.get_docstring(definition) is not None:
        del definition.body[0]
    return digest_text(ast.unparse(Renaming(function).visit(definition)))


def is_of_piccolo(kernel: Any) -> bool:
    """Return True for a kernel of `piccolo`.

    Python may have called a part of kernels by itself, which compiles it once more: that is no kernel.
    """
    function = kernel.py_func
    if not function.__module__.startswith("piccolo."):
        return False
    return getattr(sys.modules[function.__module__], function.__name__, kernel) is kernel


def list_digests() -> dict[str, str]:
    """Return the digest of each kernel of `piccolo`, and of the flags with which all are compiled."""
    root = Path(piccolo.__file__).parent
    for path in sorted(root.rglob("*.py")):
        if "kernels.jit import" in path.read_text():
            importlib.import_module(".".join(path.relative_to(root.parent).with_suffix("").parts))
    kernels = {
        name.replace(" ", "+"): kernel for name, kernel in jit.KERNELS.items() if is_of_piccolo(kernel)
    }
    flags = digest_text(" ".join(sorted(jit.FASTMATH)))
    return {"flags": flags, **{name: describe_value(kernels[name]) for name in sorted(kernels)}}


def list_lines(commit: str) -> list[str]:
    """Return the lines of MEASURED, for a page that is made at a commit."""
    return [HEADING + commit, *(f"{digest} {name}" for name, digest in list_digests().items())]


def read_measured() -> tuple[str, dict[str, str]]:
    """Return the commit at which the page was made, and the digests of the kernels at that time."""
    heading, *lines = MEASURED.read_text().splitlines()
    pairs = (line.split() for line in lines)
    return heading.removeprefix(HEADING), {name: digest for digest, name in pairs}


def find_changed() -> list[str]:
    """Return the names of kernels that compute something else than those measured, are new, or are gone."""
    measured = read_measured()[1]
    present = list_digests()
    new = {name for name, digest in present.items() if digest not in measured.values()}
    gone = {name for name, digest in measured.items() if digest not in present.values()}
    return sorted(new | gone)
