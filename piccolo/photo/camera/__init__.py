"""Cameras: pixels to rays and back; calibration files; pictures resampled to the sphere."""

from .calibration import Calibration, Mount
from .model import Camera

__all__ = ["Calibration", "Camera", "Mount"]
