"""Pictures of the scan for people: filled holes, overlays with a photo, a camera's part of the sphere."""

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
MAX_DRAWN_WIDTH = 8192  # [px] of a sphere that is drawn for a camera's picture
UPRIGHT = np.eye(3)


def fill_holes(rgb: Bytes, is_seen: Mask) -> Bytes:
    """Fill the pixels of a picture (H, W, 3) where `is_seen` (H, W) is False from the colours around them.

    The colours come from the picture at half its size, which is filled in the same way: the larger the hole,
    the smoother. All is computed in bytes, as floating-point copies of a large picture would take gigabytes.
    The result is black if nothing is seen.
    """
    height, width = is_seen.shape
    if is_seen.all() or width == 1:
        return rgb
    counts = is_seen.view(np.uint8) * np.uint8(255)
    masked = cv2.bitwise_and(rgb, rgb, mask=counts)
    if height % 2 or width % 2:  # an added row has no weight, an added column repeats the first
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
    """Stack two images (H, W, 3) and a checkerboard of both, from top to bottom, into one (3 H, W, 3)."""
    row, column = np.indices(photo.shape[:2]) // (photo.shape[1] // NUM_TILES)
    mixed = np.where(((row + column) % 2 == 0)[..., None], photo, cloud)
    return np.concatenate([photo, cloud, mixed])


def overlay_png(points: PackedPoints, panorama: Panorama, pose: Pose, workers: Workers) -> bytes:
    """Return a PNG file of the panorama, the cloud rendered at the pose and a checkerboard of both.

    The three are stacked from top to bottom. A photo by one camera is shown in that camera's field of view,
    any other as a sphere.
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
    """Return the width [px], even, of a sphere as fine as a camera near its axis; at most MAX_DRAWN_WIDTH."""
    return min(2 * math.ceil(math.pi * camera.resolution), MAX_DRAWN_WIDTH)


def cut(image: Bytes, camera: Camera, R_lens_from_cam: Array = UPRIGHT) -> Bytes:
    """Return the picture (height, width, 3) that a camera takes of a sphere's picture (H, W, 3).

    It is black at pixels that no ray reaches.
    """
    u, v, is_in = _sphere_pixels(camera, image.shape[1], R_lens_from_cam)
    picture = sample_sphere(image, u, v)
    picture[~is_in] = 0
    return picture


def sample_sphere(image: Bytes, u: Array32, v: Array32) -> Bytes:
    """Return the colours of a sphere's picture (H, W, ...) at columns and rows (h, w) [px], bilinear."""
    around = np.concatenate([image[:, -1:], image, image[:, :1]], axis=1)
    return np.asarray(cv2.remap(around, u + np.float32(0.5), v - np.float32(0.5), cv2.INTER_LINEAR), np.uint8)


def cut_view(view: View, camera: Camera) -> View:
    """Return the view of a camera, cut out of the sphere's view.

    Ranges are those of the nearest pixel, inf where no ray reaches or nothing is seen.
    """
    width = view.depth.shape[1]
    u, v, is_in = _sphere_pixels(camera, width, UPRIGHT)
    rows = np.clip(v.astype(np.int64), 0, width // 2 - 1)
    depth = np.where(is_in, view.depth[rows, u.astype(np.int64) % width], np.float32(np.inf))
    return View(depth, cut(view.rgb, camera))


def _sphere_pixels(camera: Camera, width: int, R_lens_from_cam: Array) -> tuple[Array32, Array32, Mask]:
    """Return the sphere's column and row [px] at each pixel of a camera, and which pixels have a ray.

    All three are (height, width); the sphere's picture is `width` [px] wide.
    """
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays, is_in = camera.rays(np.stack([u, v], axis=-1))
    columns, rows = compute_pixels(rays @ R_lens_from_cam, width)
    return columns.astype(np.float32), rows.astype(np.float32), is_in
