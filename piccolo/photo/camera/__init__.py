"""Cameras: pixels to rays and back, their files, and pictures resampled to the sphere."""

from .calibration import Calibration, Mount
from .model import Camera

__all__ = ["Calibration", "Camera", "Mount"]
