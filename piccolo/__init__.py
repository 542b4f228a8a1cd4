"""Where in a coloured 3D scan a 360-degree photo was taken (PICCOLO, Kim et al., ICCV 2021), on the CPU.

In the folder in which `make_room.py --out room --seed 4 --points 100000 --panoramas 2 --width 1024` was run:

>>> import piccolo
>>> scan = piccolo.open_scan("room/cloud.ply")
>>> result = scan.localize("room/images/clean_0.jpg")
>>> result.status, result.pose.center_world.round(2)
('localized', array([2.6 , 3.17, 1.21]))
"""

__version__ = "0.1.0"  # above the imports: a result repeats it

from .errors import InputError
from .geometry.pose import Pose
from .result import Result
from .scan import Scan, open_scan

__all__ = ["InputError", "Pose", "Result", "Scan", "__version__", "open_scan"]
