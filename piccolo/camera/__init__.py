"""Cameras: pixels to rays and back, their files, and pictures resampled to the sphere."""

from .model import Camera
from .rig import Calibration, Mount

__all__ = ["Calibration", "Camera", "Mount"]
