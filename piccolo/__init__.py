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

from .errors import InputError as InputError

if TYPE_CHECKING:
    from .confidence.covariance import PoseCovariance as PoseCovariance
    from .confidence.localization import (
        Alternative as Alternative,
        Evidence as Evidence,
        FocalLength as FocalLength,
    )
    from .geometry.pose import Pose as Pose
    from .localization.settings import CoarseToFineSettings as CoarseToFineSettings
    from .opening import Cloud as Cloud, open_scan as open_scan
    from .paper.localize import PaperSettings as PaperSettings
    from .photo import GpsPrior as GpsPrior, Photo as Photo, Prior as Prior
    from .report.build import ReportSettings as ReportSettings, write_report as write_report
    from .result import Result as Result, Source as Source
    from .scan import Scan as Scan
    from .scan_walk import Walk as Walk
    from .walk.frames import Motion as Motion
    from .walk.path import Gap as Gap
    from .walk.results import Alone as Alone, WalkFrame as WalkFrame

NAMES = {  # by module
    ".confidence.covariance": ("PoseCovariance",),
    ".confidence.localization": ("Alternative", "Evidence", "FocalLength"),
    ".geometry.pose": ("Pose",),
    ".localization.settings": ("CoarseToFineSettings",),
    ".opening": ("Cloud", "open_scan"),
    ".paper.localize": ("PaperSettings",),
    ".photo": ("GpsPrior", "Photo", "Prior"),
    ".report.build": ("ReportSettings", "write_report"),
    ".result": ("Result", "Source"),
    ".scan": ("Scan",),
    ".scan_walk": ("Walk",),
    ".walk.frames": ("Motion",),
    ".walk.path": ("Gap",),
    ".walk.results": ("Alone", "WalkFrame"),
}
MODULES = {name: module for module, names in NAMES.items() for name in names}
__all__ = ["InputError", "__version__", *MODULES]  # noqa: PLE0604  names all


def __getattr__(name: str) -> object:
    """Import a public name at its first use (PEP 562): Numba, SciPy and OpenCV take most of a second."""
    if name not in MODULES:
        raise AttributeError(f"module 'piccolo' has no attribute {name!r}")
    return getattr(import_module(MODULES[name], __name__), name)
