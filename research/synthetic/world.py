"""Rooms side by side with their scan, and panoramas and photos with true poses.

The scanner has noise, shadows and uneven density. Light, other cameras, files and things in front change the
pictures; photos are cut out of panoramas.
"""

import io
import itertools
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import PIL.Image
from scipy.ndimage import gaussian_filter

from piccolo.geometry.pose import Pose, exp_so3, uniform_rotations, yaw_rotation
from piccolo.geometry.sphere import compute_pixels, pixel_rays, solid_angles
from piccolo.photo.camera import Calibration, Mount
from piccolo.photo.camera.calibration import compute_extent
from piccolo.photo.camera.model import camera_of_fov
from piccolo.system.arrays import Array, Array32, Bytes, Int64s, Mask, Uint16s, Values
from piccolo.system.errors import InputError
from piccolo.system.files.atomic import write_atomically
from piccolo.system.jobs.threads import Workers

from .layout import Room, make_room
from .raycast import cast_rays

SUPERSAMPLING = 2  # rays a pixel, each way
TILE = 64  # side [px] of what is cast at once: rays near each other meet few boxes

RANGE_NOISE = 0.003  # of the scanner, standard deviation [m]
MIN_CLEARANCE = 0.35  # of a station or camera [m]
VARIANTS = ("clean", "tilt", "photo", "change")
GAP = 0.4  # between rooms [m]
MIN_SIZE = 2.0  # of a room, each way [m]
MAX_SIZE = 50.0
MAX_ROOMS = 256
SEED_STEP = 64  # between the rooms of two seeds; larger buildings share rooms with the next seed
MAX_SIDE = 4096  # [px] of a camera's picture
PHOTO_SIZE = (1024, 768)  # [px]
PHOTO_FOV_DEG = 70.0
DIAGONAL_35MM = 43.27  # [mm] of the film that EXIF compares with
EXIF_IFD = 0x8769
EXIF_FOCAL_35MM = 0xA405
EXIF_FOCAL = 0x920A
LEAST_RADIUS = math.radians(8.0)  # of an occluder
MOST_RADIUS = math.radians(28.0)
ASPECT = 0.75  # height by width of a narrow photo
UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])  # half a turn about the view axis


def free_position(room: Room, rng: np.random.Generator, heights: tuple[float, float]) -> Array:
    """Draw a position (3,) at least MIN_CLEARANCE from every surface, at a height [m] above the floor.

    Raises InputError if the room is so full that none is found.
    """
    for _ in range(2000):
        low = np.array([MIN_CLEARANCE, MIN_CLEARANCE, heights[0]])
        high = np.array([*(room.size[:2] - MIN_CLEARANCE), heights[1]])
        position = room.corner + rng.uniform(low, high)
        if room.clearance(position) >= MIN_CLEARANCE:
            return position
    text = f"has no free position {MIN_CLEARANCE} m from everything; use a larger one"
    raise InputError(f"`size`: a room of {room.size.tolist()} m {text}")


def scan_room(
    room: Room, num_points: int, rng: np.random.Generator, workers: Workers
) -> tuple[Array32, Bytes, Int64s]:
    """Points (N, 3) [m], colours (N, 3) and labels (N,) of a room, N = num_points, from three stations."""
    num_stations = 3
    width = 2 * int(np.ceil(np.sqrt(1.15 * num_points / num_stations / 2.0)))
    parts = []
    for station in range(num_stations):
        position = free_position(room, rng, (1.2, 1.8))
        rays = pixel_rays(width).reshape(-1, 3) @ yaw_rotation(rng.uniform(0, 2 * np.pi))
        ranges, rgb, kinds = cast_rays(room, position, rays, workers, f"scan, station {station + 1}")
        ranges = ranges + rng.normal(0.0, RANGE_NOISE, len(ranges))
        points = (position + ranges[:, None] * rays).astype(np.float32)
        parts.append((points, np.round(rgb * 255.0).astype(np.uint8), kinds))
    points, colors, labels = map(np.concatenate, zip(*parts, strict=True))
    is_hit = np.isfinite(points).all(axis=1)
    chosen = np.sort(rng.choice(np.flatnonzero(is_hit), num_points, replace=False))
    return points[chosen], colors[chosen], labels[chosen]


