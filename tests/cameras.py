"""Made-up cameras, for the tests of photos and rigs."""

import functools

import numpy as np

from piccolo.geometry.pose import exp_so3
from piccolo.photo.camera import Calibration, Mount
from piccolo.photo.camera.model import pinhole
from piccolo.photo.photo import Photo


def calibrated(picture, mounts):
    return Photo(picture).with_calibration(Calibration("made", tuple(mounts)))


@functools.lru_cache
def four_sides():
    """Four cameras of 90 degrees, to all sides, upright."""
    turns = [exp_so3(np.radians([0.0, 0.0, 90.0 * k])) for k in range(4)]
    rotations = [tuple(map(tuple, R.tolist())) for R in turns]
    return tuple(Mount(pinhole(320, 320, 160.0), R, image=f"{k}.png") for k, R in enumerate(rotations))
