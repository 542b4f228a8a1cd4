"""The pictures of a report: of each photo, and the plans of storeys.

A photo has a thumbnail, its sphere, the scan from its pose, and what of it contradicts the scan. It may be a
frame of a video, as results of localize.py --video name them: these are taken out. A plan is the scan from
above, cut below the ceiling; or an image of the user's own, put into the scan by points that are
known in both.
"""

import base64
import csv
import json
import math
import re
import zlib
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from ...api.values import AMBIGUOUS, Result, photo_of
from ...evidence.occlusion import occlusion_mask
from ...geometry.colors import unpack_rgb
from ...geometry.points import PackedPoints
from ...geometry.pose import Pose, yaw_rotation
from ...photo.camera.model import pinhole
from ...photo.panorama import Panorama, read_panorama
from ...photo.panorama.panorama import shrink
from ...photo.panorama.picture import encode_image, read_picture
from ...photo.panorama.video import frames_at
from ...scan_map.scan_map import ScanMap
from ...system.arrays import Array, Array32, Bytes, Int64s, Mask
from ...system.errors import InputError
from ...system.files.atomic import temporary_folder
from ...system.files.json_file import read_text
from ...system.jobs.threads import Workers
from ...views.pictures import cut, fill_holes
from ...views.surfels import Surfels, render_surfels, visible_indices
from ...views.zbuffer import View

PICTURE_QUALITY = 80  # of JPEG
THUMB_QUALITY = 78
THUMB_SIZE = (256, 160)
THUMB_FOV_DEG = 100.0
SHOWN_MASK_WIDTH = 1024  # [px]
SCAN_WIDTH = 1024  # [px] surfels are hardly finer
DEPTH_FROM = 0.05  # [m]
DEPTH_TO = 1e5  # [m]
DEPTH_STEP = 0.001  # of a range, to the next that the page can tell from it
LEAST_PROBABILITY = 0.02  # of alternatives from which the scan is drawn
MAX_SHOWN_ALTERNATIVES = 3
MAX_SPHERE_PICTURE = 8192  # [px] of a sphere at full size
NOT_SCANNED_GAP = 0.004  # by the width: wider gaps are marked as not scanned
UNSCANNED = np.array([96, 100, 106], np.float32)
FRAME = re.compile(r"(?P<video>.+)#t=(?P<time>\d+\.\d{3})", re.DOTALL)
# of plans
CUT = 1.9  # [m] above the floor: below ceilings and lintels, above most furniture
BELOW_FLOOR = 0.4  # [m] that still belongs to the storey: steps, ramps
CAMERA_REACH = 5.0  # [m] around the places of a camera that is drawn
PIXEL = 0.02  # [m] of a plan, or more if it would be larger than
MAX_PLAN_SIDE = 3072  # [px]
PLAN_MARGIN = 0.5  # [m] around what is drawn
FLOOR_CELL = 0.5  # [m] on which the height of the floor is looked up
WALL_FROM = 0.6  # [m] above the floor
WALL_BINS = 13  # what fills most of these is a wall
WALL_BIN = 0.1  # [m]
WALL_FILLED = 8  # bins
WALL_COLOR = (52, 60, 72)
HOLE_COLOR = (150, 158, 168)  # of gaps in a floor
HOLE_ALPHA = 90
LARGEST_HOLE = 12.0  # [m2]
PALENESS = 0.25  # of the colours, so that what is drawn on them is seen
PLAN_GAP = 13  # [px] that is closed
SHADOW = 0.35  # of walls on the floor: strength
SHADOW_WIDTH = 0.25  # [m]
COLUMNS = ("u", "v", "x", "y")
WANTED = "wanted a CSV file with the columns u, v [px] and x, y [m], and two rows or more"
MAX_OWN_SIDE = 4096  # [px]
LEAST_CONTROL_SPREAD = 1e-6  # of the control points, by their distance: less is one point, or a line of three


def make_pictures(
    photo: Path, result: Result, poses: list[Pose], scan: tuple[Surfels, PackedPoints], width: int | None
) -> tuple[bytes, str]:
    """Return the thumbnail of a photo, JPEG, and the JSON of its other pictures.

    Spheres are at most `width` px wide, None for the photo's own size. Without a pose there is no scan.
    """
    panorama = read_panorama(photo_of(result, photo))
    surfels, points = scan
    full = min(panorama.rgb.shape[1], width or MAX_SPHERE_PICTURE)
    small = shrink(panorama, full)
    document: dict[str, Any] = {"sphere": _base64(encode_image(small.rgb, ".jpg", PICTURE_QUALITY))}
    if poses:
        view_width = min(full, SCAN_WIDTH) & ~1
        view = scan_view(surfels, poses[0], view_width)
        document["scan"] = _base64(scan_picture(view))
        document["depth"] = _base64(pack_depth(view.depth))
        mask = occlusion_mask(points, shrink(panorama, SHOWN_MASK_WIDTH), poses[0])
        document["mask"] = _base64(encode_image(mask, ".png"))
        document["alternatives"] = [
            _base64(scan_picture(scan_view(surfels, pose, view_width))) if is_shown else None
            for pose, is_shown in zip(poses[1:], _shown(result), strict=True)
        ]
    return make_thumbnail(small, poses[0] if poses else None), json.dumps(document)


