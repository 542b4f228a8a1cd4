"""The structure of the packages, read from their sources."""

import ast
import functools
import re
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

from piccolo.apps.report import build
from piccolo.scan_map import open_map

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("piccolo", "research")

# A module imports from its own folder or from one further down this list.
LAYERS = [
    "research.measuring",
    "research.experiments",
    "research.evaluation",
    "research.datasets",
    "research.synthetic",
    "research.scene",
    "__main__",
    "doors",
    "apps",
    "cli",
    "batch",
    "api",
    "together",
    "localization",
    "paper",
    "evidence",
    "judge",
    "problem",
    "scan_map",
    "local_features",
    "gravity",
    "optimize",
    "views",
    "panorama",
    "photo",
    "camera",
    "cloud",
    "geometry",
    "kernels",
    "files",
    "jobs",
    "arguments",
    "errors",
    "arrays",
]


def _module(path):
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {_module(path): path for name in PACKAGES for path in sorted((ROOT / name).rglob("*.py"))}


@functools.cache
def _nodes(path):
    """All nodes of a source's syntax."""
    return list(ast.walk(ast.parse(path.read_text())))


def _folder(module):
    """The longest entry of LAYERS that a module belongs to."""
    name = module.removeprefix("piccolo.")
    parts = name.split(".")
    return next(p for p in (".".join(parts[:n]) for n in range(len(parts), 0, -1)) if p in LAYERS)


def _imported(module):
    """The modules that one imports, of these packages and others."""
    path = MODULES[module]
    base = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
    for node in _nodes(path):
        if isinstance(node, ast.ImportFrom):
            above = base[: len(base) - node.level + 1] if node.level else []
            parent = ".".join([*above, *filter(None, [node.module])])
            for alias in node.names:
                name = f"{parent}.{alias.name}"
                yield name if name in MODULES else parent
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def _graph():
    """The modules that each module imports, but for the package's own `__init__`."""
    modules = set(MODULES) - {"piccolo"}
    return {module: set(_imported(module)) & modules for module in modules}


def test_imports_go_down_the_list():
    for module, imported in _graph().items():
        for other in imported:
            above, below = LAYERS.index(_folder(module)), LAYERS.index(_folder(other))
            assert above <= below, f"{module} imports {other}, which is above it"


def test_product_and_research_import_no_scripts_and_the_product_no_research():
    scripts = {path.stem for path in (ROOT / "tools").glob("*.py")} | {"tools", "examples", "tests"}
    for module in MODULES:
        tops = {name.split(".")[0] for name in _imported(module)}
        assert not tops & scripts, module
        assert module.startswith("research.") or "research" not in tops, module


def test_no_modules_import_each_other():
    try:
        TopologicalSorter(_graph()).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(error.args[1]))


def test_kept_results_depend_on_sources_that_exist():
    """A folder that was renamed would no longer make old ones stale."""
    for module in (open_map, build):
        assert [name for name in module.MAKERS if not (ROOT / "piccolo" / name).is_dir()] == []


def test_only_commands_know_argparse():
    for module, path in MODULES.items():
        imports = [n for n in _nodes(path) if isinstance(n, ast.Import)]
        imports = {a.name for n in imports for a in n.names}
        assert "argparse" not in imports or _folder(module) == "cli" or module.startswith("research."), module


def test_one_module_makes_statuses():
    """All others hand it a belief; one of them gives a result its status."""
    calls = [
        (str(path.relative_to(ROOT / "piccolo")), node)
        for path in (ROOT / "piccolo").rglob("*.py")
        for node in _nodes(path)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    ]

    def find_callers(name):
        return {path for path, node in calls if node.func.id == name}

    assert find_callers("classify") == {"judge/belief.py"}
    assert find_callers("decide") == {"judge/result.py"}
    results = [node for path, node in calls if node.func.id == "Result" and path != "api/photo_reader.py"]
    assert len(results) > 2
    assert not any(node.args or "status" in [k.arg for k in node.keywords] for node in results)


def _is_numeric(value):
    """True for numbers, their tuples, and what NumPy and `math` make of them."""
    kinds = ast.Dict, ast.DictComp, ast.Set, ast.Lambda, ast.JoinedStr
    constants = [node.value for node in ast.walk(value) if isinstance(node, ast.Constant)]
    if any(isinstance(node, kinds) for node in ast.walk(value)):
        return False
    return bool(constants) and all(isinstance(constant, int | float) for constant in constants)


def _list_numbers(path):
    """The names of a source's constants that are numbers."""
    for node in ast.parse(path.read_text()).body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value and _is_numeric(node.value):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            named = [n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)]
            yield from filter(str.isupper, named)


def test_a_number_has_a_name_of_its_own():
    """Who reads LEAST_CONFIDENCE in one module must not think of another's; the same thing is imported."""
    users = {}
    for module, path in MODULES.items():
        for name in _list_numbers(path) if module.startswith("piccolo") else ():
            users.setdefault(name, set()).add(module)
    assert len(users) > 500
    assert {name: found for name, found in users.items() if len(found) > 1} == {}


def test_no_test_imports_another():
    """What tests share is in a module beside them."""
    for path in sorted([*(ROOT / "tests").glob("*.py"), *(ROOT / "browser_tests").glob("*.py")]):
        assert not re.findall(r"^\s*(?:from|import) test_\w+", path.read_text(), flags=re.MULTILINE), path
