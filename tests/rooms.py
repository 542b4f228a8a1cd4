"""Seeded synthetic rooms, small and quick, kept for all tests of a run."""

import contextlib
import fcntl
import functools
import io
import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from piccolo.api.scan import Scan
from piccolo.cloud.cloud_settings import CloudSettings
from piccolo.cloud.stream import CloudPoints, stream_of_arrays
from piccolo.cloud.voxels import VoxelTable, morton_order
from piccolo.cloud.writers import vertex_rows, writing_ply
from piccolo.geometry.points import pack_points
from piccolo.geometry.pose import Pose, angle_between, yaw_rotation
from piccolo.localization.means import Means, Trace
from piccolo.localization.run import localize
from piccolo.photo.panorama import Panorama
from piccolo.problem.problem import prepare_problem
from piccolo.problem.settings import CoarseToFineSettings
from piccolo.scan_map.map_file import load_map, save_map
from piccolo.scan_map.scan_map import prepare_map
from piccolo.system.jobs.threads import Stopwatch, Workers
from piccolo.views.view import average_view, normalize_view
from research.synthetic import make_room
from research.synthetic.world import make_query, make_world, mask_outside_field, photograph, scan_world

SIZE = (4.5, 3.5, 2.5)
NUM_POINTS = 60_000
WIDTH = 512
WORKERS = Workers(2)
SHARED = []  # the folder that all workers of a run have in common; conftest.py puts it in
AUTO, KNOWN, UNKNOWN = (CoarseToFineSettings(gravity=gravity) for gravity in ("auto", "known", "unknown"))


@functools.lru_cache
def room(seed, num_points=NUM_POINTS):
    """World of one room, and its cloud as a file would be read: shifted and in Morton order."""
    world = make_world(seed, np.array(SIZE))
    points, colors, _ = scan_world(world, num_points, Workers(2))
    origin_world = np.round((points.min(axis=0).astype(float) + points.max(axis=0)) / 2)
    points = (points - origin_world).astype(np.float32)
    order = morton_order(points, colors)
    return world, CloudPoints(points[order], colors[order], origin_world)


def stream(cloud):
    """A cloud as if it were read from a file."""
    found = stream_of_arrays(cloud.points + cloud.origin_world, cloud.colors)
    channel = "colors" if cloud.has_colors else "intensity"
    return replace(found, sources=[source._replace(channel=channel) for source in found.sources])


def voxels(points, colors=None):
    """The voxels of points (N, 3) [m] with colours (N, 3), by default grey."""
    table = VoxelTable("points")
    grey = np.full(points.shape, 128, np.uint8)
    table.add(points.astype(np.float32).astype(np.float64), grey if colors is None else colors)
    return table.finish()


def write_ply(path, rows):
    """Write vertices to a file."""
    with writing_ply(path) as writer:
        writer.add(rows)