def _shown(result: Result) -> list[bool]:
    """Which alternatives are worth a picture."""
    most = MAX_SHOWN_ALTERNATIVES if result.status == AMBIGUOUS else 0
    shares = [other.probability for other in result.alternatives]
    return [share >= LEAST_PROBABILITY and k < most for k, share in enumerate(shares)]


def scan_view(surfels: Surfels, pose: Pose, width: int) -> View:
    """Return what the scan shows from a pose of its frame."""
    visible = surfels.take(visible_indices(surfels.points, pose.center_world))
    return render_surfels(visible, pose, width, Workers())


def scan_picture(view: View) -> bytes:
    """JPEG of a view; grey where nothing was scanned."""
    rgb = fill_holes(view.rgb, view.is_seen)
    return encode_image(_grey_where_unscanned(rgb, view.is_seen), ".jpg", PICTURE_QUALITY)


def pack_depth(depth: Array32) -> bytes:
    """Return the ranges (H, W) [m] of a view, inf for nothing scanned, as the page's pictures.ts reads them.

    Codes are 1 + log(range / DEPTH_FROM) / DEPTH_STEP in 16 bits, 0 for nothing; kept are their differences
    along columns, then rows, even ones for positive, in two planes of bytes (high, low), by zlib.
    """
    codes = 1.0 + np.log(np.clip(depth, DEPTH_FROM, DEPTH_TO) / DEPTH_FROM) / DEPTH_STEP
    whole = np.where(np.isfinite(depth), np.rint(codes), 0.0).astype(np.int32)
    steps = np.diff(np.diff(whole, axis=0, prepend=0), axis=1, prepend=0)
    folded = np.where(steps < 0, -2 * steps - 1, 2 * steps).astype(">u2")
    return zlib.compress(np.moveaxis(folded.view(np.uint8).reshape(*depth.shape, 2), 2, 0).tobytes())


def _grey_where_unscanned(rgb: Bytes, is_seen: Mask) -> Bytes:
    """Return a sphere (H, W, 3) whose larger gaps (H, W) are dimmed towards grey."""
    size = 2 * math.ceil(NOT_SCANNED_GAP * rgb.shape[1]) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    seen = np.pad(is_seen.view(np.uint8), ((0, 0), (size, size)), mode="wrap")
    closed = cv2.morphologyEx(seen, cv2.MORPH_CLOSE, disc)[:, size:-size]
    if closed.all():
        return rgb
    weight = (np.float32(0.75) * (closed == 0))[..., None]
    return np.asarray(rgb + weight * (UNSCANNED - rgb), np.uint8)


def make_thumbnail(panorama: Panorama, pose: Pose | None) -> bytes:
    """JPEG of what lies ahead of the camera; level if the pose is known."""
    width, height = THUMB_SIZE
    camera = pinhole(width, height, 0.5 * width / math.tan(math.radians(0.5 * THUMB_FOV_DEG)))
    R_lens_from_cam = np.eye(3) if pose is None else level_lens(pose.R_cam_from_world)
    small = shrink(panorama, 4 * width)
    return encode_image(cut(small.rgb, camera, R_lens_from_cam), ".jpg", THUMB_QUALITY)


def level_lens(R_cam_from_world: Array) -> Array:
    """R_lens_from_cam (3, 3) of a level lens that looks where the image centre does."""
    yaw = math.atan2(R_cam_from_world[0, 1], R_cam_from_world[0, 0])
    return np.asarray(yaw_rotation(yaw) @ R_cam_from_world.T)


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()


