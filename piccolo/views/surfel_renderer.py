"""The cloud rendered at a pose: surfaces closed, what nobody scanned filled or left open; and overlays."""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from ..cloud.soa import PackedPoints
from ..geometry.pose import Array, Pose
from ..jobs.threads import Workers
from ..panorama import Panorama
from ..panorama.model import shrink
from .field import cut, sphere_width_for
from .surfels import MIN_RADIUS_PX, Surfels, splat, surfels_of
from .zbuffer import View, nearest_depth, select_visible

STRIP = 1 << 21  # pixels that one thread draws at a time
MAX_SURFELS = 8_000_000  # of more points that may be seen, this many are drawn, evenly in space
MAX_ANGLE = 0.3  # [rad] as which a surfel's radius is seen, at most
MIN_COSINE = 0.15  # a surfel seen flatter than this is turned towards the camera: normals are not that sure
# Rooms behind gaps leave lone points with large surfels. Large surfels far off are sparse surfaces.
MAX_RADIUS = 1.5  # by the radius that 95 % of the surfels stay below
MIN_RANGE = 1e-3  # [m] nearer to the camera nothing is drawn
HIDING_WIDTHS = (360, 720)  # cells of 1 and 1/2 degrees; wider ones hide what is seen through a door ajar
FAR_ANGLE = 0.02  # [rad] as which a far surfel's radius is seen
OVERLAY_WIDTH = 1024
NUM_TILES = 16  # columns of the checkerboard


def render_points(points: PackedPoints, pose: Pose, width: int, workers: Workers) -> View:
    """The cloud at `pose`, `width` x width / 2 pixels; colours in uint8."""
    visible = points.take(visible_indices(points, pose.center_world)).subsample(MAX_SURFELS)
    return render_surfels(surfels_of(visible, workers), pose, width, workers)


def visible_indices(points: PackedPoints, center_world: Array) -> NDArray[np.int64]:
    """Indices of all points but those behind a surface that goes on around them.

    `zbuffer.visible_points` lets what is in front in a cell hide all of the cell: a rim of two degrees around
    each thing would be missing in a picture. Here nine cells must agree, of one or the other size.
    """
    pose = Pose(np.eye(3), center_world)
    R, t = pose.R_cam_from_world, pose.center_world
    kept = np.arange(len(points))
    for width in HIDING_WIDTHS:
        depth = nearest_depth(points, pose, width).reshape(-1, width)
        around = np.pad(depth, ((1, 1), (1, 1)), mode="wrap")
        around[[0, -1]] = -np.inf  # no row beyond a pole
        farthest = cv2.dilate(around, np.ones((3, 3), np.uint8))[1:-1, 1:-1].reshape(-1)
        indices = np.empty(len(points), np.int64)
        count = select_visible(points.x, points.y, points.z, R, t, width, farthest, indices)
        points, kept = points.take(indices[:count]), kept[indices[:count]]
    return kept


