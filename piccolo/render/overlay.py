"""Overlays by which a person checks a pose: panorama, cloud at the pose, checkerboard of both."""

import cv2
import numpy as np
from numpy.typing import NDArray

from ..cloud.soa import PackedPoints
from ..geometry.pose import Pose
from ..panorama import Panorama
from ..panorama.resize import shrink
from ..runtime.threads import Workers
from .surfel_renderer import encode_image, fill_holes, render_points

OVERLAY_WIDTH = 1024
NUM_TILES = 16  # columns of the checkerboard


def resized_rgb(panorama: Panorama, width: int) -> NDArray[np.uint8]:
    """The panorama's colours, resized to (width / 2, width, 3)."""
    rgb = shrink(panorama, width).rgb
    return np.asarray(cv2.resize(rgb, (width, width // 2), interpolation=cv2.INTER_LINEAR), np.uint8)


def checkerboard(photo: NDArray[np.uint8], cloud: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Two images (H, W, 3) and a checkerboard of both, one above the other (3 H, W, 3)."""
    row, column = np.indices(photo.shape[:2]) // (photo.shape[1] // NUM_TILES)
    mixed = np.where(((row + column) % 2 == 0)[..., None], photo, cloud)
    return np.concatenate([photo, cloud, mixed])


def overlay_png(points: PackedPoints, panorama: Panorama, pose: Pose, workers: Workers) -> bytes:
    """PNG file of three images, one above the other: panorama, cloud from the pose, checkerboard of both."""
    cloud = fill_holes(render_points(points, pose, OVERLAY_WIDTH, workers))
    return encode_image(checkerboard(resized_rgb(panorama, OVERLAY_WIDTH), cloud), ".png")
