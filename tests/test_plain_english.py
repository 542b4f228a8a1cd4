"""Plain words and one statement a line, counted in the sources and documents."""

import ast
import functools
import re
from pathlib import Path

import pytest

from piccolo.doors import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("piccolo", "research", "tools", "examples")
SOURCES = [ROOT / "localize.py", *(path for name in FOLDERS for path in sorted((ROOT / name).rglob("*.py")))]
BLOCKS = (ast.Module, ast.ClassDef, ast.FunctionDef)

VAGUE = re.compile(r"(The same|What|How|Where)\b")  # such a first line needs the code around it
# A name that begins with a participle says what has been done, not what the function does.
REAL_VERBS = {"embed", "shed"}
IRREGULAR = re.compile(
    "begun|bent|broken|brought|built|caught|chosen|done|drawn|found|given|gone|grown|held|hidden|kept|known|laid|"
    "led|lost|made|meant|met|paid|said|seen|sent|shown|sought|spent|taken|thrown|told|worn|written"
)
MAX_PARTICIPLES = 3  # of nouns: masked_correlation, square_gap; and searched_for
# A message of no command names a parameter in backticks by its Python name, such as `max_memory`, and a
# script as tools/NAME.py; for_terminal of cli/start.py makes them --max-memory and piccolo-NAME.
FLAG = re.compile(r"(?<![\w-])--[a-z{]")
DOCUMENTS = ("README.md", "BENCHMARK.md", "CHANGELOG.md", "CONTRIBUTING.md", "docs/*.md", "docs/recipes/*.md")
MAX_WORDS = 20_000
MAX_PARALLEL = 4.99  # assignments a, b = x, y in 1,000 lines


@functools.cache
def _trees():
    """The syntax of each source, by its name."""
    return {str(path.relative_to(ROOT)): ast.parse(path.read_text()) for path in SOURCES}


def _blocks(tree):
    return [node for node in ast.walk(tree) if isinstance(node, BLOCKS)]


def _texts(tree):
    """Line and text of all strings but docstrings; {} stands for what an f-string inserts."""
    skipped = {id(block.body[0].value) for block in _blocks(tree) if ast.get_docstring(block) is not None}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            skipped.update(map(id, node.values))
            yield (
                node.lineno,
                "".join(getattr(part, "value", "{}") if _is_text(part) else "{}" for part in node.values),
            )
        elif _is_text(node) and id(node) not in skipped:
            yield node.lineno, node.value


def _is_text(node):
    return isinstance(node, ast.Constant) and isinstance(node.value, str)


def _is_participle(word):
    return bool(IRREGULAR.fullmatch(word)) or (
        word.endswith("ed") and not word.endswith("eed") and word not in REAL_VERBS
    )


def _is_parallel(node):
    """True for a, b = x, y that is no swap."""
    if not (isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple)):
        return False
    values = sorted(map(ast.unparse, node.value.elts))
    targets = [target for target in node.targets if isinstance(target, ast.Tuple)]
    return any(sorted(map(ast.unparse, target.elts)) != values for target in targets)


def _packed(function):
    """Lines of calls f(*name) for which the function has put a tuple into `name`."""
    names = {
        node.targets[0].id
        for node in ast.walk(function)
        if isinstance(node, ast.Assign)
        and isinstance(node.value, ast.Tuple)
        and isinstance(node.targets[0], ast.Name)
    }
    for call in ast.walk(function):
        for argument in getattr(call, "args", []) if isinstance(call, ast.Call) else []:
            if isinstance(argument, ast.Starred) and getattr(argument.value, "id", None) in names:
                yield call.lineno


def _report(what, count, most, places=()):
    print(f"{what}: {count:,}, at most {most:,}")  # noqa: T201, shown by pytest -s
    assert count <= most, "\n".join(places)


def test_docstrings_can_be_understood_alone():
    found = [
        f"{name}: {text.splitlines()[0]}"
        for name, tree in _trees().items()
        for block in _blocks(tree)
        if VAGUE.match(text := ast.get_docstring(block) or "")
    ]
    _report("vague docstrings", len(found), 0, found)


def test_functions_are_verbs():
    found = [
        f"{name}:{function.lineno} {function.name}"
        for name, tree in _trees().items()
        for block in _blocks(tree)
        if not isinstance(block, ast.FunctionDef)
        for function in block.body
        if isinstance(function, ast.FunctionDef) and _is_participle(function.name.split("_")[0])
    ]
    _report("participles as names", len(found), MAX_PARTICIPLES, found)


def test_messages_of_the_package_name_parameters_not_flags():
    commands = {f"{module.replace('.', '/')}.py" for module in COMMANDS.values()}
    trees = {n: t for n, t in _trees().items() if n.startswith("piccolo/") and "/cli/" not in n}
    trees = {n: t for n, t in trees.items() if n not in commands}
    found = [f"{n}:{line} {text}" for n, t in trees.items() for line, text in _texts(t) if FLAG.search(text)]
    _report("flags in messages", len(found), 0, found)


def test_documents_are_short():
    texts = [path.read_text() for pattern in DOCUMENTS for path in sorted(ROOT.glob(pattern))]
    _report("words of the documents", sum(len(text.split()) for text in texts), MAX_WORDS)


@pytest.mark.parametrize(("name", "most"), [("README.md", 130), ("BENCHMARK.md", 200)])
def test_page_fits_a_few_screens(name, most):
    _report(f"lines of {name}", len((ROOT / name).read_text().splitlines()), most)


def test_one_statement_a_line():
    packages = ("piccolo/", "research/", "tools/")
    trees = {name: tree for name, tree in _trees().items() if name.startswith(packages)}
    num_lines = sum(len((ROOT / name).read_text().splitlines()) for name in trees)
    found = [
        f"{n}:{node.lineno}" for n, tree in trees.items() for node in ast.walk(tree) if _is_parallel(node)
    ]
    _report("parallel assignments per 1,000 lines", 1000 * len(found) / num_lines, MAX_PARALLEL, found)


def test_no_tuple_hides_arguments():
    found = {
        f"{name}:{line}"
        for name, tree in _trees().items()
        for function in _blocks(tree)
        if isinstance(function, ast.FunctionDef)
        for line in _packed(function)
    }
    _report("packed arguments", len(found), 0, sorted(found))
