"""Masks: from a picture file, of the cap around a pole, and of borders and patches found in the picture.

Black borders and patches over the nadir or zenith are masked; pictures of two fisheyes are recognised. Each
rule is narrow, as wrongly masked pixels are lost. The thresholds were set by hand, with a distance to both
sides: tests/test_panorama_masks.py has rooms in which nothing may be masked, and patches that must be found.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ...system.arguments import PICTURES
from ...system.arrays import Array32, Bytes, Int64s, Mask
from ...system.errors import InputError
from .gpano import ASPECT_TOLERANCE
from .picture import read_picture

NEAR_BLACK = 8  # [levels] of a border's pixels, at most
BLACK_LEVEL = 2  # [levels] of most of them, at most
MIN_FULL_EDGE = 0.99  # of a full sphere's edge that is black: a row at a pole is one point, the seam one line
MIN_CROP_EDGE = 1.0 / 64.0  # of a crop's edge that is black: its borders may be ragged
MIN_PURE = 0.95  # of a border's pixels that are BLACK_LEVEL or less
RIM = 8  # [px] by which JPEG blurs a border's edge: a block
ROWS_AT_ONCE = 64

DISC_WIDTH = 720  # [px] at which discs are searched: rows of half a degree; not in smaller pictures
ROWS_PER_DEG = DISC_WIDTH / 360.0
NUM_ROWS = round(45.0 * ROWS_PER_DEG)  # around a pole, in which discs are searched
# numbers of rows inside a disc, largest first: half angles of 40 to 3 deg
CANDIDATES = range(round(40.0 * ROWS_PER_DEG), round(3.0 * ROWS_PER_DEG) - 1, -1)
MIN_STEP = 12.0  # [levels] between inside and outside of a disc's edge
MIN_EDGE_FRACTION = 0.9  # of the columns that have such a step at the edge
MAX_CALM_FRACTION = 0.5  # of the columns that have one in the rows near the edge, at most
NUM_SECTORS = 16
DETAIL_DEG = 0.5  # over which detail is measured
MIN_DETAIL = 4.0  # [levels] of detail around a disc that has none
MIN_DETAIL_RATIO = 5.0  # of detail outside to detail inside
NEAR_ROWS = round(2.0 * ROWS_PER_DEG)  # on each side of a disc's edge, in which detail is compared
# Set by hand, between the circles and the panoramas of tests/test_panorama_masks.py.
FISHEYE_SIZE = 128  # [px] of each half, for the test
FISHEYE_BLACK = 24  # [levels] of the pixels around the circles, at most: they have some noise
MIN_BLACK_OUTSIDE = 0.98  # of the pixels around the circles
MIN_BRIGHT_INSIDE = 0.7  # of the pixels in each sector of a ring within the circle
FISHEYE_SECTORS = 8
MIN_ALIKE = 0.9  # correlation of the pictures of two eyes, without the mean of each row
MIN_MASK = (16, 8)  # [px] width and height of a mask's picture
WHITE_LEVEL = 128  # [levels] a mask's pixel is white from here on


def black_borders(rgb: Bytes, is_valid: Mask, is_full: bool) -> Mask | None:
    """Return the mask (H, W) of the black borders of a picture; None if there are none.

    A border begins at an edge of the picture that is near black and valid, and goes inwards up to the first
    pixel that is not near black. In a full sphere the whole edge must be black (a pole is one point, the seam
    one line), in a crop a part of it. 95 % of a border's pixels, except for a rim of 8 pixels, must be black
    within two levels: shadows have more noise.
    """
    if rgb[0].max() <= BLACK_LEVEL and rgb.max() <= BLACK_LEVEL:
        return np.ones(is_valid.shape, dtype=np.bool_)
    min_fraction = MIN_FULL_EDGE if is_full else MIN_CROP_EDGE
    is_border = np.zeros(is_valid.shape, dtype=np.bool_)
    for axis in (0, 1):
        for step in (1, -1):
            inwards = rgb.swapaxes(0, axis)[::step]
            is_black = (inwards[0].max(axis=1) <= NEAR_BLACK) & is_valid.swapaxes(0, axis)[::step][0]
            if is_black.mean() < min_fraction:
                continue
            depth = _depth_of_black(inwards, is_black)
            core = np.maximum(_filter_depths(cv2.erode, depth) - RIM, 0)
            if _black_fraction(inwards, core if core.any() else depth) >= MIN_PURE:
                depth = np.where(depth > 0, depth + RIM, 0)
                border = is_border.swapaxes(0, axis)[::step][: depth.max()]
                border |= np.arange(len(border))[:, None] < _filter_depths(cv2.dilate, depth)
    return is_border if is_border.any() else None


def _filter_depths(which: Callable[..., Any], depth: Int64s) -> Int64s:
    """Return the least (cv2.erode) or largest (cv2.dilate) of the depths (columns,) within RIM of each."""
    column = depth[:, None].astype(np.float32)  # exact, as the whole numbers are small
    return np.asarray(which(column, np.ones((2 * RIM + 1, 1), np.uint8))[:, 0], np.int64)


def _depth_of_black(inwards: Bytes, is_black: Mask) -> Int64s:
    """Return the number (columns,) of near black pixels inwards from the edge (row 0), where it is black."""
    depth = np.zeros(len(is_black), dtype=np.int64)
    for begin in range(0, len(inwards), ROWS_AT_ONCE):
        band = np.ascontiguousarray(inwards[begin : begin + ROWS_AT_ONCE])
        is_near_black = cv2.inRange(band, (0, 0, 0), (NEAR_BLACK,) * 3) > 0
        run = np.where(is_near_black.all(axis=0), len(band), is_near_black.argmin(axis=0))
        depth += run * is_black
        is_black = is_black & (run == len(band))
        if not is_black.any():
            break
    return depth


def _black_fraction(inwards: Bytes, depth: Int64s) -> float:
    """Return the fraction of BLACK_LEVEL pixels among those within `depth` (columns,) of the edge."""
    num_black = 0
    for begin in range(0, int(depth.max()), ROWS_AT_ONCE):
        band = np.ascontiguousarray(inwards[begin : begin + ROWS_AT_ONCE])
        is_within = np.arange(begin, begin + len(band))[:, None] < depth
        num_black += int(((cv2.inRange(band, (0, 0, 0), (BLACK_LEVEL,) * 3) > 0) & is_within).sum())
    return num_black / float(depth.sum())


def polar_disc(rgb: Bytes, is_valid: Mask, pole: str) -> float:
    """Return the half angle [deg] of a disc over the `pole` of a full sphere; 0 if there is none.

    The pole is zenith or nadir. The disc's border is a circle of latitude that is an edge in 90 % of all
    directions while the rows near it are not (a logo, a plain colour), or at which all detail ends in every
    direction (a blur). Scenes have no such circles, except by round things directly over or under the camera,
    such as its own stand.
    """
    num_rows = round(NUM_ROWS / DISC_WIDTH * rgb.shape[1])
    rows = slice(num_rows) if pole == "zenith" else slice(-num_rows, None)
    if rgb.shape[1] < DISC_WIDTH or not is_valid[rows].all():
        return 0.0
    cap = cv2.resize(rgb[rows], (DISC_WIDTH, NUM_ROWS), interpolation=cv2.INTER_AREA).astype(np.float32)
    cap = cap if pole == "zenith" else cap[::-1]
    num_inside = max(_edge_circle(cap), _detail_circle(cap))
    return (num_inside + 1) / ROWS_PER_DEG if num_inside else 0.0


def _edge_circle(cap: Array32) -> int:
    """Return the number of rows from the pole (row 0) to the outermost circle that is an edge, or 0."""
    pairs = (cap[1:] + cap[:-1]) / 2.0
    is_step = (cv2.absdiff(pairs[2:], pairs[:-2]) > MIN_STEP) @ np.ones(3, np.bool_)
    fraction = np.concatenate([[0.0, 0.0], is_step.mean(axis=1)])  # fraction[k]: k rows are inside
    for k in CANDIDATES:
        near = np.concatenate([fraction[max(k - 8, 0) : k - 2], fraction[k + 3 : k + 9]])
        if fraction[k] >= MIN_EDGE_FRACTION and np.median(near) <= MAX_CALM_FRACTION:
            return k
    return 0


@lru_cache(maxsize=1)
def _neighbors_around() -> tuple[Int64s, Int64s]:
    """Return flat indices (NUM_ROWS, DISC_WIDTH) of the pixels DETAIL_DEG east and west of each."""
    around = np.sin(np.radians((np.arange(NUM_ROWS) + 0.5) / ROWS_PER_DEG))
    spacing = np.clip(np.round(DETAIL_DEG * ROWS_PER_DEG / around), 1, DISC_WIDTH // 8).astype(int)
    rows = np.arange(NUM_ROWS)[:, None]
    columns = np.arange(DISC_WIDTH)
    east, west = ((columns + sign * spacing[:, None]) % DISC_WIDTH for sign in (1, -1))
    return rows * DISC_WIDTH + east, rows * DISC_WIDTH + west


def _detail_circle(cap: Array32) -> int:
    """Return the number of rows from the pole (row 0) to the outermost circle where all detail ends, or 0."""
    grey = cv2.transform(cap, np.full((1, 3), 1.0 / 3.0))
    east, west = _neighbors_around()
    second = grey.ravel()[east] + grey.ravel()[west] - 2.0 * grey
    detail = np.abs(second).reshape(NUM_ROWS, NUM_SECTORS, -1).mean(axis=2)
    ends = np.cumsum(np.concatenate([np.zeros((1, NUM_SECTORS)), detail]), axis=0)
    within = (ends[NEAR_ROWS:] - ends[:-NEAR_ROWS]) / NEAR_ROWS  # mean of the NEAR_ROWS rows from each row on
    for k in CANDIDATES:
        inside = within[k - 1 - NEAR_ROWS]  # without row k - 1, in which the step may be
        outside = within[k + 1]
        if (outside < np.maximum(MIN_DETAIL_RATIO * inside, MIN_DETAIL)).any():
            continue
        if (outside >= MIN_DETAIL_RATIO * np.median(detail[: k - 1], axis=0)).all():
            return k
    return 0


def is_dual_fisheye(rgb: Bytes) -> bool:
    """Return True if a picture is black around the two circles inscribed in its halves, but not in them.

    A panorama with black poles is also black in the upper and lower parts of the circles, and a dark one is
    dark everywhere. Circles down to 0.9 of the halves' height are found.
    """
    upper = rgb[: max(len(rgb) // FISHEYE_SIZE, 1)]  # three quarters of this are outside of circles
    if np.median(upper) >= 2 * FISHEYE_BLACK:
        return False
    small = cv2.resize(rgb, (2 * FISHEYE_SIZE, FISHEYE_SIZE), interpolation=cv2.INTER_AREA).max(axis=2)
    v, u = np.mgrid[:FISHEYE_SIZE, :FISHEYE_SIZE] + 0.5 - FISHEYE_SIZE / 2
    radius = np.hypot(u, v) / (FISHEYE_SIZE / 2)
    sector = np.floor(np.arctan2(v, u) / (2.0 * np.pi) * FISHEYE_SECTORS).astype(int) % FISHEYE_SECTORS
    is_ring = (radius > 0.7) & (radius < 0.85)
    for half in (small[:, :FISHEYE_SIZE], small[:, FISHEYE_SIZE:]):
        if (half[radius > 1.03] < FISHEYE_BLACK).mean() < MIN_BLACK_OUTSIDE:
            return False
        is_bright = half >= FISHEYE_BLACK
        if min(is_bright[is_ring & (sector == k)].mean() for k in range(FISHEYE_SECTORS)) < MIN_BRIGHT_INSIDE:
            return False
    return True


def shows_twice(rgb: Bytes, axis: int) -> bool:
    """Return True if the two halves of a picture along an axis show the same, as pictures for two eyes do.

    Halves beside each other must also have an edge between them: spheres have none, even in repeating rooms.
    """
    small = cv2.resize(rgb, (2 * FISHEYE_SIZE, 2 * FISHEYE_SIZE), interpolation=cv2.INTER_AREA).astype(float)
    steps = np.abs(np.diff(small, axis=1)).mean(axis=(0, 2))
    if axis and steps[FISHEYE_SIZE - 1] < max(MIN_STEP, MIN_DETAIL_RATIO * float(np.median(steps))):
        return False
    halves = [half - half.mean(axis=1, keepdims=True) for half in np.split(small, 2, axis=axis)]
    scale = math.sqrt(float(np.square(halves[0]).sum() * np.square(halves[1]).sum()))
    return float((halves[0] * halves[1]).sum()) > MIN_ALIKE * scale


def find_mask(mask: Path, pano: Path) -> Path | None:
    """Return the file of a panorama's mask: `mask`, or if that is a folder, the file in it with its name.

    Return None if there is none. COLMAP appends `.png` to the panorama's name, Metashape `_mask` to its stem.
    """
    if not mask.is_dir():
        return mask
    names = (f"{stem}{suffix}" for stem in (pano.stem, pano.name, f"{pano.stem}_mask") for suffix in PICTURES)
    return next((file for name in names if (file := mask / name).is_file()), None)


def read_mask(path: Path, sizes: list[tuple[int, int]], is_black_ignored: bool = False) -> tuple[int, Mask]:
    """Read a mask for a picture with one of some sizes (width, height), which its shape tells.

    Return the index of the size, and the mask (H, W) at that size, True for valid pixels. A larger mask
    ignores a pixel if any of its own pixels there is ignored; a smaller one is enlarged.

    Raise InputError if the mask can't be read, or has the shape of none of the sizes, within 1 %.
    """
    rgb = read_picture(path, MIN_MASK).rgb
    height, width = rgb.shape[:2]
    for k, size in enumerate(sizes):
        if abs(width * size[1] - height * size[0]) <= ASPECT_TOLERANCE * height * size[0]:
            white = WHITE_LEVEL if rgb.max() > 1 else 1  # scripts write True as 1
            is_white = ((rgb.max(axis=2) >= white) != is_black_ignored).astype(np.float32)
            # the average of a larger mask is above 0 where any of its pixels is white
            method = cv2.INTER_AREA if width > size[0] else cv2.INTER_NEAREST
            return k, np.asarray(cv2.resize(is_white, size, interpolation=method) == 0)
    wanted = " or ".join(f"{size[0]} x {size[1]}" for size in sizes)
    raise InputError(f"{path}: found a mask of {width} x {height}, wanted the shape of {wanted}")


def mask_pole(is_valid: Mask, pole: str, half_angle_deg: float) -> Mask:
    """Return a mask (H, W) without the rows whose centre is within `half_angle_deg` of the `pole`."""
    if half_angle_deg <= 0.0:
        return is_valid
    height = len(is_valid)
    from_zenith = (np.arange(height) + 0.5) * 180.0 / height
    from_pole = from_zenith if pole == "zenith" else from_zenith[::-1]
    return np.asarray(is_valid & (from_pole >= half_angle_deg)[:, None])