def make_once(name, make):
    """A file or folder in the folder of all workers, made by the first that asks for it; returns its path."""
    path = SHARED[0] / name
    with Path(f"{path}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not path.exists():
            make(path)
    return path


def make_map(seed, num_points=NUM_POINTS):
    """The map of a room, prepared anew."""
    return replace(prepare_map(stream(room(seed, num_points)[1]), Workers(2)), scan_sha256=64 * "0")


def map_path(seed, num_points=NUM_POINTS):
    """The file of a room's map."""
    return make_once(f"{seed}-{num_points}.map", lambda path: save_map(make_map(seed, num_points), path))


@functools.lru_cache
def scan_map(seed, num_points=NUM_POINTS):
    """The map of a room, which one worker prepares for all."""
    return load_map(map_path(seed, num_points))


@functools.lru_cache
def query(seed, variant="clean", index=0, width=WIDTH):
    """A panorama of a room with its true pose in the world."""
    return make_query(room(seed)[0], index, variant, width, Workers(2))


@functools.lru_cache
def scan(seed, num_threads=2, num_points=NUM_POINTS):
    """A room as it is after it was opened."""
    prepared = scan_map(seed, num_points)
    return Scan(prepared, "room", CloudSettings(), AUTO, Workers(num_threads), {})


def turned_poses(seed, offset_by_eighth):
    """Poses in a room, at offsets (3,) from a place and turned by eighths."""
    base = query(seed).pose
    turns = {eighth: yaw_rotation(eighth * math.pi / 4.0) for eighth in offset_by_eighth}
    return [
        Pose(turns[eighth] @ base.R_cam_from_world, base.center_world + np.array(offset))
        for eighth, offset in offset_by_eighth.items()
    ]


def take_photos(seed, fov_deg, offset_by_eighth, width=WIDTH):
    """Photos of a room, at offsets (3,) from a place and turned by eighths, each with its true pose."""
    world = room(seed)[0]
    taken = []
    for pose in turned_poses(seed, offset_by_eighth):
        rgb = photograph(world.rooms[0], pose, width, Workers(2))
        taken.append((Panorama(rgb, ~mask_outside_field(width, fov_deg, 0.0)), pose))
    return taken


def as_panorama(rgb):
    """An image (H, W, 3) as it is read, all pixels valid."""
    return Panorama(rgb, np.ones(rgb.shape[:2], dtype=bool))


def ask(panorama, scan_map, settings=AUTO):
    """The problem of a panorama in a map."""
    return prepare_problem(panorama, scan_map, settings.prior, settings.gravity, settings.method)


def means(settings=AUTO, workers=WORKERS):
    """With what a photo is searched; its steps are noted."""
    return Means(settings.effort, workers, Stopwatch(), Trace(is_wanted=True))


def listen():
    """Workers of one thread, and a list of what they are asked to do, and how often."""
    asked = []

    def show(values, total, label):
        asked.append((label, total))
        yield from values

    return Workers(1, show), asked


def locate(panorama, scan_map, settings=AUTO, num_threads=2):
    """A panorama localized in a map."""
    return localize(scan_map, panorama, settings, means(settings, Workers(num_threads)))


def errors(pose, true_pose):
    """Position error [m] and rotation error [deg]."""
    distance = np.linalg.norm(pose.center_world - true_pose.center_world)
    return distance, np.degrees(angle_between(pose.R_cam_from_world, true_pose.R_cam_from_world))


def assert_near(pose, true_pose, most, most_deg):
    """A pose is less than so far [m, deg] from another."""
    distance, angle_deg = errors(pose, true_pose)
    assert distance < most, f"{1000.0 * distance:.1f} mm"
    assert angle_deg < most_deg, f"{angle_deg:.2f} deg"


def local(seed, pose, num_points=NUM_POINTS):
    """A pose of the world near a room's local origin."""
    return Pose(pose.R_cam_from_world, pose.center_world - room(seed, num_points)[1].origin_world)


def points_world(seed, num_points=NUM_POINTS):
    """The points (N, 3) of a room in the world, float64."""
    cloud = room(seed, num_points)[1]
    return cloud.points.astype(np.float64) + cloud.origin_world


def packed(seed):
    cloud = room(seed)[1]
    return pack_points(cloud.points, cloud.colors)


def scene(seed):
    """A room's points as kernels read them, a panorama of it, and its true pose near the local origin."""
    taken = query(seed)
    return packed(seed), as_panorama(taken.rgb), local(seed, taken.pose)


def view(octree, center_map, config, shown):
    """What is seen around a centre on the cells that are shown."""
    return normalize_view(average_view(octree, center_map, config), center_map, config, shown)


def write_cloud(path, seed, num_points=NUM_POINTS, flip=(1.0, 1.0, 1.0)):
    """A room's points as a PLY, as they are or mirrored; returns its path as text."""
    rows = vertex_rows(points_world(seed, num_points) * flip, room(seed, num_points)[1].colors)
    write_ply(path, rows)
    return str(path)


def write_room(folder, words):
    """A room's files by tools/make_room.py with its options in one string; returns the folder."""
    size = ["--size", *map(str, SIZE)]
    with contextlib.redirect_stdout(io.StringIO()):
        assert make_room.main(["--out", str(folder), *size, "--quiet", *words.split()]) == 0
    return folder
