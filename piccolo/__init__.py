"""Where in a coloured 3D scan a 360-degree photo was taken (PICCOLO, Kim et al., ICCV 2021), on the CPU.

>>> import piccolo
>>> scan = piccolo.open_scan("scan.e57")  # doctest: +SKIP
>>> result = scan.localize("query.jpg")  # doctest: +SKIP
>>> result.status, result.pose.center_world  # doctest: +SKIP
('localized', array([2.412, 1.068, 1.577]))
"""

__version__ = "0.1.0"  # above the imports: a result repeats it

from .errors import InputError
from .geometry.pose import Pose
from .result import Result
from .scan import Scan, open_scan

__all__ = ["InputError", "Pose", "Result", "Scan", "__version__", "open_scan"]