@contextmanager
def extract_frames(photos: Sequence[Path]) -> Iterator[dict[Path, Path]]:
    """Files of those photos that are frames of a video, until the end; of others none.

    A video that can't be read has none either: its frames are then photos that are not there.
    """
    by_video: dict[Path, dict[int, Path]] = defaultdict(dict)
    for photo in photos:
        if found := FRAME.fullmatch(str(photo)):
            by_video[Path(found["video"])][round(1000.0 * float(found["time"]))] = photo
    with temporary_folder() as folder:
        files: dict[Path, Path] = {}
        for number, (video, frames) in enumerate(by_video.items()):
            own = folder / str(number)
            own.mkdir()
            try:
                for frame in frames_at(video, [time / 1000.0 for time in frames], own):
                    files[frames[round(1000.0 * frame.time)]] = frame.path
            except (OSError, InputError):
                continue
        yield files


class PlanImage(NamedTuple):
    """A plan in pixels."""

    pixels: Bytes  # (H, W, 4) RGBA, transparent where nothing is; or (H, W, 3)
    # a, b, c, d, e, f of x = a u + c v + e, y = b u + d v + f [m, map], of pixels (u, v)
    matrix: tuple[float, ...]


def draw_plan(points: PackedPoints, places: Array, floors: Array) -> PlanImage | None:
    """Return the plan of a storey of a map's points.

    Around the places (P, 3) [m] in it where a camera can be, above each of which the floor is at `floors`
    (P,) [m]. None if nothing is there.
    """
    shown = _of_storey(points, places, floors) if len(places) else None
    if shown is None:
        return None
    x, y, above, rgb = shown
    width = np.ptp(x) + 2 * PLAN_MARGIN
    height = np.ptp(y) + 2 * PLAN_MARGIN
    pixel = max(PIXEL, float(max(width, height)) / MAX_PLAN_SIDE)
    left = float(x.min()) - PLAN_MARGIN
    top = float(y.max()) + PLAN_MARGIN
    columns = ((x - left) / pixel).astype(np.int64)
    rows = ((top - y) / pixel).astype(np.int64)
    shape = math.ceil(height / pixel), math.ceil(width / pixel)
    painted = _paint(columns, rows, above, rgb, shape, pixel)
    return PlanImage(painted, (pixel, 0.0, 0.0, -pixel, left, top))


def _of_storey(
    points: PackedPoints, places: Array, floors: Array
) -> tuple[Array, Array, Array, Bytes] | None:
    """X, y and height above the floor [m] of a storey's points below the cut, and their colours (N, 3)."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  # who draws no plan need not wait for it

    low = places[:, :2].min(axis=0) - CAMERA_REACH
    high = places[:, :2].max(axis=0) + CAMERA_REACH
    count = np.ceil((high - low) / FLOOR_CELL).astype(np.int64) + 1
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in count), indexing="ij"), axis=-1).reshape(-1, 2)
    distance, nearest = cKDTree(places[:, :2]).query(low + (grid + 0.5) * FLOOR_CELL)
    floor = np.where(distance < CAMERA_REACH, floors[nearest], np.inf).reshape(count)
    cells = np.stack([(points.x - low[0]) / FLOOR_CELL, (points.y - low[1]) / FLOOR_CELL]).astype(np.int64)
    is_inside = ((cells >= 0) & (cells < count[:, None])).all(axis=0)
    above = np.full(len(points), np.inf)
    above[is_inside] = points.z[is_inside] - floor[tuple(cells[:, is_inside])]
    kept = np.flatnonzero((above > -BELOW_FLOOR) & (above < CUT))
    if not len(kept):
        return None
    x, y = points.x[kept].astype(np.float64), points.y[kept].astype(np.float64)
    return x, y, above[kept], unpack_rgb(points.rgbx[kept])


def _paint(
    columns: Int64s, rows: Int64s, above: Array, rgb: Bytes, shape: tuple[int, int], pixel: float
) -> Bytes:
    """Return the picture (H, W, 4): the highest points below the cut, gaps closed, walls with shadows."""
    order = np.argsort(above, kind="stable")  # what is higher is written later
    color = np.zeros((*shape, 3), np.uint8)
    is_seen = np.zeros(shape, np.bool_)
    color[rows[order], columns[order]] = rgb[order]
    is_seen[rows, columns] = True
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (PLAN_GAP, PLAN_GAP))
    is_drawn = cv2.morphologyEx(is_seen.view(np.uint8), cv2.MORPH_CLOSE, disc) > 0
    filled = cv2.medianBlur(fill_holes(color, is_seen), 3).astype(np.float32)
    filled += (np.float32(255.0) - filled) * np.float32(PALENESS)
    is_wall = _walls(columns, rows, above, shape)
    shadow = cv2.GaussianBlur(is_wall.astype(np.float32), (0, 0), SHADOW_WIDTH / pixel)
    filled *= (np.float32(1.0) - np.float32(SHADOW) * np.minimum(2.0 * shadow, 1.0))[..., None]
    filled[is_wall] = WALL_COLOR
    is_hole = _holes(is_drawn | is_wall, pixel)
    filled[is_hole] = HOLE_COLOR
    alpha = np.where(is_drawn | is_wall, 255, np.where(is_hole, HOLE_ALPHA, 0)).astype(np.uint8)
    smooth = cv2.GaussianBlur(alpha, (3, 3), 0)
    return np.dstack([np.rint(filled).astype(np.uint8), np.where(is_wall, 255, smooth)])


def _holes(is_drawn: Mask, pixel: float) -> Mask:
    """(H, W), true in gaps that what is drawn encloses: floor that no scanner saw."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~is_drawn).astype(np.uint8), connectivity=4)
    is_hole = stats[:, cv2.CC_STAT_AREA] * pixel**2 < LARGEST_HOLE
    is_hole &= (stats[:, cv2.CC_STAT_LEFT] > 0) & (stats[:, cv2.CC_STAT_TOP] > 0)
    is_hole[0] = False  # what is drawn
    return np.asarray(is_hole[labels])


