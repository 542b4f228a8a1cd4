"""A plan image of the user's own, put into the scan's coordinates by points that are known in both."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.json_file import read_text
from ..geometry.pose import Array
from ..panorama.picture import read_picture
from ..scan_map.scan_map import ScanMap
from ..views.pictures import encode_image

COLUMNS = ("u", "v", "x", "y")
WANTED = "wanted a CSV file with the columns u, v [px] and x, y [m], and two rows or more"
MAX_SIDE = 4096  # [px]
LEAST_SPREAD = 1e-6  # of the control points, by their distance: less is one point, or a line of three


class OwnPlan(NamedTuple):
    """A plan of a storey."""

    storey: int  # 1 for the lowest
    image: Path
    control_points: Path  # CSV


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


def plan_matrix(pixels: Array, places: Array) -> tuple[tuple[float, ...], float]:
    """a, b, c, d, e, f of x = a u + c v + e, y = b u + d v + f, and the rms error [m] at the points.

    Of pixels (N, 2), v downwards, and places (N, 2) [m]: two points give a turn and a scale, more any affine
    map by least squares. InputError if they lie in one point or, more than two, on one line.
    """
    centred = pixels - pixels.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False)
    rank = 1 if len(pixels) == 2 else 2
    if spread[rank - 1] <= LEAST_SPREAD * max(spread[0], 1.0):
        raise InputError("control points: found them in one point or on one line, wanted them far apart")
    if rank == 1:
        z, w = (complex(*(pair[1] - pair[0])) for pair in (pixels * np.array([1.0, -1.0]), places))
        turn = w / z
        a, b = turn.real, turn.imag
        linear = np.array([[a, b], [b, -a]])  # v points down
    else:
        linear = np.linalg.lstsq(centred, places - places.mean(axis=0), rcond=None)[0].T
    shift = places.mean(axis=0) - linear @ pixels.mean(axis=0)
    error = float(np.sqrt(((pixels @ linear.T + shift - places) ** 2).sum(axis=1).mean()))
    return (*linear.T.ravel().tolist(), *shift.tolist()), error


def own_plan(plan: OwnPlan, scan_map: ScanMap) -> tuple[bytes, tuple[int, int], tuple[float, ...]]:
    """PNG of a user's plan, its width and height, and its matrix in the map's frame, as of plan_matrix."""
    points = read_control_points(plan.control_points)
    world = np.column_stack([points[:, 2:], np.full(len(points), scan_map.origin_world[2])])
    places = ((world - scan_map.origin_world) @ scan_map.R_map_from_world.T)[:, :2]
    rgb: NDArray[np.uint8] = read_picture(plan.image).rgb
    scale = min(1.0, MAX_SIDE / max(rgb.shape[:2]))
    size = math.ceil(rgb.shape[1] * scale), math.ceil(rgb.shape[0] * scale)
    if scale < 1.0:
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
    try:
        matrix, _ = plan_matrix(points[:, :2] * scale, places)
    except InputError as error:
        raise InputError(f"{plan.control_points}: {error}") from error
    return encode_image(rgb, ".png"), size, matrix


def check_own_plans(plans: Sequence[OwnPlan], num_storeys: int) -> None:
    """Refuse plans of storeys that are not there."""
    for plan in plans:
        if not 1 <= plan.storey <= num_storeys:
            raise InputError(f"{plan.image}: found storey {plan.storey}, wanted 1 to {num_storeys}")
