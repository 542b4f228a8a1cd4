"""The structure of the package, read from its sources."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "piccolo"
SCRIPTS = [ROOT / "localize.py", ROOT / "command_line.py"]

# A module may import from the lines above its own, and from its own line only if the line says so.
LAYERS = [
    {"errors"},
    {"jit", "threads", "files", "stopwatch", "labels"},
    {"pose", "settings"},
    {"sphere", "rotations"},
    {"panorama", "cloud", "sampling", "pyramid"},
    {"loss", "render", "gravity", "surfels", "splatting"},
    {"picture"},
    {"overlay", "verify", "refine", "synthetic", "truth", "hypotheses", "certainty", "pose_file"},
    {"verdict", "animation", "loss_surface"},
    {"result", "scenes"},
    {"paper", "engine", "export"},
    {"datasets"},
    {"pipeline", "alignment"},
    {"evaluation"},
    {"experiments"},
    {"surface_files"},
]
# pyramid shrinks panoramas; points are packed as texels are
SIDEWAYS = {("pyramid", "panorama"), ("cloud", "sampling")}
LEVEL = {name: level for level, names in enumerate(LAYERS) for name in names}


def _modules():
    return sorted(PACKAGE.rglob("*.py"))


def _module_name(path):
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def _imported(path):
    """Names of the package's modules that a file imports."""
    depth = len(path.relative_to(PACKAGE).parts)
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level == depth:
            yield from [node.module.split(".")[0]] if node.module else [alias.name for alias in node.names]


@pytest.mark.parametrize("path", _modules(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_imports_go_up_the_list(path):
    name = _module_name(path)
    if name == "__init__":
        return
    assert name in LEVEL, f"{name} has no place in the list of layers"
    for other in _imported(path):
        if other in ("__version__", name):
            continue
        allowed = LEVEL[other] < LEVEL[name] or (name, other) in SIDEWAYS
        assert allowed, f"{path.name} imports {other}, which is not above it"


@pytest.mark.parametrize("path", [*SCRIPTS, *_modules()], ids=lambda p: str(p.relative_to(ROOT)))
def test_every_function_but_a_kernel_is_annotated(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef):
            decorators = {d.id for d in node.decorator_list if isinstance(d, ast.Name)}
            if not decorators & {"kernel", "scalar"}:
                assert node.returns is not None, f"{path.name}: {node.name} has no annotations"


@pytest.mark.parametrize("path", _modules(), ids=lambda p: str(p.relative_to(PACKAGE)))
def test_print_and_argparse_stay_in_the_command_lines(path):
    tree = ast.parse(path.read_text())
    names = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name)}
    imports = {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    assert "print" not in names
    assert "argparse" not in imports


def test_a_test_reaches_every_kernel():
    """Each is named in the tests, or is used, by any number of steps, by a function that is."""
    tests = "".join(path.read_text() for path in (ROOT / "tests").glob("*.py"))
    trees = [ast.parse(path.read_text()) for path in _modules()]
    functions = [n for tree in trees for n in ast.walk(tree) if isinstance(n, ast.FunctionDef)]
    uses: dict[str, set[str]] = {}
    for f in functions:
        uses.setdefault(f.name, set()).update(n.id for n in ast.walk(f) if isinstance(n, ast.Name))
    kernels = [f.name for f in functions if {"kernel"} & {getattr(d, "id", "") for d in f.decorator_list}]
    assert len(kernels) > 20
    for kernel in kernels:
        assert any(re.search(rf"\b{name}\b", tests) for name in _users(kernel, uses)), kernel


def _users(name, uses):
    """A function and those that use it, by any number of steps."""
    users, more = set(), {name}
    while more - users:
        users |= more
        more = {f for f, used in uses.items() if used & users}
    return users
