"""Localize 360-degree photos in coloured 3D scans on the CPU (PICCOLO, Kim et al., ICCV 2021).

The example files are made by `make_room.py --out room --seed 4 --points 100000 --panoramas 2 --width 1024`:

>>> import piccolo
>>> scan = piccolo.open_scan("room/cloud.ply")
>>> result = scan.localize("room/images/clean_0.jpg")
>>> result.status, result.pose.center_world.round(2)
('localized', array([2.6 , 3.17, 1.21]))
"""

import lazy_loader

__version__ = "0.1.0"
# __init__.pyi has the names. Numba, SciPy and OpenCV take most of a second.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
