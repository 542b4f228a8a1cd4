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

# The highest first. A room is a folder of `piccolo` or of its `apps`, or a module beside such folders. It
# imports from rooms of lower storeys; from one of its own storey only if BESIDE says why.
STOREYS = {
    "doors": ["__main__", "doors"],
    "apps": ["apps"],
    "what programs and commands call": ["cli", "batch", "api"],
    "photos that help each other": ["together"],
    "method": ["localization", "evidence", "judge", "problem"],
    "scan and photos": ["scan_map", "local_features", "optimize", "views", "poses", "photo", "cloud"],
    "ground": ["geometry", "system"],
}
BESIDE = """
apps.service -> apps.report: the page that it serves is a report
apps.models -> apps.export: models are read and written as exports are
cli -> batch: its command localizes batches
cli -> api: commands call what programs call
batch -> api: its jobs call what programs call
localization -> evidence: what is found is examined
localization -> judge: the search stops when a candidate is sure
localization -> problem: it solves one
evidence -> judge: it is gathered in a candidate, which the judge defines
evidence -> problem: it compares the photo and the map of a problem
judge -> problem: results repeat what was asked
scan_map -> views: a map holds views of its scan
scan_map -> local_features: and keypoints in them
scan_map -> cloud: it is made of points
optimize -> photo: its losses compare a photo with points
poses -> photo: models of structure from motion hold cameras and poses
poses -> cloud: and E57 files points and poses
views -> photo: they are normalised as photos are
views -> cloud: they are drawn of points
geometry -> system: types of arrays, flags of kernels
"""
RESEARCH = ["measuring", "experiments", "evaluation", "datasets", "synthetic", "scene"]  # the highest first
MOST_OF_CLI = 12  # rooms that it imports
# Besides those of `piccolo`, each a room; the scripts import `piccolo.cli.start` alone, the page no Python.
OTHER_ROOMS = {"localize.py": {"cli"}, "tools": {"cli"}, "page": set()}


def _module(path):
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {_module(path): path for name in PACKAGES for path in sorted((ROOT / name).rglob("*.py"))}


@functools.cache
def _nodes(path):
    """All nodes of a source's syntax."""
    return list(ast.walk(ast.parse(path.read_text())))


def _room(module):
    """The room of a module of `piccolo`."""
    parts = module.split(".")[1:]
    return ".".join(parts[: 2 if parts[0] == "apps" else 1])


def _storey(room):
    """The number of a room's storey, from 0 for the highest."""
    return next(k for k, rooms in enumerate(STOREYS.values()) if room.split(".")[0] in rooms)


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


def _arrows():
    """From which rooms to which others modules of `piccolo` import, with the names of these modules."""
    arrows = {}
    for module, imported in _graph().items():
        for other in imported if module.startswith("piccolo.") else ():
            arrows.setdefault((_room(module), _room(other)), set()).add(f"{module} imports {other}")
    return {ends: imports for ends, imports in arrows.items() if ends[0] != ends[1]}


def test_rooms_import_from_lower_storeys():
    reasons = dict(line.split(": ") for line in BESIDE.strip().splitlines())
    arrows = _arrows()
    for (room, other), imports in arrows.items():
        assert _storey(room) <= _storey(other), imports
        assert _storey(room) < _storey(other) or f"{room} -> {other}" in reasons, imports
    assert [line for line in reasons if tuple(line.split(" -> ")) not in arrows] == []


def test_rooms_know_at_most_a_third_of_the_others():
    """Of all pairs of rooms in the checkout, of which one can import the other."""
    arrows = set(_arrows()) | {(room, other) for room, others in OTHER_ROOMS.items() for other in others}
    graph = {module: other for module, other in _graph().items() if module.startswith("research.")}
    imported = {name for others in graph.values() for name in others if name.startswith("piccolo.")}
    arrows |= {("research", _room(name)) for name in imported}
    inside = {_room(module) for module in MODULES if module.startswith("piccolo.")} - {"apps"}
    num = len({*inside, *OTHER_ROOMS, "research"})
    assert len(arrows) <= num * (num - 1) / 2 / 3


def test_research_imports_downwards():
    for module, imported in _graph().items():
        for other in imported:
            if module.startswith("research.") and other.startswith("research."):
                above, below = (RESEARCH.index(name.split(".")[1]) for name in (module, other))
                assert above <= below, f"{module} imports {other}"


def test_the_command_line_leans_on_few_rooms():
    assert len({other for room, other in _arrows() if room == "cli"}) <= MOST_OF_CLI


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


def test_every_folder_is_a_package():
    """Tools know a package by its `__init__.py`."""
    folders = {path.parent for path in MODULES.values()}
    assert [folder for folder in folders if not (folder / "__init__.py").is_file()] == []


def test_only_commands_know_argparse():
    for module, path in MODULES.items():
        imports = [n for n in _nodes(path) if isinstance(n, ast.Import)]
        imports = {a.name for n in imports for a in n.names}
        assert "argparse" not in imports or module.startswith(("piccolo.cli.", "research.")), module


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


def test_a_file_a_function_or_a_class_has_a_name_of_its_own():
    """But for the parts of a command."""
    users = {}
    for module, path in MODULES.items():
        if module.startswith("piccolo."):
            kinds = ast.FunctionDef, ast.ClassDef
            names = {node.name for node in ast.parse(path.read_text()).body if isinstance(node, kinds)}
            names = {name for name in names if not name.startswith("_")} - {"main", "add_arguments"}
            for name in names | ({path.name} - {"__init__.py"}):
                users.setdefault(name, []).append(module)
    assert len(users) > 1500
    assert {name: found for name, found in users.items() if len(found) > 1} == {}


def test_no_test_imports_another():
    """What tests share is in a module beside them."""
    for path in sorted([*(ROOT / "tests").glob("*.py"), *(ROOT / "browser_tests").glob("*.py")]):
        assert not re.findall(r"^\s*(?:from|import) test_\w+", path.read_text(), flags=re.MULTILINE), path