def _walls(columns: Int64s, rows: Int64s, above: Array, shape: tuple[int, int]) -> Mask:
    """(H, W), true where most heights of a person are filled, small gaps closed."""
    bins = np.floor((above - WALL_FROM) / WALL_BIN).astype(np.int64)
    is_in = (bins >= 0) & (bins < WALL_BINS)
    filled = np.zeros((WALL_BINS, *shape), np.uint8)
    filled[bins[is_in], rows[is_in], columns[is_in]] = 1
    square = np.ones((3, 3), np.uint8)
    count = np.zeros(shape, np.uint8)
    for level in filled:
        count += np.asarray(cv2.dilate(level, square), np.uint8)
    is_wall = cv2.erode((count >= WALL_FILLED).astype(np.uint8), square)
    closed = cv2.morphologyEx(is_wall, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    return np.asarray(cv2.dilate(closed, square) > 0)


def read_control_points(path: Path) -> Array:
    """Rows u, v [px], x, y [m, world] (N, 4) of a CSV file."""
    rows = csv.DictReader(read_text(path, WANTED).splitlines())
    names = [name.strip() for name in rows.fieldnames or ()]
    rows.fieldnames = names
    if set(COLUMNS) - set(names):
        raise InputError(f"{path}: found the columns {names}, {WANTED}")
    try:
        points = np.array([[float(row[name]) for name in COLUMNS] for row in rows])
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: found {error}, {WANTED}") from error
    if len(points) < 2 or not np.isfinite(points).all():
        raise InputError(f"{path}: found {len(points)} control points, {WANTED}")
    return points


def plan_matrix(pixels: Array, places: Array) -> tuple[float, ...]:
    """Return a, b, c, d, e, f of x = a u + c v + e, y = b u + d v + f.

    Of pixels (N, 2), v downwards, and places (N, 2) [m]: two points give a turn and a scale, more any affine
    map by least squares. InputError if they lie in one point or, more than two, on one line.
    """
    centred = pixels - pixels.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False)
    rank = 1 if len(pixels) == 2 else 2
    if spread[rank - 1] <= LEAST_CONTROL_SPREAD * max(spread[0], 1.0):
        raise InputError("control points: found them in one point or on one line, wanted them far apart")
    if rank == 1:
        z, w = (complex(*(pair[1] - pair[0])) for pair in (pixels * np.array([1.0, -1.0]), places))
        turn = w / z
        a = turn.real
        b = turn.imag
        linear = np.array([[a, b], [b, -a]])  # v points down
    else:
        linear = np.linalg.lstsq(centred, places - places.mean(axis=0), rcond=None)[0].T
    shift = places.mean(axis=0) - linear @ pixels.mean(axis=0)
    return (*linear.T.ravel().tolist(), *shift.tolist())


def own_plan(image: Path, control_points: Path, scan_map: ScanMap) -> PlanImage:
    """Return the user's plan, an image and a CSV file, in the map's frame."""
    points = read_control_points(control_points)
    world = np.column_stack([points[:, 2:], np.full(len(points), scan_map.origin_world[2])])
    places = ((world - scan_map.origin_world) @ scan_map.R_map_from_world.T)[:, :2]
    rgb: Bytes = read_picture(image).rgb
    scale = min(1.0, MAX_OWN_SIDE / max(rgb.shape[:2]))
    size = math.ceil(rgb.shape[1] * scale), math.ceil(rgb.shape[0] * scale)
    if scale < 1.0:
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
    try:
        return PlanImage(rgb, plan_matrix(points[:, :2] * scale, places))
    except InputError as error:
        raise InputError(f"{control_points}: {error}") from error
