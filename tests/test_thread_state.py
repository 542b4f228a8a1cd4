"""State that belongs to a thread is not held where a generator waits, as another thread may go on with it."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = [path for name in ("piccolo", "research", "tools") for path in sorted((ROOT / name).rglob("*.py"))]
# calls that change the state of a thread, a context or the process, until they are undone
HOLDERS = {
    "catch_warnings", "chdir", "errstate", "localcontext", "one_blas_thread", "printoptions", "rc_context",
    "reading_once", "redirect_stderr", "redirect_stdout", "seterr", "setcontext", "threadpool_limits",
}  # fmt: skip
SCOPES = (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda, ast.ClassDef, ast.GeneratorExp)
FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
YIELDS = (ast.Yield, ast.YieldFrom)


def _within(node):
    """All nodes of a function's own, not those of functions within it."""
    for child in ast.iter_child_nodes(node):
        yield child
        if not isinstance(child, SCOPES):
            yield from _within(child)


def _name(node):
    called = node.func if isinstance(node, ast.Call) else node
    return getattr(called, "attr", getattr(called, "id", ""))


def _is_manager(function):
    return any(_name(node) in ("contextmanager", "asynccontextmanager") for node in function.decorator_list)


def _held(function, holders):
    """Yield the calls of holders in a function, but for those of a `with` in which it never yields."""
    passing = set()
    for node in _within(function):
        if isinstance(node, (ast.With, ast.AsyncWith)):
            is_left = not any(isinstance(inner, YIELDS) for inner in _within(node))
            passing |= {item.context_expr for item in node.items if is_left}
    yield from (
        node
        for node in _within(function)
        if isinstance(node, ast.Call) and _name(node) in holders and node not in passing
    )


def find_held(sources):
    """The places (file, line) of sources {file: text} where a generator holds such state while it waits."""
    # without the word in a text there is no generator in it
    trees = {file: ast.parse(text) for file, text in sources.items() if "yield" in text}
    generators = [
        (file, node)
        for file, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, FUNCTIONS) and any(isinstance(inner, YIELDS) for inner in _within(node))
    ]
    holders = set(HOLDERS)
    while True:  # what holds such state for a `with` is such a holder itself
        more = {f.name for _, f in generators if _is_manager(f) and any(_held(f, holders))} - holders
        if not more:
            break
        holders |= more
    return [
        (file, call.lineno)
        for file, function in generators
        if not _is_manager(function)
        for call in _held(function, holders)
    ]


def test_no_generator_holds_the_state_of_a_thread_across_a_yield():
    assert len(SOURCES) > 200
    assert find_held({str(path.relative_to(ROOT)): path.read_text() for path in SOURCES}) == []


MANAGER = """
@contextmanager
def quiet():
    with np.errstate(all="ignore"):
        yield
"""


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("def f():\n with np.errstate(all='ignore'):\n  yield 1\n", [2]),
        ("def f():\n with open(x) as file, errstate():\n  for line in file:\n   yield from line\n", [2]),
        ("def f():\n with ExitStack() as stack:\n  stack.enter_context(catch_warnings())\n  yield 1\n", [3]),
        ("def f():\n np.seterr(all='ignore')\n yield 1\n", [2]),
        ("@np.errstate(all='ignore')\ndef f():\n yield 1\n", [1]),
        (f"{MANAGER}\ndef f():\n with quiet():\n  yield 1\n", [8]),
        (MANAGER, []),
        ("def f():\n with np.errstate(all='ignore'):\n  a = 1\n yield a\n", []),
        ("def f():\n with np.errstate(all='ignore'):\n  def g():\n   yield 1\n  return list(g())\n", []),
    ],
)
def test_the_check_finds_each_way_to_hold_it(text, lines):
    assert find_held({"a.py": text}) == [("a.py", line) for line in lines]
