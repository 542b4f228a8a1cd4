"""Localize 360-degree photos in coloured 3D scans on the CPU (PICCOLO, Kim et al., ICCV 2021).

The example files are made by `make_room.py --out room --seed 4 --points 100000 --panoramas 2 --width 1024`:

>>> import piccolo
>>> scan = piccolo.open_scan("room/cloud.ply")
>>> result = scan.localize("room/images/clean_0.jpg")
>>> result.status, result.pose.center_world.round(2)
('localized', array([2.6 , 3.17, 1.21]))
"""

import ast
from importlib import import_module
from pathlib import Path

__version__ = "0.1.0"
# Public names are imported at their first use, as Numba, SciPy and OpenCV take most of a second.
# __init__.pyi, which type checkers read, says where each is.
_stub = ast.parse(Path(__file__).with_suffix(".pyi").read_text())
_modules = {
    name.name: f".{node.module}"
    for node in _stub.body
    if isinstance(node, ast.ImportFrom)
    for name in node.names
}
__all__ = list(_modules)


def __getattr__(name: str) -> object:
    """Import a public name, and keep it."""
    if name not in _modules:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = getattr(import_module(_modules[name], __name__), name)
    return globals()[name]


def __dir__() -> list[str]:
    """Return the public names."""
    return __all__
