"""What a camera shows of pictures of the whole sphere: overlays and renderings in a photo's own field."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ..camera import Camera
from ..geometry.pose import Array
from ..geometry.sphere import pixels_of
from .zbuffer import View

MAX_SPHERE_WIDTH = 8192  # [px]
UPRIGHT = np.eye(3)


def sphere_width_for(camera: Camera) -> int:
    """Width [px], even, of the sphere that is as fine as the camera's picture at its axis, bounded."""
    return min(2 * math.ceil(math.pi * camera.resolution), MAX_SPHERE_WIDTH)


def cut(image: NDArray[np.uint8], camera: Camera, R_lens_from_cam: Array = UPRIGHT) -> NDArray[np.uint8]:
    """A camera's picture (height, width, 3) of that of the sphere (H, W, 3); black where it shows nothing."""
    u, v, is_in = _places(camera, image.shape[1], R_lens_from_cam)
    around = np.concatenate([image[:, -1:], image, image[:, :1]], axis=1)
    found = cv2.remap(around, u + np.float32(0.5), v - np.float32(0.5), cv2.INTER_LINEAR)
    found[~is_in] = 0
    return np.asarray(found, np.uint8)


def cut_view(view: View, camera: Camera) -> View:
    """The same of colours with ranges; these of the nearest pixel, infinite where nothing is shown."""
    width = view.depth.shape[1]
    u, v, is_in = _places(camera, width, UPRIGHT)
    rows = np.clip(v.astype(np.int64), 0, width // 2 - 1)
    depth = np.where(is_in, view.depth[rows, u.astype(np.int64) % width], np.float32(np.inf))
    return View(depth, cut(view.rgb, camera))


def _places(
    camera: Camera, width: int, R_lens_from_cam: Array
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Columns and rows of the sphere that pixels show (height, width), and which show any."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays, is_in = camera.rays(np.stack([u, v], axis=-1))
    columns, rows = pixels_of(rays @ R_lens_from_cam, width)
    return columns.astype(np.float32), rows.astype(np.float32), is_in
