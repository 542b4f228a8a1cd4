"""Panoramas at other sizes."""

import cv2
import numpy as np

from . import Panorama


def shrink(panorama: Panorama, width: int) -> Panorama:
    """The panorama area-averaged to `width` x width / 2, or itself if it is no larger."""
    return panorama if panorama.rgb.shape[1] <= width else resize(panorama, width)


def resize(panorama: Panorama, width: int) -> Panorama:
    """The panorama at `width` x width / 2: area-averaged where that is smaller, interpolated where larger.

    Pixels that do not count stay out of the averages; a pixel counts if half of its area does.
    """
    if panorama.rgb.shape[1] == width:
        return panorama
    size = (width, width // 2)
    if panorama.is_valid.all():
        rgb = np.asarray(cv2.resize(panorama.rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
        return Panorama(rgb, np.ones(rgb.shape[:2], np.bool_))
    # in bytes, as floating-point copies of a large picture would take gigabytes
    counts = panorama.is_valid.view(np.uint8) * np.uint8(255)
    weight = cv2.resize(counts, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
    masked = cv2.bitwise_and(panorama.rgb, panorama.rgb, mask=counts)
    total = cv2.resize(masked, size, interpolation=cv2.INTER_AREA)
    rgb = np.round(total / np.maximum(weight, 1e-6)[..., None]).clip(0, 255).astype(np.uint8)
    return Panorama(rgb, weight >= 0.5)
