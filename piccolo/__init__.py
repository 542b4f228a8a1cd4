"""Where in a coloured 3D scan a 360-degree photo was taken (PICCOLO, Kim et al., ICCV 2021), on the CPU.

In the folder in which `make_room.py --out room --seed 4 --points 100000 --panoramas 2 --width 1024` was run:

>>> import piccolo
>>> scan = piccolo.open_scan("room/cloud.ply")
>>> result = scan.localize("room/images/clean_0.jpg")
>>> result.status, result.pose.center_world.round(2)
('localized', array([2.6 , 3.17, 1.21]))
"""

__version__ = "0.1.0"  # above the imports: a result repeats it

from importlib import import_module
from typing import TYPE_CHECKING

from .errors import InputError

if TYPE_CHECKING:
    from .geometry.pose import Pose
    from .opening import open_scan
    from .report.build import write_report
    from .result import Result
    from .scan import Scan

__all__ = ["InputError", "Pose", "Result", "Scan", "__version__", "open_scan", "write_report"]
MODULES = {
    "Pose": ".geometry.pose",
    "Result": ".result",
    "Scan": ".scan",
    "open_scan": ".opening",
    "write_report": ".report.build",
}


def __getattr__(name: str) -> object:
    """Import what is asked for when it is (PEP 562): Numba, SciPy and OpenCV take most of a second."""
    if name not in MODULES:
        raise AttributeError(f"module 'piccolo' has no attribute {name!r}")
    return getattr(import_module(MODULES[name], __name__), name)