def render_surfels(surfels: Surfels, pose: Pose, width: int, workers: Workers) -> View:
    """The surfels seen from `pose`; colours in uint8."""
    p = surfels.points
    ranges = np.linalg.norm(np.stack([p.x, p.y, p.z], axis=1) - pose.center_world, axis=1)
    largest = np.maximum(MAX_RADIUS * np.percentile(surfels.radii, 95.0), FAR_ANGLE * ranges)  # not lone
    surfels = surfels.take(np.flatnonzero((surfels.radii <= largest) & (ranges > MIN_RANGE)))
    packed, directions, angles = _in_camera(surfels, pose, width)
    rgb = np.zeros((width // 2, width, 3), np.uint8)
    depth = np.full((width // 2, width), np.inf, np.float32)
    num_rows = max(1, STRIP // width)
    rows_per_rad = width / (2.0 * math.pi)
    top = (0.5 * math.pi - directions[:, 1] - angles) * rows_per_rad
    bottom = (0.5 * math.pi - directions[:, 1] + angles) * rows_per_rad

    def run(first: int) -> None:
        rows = slice(first, first + num_rows)
        inside = np.flatnonzero((bottom >= first) & (top <= first + num_rows))
        some = packed[inside], surfels.points.rgbx[inside], directions[inside], angles[inside], first
        sums = np.zeros((*depth[rows].shape, 5), np.float32)
        splat(*some, depth[rows], sums[:0])
        splat(*some, depth[rows], sums)
        is_seen = sums[..., 4] > 0.0
        means = sums[..., :4] / np.where(is_seen, sums[..., 4], np.float32(1.0))[..., None]
        rgb[rows] = np.rint(means[..., :3])
        depth[rows] = np.where(is_seen, means[..., 3], np.float32(np.inf))

    list(workers.map(run, range(0, width // 2, num_rows), "draw"))
    return View(depth, rgb)


def _in_camera(
    surfels: Surfels, pose: Pose, width: int
) -> tuple[NDArray[np.float32], NDArray[np.float64], NDArray[np.float64]]:
    """Surfels (N, 9), directions (N, 2) and angles (N,) as `surfels.splat` reads them."""
    p, R = surfels.points, pose.R_cam_from_world
    x_cam = (np.stack([p.x, p.y, p.z], axis=1) - pose.center_world) @ R.T
    ranges = np.linalg.norm(x_cam, axis=1)
    rays = x_cam / ranges[:, None]
    normals = surfels.normals @ R.T
    cosine = np.einsum("ni,ni->n", normals, rays)
    normals *= np.where(cosine < 0.0, -1.0, 1.0)[:, None]
    # without a plane the normal is 0, and becomes the ray
    normals += np.maximum(MIN_COSINE - np.abs(cosine), 0.0)[:, None] / (1.0 - MIN_COSINE) * rays
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    radii = np.clip(surfels.radii, 1e-9, MAX_ANGLE * ranges)
    along = np.einsum("ni,ni->n", normals, x_cam)
    packed = np.column_stack([x_cam, normals, along, 1.0 / radii**2, ranges]).astype(np.float32)
    azimuth = np.arctan2(x_cam[:, 1], x_cam[:, 0])
    elevation = np.arctan2(x_cam[:, 2], np.hypot(x_cam[:, 0], x_cam[:, 1]))
    angles = np.maximum(np.arcsin(radii / ranges), MIN_RADIUS_PX * 2.0 * math.pi / width)
    return packed, np.stack([azimuth, elevation], axis=1), angles


def fill_holes(rgb: NDArray[np.uint8], is_seen: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A picture (H, W, 3); what is not seen (H, W) takes colours around it, the farther away the smoother.

    From the same at half the size, in bytes, as floating-point copies of a large picture would take
    gigabytes. Black if nothing is seen at all.
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


def encode_image(image: NDArray[np.uint8] | NDArray[np.uint16], suffix: str, quality: int = 95) -> bytes:
    """Bytes of a file with an image (H, W, 3) RGB, (H, W, 4) RGBA or (H, W) gray, as the suffix says.

    The quality, up to 100, is that of a JPEG.
    """
    order = cv2.COLOR_RGBA2BGRA if image.ndim == 3 and image.shape[2] == 4 else cv2.COLOR_RGB2BGR
    bgr = cv2.cvtColor(image, order) if image.ndim == 3 else image
    options = [cv2.IMWRITE_JPEG_QUALITY, quality] if suffix in (".jpg", ".jpeg") else []
    is_encoded, content = cv2.imencode(suffix, bgr, options)
    if not is_encoded:
        raise OSError(f"an image of {image.shape[1]} x {image.shape[0]} could not be encoded as {suffix}")
    return content.tobytes()


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
    """PNG file of three images, one above the other: panorama, cloud from the pose, checkerboard of both.

    A photo by one camera is shown in its own field, others as spheres.
    """
    if len(panorama.cameras) != 1:
        view = render_points(points, pose, OVERLAY_WIDTH, workers)
        cloud = fill_holes(view.rgb, view.is_seen)
        return encode_image(checkerboard(resized_rgb(panorama, OVERLAY_WIDTH), cloud), ".png")
    (mount,) = panorama.cameras
    camera = mount.camera.scaled_to_width(OVERLAY_WIDTH)
    view = render_points(points, mount.pose(pose), sphere_width_for(camera), workers)
    cloud = cut(fill_holes(view.rgb, view.is_seen), camera)
    photo = cut(panorama.rgb, camera, mount.rotation)
    return encode_image(checkerboard(photo, cloud), ".png")
