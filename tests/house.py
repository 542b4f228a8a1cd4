"""The house: its storeys and rooms, and what each imports, read from the sources.

`python tests/house.py` draws it in docs/ARCHITECTURE.md.
"""

import ast
import functools
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "ARCHITECTURE.md"
PACKAGES = ("piccolo", "research")
FENCE = "```"  # around the drawing, the first block of the page

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


def name_module(path):
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULES = {name_module(path): path for name in PACKAGES for path in sorted((ROOT / name).rglob("*.py"))}


@functools.cache
def list_nodes(path):
    """All nodes of a source's syntax."""
    return list(ast.walk(ast.parse(path.read_text())))


def room_of(module):
    """The room of a module of `piccolo`."""
    parts = module.split(".")[1:]
    return ".".join(parts[: 2 if parts[0] == "apps" else 1])


def storey_of(room):
    """The number of a room's storey, from 0 for the highest."""
    return next(k for k, rooms in enumerate(STOREYS.values()) if room.split(".")[0] in rooms)


def list_imported(module):
    """The modules that one imports, of these packages and others."""
    path = MODULES[module]
    base = module.split(".") if path.name == "__init__.py" else module.split(".")[:-1]
    for node in list_nodes(path):
        if isinstance(node, ast.ImportFrom):
            above = base[: len(base) - node.level + 1] if node.level else []
            parent = ".".join([*above, *filter(None, [node.module])])
            for alias in node.names:
                name = f"{parent}.{alias.name}"
                yield name if name in MODULES else parent
        elif isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)


def list_imports():
    """The modules that each module imports, but for the package's own `__init__`."""
    modules = set(MODULES) - {"piccolo"}
    return {module: set(list_imported(module)) & modules for module in modules}


def list_arrows():
    """From which rooms to which others modules of `piccolo` import, with the names of these modules."""
    arrows = {}
    for module, imported in list_imports().items():
        for other in imported if module.startswith("piccolo.") else ():
            arrows.setdefault((room_of(module), room_of(other)), set()).add(f"{module} imports {other}")
    return {ends: imports for ends, imports in arrows.items() if ends[0] != ends[1]}


def draw():
    """Return the storeys with their rooms, the highest first, and the arrows within each storey."""
    rooms = {room_of(module) for module in MODULES if module.startswith("piccolo.")} - {"apps"}
    arrows = [ends for ends in list_arrows() if storey_of(ends[0]) == storey_of(ends[1])]
    lines = []
    for name, inside in STOREYS.items():
        here = sorted(room for room in rooms if storey_of(room) == list(STOREYS).index(name))
        here.sort(key=lambda room: inside.index(room) if room in inside else 0)
        lines.append(name)
        for room in here:
            others = [other for other in here if (room, other) in arrows]
            lines.append("    " + room.removeprefix("apps.") + _describe(others))
    return "\n".join(lines)


def _describe(others):
    """Return the arrow from a room to others of its storey."""
    return f" -> {', '.join(other.removeprefix('apps.') for other in others)}" if others else ""


def replace_drawing(page):
    """Return a page with the drawing in its first block."""
    before, _, rest = page.partition(f"{FENCE}\n")
    return f"{before}{FENCE}\n{draw()}\n{FENCE}{rest.partition(FENCE)[2]}"


if __name__ == "__main__":
    PAGE.write_text(replace_drawing(PAGE.read_text()))
