"""The structure of the package, read from its sources."""

import ast
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "piccolo"

# A module imports from its own folder or from one further down this list.
LAYERS = [
    "cli",
    "report",
    "scenes.reproduce_paper",
    "scenes.evaluation",
    "scenes.datasets",
    "scenes.synthetic",
    "scenes.export",
    "scenes",
    "batch",
    "opening",
    "scan",
    "coloring",
    "scan_walk",
    "opened_scan",
    "result",
    "walk",
    "localization",
    "scan_map",
    "local_features",
    "paper",
    "gravity",
    "optimize",
    "confidence",
    "views",
    "panorama",
    "camera",
    "cloud",
    "geometry",
    "kernels",
    "files",
    "jobs",
    "optional",
    "arguments",
    "errors",
]


def _module(path):
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {_module(path): path for path in sorted(PACKAGE.rglob("*.py"))}


def _folder(module):
    """The longest entry of LAYERS that a module belongs to."""
    name = module.removeprefix("piccolo.")
    parts = name.split(".")
    return next(p for p in (".".join(parts[:n]) for n in range(len(parts), 0, -1)) if p in LAYERS)


def _imported(module):
    """The package's modules that one imports."""
    path = MODULES[module]
    base = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level:
            parent = ".".join([*base[: len(base) - node.level + 1], *filter(None, [node.module])])
            for alias in node.names:
                name = f"{parent}.{alias.name}"
                yield name if name in MODULES else parent


def _graph():
    return {module: set(_imported(module)) - {"piccolo"} for module in MODULES if module != "piccolo"}


def test_imports_go_down_the_list():
    for module, imported in _graph().items():
        for other in imported:
            above, below = LAYERS.index(_folder(module)), LAYERS.index(_folder(other))
            assert above <= below, f"{module} imports {other}, which is above it"


def test_no_modules_import_each_other():
    try:
        TopologicalSorter(_graph()).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_only_commands_know_argparse():
    for module, path in MODULES.items():
        imports = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Import)]
        imports = {a.name for n in imports for a in n.names}
        assert "argparse" not in imports or _folder(module) == "cli", module


def test_one_module_makes_statuses():
    """All others hand it probabilities."""
    callers = {
        str(path.relative_to(ROOT / "piccolo"))
        for path in (ROOT / "piccolo").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "classify"
    }
    assert callers == {"localization/judge.py"}
