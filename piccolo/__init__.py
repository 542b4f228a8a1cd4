"""Localize 360-degree photos in coloured 3D scans on the CPU (PICCOLO, Kim et al., ICCV 2021).

The example files are made by `make_room.py --out room --seed 4 --points 100000 --panoramas 2 --width 1024`:

>>> import piccolo
>>> scan = piccolo.open_scan("room/cloud.ply")
>>> result = scan.localize("room/images/clean_0.jpg")
>>> result.status, result.pose.center_world.round(2)
('localized', array([2.6 , 3.17, 1.21]))
"""

__version__ = "0.1.0"  # above the imports: piccolo.result imports it

from importlib import import_module
from typing import TYPE_CHECKING

from .errors import InputError

if TYPE_CHECKING:
    from .confidence.covariance import PoseCovariance
    from .confidence.localization import Alternative, Evidence, FocalLength
    from .geometry.pose import Pose
    from .localization.settings import CoarseToFineSettings
    from .opening import open_scan
    from .paper.settings import PaperSettings
    from .report.build import write_report
    from .result import Result, Source
    from .scan import Scan
    from .scan_map.prior import GpsPrior
    from .scan_walk import Walk
    from .walk.path import Gap
    from .walk.results import Alone, WalkFrame

MODULES = {
    "Alone": ".walk.results",
    "Alternative": ".confidence.localization",
    "CoarseToFineSettings": ".localization.settings",
    "Evidence": ".confidence.localization",
    "FocalLength": ".confidence.localization",
    "Gap": ".walk.path",
    "GpsPrior": ".scan_map.prior",
    "PaperSettings": ".paper.settings",
    "Pose": ".geometry.pose",
    "PoseCovariance": ".confidence.covariance",
    "Result": ".result",
    "Scan": ".scan",
    "Source": ".result",
    "Walk": ".scan_walk",
    "WalkFrame": ".walk.results",
    "open_scan": ".opening",
    "write_report": ".report.build",
}
__all__ = [
    "Alone",
    "Alternative",
    "CoarseToFineSettings",
    "Evidence",
    "FocalLength",
    "Gap",
    "GpsPrior",
    "InputError",
    "PaperSettings",
    "Pose",
    "PoseCovariance",
    "Result",
    "Scan",
    "Source",
    "Walk",
    "WalkFrame",
    "__version__",
    "open_scan",
    "write_report",
]


def __getattr__(name: str) -> object:
    """Import a public name at its first use (PEP 562): Numba, SciPy and OpenCV take most of a second."""
    if name not in MODULES:
        raise AttributeError(f"module 'piccolo' has no attribute {name!r}")
    return getattr(import_module(MODULES[name], __name__), name)
