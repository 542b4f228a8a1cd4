"""Photos and scans that are not as they say: bent panoramas, wrong calibrations, doubled scans."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from piccolo.geometry.pose import Gravity, Pose, yaw_rotation
from piccolo.photo.camera import Calibration, Camera, Mount
from piccolo.system.arrays import Bytes, Floats, Mask

from ..synthetic import world as worlds

Points = tuple[Floats, Bytes]
CUTS = ((0.03, 0.03), (0.08, 0.08), (0.15, 0.15), (0.0, 0.05), (0.12, 0.0))  # of the height, above and below
HORIZONS_DEG = (3.0, -8.0)  # by which rows are moved down
WIDTHS = (0.95, 1.05)  # of the turn that a panorama shows
FOVS_DEG = 45.0, 95.0  # of photos
FOCALS = (0.9, 0.97, 1.03, 1.1)  # times the true one
ASPECTS = (0.94, 1.06)
CENTER = (0.05, -0.03)  # of the picture's width and height, by which the principal point is off
DOUBLED = ((0.02, 0.2), (0.05, 0.5), (0.1, 1.0))  # [m, deg] between two copies of a scan
DIRECTION = np.array([0.78, -0.59, 0.2])  # in which a copy is moved


class Trial(NamedTuple):
    """A photo to be localized."""

    case: str
    rgb: Bytes  # (H, W, 3)
    true_pose: Pose | None  # None if it was not taken in the scan, or not as a camera would
    gravity: Gravity = "auto"
    is_masked: Mask | None = None  # (H, W) what the photo does not show
    focal_px: float | None = None  # of a pinhole photo; None for a sphere, or by a calibration
    calibration: Calibration | None = None


def bend(trial: Trial) -> Iterator[Trial]:
    """Yield a panorama that shows less or more than the sphere, or another horizon, as if it did not."""
    rgb = trial.rgb
    height, width = rgb.shape[:2]

    def change(case: str, part: Bytes) -> Trial:
        resized = cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA)
        return trial._replace(case=case, rgb=np.asarray(resized, np.uint8))

    for above, below in CUTS:
        part = rgb[round(above * height) : height - round(below * height)]
        yield change(f"cut by {above:.0%} above, {below:.0%} below", part)
    for degrees in HORIZONS_DEG:
        yield change(f"moved down by {degrees:g} deg", np.roll(rgb, round(degrees / 180.0 * height), axis=0))
    for share in WIDTHS:
        side = round(0.5 * (share - 1.0) * width)
        turned = np.concatenate([rgb[:, -side:], rgb, rgb[:, :side]], axis=1)
        yield change(f"{share:.0%} of a turn", turned if side > 0 else rgb[:, -side:side])


def miscalibrate(trial: Trial, rng: np.random.Generator) -> Iterator[Trial]:
    """Yield a photo cut out of a panorama, with its calibration and with wrong ones."""
    if trial.true_pose is None:
        return
    photo = worlds.cut_photo(trial.rgb, trial.true_pose, rng.uniform(*FOVS_DEG), rng)
    height, width = photo.rgb.shape[:2]
    focal = photo.focal_px
    x = 0.5 * width
    y = 0.5 * height

    def change(case: str, model: str, *params: float) -> Trial:
        camera = Camera(model, width, height, params)
        return Trial(case, photo.rgb, photo.pose, calibration=Calibration(case, (Mount(camera),)))

    yield change("calibrated", "PINHOLE", focal, focal, x, y)
    for factor in FOCALS:
        yield change(f"focal length x {factor:g}", "PINHOLE", factor * focal, factor * focal, x, y)
    for factor in ASPECTS:
        yield change(f"aspect x {factor:g}", "PINHOLE", focal, factor * focal, x, y)
    right = x + CENTER[0] * width
    down = y + CENTER[1] * height
    yield change("principal point off", "PINHOLE", focal, focal, right, down)
    yield change("as a fisheye", "FISHEYE", focal, focal, x, y)


def double(points: Points, move: float, turn_deg: float, by_sides: bool) -> Points:
    """Turn and move half of a scan's points: every second one, or those on one side of the middle."""
    xyz, colors = points
    is_moved = xyz[:, 0] < np.median(xyz[:, 0]) if by_sides else np.arange(len(xyz)) % 2 == 0
    middle = xyz.mean(axis=0)
    turned = (xyz - middle) @ yaw_rotation(np.radians(turn_deg)).T + middle + move * DIRECTION
    return np.where(is_moved[:, None], turned, xyz), colors


def claim_trials(
    points: Points, spheres: Sequence[Trial], rng: np.random.Generator
) -> Iterator[tuple[Points, list[Trial]]]:
    """Yield a scan with bent panoramas and wrongly calibrated photos, then doubled, with the panoramas."""
    yield points, [one for trial in spheres for one in (*bend(trial), *miscalibrate(trial, rng))]
    for move, turn_deg in DOUBLED:
        for by_sides in (False, True):
            case = f"scan doubled by {move:g} m, {turn_deg:g} deg{', by sides' if by_sides else ''}"
            yield double(points, move, turn_deg, by_sides), [s._replace(case=case) for s in spheres]
