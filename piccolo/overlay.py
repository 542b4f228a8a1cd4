"""The picture by which a person checks a pose: panorama, cloud from the pose, checkerboard of both."""

import cv2
import numpy as np
from numpy.typing import NDArray

from .cloud.packed import PackedPoints
from .panorama import Panorama
from .pose import Pose
from .pyramid import shrink
from .render import render_view, visible_points

OVERLAY_WIDTH = 1024
COARSEST_WIDTH = 16
BAND = 0.03  # of several surfaces in one pixel the nearest is drawn
NUM_TILES = 16  # columns of the checkerboard


def render_closed(points: PackedPoints, pose: Pose, width: int) -> NDArray[np.uint8]:
    """The cloud at `pose` as an image (width / 2, width, 3); holes take the colour of a coarser view."""
    # What shows through the gaps of a sparse wall is left out by the coarser cells of the visibility test.
    points = visible_points(points, pose.center_world)
    view = render_view(points, pose, width, BAND)
    rgb, is_seen = view.rgb, view.is_seen
    coarse_width = width // 2
    while coarse_width >= COARSEST_WIDTH and not is_seen.all():
        coarse = render_view(points, pose, coarse_width, BAND)
        factor = width // coarse_width
        fill = coarse.rgb.repeat(factor, axis=0).repeat(factor, axis=1)
        has_fill = coarse.is_seen.repeat(factor, axis=0).repeat(factor, axis=1) & ~is_seen
        rgb = np.where(has_fill[..., None], fill, rgb)
        is_seen = is_seen | has_fill
        coarse_width //= 2
    return np.round(rgb * 255.0).astype(np.uint8)


def overlay_png(points: PackedPoints, panorama: Panorama, pose: Pose) -> bytes:
    """PNG file of three images, one above the other: panorama, cloud from the pose, checkerboard of both."""
    photo = cv2.resize(
        shrink(panorama, OVERLAY_WIDTH).rgb,
        (OVERLAY_WIDTH, OVERLAY_WIDTH // 2),
        interpolation=cv2.INTER_LINEAR,
    )
    cloud = render_closed(points, pose, OVERLAY_WIDTH)
    tile = OVERLAY_WIDTH // NUM_TILES
    row, column = np.indices(photo.shape[:2]) // tile
    checkerboard = np.where(((row + column) % 2 == 0)[..., None], photo, cloud)
    stacked = np.concatenate([photo, cloud, checkerboard])
    is_encoded, encoded = cv2.imencode(".png", cv2.cvtColor(stacked, cv2.COLOR_RGB2BGR))
    if not is_encoded:
        raise OSError("the overlay could not be encoded as PNG")
    return bytes(encoded)
