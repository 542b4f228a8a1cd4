"""Panoramas at other sizes."""

import cv2
import numpy as np

from .panorama import Panorama


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
    weight = cv2.resize(panorama.is_valid.astype(np.float32), size, interpolation=cv2.INTER_AREA)
    if weight.min() == 1.0:
        rgb = cv2.resize(panorama.rgb, size, interpolation=cv2.INTER_AREA)
    else:
        masked = panorama.rgb * panorama.is_valid[..., None].astype(np.float32)
        total = cv2.resize(masked, size, interpolation=cv2.INTER_AREA)
        rgb = np.round(total / np.maximum(weight, 1e-6)[..., None]).clip(0, 255)
    return Panorama(rgb.astype(np.uint8), weight >= 0.5)
