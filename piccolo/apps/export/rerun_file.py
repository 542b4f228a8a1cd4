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

from ...geometry.pose import OPTICAL_FROM_CAM, turn_axes
from ...photo.camera import Camera
from ...photo.camera.model import PERSPECTIVE, Distortion
from ...photo.panorama.picture import encode_image, read_picture
from ...system.arrays import Bytes
from ...system.errors import InputError, import_optional
from ...system.files.atomic import write_atomically
from .posed_images import Options, PosedImage
from .scan_points import find_points

FARTHEST_SHOWN = 8192.0  # [m] up to which float32 rounds by less than half a millimetre
MAX_RERUN_WIDTH = 2048  # [px] of a picture
SHOWN_AXES = 0.4  # [m] of axes, and of a picture from its camera
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
        pose = turn_axes(image.pose, OPTICAL_FROM_CAM)
        transform = rr.Transform3D(translation=pose.center_world, mat3x3=pose.R_cam_from_world.T)
        result = image.result
        sure = rr.AnyValues(
            status=result.status,
            confidence=result.confidence,
            place_probability=result.place_probability,
        )
        place = ["photos", *image.name.split("/")]
        recording.log(place, transform, rr.TransformAxes3D(SHOWN_AXES), sure, static=not is_timed)
        for part in _picture(rr, image, options):
            recording.log([*place, "image"], part, static=not is_timed)
    write_atomically(out, content.read())


def check_float32(image: PosedImage) -> None:
    """Refuse a camera so far from the origin that Rerun would round its place."""
    if np.abs(image.pose.center_world).max() > FARTHEST_SHOWN:
        found = f"found a camera at {np.round(image.pose.center_world, 1).tolist()}"
        raise InputError(f"{image.path}: {found}, wanted `offset` X Y Z, as Rerun computes in 32 bits")


def _set_time(recording: Any, image: PosedImage, options: Options) -> bool:
    """Set the time that the photo is logged at: that of `timestamps`, or else EXIF's; False without one."""
    recording.reset_time()
    taken = image.result.source.capture_time
    if options.timestamps != "index":
        recording.set_time("time", duration=float(image.time))
        return True
    if taken is not None:
        time = datetime.fromisoformat(taken)
        recording.set_time("taken", timestamp=time if time.tzinfo else time.replace(tzinfo=UTC))
    return taken is not None


def _picture(rr: Any, image: PosedImage, options: Options) -> list[Any]:
    """Return the pinhole, if the lens is one, and the picture as it takes it; with `size` none is opened."""
    lens = image.lens.scale_to_width(min(image.lens.width, MAX_RERUN_WIDTH))
    size = lens.width, lens.height
    parts = []
    if lens.lens == PERSPECTIVE:
        own = {"focal_length": lens.focal, "principal_point": lens.center, "resolution": size}
        parts.append(rr.Pinhole(**own, image_plane_distance=SHOWN_AXES))
    if options.size is None:
        rgb = cv2.resize(read_picture(image.path).rgb, size, interpolation=cv2.INTER_AREA)
        content = encode_image(_undistort(np.asarray(rgb, np.uint8), lens), ".jpg")
        parts.append(rr.EncodedImage(contents=content, media_type="image/jpeg"))
    return parts


def _undistort(rgb: Bytes, lens: Camera) -> Bytes:
    """Return a picture as a pinhole takes it, black where the lens shows nothing; of other lenses itself."""
    if lens.lens != PERSPECTIVE or lens.distortion == Distortion():
        return rgb
    ideal = Camera("PINHOLE", lens.width, lens.height, (*lens.focal, *lens.center))
    grid = np.stack(np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5), axis=-1)
    places, is_in = lens.pixels(ideal.rays(grid)[0])
    columns, rows = np.moveaxis(places.astype(np.float32) - np.float32(0.5), -1, 0)
    found = np.asarray(cv2.remap(rgb, columns, rows, cv2.INTER_LINEAR), np.uint8)
    found[~is_in] = 0
    return found
