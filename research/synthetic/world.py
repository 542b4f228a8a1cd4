"""Rooms side by side with their scan, and panoramas and photos with true poses.

The scanner has noise, shadows and uneven density; light, lens and file change the panoramas.
"""

import itertools
import re
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from piccolo.arrays import Array, Array32, Bytes, Int64s
from piccolo.camera import Calibration, Mount
from piccolo.camera.calibration import compute_extent
from piccolo.errors import InputError
from piccolo.geometry.pose import Pose, exp_so3, uniform_rotations, yaw_rotation
from piccolo.geometry.sphere import pixel_rays
from piccolo.jobs.threads import Workers

from .layout import Room, make_room
from .photos import change_light
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


def make_labels(world: World, index: int, query: Query, workers: Workers) -> NDArray[np.uint16]:
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
