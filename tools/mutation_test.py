"""Change one operator, number or statement of the core at a time, and print which changes no test notices.

    python tools/mutation_test.py --count 80 --seed 1 --jobs 2

A survivor is a test that is missing, or a change that means nothing. Kernels are compiled anew only where a
change lies in one, so that the others take seconds. Works on copies; the checkout stays as it is.
"""

import argparse
import ast
import copy
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import SimpleQueue
from typing import Any, NamedTuple

import _checkout  # noqa: F401

from piccolo.runtime.kernel_cache import kernel_folder, sources_digest

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("piccolo", "tests", "tools", "pyproject.toml", "localize.py")
WHOLE = ("refinement", "coarse_to_fine")
TESTS = {  # those that matter for a module, the quickest first
    "coarse_to_fine/search.py": ("search", *WHOLE),
    "coarse_to_fine/descent.py": ("descent", *WHOLE),
    "coarse_to_fine/starts.py": WHOLE,
    "coarse_to_fine/refinement.py": WHOLE,
    "coarse_to_fine/search_result.py": WHOLE,
    "coarse_to_fine/localize.py": WHOLE,
    "coarse_to_fine/evaluation.py": WHOLE,
    "coarse_to_fine/prior.py": WHOLE,
    "coarse_to_fine/covariance.py": ("coarse_to_fine_covariance",),
    "confidence/alternatives.py": ("alternatives", "refinement"),
    "confidence/confidence.py": ("confidence",),
    "confidence/covariance.py": ("covariance",),
    "confidence/score.py": ("score",),
    "geometry/suppression.py": ("suppression", "alternatives", "refinement"),
    "render/zbuffer.py": ("zbuffer", "score", "paper_starts"),
    "render/free_space.py": ("paper_starts",),
}
OPPOSITE: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.And: ast.Or, ast.Or: ast.And,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
}  # fmt: skip
REMOVABLE = (ast.AugAssign, ast.Expr, ast.If, ast.Break, ast.Continue)
KEPT_KERNELS = ("-p", "kept_kernels")
TIMEOUT_S = 400.0  # a test that runs on for ever has noticed, too


class Mutant(NamedTuple):
    """A module with one change."""

    module: str
    line: int
    change: str
    source: str
    is_kernel: bool


