"""The structure of the packages, read from their sources."""

import ast
import re
from graphlib import CycleError, TopologicalSorter

import pytest
from house import (
    BESIDE,
    MODULES,
    PAGE,
    ROOT,
    list_arrows,
    list_imported,
    list_imports,
    list_nodes,
    replace_drawing,
    room_of,
    storey_of,
)

from piccolo.apps.report import build
from piccolo.scan_map import open_map

RESEARCH = ["measuring", "experiments", "evaluation", "datasets", "synthetic", "scene"]  # the highest first
MOST_OF_CLI = 12  # rooms that it imports
# Besides those of `piccolo`, each a room; the scripts import `piccolo.cli.start` alone, the page no Python.
OTHER_ROOMS = {"localize.py": {"cli"}, "tools": {"cli"}, "page": set()}


def test_rooms_import_from_lower_storeys():
    reasons = dict(line.split(": ") for line in BESIDE.strip().splitlines())
    arrows = list_arrows()
    for (room, other), imports in arrows.items():
        assert storey_of(room) <= storey_of(other), imports
        assert storey_of(room) < storey_of(other) or f"{room} -> {other}" in reasons, imports
    assert [line for line in reasons if tuple(line.split(" -> ")) not in arrows] == []


def test_the_drawing_in_the_documents_is_of_this_tree():
    page = PAGE.read_text()
    assert page == replace_drawing(page), "run python tests/house.py"


def test_rooms_know_at_most_a_third_of_the_others():
    """Of all pairs of rooms in the checkout, of which one can import the other."""
    arrows = set(list_arrows()) | {(room, other) for room, others in OTHER_ROOMS.items() for other in others}
    graph = {module: other for module, other in list_imports().items() if module.startswith("research.")}
    imported = {name for others in graph.values() for name in others if name.startswith("piccolo.")}
    arrows |= {("research", room_of(name)) for name in imported}
    inside = {room_of(module) for module in MODULES if module.startswith("piccolo.")} - {"apps"}
    num = len({*inside, *OTHER_ROOMS, "research"})
    assert len(arrows) <= num * (num - 1) / 2 / 3


def test_research_imports_downwards():
    for module, imported in list_imports().items():
        for other in imported:
            if module.startswith("research.") and other.startswith("research."):
                above, below = (RESEARCH.index(name.split(".")[1]) for name in (module, other))
                assert above <= below, f"{module} imports {other}"


def test_the_command_line_leans_on_few_rooms():
    assert len({other for room, other in list_arrows() if room == "cli"}) <= MOST_OF_CLI


def test_product_and_research_import_no_scripts_and_the_product_no_research():
    scripts = {path.stem for path in (ROOT / "tools").glob("*.py")} | {"tools", "examples", "tests"}
    for module in MODULES:
        tops = {name.split(".")[0] for name in list_imported(module)}
        assert not tops & scripts, module
        assert module.startswith("research.") or "research" not in tops, module


def test_no_modules_import_each_other():
    try:
        TopologicalSorter(list_imports()).prepare()
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
        imports = [n for n in list_nodes(path) if isinstance(n, ast.Import)]
        imports = {a.name for n in imports for a in n.names}
        assert "argparse" not in imports or module.startswith(("piccolo.cli.", "research.")), module


def test_one_module_makes_statuses():
    """All others hand it a belief; one of them gives a result its status."""
    calls = [
        (str(path.relative_to(ROOT / "piccolo")), node)
        for path in (ROOT / "piccolo").rglob("*.py")
        for node in list_nodes(path)
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
