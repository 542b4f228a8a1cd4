"""Pictures for people: holes filled, overlays, a camera's part of the sphere, files."""

import math

import cv2
import numpy as np

from ..geometry.points import PackedPoints
from ..geometry.pose import Pose
from ..geometry.sphere import compute_pixels
from ..photo.camera import Camera
from ..photo.panorama import Panorama
from ..photo.panorama.panorama import resize
from ..photo.panorama.picture import encode_image
from ..system.arrays import Array, Array32, Bytes, Mask
from ..system.jobs.threads import Workers
from .surfels import render_points
from .zbuffer import View

OVERLAY_WIDTH = 1024
NUM_TILES = 16  # columns of the checkerboard
MAX_DRAWN_WIDTH = 8192  # [px]
UPRIGHT = np.eye(3)


def fill_holes(rgb: Bytes, is_seen: Mask) -> Bytes:
    """Fill the pixels of a picture (H, W, 3) where `is_seen` (H, W) is False from the colours around them.

    They come from the picture filled at half the size: the larger the hole, the smoother. All is computed in
    bytes, as floating-point copies of a large picture would take gigabytes. Black if nothing is seen.
    """
    height, width = is_seen.shape
    if is_seen.all() or width == 1:
        return rgb
    counts = is_seen.view(np.uint8) * np.uint8(255)
    masked = cv2.bitwise_and(rgb, rgb, mask=counts)
    if height % 2 or width % 2:  # a row more counts nothing, a column more is the first again
        counts = np.pad(np.pad(counts, ((0, height % 2), (0, 0))), ((0, 0), (0, width % 2)), mode="wrap")
        masked = np.pad(masked, ((0, height % 2), (0, 0), (0, 0)))
        masked = np.pad(masked, ((0, 0), (0, width % 2), (0, 0)), mode="wrap")
    size = (counts.shape[1] // 2, counts.shape[0] // 2)
    weights = cv2.resize(counts, size, interpolation=cv2.INTER_AREA)
    total = cv2.resize(masked, size, interpolation=cv2.INTER_AREA)
    del counts, masked
    mean = cv2.divide(total, cv2.merge([weights, weights, weights]), scale=255.0)
    coarse = fill_holes(np.asarray(mean, np.uint8), weights > 0)
    around = np.concatenate([coarse[:, -1:], coarse, coarse[:, :1]], axis=1)
    double = (2 * around.shape[1], 2 * len(around))
    smooth = cv2.resize(around, double, interpolation=cv2.INTER_LINEAR)[:height, 2 : 2 + width]
    np.copyto(smooth, rgb, where=is_seen[..., None])
    return np.asarray(smooth, np.uint8)


def checkerboard(photo: Bytes, cloud: Bytes) -> Bytes:
    """Stack two images (H, W, 3) and a checkerboard of both, one above the other (3 H, W, 3)."""
    row, column = np.indices(photo.shape[:2]) // (photo.shape[1] // NUM_TILES)
    mixed = np.where(((row + column) % 2 == 0)[..., None], photo, cloud)
    return np.concatenate([photo, cloud, mixed])


def overlay_png(points: PackedPoints, panorama: Panorama, pose: Pose, workers: Workers) -> bytes:
    """Return a PNG file of panorama, cloud rendered at the pose and checkerboard of both, top to bottom.

    A photo by one camera is shown in its own field, others as spheres.
    """
    if len(panorama.cameras) != 1:
        view = render_points(points, pose, OVERLAY_WIDTH, workers)
        cloud = fill_holes(view.rgb, view.is_seen)
        return encode_image(checkerboard(resize(panorama, OVERLAY_WIDTH).rgb, cloud), ".png")
    (mount,) = panorama.cameras
    camera = mount.camera.scale_to_width(OVERLAY_WIDTH)
    view = render_points(points, mount.pose(pose), sphere_width_for(camera), workers)
    cloud = cut(fill_holes(view.rgb, view.is_seen), camera)
    photo = cut(panorama.rgb, camera, mount.rotation)
    return encode_image(checkerboard(photo, cloud), ".png")


def sphere_width_for(camera: Camera) -> int:
    """Return the even width [px] of a sphere as fine as the camera at its axis, up to MAX_DRAWN_WIDTH."""
    return min(2 * math.ceil(math.pi * camera.resolution), MAX_DRAWN_WIDTH)


def cut(image: Bytes, camera: Camera, R_lens_from_cam: Array = UPRIGHT) -> Bytes:
    """Return a camera's picture (height, width, 3) of a sphere's (H, W, 3); black where it shows nothing."""
    u, v, is_in = _places(camera, image.shape[1], R_lens_from_cam)
    found = sample_sphere(image, u, v)
    found[~is_in] = 0
    return found


def sample_sphere(image: Bytes, u: Array32, v: Array32) -> Bytes:
    """Return the colours of a sphere's picture (H, W, ...) at its columns and rows (h, w) [px], bilinear."""
    around = np.concatenate([image[:, -1:], image, image[:, :1]], axis=1)
    return np.asarray(cv2.remap(around, u + np.float32(0.5), v - np.float32(0.5), cv2.INTER_LINEAR), np.uint8)


def cut_view(view: View, camera: Camera) -> View:
    """Return a camera's view from the sphere's: ranges of the nearest pixels, inf where it shows nothing."""
    width = view.depth.shape[1]
    u, v, is_in = _places(camera, width, UPRIGHT)
    rows = np.clip(v.astype(np.int64), 0, width // 2 - 1)
    depth = np.where(is_in, view.depth[rows, u.astype(np.int64) % width], np.float32(np.inf))
    return View(depth, cut(view.rgb, camera))


def _places(camera: Camera, width: int, R_lens_from_cam: Array) -> tuple[Array32, Array32, Mask]:
    """Return columns and rows [px] of the sphere at a camera's pixels (height, width), and which show any."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays, is_in = camera.rays(np.stack([u, v], axis=-1))
    columns, rows = compute_pixels(rays @ R_lens_from_cam, width)
    return columns.astype(np.float32), rows.astype(np.float32), is_in