def photograph(room: Room, pose: Pose, width: int, workers: Workers, meanwhile: Sequence[Pose] = ()) -> Bytes:
    """Equirectangular image (width / 2, width, 3) of a room at `pose`.

    With poses that the camera has `meanwhile`, a multiple of four of them, it is the mean over these.
    """
    rays_cam = pixel_rays(SUPERSAMPLING * width)
    rgb = np.empty((width // 2, width, 3), np.uint8)
    parts = [divmod(k, SUPERSAMPLING) for k in range(SUPERSAMPLING**2)]
    samples = [(each, parts[k % len(parts)]) for k, each in enumerate(meanwhile or [pose] * len(parts))]

    def run(corner: tuple[int, int]) -> None:
        rows, columns = (slice(begin, begin + TILE) for begin in corner)
        tile = rgb[rows, columns]
        total = np.zeros((tile.size // 3, 3))
        for each, (row, column) in samples:
            rays = rays_cam[row::SUPERSAMPLING, column::SUPERSAMPLING][rows, columns].reshape(-1, 3)
            total += cast_rays(room, each.center_world, rays @ each.R_cam_from_world, Workers(), "tile")[1]
        tile[:] = np.round(255.0 / len(samples) * total).reshape(tile.shape)

    corners = itertools.product(range(0, width // 2, TILE), range(0, width, TILE))
    list(workers.map(run, list(corners), "panorama"))
    return rgb


def render_picture(mount: Mount, room: Room, pose: Pose, workers: Workers) -> Bytes:
    """Render the picture (H, W, 3) of a room by a camera, its rig at `pose`; black where it shows nothing."""
    camera = mount.camera
    u = (np.arange(SUPERSAMPLING * camera.width) + 0.5) / SUPERSAMPLING
    v = (np.arange(SUPERSAMPLING * camera.height) + 0.5) / SUPERSAMPLING
    rays, is_seen = camera.rays(np.stack(np.meshgrid(u, v), axis=-1))
    own = mount.pose(pose)
    rgb = np.zeros((*is_seen.shape, 3), np.float32)
    rays_world = rays[is_seen] @ own.R_cam_from_world
    rgb[is_seen] = cast_rays(room, own.center_world, rays_world, workers, "photo")[1]
    small = cv2.resize(rgb, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    return np.asarray(np.round(small * 255.0), np.uint8)


def picture_of_all(mounts: Sequence[Mount], room: Room, pose: Pose, workers: Workers) -> Bytes:
    """Render the picture of which each camera has a part, such as a dual fisheye's."""
    width, height = compute_extent(mounts)
    rgb = np.zeros((height, width, 3), np.uint8)
    for mount in mounts:
        left, top = mount.offset
        camera = mount.camera
        picture = render_picture(mount, room, pose, workers)
        rgb[top : top + camera.height, left : left + camera.width] = picture
    return rgb


class World(NamedTuple):
    """Seeded rooms in a square grid."""

    seed: int
    rooms: tuple[Room, ...]


class Query(NamedTuple):
    """A panorama with the pose at which it was taken."""

    rgb: Bytes  # (H, W, 3)
    pose: Pose
    variant: str


def make_world(seed: int, size: Array, num_rooms: int = 1) -> World:
    """`num_rooms` rooms of `size` (3,) [m], all different."""
    size = np.asarray(size, dtype=float)
    if not ((size >= MIN_SIZE) & (size <= MAX_SIZE)).all():  # so that NaN is refused too
        wanted = f"wanted {MIN_SIZE} to {MAX_SIZE} m in each direction"
        raise InputError(f"`size`: found {size.tolist()}, {wanted}")
    if not 1 <= num_rooms <= MAX_ROOMS:
        raise InputError(f"`rooms`: found {num_rooms}, wanted 1 to {MAX_ROOMS}")
    columns = int(np.ceil(np.sqrt(num_rooms)))
    rooms = []
    for k in range(num_rooms):
        corner = np.array([*((size[:2] + GAP) * divmod(k, columns)), 0.0])
        rooms.append(make_room(seed * SEED_STEP + k, size, corner))
    return World(seed, tuple(rooms))


def scan_world(world: World, num_points: int, workers: Workers) -> tuple[Array32, Bytes, Int64s]:
    """Points (num_points, 3) [m], colours (num_points, 3) and labels (num_points,) of all rooms."""
    counts = np.diff(np.linspace(0, num_points, len(world.rooms) + 1).astype(int))
    rng = np.random.default_rng([world.seed, 10])
    parts = [scan_room(room, int(n), rng, workers) for room, n in zip(world.rooms, counts, strict=True)]
    points, colors, labels = zip(*parts, strict=True)
    return np.concatenate(points), np.concatenate(colors), np.concatenate(labels)


def make_query(world: World, index: int, variant: str, width: int, workers: Workers) -> Query:
    """Query number `index` of a variant: upright but for `tilt`, in a room drawn at random."""
    room, pose, rng = pose_of_query(world, index, variant)
    rgb = photograph(room, pose, width, workers)
    return Query(change_light(rgb, rng, rng) if variant == "photo" else rgb, pose, variant)


def pose_of_query(world: World, index: int, variant: str) -> tuple[Room, Pose, np.random.Generator]:
    """Return room, camera pose and random generator of query number `index` of a variant."""
    if variant not in VARIANTS:
        raise InputError(f"variant: found {variant!r}, wanted one of {', '.join(VARIANTS)}")
    rng = np.random.default_rng([world.seed, 20, VARIANTS.index(variant), index])
    number = int(rng.integers(len(world.rooms)))
    room = world.rooms[number]
    if variant == "change":
        room = make_room(world.seed * SEED_STEP + number, room.size, room.corner, changed=index + 1)
    center_world = free_position(room, rng, (1.0, min(1.9, float(room.size[2]) - 0.4)))
    R_cam_from_world = yaw_rotation(rng.uniform(0, 2 * np.pi))
    if variant == "tilt":
        R_cam_from_world = exp_so3(rng.uniform(-1, 1, 3)) @ uniform_rotations(64)[rng.integers(64)]
    return room, Pose(R_cam_from_world, center_world), rng


def make_labels(world: World, index: int, query: Query, workers: Workers) -> Uint16s:
    """Image (H, W) of the labels that query number `index` of its variant shows, of pixels' centres."""
    room, _, _ = pose_of_query(world, index, query.variant)
    shape = query.rgb.shape[:2]
    rays = pixel_rays(shape[1]).reshape(-1, 3) @ query.pose.R_cam_from_world
    labels = cast_rays(room, query.pose.center_world, rays, workers, "labels")[2]
    return labels.astype(np.uint16).reshape(shape)


def check_cameras(cameras: Calibration) -> None:
    """Refuse, before any work is done, cameras whose pictures can't be made, naming the option."""
    path = cameras.path
    mounts = cameras.mounts
    if cameras.is_choice and len(mounts) > 1:
        raise InputError(f"`camera`: found {len(mounts)} cameras in {path}, wanted one, or those of a rig")
    if not cameras.has_sizes or max(compute_extent(mounts)) > MAX_SIDE:
        raise InputError(f"`camera`: found pictures of no size in {path}, or over {MAX_SIDE} px")
    names = [mount.image for mount in mounts if mount.image is not None]
    if any(re.search(r"[*?|\[/]", name) or not name.endswith((".jpg", ".png")) for name in names):
        raise InputError(f"`camera`: found images {names} in {path}, wanted names of .jpg or .png files")


def make_photos(
    world: World, index: int, variant: str, cameras: Calibration, workers: Workers
) -> tuple[list[tuple[str, Bytes]], Pose]:
    """Render the pictures (H, W, 3) by the cameras of query `index` of a variant; return the rig's pose too.

    Each picture has a file name, "" of one that stands alone.
    """
    room, pose, rng = pose_of_query(world, index, variant)
    if cameras.is_rig:
        pictures = [(m.image or "", render_picture(m, room, pose, workers)) for m in cameras.mounts]
    else:
        pictures = [("", picture_of_all(cameras.mounts, room, pose, workers))]
    if variant == "photo":
        pictures = [(name, change_light(rgb, rng, rng)) for name, rgb in pictures]
    return pictures, pose


class Photo(NamedTuple):
    """A phone photo cut out of a panorama."""

    rgb: Bytes  # (H, W, 3)
    pose: Pose
    focal_px: float


def cut_photo(rgb: Bytes, pose: Pose, fov_deg: float, rng: np.random.Generator) -> Photo:
    """Cut a pinhole photo out of a panorama (H, W, 3) taken at `pose`, in any direction but steep ones."""
    camera = camera_of_fov("pinhole", fov_deg, *PHOTO_SIZE)
    pitch, roll = np.radians(rng.uniform([-15.0, -5.0], [15.0, 5.0]))
    R_photo_from_pano = exp_so3(np.array([roll, pitch, 0.0])) @ yaw_rotation(rng.uniform(0.0, 2.0 * np.pi))
    columns, rows = (np.arange(size) + 0.5 for size in PHOTO_SIZE)
    rays, _ = camera.rays(np.stack(np.meshgrid(columns, rows), axis=-1))
    u, v = compute_pixels(rays @ R_photo_from_pano, rgb.shape[1])
    map_u = (u - 0.5).astype(np.float32)  # OpenCV has pixel centres at whole numbers
    map_v = (v - 0.5).astype(np.float32)
    picture = cv2.remap(rgb, map_u, map_v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP)
    pose = Pose(R_photo_from_pano @ pose.R_cam_from_world, pose.center_world)
    return Photo(np.asarray(picture, np.uint8), pose, camera.focal[0])


def write_photo(photo: Photo, path: Path) -> None:
    """Write a JPEG with its focal length in EXIF in whole millimetres, as phones write it."""
    image = PIL.Image.fromarray(photo.rgb)
    exif = image.getexif()
    focal_35mm = round(photo.focal_px / math.hypot(*PHOTO_SIZE) * DIAGONAL_35MM)
    exif.get_ifd(EXIF_IFD).update({EXIF_FOCAL_35MM: focal_35mm, EXIF_FOCAL: 4.25})
    file = io.BytesIO()
    image.save(file, "JPEG", quality=93, exif=exif)
    write_atomically(path, file.getvalue())


def change_sensor(rgb: Bytes, rng: np.random.Generator, noise: np.random.Generator) -> Bytes:
    """Process a photo (H, W, 3) as another phone would: light, colours, sharpness, noise and file.

    `noise` may be `rng`; photos of one phone have the same `rng` each, and other noise.
    """
    linear = (rgb / 255.0) ** 2.2 * 2.0 ** rng.uniform(-0.7, 0.7) * rng.uniform(0.8, 1.25, 3)
    toned = linear.clip(0.0, 1.0) ** (1.0 / rng.uniform(1.7, 2.8))
    smooth = cv2.GaussianBlur(toned, (0, 0), rng.uniform(1.0, 3.0))
    sharpened = toned + rng.uniform(0.0, 1.0) * (toned - smooth)
    noisy = 255.0 * sharpened + noise.normal(0.0, rng.uniform(0.0, 6.0), rgb.shape)
    quality = int(rng.integers(50, 95))
    return compress(noisy, quality)


def compress(rgb: Array, quality: int) -> Bytes:
    """Store a photo (H, W, 3) of levels up to 255 as a JPEG, and read it again."""
    levels = rgb.clip(0.0, 255.0).astype(np.uint8)
    _, content = cv2.imencode(".jpg", levels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR), np.uint8)


def blur(image: Values, sigma: float) -> Array:
    """Blur an equirectangular image (H, W, 3) by a Gaussian [px]."""
    mode = ("nearest", "wrap", "nearest")
    return np.asarray(gaussian_filter(image.astype(float), (sigma, sigma, 0.0), mode=mode))


def change_light(rgb: Bytes, rng: np.random.Generator, noise: np.random.Generator) -> Bytes:
    """Return the image (H, W, 3) with another exposure, white balance and gamma, blurred and noisy.

    `noise` may be `rng`; photos of one light have the same `rng` each, and other noise.
    """
    gain = rng.uniform(0.7, 1.3) * rng.uniform(0.85, 1.15, 3)
    linear = (rgb / 255.0) ** rng.uniform(0.8, 1.25)
    noisy = blur(linear * gain, 0.8) + noise.normal(0.0, 0.02, rgb.shape)
    return np.asarray(np.round(noisy.clip(0.0, 1.0) * 255.0).astype(np.uint8))


def occlude(rgb: Bytes, other: Bytes, fraction: float, rng: np.random.Generator) -> Bytes:
    """Hide a fraction of the sphere of a photo (H, W, 3) behind round pieces of another."""
    height, width = rgb.shape[:2]
    rays = pixel_rays(width)
    areas = solid_angles(width)[:, None] / (4.0 * math.pi)
    is_hidden = np.zeros((height, width), np.bool_)
    shown = rgb.copy()
    while float((is_hidden * areas).sum()) < fraction:
        direction = rng.normal(size=3) * [1.0, 1.0, 0.4]  # people and things stand around the camera
        radius = rng.uniform(LEAST_RADIUS, MOST_RADIUS)
        is_new = (rays @ (direction / np.linalg.norm(direction)) > math.cos(radius)) & ~is_hidden
        moved = np.roll(other, rng.integers(width), axis=1)[:: int(rng.choice([-1, 1]))]
        shown[is_new] = moved[is_new]
        is_hidden |= is_new
    return shown


def light_unevenly(rgb: Bytes, stops: float, rng: np.random.Generator) -> Bytes:
    """Put a photo (H, W, 3) under patches of light that differ by some stops."""
    noise = blur(rng.normal(size=rgb.shape[:2])[..., None], 0.08 * rgb.shape[1])
    gain = 2.0 ** (0.5 * stops * noise / noise.std())
    linear = (rgb / 255.0) ** 2.2 * gain
    return np.asarray(255.0 * linear.clip(0.0, 1.0) ** (1.0 / 2.2), np.uint8)


def take_at_night(rgb: Bytes, rng: np.random.Generator) -> Bytes:
    """Dim and tint the light by four stops, and add the noise of a sensor that makes up for most of it."""
    linear = (rgb / 255.0) ** 2.2 * 2.0**-4 * np.array([1.3, 0.8, 0.6])
    noisy = rng.poisson(900.0 * linear) / 900.0 + rng.normal(0.0, 0.004, rgb.shape)
    return np.asarray(255.0 * (5.0 * noisy).clip(0.0, 1.0) ** (1.0 / 2.2), np.uint8)


def mask_outside_field(width: int, fov_deg: float, yaw: float) -> Mask:
    """Return the mask (H, W) of a sphere outside a level pinhole photo that looks along azimuth `yaw`."""
    x, y, z = np.moveaxis(pixel_rays(width), -1, 0)
    forward = math.cos(yaw) * x + math.sin(yaw) * y
    left = math.cos(yaw) * y - math.sin(yaw) * x
    reach = math.tan(math.radians(fov_deg / 2.0)) * forward
    return np.asarray((forward <= 0.0) | (np.abs(left) > reach) | (np.abs(z) > ASPECT * reach))


def draw_fractal_noise(shape: tuple[int, ...], rng: np.random.Generator) -> Bytes:
    """Draw smooth noise of several scales (H, W, 3), with the contrast of a photo."""
    total = np.zeros(shape)
    for scale in (0.004, 0.015, 0.06):
        noise = blur(rng.normal(size=shape), scale * shape[1])
        total += noise / noise.std()
    return np.asarray((127.0 + 40.0 * total).clip(0, 255), np.uint8)
