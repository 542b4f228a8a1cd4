"""Recordings of Rerun: points of the scan, and each photo at its pose, on the time line if it has a time.

https://rerun.io/docs/reference/types: a transform takes the camera's coordinates to the world's; camera axes
are right, down, forward, and pixels ours. It computes in 32 bits.
"""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..arrays import Bytes
from ..camera import Camera
from ..camera.model import PERSPECTIVE, Distortion
from ..errors import InputError, import_optional
from ..files.atomic import write_atomically
from ..geometry.pose import OPTICAL_FROM_CAM, turn_axes
from ..panorama.picture import read_picture
from ..views.pictures import encode_image
from .posed_images import Options, PosedImage
from .scan_points import find_points

FARTHEST = 8192.0  # [m] up to which float32 rounds by less than half a millimetre
MAX_WIDTH = 2048  # [px] of a picture
SHOWN = 0.4  # [m] of axes, and of a picture from its camera
POINT = 0.01  # [m]


def write_rerun(images: Sequence[PosedImage], out: Path, options: Options) -> None:
    """Write a recording with `scan`, and `photos/NAME` with `image` below it, a pinhole where it is one."""
    rr = import_optional("Rerun", "rerun", "rerun")
    recording = rr.RecordingStream("piccolo")
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    content = recording.binary_stream()
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    if options.offset is not None:
        recording.log("scan", rr.AnyValues(offset=options.offset), static=True)
    if options.points is not None:
        found = find_points(images, options)
        recording.log("scan", rr.Points3D(found.xyz, colors=found.rgb, radii=POINT), static=True)
    for image in images:
        is_timed = _set_time(recording, image, options)
        place = ["photos", *image.name.split("/")]
        confidence = image.result.confidence
        for part in (*_frame(rr, image), rr.AnyValues(status=image.result.status, confidence=confidence)):
            recording.log(place, part, static=not is_timed)
        for part in _picture(rr, image, options):
            recording.log([*place, "image"], part, static=not is_timed)
    write_atomically(out, content.read())


def check_float32(image: PosedImage) -> None:
    """Refuse a camera so far from the origin that Rerun would round its place."""
    if np.abs(image.pose.center_world).max() > FARTHEST:
        found = f"found a camera at {np.round(image.pose.center_world, 1).tolist()}"
        raise InputError(f"{image.path}: {found}, wanted `offset` X Y Z, as Rerun computes in 32 bits")


def _set_time(recording: Any, image: PosedImage, options: Options) -> bool:
    """Set the time that the photo is logged at: that of `timestamps`, or else EXIF's; False without one."""
    recording.reset_time()
    taken = image.result.source.capture_time
    if options.timestamps != "index":
        recording.set_time("time", duration=float(image.time))
    elif taken is not None:
        moment = datetime.fromisoformat(taken)
        moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
        recording.set_time("taken", timestamp=moment)
    return options.timestamps != "index" or taken is not None


def _frame(rr: Any, image: PosedImage) -> list[Any]:
    """Return the camera's place, its axes, and a point with its name."""
    pose = turn_axes(image.pose, OPTICAL_FROM_CAM)
    transform = rr.Transform3D(translation=pose.center_world, mat3x3=pose.R_cam_from_world.T)
    label = rr.Points3D([[0.0, 0.0, 0.0]], labels=[image.name], show_labels=False, radii=2.0 * POINT)
    return [transform, rr.TransformAxes3D(SHOWN), label]


def _picture(rr: Any, image: PosedImage, options: Options) -> list[Any]:
    """Return the pinhole without distortion, if there is one, and the picture, unless `size` replaces it."""
    parts = []
    camera = image.camera
    is_pinhole = camera is not None and camera.lens == PERSPECTIVE
    rgb = None if options.size else read_picture(image.path).rgb
    if camera is not None and is_pinhole:
        camera = camera.scale_to_width(min(camera.width, MAX_WIDTH))
        size = camera.width, camera.height
        wide = {"focal_length": camera.focal, "principal_point": camera.center, "resolution": size}
        parts.append(rr.Pinhole(**wide, image_plane_distance=SHOWN))
    elif rgb is not None:
        width = min(rgb.shape[1], MAX_WIDTH)
        size = width, max(1, round(width * rgb.shape[0] / rgb.shape[1]))
    if rgb is not None:
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
        rgb = _undistort(rgb, camera) if camera is not None and is_pinhole else rgb
        parts.append(rr.EncodedImage(contents=encode_image(rgb, ".jpg"), media_type="image/jpeg"))
    return parts


def _undistort(rgb: Bytes, camera: Camera) -> Bytes:
    """Return a camera's picture as a pinhole of its focal length takes it, black where it shows nothing."""
    if camera.distortion == Distortion():
        return rgb
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    x, y = (
        (pixels - middle) / f for pixels, middle, f in zip((u, v), camera.center, camera.focal, strict=True)
    )
    places, is_in = camera.pixels(np.stack([np.ones_like(x), -x, -y], axis=-1))
    columns, rows = np.moveaxis(places.astype(np.float32) - np.float32(0.5), -1, 0)
    found = np.asarray(cv2.remap(rgb, columns, rows, cv2.INTER_LINEAR), np.uint8)
    found[~is_in] = 0
    return found
