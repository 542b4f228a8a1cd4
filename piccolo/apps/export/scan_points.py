"""Points of the scan that photos see, spread evenly, as the beginning of a splat or a neural field."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec import convert

from ...api.opening import find_prepared_map, open_points
from ...api.values import Result
from ...cloud.cloud_settings import CloudSettings
from ...cloud.stream import open_cloud
from ...geometry.colors import unpack_rgb
from ...geometry.points import LocalCloud, pack_points
from ...geometry.pose import Pose, rotate_points
from ...system.arrays import Array, Bytes, Int64s, Mask
from ...system.errors import InputError
from ...system.jobs.threads import Workers
from ...views.zbuffer import VISIBLE_WIDTH, indices_in_front, nearest_depth
from .posed_images import Options, PosedImage

MORE = 4  # times as many points are looked at as are kept


class SeenPoints(NamedTuple):
    """The points that a picture shows."""

    points: Int64s  # (M,) their numbers
    pixels: Array  # (M, 2) [px]


class ScanPoints(NamedTuple):
    """Points with their colours, and what each picture shows of them."""

    xyz: Array  # (N, 3) [m] in the world, less the offset
    rgb: Bytes  # (N, 3)
    seen: list[SeenPoints]


def open_scan_of(results: Sequence[Result], workers: Workers) -> LocalCloud:
    """Return voxels of 2 cm of the one scan of results, read as for them; InputError for several."""
    clouds = {result.cloud_name: result.cloud for result in results}
    if len(clouds) != 1:
        found = f"found results of the clouds {', '.join(sorted(clouds))}" if clouds else "found no result"
        raise InputError(f"`points`: {found}, wanted those of one; choose with `cloud`")
    (cloud,) = clouds.values()
    paths = [Path(name) for name in ([cloud] if isinstance(cloud, str) else cloud)]
    settings = convert(results[0].settings.get("cloud") or {}, CloudSettings)
    if find_prepared_map(paths):
        return open_points(paths, settings, workers)
    voxels = open_cloud(paths, settings, workers.show).voxels(np.eye(3))
    points = pack_points(voxels.nodes[:, :3], np.rint(255.0 * voxels.nodes[:, 3:]).astype(np.uint8))
    return LocalCloud(np.eye(3), voxels.origin, points, voxels.warnings)


def find_points(images: Sequence[PosedImage], options: Options) -> ScanPoints:
    """Return at most `options.points` points of `options.scan` that pictures show; none if not asked for.

    A point counts as shown where no surface of the scan is in front of it.
    """
    if options.points is None or options.scan is None:
        nothing = SeenPoints(np.empty(0, np.int64), np.empty((0, 2)))
        return ScanPoints(np.empty((0, 3)), np.empty((0, 3), np.uint8), [nothing] * len(images))
    cloud = options.scan
    offset = np.array(options.offset or (0.0, 0.0, 0.0))
    few = cloud.points.subsample(MORE * options.points)
    xyz = rotate_points(few.stack().astype(np.float64), cloud.R_map_from_world.T)
    xyz = xyz + (cloud.origin_world - offset)
    visible: dict[bytes, Mask] = {}  # by a picture's centre, True for each point (N,) that is in front
    is_shown = np.zeros(len(few), np.bool_)
    for image in images:
        center = image.pose.center_world
        if center.tobytes() not in visible:  # faces of one panorama have one centre
            center_map = cloud.R_map_from_world @ (center + offset - cloud.origin_world)
            depth = nearest_depth(cloud.points, Pose(np.eye(3), center_map), VISIBLE_WIDTH)
            visible[center.tobytes()] = np.zeros(len(few), np.bool_)
            visible[center.tobytes()][indices_in_front(few, center_map, depth)] = True
        is_shown[_project(image, xyz, visible).points] = True
    if not is_shown.any():
        raise InputError("`points`: found no point of the scan in the photos, wanted the scan of the results")
    union = np.flatnonzero(is_shown)
    kept = union[np.linspace(0, len(union) - 1, min(options.points, len(union))).astype(np.int64)]
    visible = {center: is_in_front[kept] for center, is_in_front in visible.items()}
    seen = [_project(image, xyz[kept], visible) for image in images]
    return ScanPoints(xyz[kept], unpack_rgb(few.rgbx[kept]), seen)


def _project(image: PosedImage, xyz: Array, visible: dict[bytes, Mask]) -> SeenPoints:
    """Return those of points (N, 3) that are visible from a picture's centre and in the picture."""
    numbers = np.flatnonzero(visible[image.pose.center_world.tobytes()])
    x_cam = rotate_points(xyz[numbers] - image.pose.center_world, image.pose.R_cam_from_world)
    pixels, is_in = image.lens.pixels(x_cam)
    return SeenPoints(numbers[is_in], pixels[is_in])
