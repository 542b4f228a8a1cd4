"""The pictures of a photo: thumbnail, sphere, the scan from its pose, and what of it contradicts the scan.

Photos may be frames of a video, as results of localize.py --video name them: these are taken out.
"""

import base64
import json
import math
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..arrays import Array, Bytes, Mask
from ..camera.model import pinhole
from ..cloud.soa import PackedPoints
from ..confidence.confidence import AMBIGUOUS
from ..confidence.occlusion import occlusion_mask
from ..errors import InputError
from ..files.temporary import temporary_folder
from ..geometry.pose import Pose, yaw_rotation
from ..jobs.threads import Workers
from ..opened_scan import labels_of, photo_of
from ..panorama import Panorama, read_panorama
from ..panorama.model import shrink
from ..panorama.video import frames_at
from ..result import Result
from ..views.pictures import cut, encode_image, fill_holes
from ..views.surfels import Surfels, render_surfels, visible_indices
from ..views.zbuffer import View

QUALITY = 80  # of JPEG
THUMB_QUALITY = 78
THUMB_SIZE = (256, 160)
THUMB_FOV_DEG = 100.0
MASK_WIDTH = 1024  # [px]
SCAN_WIDTH = 1536  # [px] a voxel of the map is wider than a pixel
ALTERNATIVE_WIDTH = 1024  # [px]
REACH_SIZE = (96, 48)  # [px]
LEAST_PROBABILITY = 0.02  # of alternatives from which the scan is drawn
MAX_ALTERNATIVES = 3
MAX_WIDTH = 8192  # [px] of a sphere at full size
GAP = 0.004  # by the width: wider gaps are marked as not scanned
UNSCANNED = np.array([96, 100, 106], np.float32)
FRAME = re.compile(r"(?P<video>.+)#t=(?P<time>\d+\.\d{3})", re.DOTALL)


def make_pictures(
    photo: Path, result: Result, poses: list[Pose], scan: tuple[Surfels, PackedPoints], width: int | None
) -> tuple[bytes, str]:
    """Return the thumbnail of a photo, JPEG, and the JSON of its other pictures.

    Spheres are at most `width` px wide, None for the photo's own size. Without a pose there is no scan.
    """
    panorama = read_panorama(photo_of(result, photo), labels_of(result))
    surfels, points = scan
    full = min(panorama.rgb.shape[1], width or MAX_WIDTH)
    small = shrink(panorama, full)
    document: dict[str, Any] = {"sphere": _base64(encode_image(small.rgb, ".jpg", QUALITY))}
    if poses:
        view_width = min(full, SCAN_WIDTH) & ~1
        view = scan_view(surfels, poses[0], view_width)
        document["scan"] = _base64(scan_picture(view))
        document["reach"] = _base64(measure_reach(view).tobytes())
        mask = occlusion_mask(points, shrink(panorama, MASK_WIDTH), poses[0])
        document["mask"] = _base64(encode_image(mask, ".png"))
        document["alternatives"] = [
            _base64(scan_picture(scan_view(surfels, pose, ALTERNATIVE_WIDTH))) if is_shown else None
            for pose, is_shown in zip(poses[1:], _shown(result), strict=True)
        ]
    return make_thumbnail(small, poses[0] if poses else None), json.dumps(document)


def _shown(result: Result) -> list[bool]:
    """Which alternatives are worth a picture."""
    most = MAX_ALTERNATIVES if result.status == AMBIGUOUS else 0
    shares = [other.probability or 0.0 for other in result.alternatives]
    return [share >= LEAST_PROBABILITY and k < most for k, share in enumerate(shares)]


def scan_view(surfels: Surfels, pose: Pose, width: int) -> View:
    """Return what the scan shows from a pose of its frame."""
    visible = surfels.take(visible_indices(surfels.points, pose.center_world))
    return render_surfels(visible, pose, width, Workers())


def measure_reach(view: View) -> Bytes:
    """Return the range (h, w) of a small sphere [0.1 m]; 255 for 25.5 m and more, or nothing scanned."""
    tenths = np.minimum(10.0 * view.depth, 255.0).astype(np.uint8)
    return np.asarray(cv2.resize(tenths, REACH_SIZE, interpolation=cv2.INTER_AREA), np.uint8)


def scan_picture(view: View) -> bytes:
    """JPEG of a view; grey where nothing was scanned."""
    rgb = fill_holes(view.rgb, view.is_seen)
    return encode_image(_grey_where_unscanned(rgb, view.is_seen), ".jpg", QUALITY)


def _grey_where_unscanned(rgb: Bytes, is_seen: Mask) -> Bytes:
    """Return a sphere (H, W, 3) whose larger gaps (H, W) are dimmed towards grey."""
    size = 2 * math.ceil(GAP * rgb.shape[1]) + 1
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
    R_lens_from_cam = np.eye(3) if pose is None else level(pose.R_cam_from_world)
    small = shrink(panorama, 4 * width)
    return encode_image(cut(small.rgb, camera, R_lens_from_cam), ".jpg", THUMB_QUALITY)


def level(R_cam_from_world: Array) -> Array:
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