def _changed(node: ast.AST) -> Iterator[ast.AST]:
    """The node with one change, for each that it can have."""
    other = copy.copy(node)
    if isinstance(node, ast.Compare):
        other.ops = [OPPOSITE[type(node.ops[0])](), *node.ops[1:]]  # type: ignore[attr-defined]
        yield other
    elif isinstance(node, ast.BoolOp | ast.BinOp) and type(node.op) in OPPOSITE:
        other.op = OPPOSITE[type(node.op)]()  # type: ignore[attr-defined]
        yield other
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        yield node.operand
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield ast.Constant(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        yield from (ast.Constant(value) for value in {2 * node.value, 0, 1} - {node.value})
    elif isinstance(node, REMOVABLE) and not (
        isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    ):
        yield ast.Pass()


def _nodes(node: ast.AST, is_kernel: bool = False) -> Iterator[tuple[ast.AST, bool]]:
    """All nodes below one that are code, not types, and whether they lie in a kernel."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_comment"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                decorators = [ast.unparse(d) for d in getattr(child, "decorator_list", [])]
                in_kernel = is_kernel or bool({"kernel", "inline_kernel"} & set(decorators))
                yield child, in_kernel
                yield from _nodes(child, in_kernel)


def mutants(module: str) -> Iterator[Mutant]:
    """Every mutant of a module."""
    source = (ROOT / "piccolo" / module).read_text()
    starts = [0]
    for line in source.encode().splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    tree, has_kernels = ast.parse(source), "runtime.jit import" in source
    assigned = [statement for statement in tree.body if isinstance(statement, ast.Assign)]
    global_nodes = {id(node) for statement in assigned for node in ast.walk(statement)}  # kernels hold them
    for node, is_kernel in _nodes(tree):
        if not isinstance(node, ast.stmt | ast.expr):
            continue
        lo = starts[node.lineno - 1] + node.col_offset
        hi = starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)
        for other in _changed(node):
            text = ast.unparse(other)
            text = text if isinstance(node, ast.stmt | ast.Constant) else f"({text})"
            changed = source.encode()[:lo] + text.encode() + source.encode()[hi:]
            told = f"{ast.unparse(node).splitlines()[0]}  ->  {text}"
            is_compiled = is_kernel or (has_kernels and id(node) in global_nodes)
            yield Mutant(module, node.lineno, told, changed.decode(), is_compiled)


def fails(names: Sequence[str], folder: Path, *options: str, timeout_s: float | None = TIMEOUT_S) -> bool:
    """True if one of these tests fails in a copy of the checkout."""
    tests = [f"tests/test_{name}.py" for name in names]
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *options, *tests]
    own = {"PYTHONPATH": str(folder), "XDG_CACHE_HOME": str(folder.parent), "PYTHONDONTWRITEBYTECODE": "1"}
    limits: dict[str, Any] = {"cwd": folder, "env": os.environ | own, "timeout": timeout_s}
    try:
        return subprocess.run(command, check=False, capture_output=True, **limits).returncode != 0
    except subprocess.TimeoutExpired:
        return True


def is_caught(mutant: Mutant, folder: Path) -> bool:
    """True if a test fails on the mutant in a copy of the checkout."""
    path = folder / "piccolo" / mutant.module
    original = path.read_text()
    path.write_text(mutant.source)
    try:
        return fails(TESTS[mutant.module], folder, *([] if mutant.is_kernel else KEPT_KERNELS))
    finally:
        path.write_text(original)


def checkout_copy(folder: Path) -> Path:
    """A copy of the checkout in which kernels can be told to stay as they were compiled for the checkout."""
    folder.mkdir()
    for name in COPIED:
        (shutil.copytree if (ROOT / name).is_dir() else shutil.copy)(ROOT / name, folder / name)
    digest = f"kernel_cache.sources_digest = lambda: {sources_digest()!r}\n"
    (folder / "kept_kernels.py").write_text(f"from piccolo.runtime import kernel_cache\n{digest}")
    return folder


def try_all(chosen: Sequence[Mutant], num_jobs: int) -> int:
    """Print what becomes of each mutant; returns how many were caught."""
    with tempfile.TemporaryDirectory() as temporary, ThreadPoolExecutor(num_jobs) as pool:
        folders: SimpleQueue[Path] = SimpleQueue()
        for k in range(num_jobs):
            folders.put(checkout_copy(Path(temporary) / str(k)))
        shutil.copytree(
            kernel_folder() or sys.exit("no folder for kernels"), Path(temporary) / "piccolo" / "kernels"
        )
        names = sorted({name for mutant in chosen for name in TESTS[mutant.module]})
        if fails(names, Path(temporary) / "0", *KEPT_KERNELS, timeout_s=None):
            sys.exit(f"the tests fail without a mutant: {' '.join(names)}")

        def tried(mutant: Mutant) -> bool:
            folder = folders.get()
            caught = is_caught(mutant, folder)
            folders.put(folder)
            word = "caught" if caught else "SURVIVED"
            print(f"{word}  {mutant.module}:{mutant.line}  {mutant.change}", flush=True)
            return caught

        return sum(pool.map(tried, chosen))


def main() -> int:
    """Try a sample of mutants; print the survivors and the share that was caught."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    parser.add_argument("--count", type=int, default=60, help="mutants tried")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, help="at a time")
    parser.add_argument("--modules", nargs="+", default=list(TESTS), choices=list(TESTS), metavar="MODULE")
    parser.add_argument("--no-kernels", action="store_true", help="leave out changes within kernels")
    arguments = parser.parse_args()
    every = [m for module in arguments.modules for m in mutants(module)]
    every = [m for m in every if not (arguments.no_kernels and m.is_kernel)]
    chosen = random.Random(arguments.seed).sample(every, min(arguments.count, len(every)))
    num_caught = try_all(chosen, arguments.jobs)
    share = 100 * num_caught / len(chosen)
    print(f"caught {num_caught} of {len(chosen)} ({share:.0f} %), of {len(every)} mutants")
    return 0


if __name__ == "__main__":
    sys.exit(main())
