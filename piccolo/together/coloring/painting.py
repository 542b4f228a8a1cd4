"""A scan in the colours of photos that were localized in it, by its shape or by colours it has already.

A point's colour is the weighted median of the photos that see it, so that no single photo decides. Parts of a
photo that other photos contradict do not count.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...cloud.cloud_settings import CloudSettings
from ...cloud.octree import Octree, recolor
from ...cloud.stream import open_cloud
from ...cloud.writers import SUFFIXES, describe_unit, write_colored
from ...geometry.pose import Pose
from ...geometry.pose_gaussian import turn_positions
from ...judge.result import FAILED, Result
from ...judge.result_photo import read_as_localized
from ...photo.panorama import Panorama, texels
from ...photo.panorama.panorama import shrink
from ...scan_map.open_map import find_prepared_map
from ...scan_map.scan_map import SHAPE_ALONE, ScanMap, change_colors
from ...system.arrays import Array, Array32, Bytes, Int32s
from ...system.errors import InputError
from ...system.files.line_file import Journal
from ...system.jobs.memory import check_memory
from ...system.jobs.threads import Workers
from ...system.kernels.jit import F0, HALF, kernel
from .alignment import Anchor, Sight, align, look, weigh_points
from .passersby import remove_passersby

LEAST_COLORING_PHOTOS = 2
NUM_COLORING_ROUNDS = 2  # rounds, each of which localizes photos by the colours of the round before
MOST_FOLDS = 8  # groups of photos; each is localized in a map that has no paint of the group's own photos
PIXEL_BYTES = 8  # a pixel of a photo that gives colours: RGB, whether it counts, and both packed
PHOTO_BYTES = 40e6  # further, a photo: its smaller copy, ranges around it, and its share of aligned points
PAIR_BYTES = 5 * 6 * 6 * 8  # a pair of photos: normal equations, and copies of them in a step
UNKNOWN_STD = np.radians(0.5), 0.03  # [rad], [m] of a pose without a covariance
PAINT_STD = 0.008  # [m] of positions in a scan that the localized photos have coloured themselves
PAINTED = "photos are localized by the colours that others gave to the scan"
MAX_COLORING_WIDTH = 4096  # [px] of a photo, at most
SAMPLES = 1 << 21  # colours of photos at points that a task holds
LEAST_PAINTED = 0.25  # share of what a photo sees that must have paint; with less, most were refused
MOST_PHOTOS = 255  # largest number of photos that is counted for a point
FULL_LEVEL = np.float32(255.0)


Localize = Callable[[ScanMap, int], Result]  # localizes a photo, by its number, in a map with some colours
OF_RESULTS = {"colors": "those of the other photos"}  # settings that results repeat


class Brush(NamedTuple):
    """A photo that gives colours."""

    image: texels.Texels
    pose: Pose  # in the map
    gains: Array32  # (3,) by which its colours are multiplied
    sight: Sight


class Paint(NamedTuple):
    """Colours of points."""

    colors: Bytes  # (N, 3) RGB, 0 where no photo sees the point
    num_photos: Bytes  # (N,) photos that see the point


def make_brushes(
    octree: Octree, panoramas: Sequence[Panorama], poses: Sequence[Pose], gains: Array32, workers: Workers
) -> list[Brush]:
    """Return the photos at their poses in a map, with gains (photos, 3)."""

    def make(k: int) -> Brush:
        shown = shrink(panoramas[k], MAX_COLORING_WIDTH)
        image = texels.pack_texels(shown.rgb, shown.is_valid)
        return Brush(image, poses[k], gains[k], look(octree, poses[k]))

    return workers.map(make, range(len(poses)), "see")


def paint_points(points: Array32, brushes: Sequence[Brush], workers: Workers) -> Paint:
    """Return the colours of points (N, 3) of the map."""
    paint = Paint(np.empty((len(points), 3), np.uint8), np.empty(len(points), np.uint8))
    at_once = max(1, SAMPLES // len(brushes))

    def run(lo: int) -> None:
        part = slice(lo, lo + at_once)
        some = points[part]
        weights = np.empty((len(brushes), len(some)), np.float32)
        colors = np.empty((len(brushes), len(some), 3), np.float32)
        for k, (image, pose, gains, sight) in enumerate(brushes):
            R, t = pose.R_cam_from_world, pose.center_world
            weigh_points(some, sight, R, t, weights[k])
            read_colors(some, image.rgbx, image.width, gains, R, t, weights[k], colors[k])
        find_medians(colors, weights, paint.colors[part], paint.num_photos[part])

    workers.map(run, range(0, len(points), at_once), "paint")
    return paint


def sees_paint(brush: Brush, points: Array32, paint: Paint) -> bool:
    """Return True if enough of what a photo sees of points (N, 3), by its solid angle, has paint."""
    weights = np.empty(len(points), np.float32)
    weigh_points(points, brush.sight, brush.pose.R_cam_from_world, brush.pose.center_world, weights)
    return bool(weights[paint.num_photos > 0].sum() > LEAST_PAINTED * weights.sum())


@kernel
def read_colors(
    points: Array32,
    image: Int32s,
    width: int,
    gains: Array32,
    R_cam_from_map: Array,
    center_map: Array,
    weights: Array32,
    colors: Array32,
) -> None:
    """Write a photo's colours at points (N, 3) with weights (N,) above 0; masked, weights become 0."""
    pose = texels.pose_float32(R_cam_from_map, center_map)
    for n in range(len(points)):
        if weights[n] <= F0:
            continue
        x, y, z = texels.in_camera(points[n, 0], points[n, 1], points[n, 2], pose)
        k, fu, fv = texels.locate_texel(x, y, z, np.sqrt(x * x + y * y), width)
        below = k + width + 2
        t00, t10, t01, t11 = image[k], image[k + 1], image[below], image[below + 1]
        weights[n] *= texels.is_valid(t00, t10, t01, t11)
        blended = texels.bilinear_weights(fu, fv)
        for c in range(3):
            colors[n, c] = min(texels.blend(t00, t10, t01, t11, blended, 8 * c) * gains[c], FULL_LEVEL)


@kernel
def find_medians(colors: Array32, weights: Array32, medians: Bytes, counts: Bytes) -> None:
    """Write weighted medians (N, 3) of colours (K, N, 3), and how many weights (K, N) are above 0 (N,)."""
    num = len(weights)
    values = np.empty(num, np.float32)
    loads = np.empty(num, np.float32)
    for n in range(weights.shape[1]):
        count = 0
        for k in range(num):
            count += weights[k, n] > F0
        counts[n] = min(count, MOST_PHOTOS)
        for c in range(3):
            total = F0
            filled = 0
            for k in range(num):
                if weights[k, n] <= F0:
                    continue
                at = filled
                while at > 0 and values[at - 1] > colors[k, n, c]:
                    values[at] = values[at - 1]
                    loads[at] = loads[at - 1]
                    at -= 1
                values[at] = colors[k, n, c]
                loads[at] = weights[k, n]
                total += weights[k, n]
                filled += 1
            at = 0
            below = loads[0] if filled else F0
            while below < HALF * total:
                at += 1
                below += loads[at]
            medians[n, c] = np.uint8(values[at] + HALF) if filled else np.uint8(0)


class Colored(NamedTuple):
    """The numbers of photos and points of a scan that was coloured."""

    num_photos: int
    num_points: int
    num_colored: int  # points that at least one photo sees


@dataclass(frozen=True)
class Coloring:
    """A scan that was coloured by photos, and the photos in it."""

    results: list[Result]  # one of each photo, in order
    num_points: int  # points written; 0 if no scan was, as fewer than two photos are localized
    num_colored: int  # those of these points that at least one photo sees


def localize_for_colors(
    scan_map: ScanMap,
    steps: Iterable[str],
    localize: Localize,
    num_photos: int,
    workers: Workers,
    journal: Journal,
) -> list[Result]:
    """Localize photos by a scan as it is, and then in the colours that the others give to it.

    `localize` returns the result of a photo by its number; `steps` are the journal's names for the results by
    the scan as it is. Results that the journal has are not computed again.
    """
    names = [*steps]
    by_shape = journal.recall(names, lambda _, text: Result.from_json(text))
    left = range(len(by_shape), num_photos)
    for k in workers.show(iter(left), len(left), "photos"):
        by_shape.append(localize(scan_map, k))
        keep_step(journal, names[k], by_shape[k])
    return localize_by_colors(scan_map, by_shape, localize, workers, journal)


def localize_by_colors(
    scan_map: ScanMap,
    by_shape: Sequence[Result],
    localize: Localize,
    workers: Workers,
    journal: Journal,
) -> list[Result]:
    """Localize photos in the colours that the others give to a map, by `localize(painted_map, photo)`.

    A photo that is not localized in these colours does not paint in the next round. A photo that sees hardly
    any paint of others keeps its result of `by_shape`. Results that the journal has are not computed again.
    """
    results = list(by_shape)
    leaves = list_leaves(scan_map)
    for number in range(NUM_COLORING_ROUNDS):
        painters = [k for k, result in enumerate(results) if result.pose is not None]
        if len(painters) < LEAST_COLORING_PHOTOS:
            break
        idle = [k for k in range(len(results)) if k not in painters]
        folds = [*filter(None, [*(painters[n::MOST_FOLDS] for n in range(MOST_FOLDS)), idle])]
        steps = {k: f"colours, round {number + 1}: {by_shape[k].pano}" for own in folds for k in own}
        recalled = journal.recall(steps.values(), lambda _, text: Result.from_json(text))
        known = dict(zip(steps, recalled, strict=False))
        if len(known) < len(steps):
            brushes = dict(zip(painters, make_aligned_brushes(scan_map, results, workers), strict=True))
        for own in folds:
            left = [k for k in own if k not in known]
            if not left:
                continue
            paint = paint_points(leaves, [brush for k, brush in brushes.items() if k not in own], workers)
            shown = [k for k in left if k in idle or sees_paint(brushes[k], leaves, paint)]
            painted = color_map(scan_map, paint, workers) if shown else scan_map
            for k in workers.show(iter(left), len(left), "photos"):
                known[k] = localize(painted, k) if k in shown else by_shape[k]
                keep_step(journal, steps[k], known[k])
        results = [known[k] for k in range(len(results))]
    return results


def keep_step(journal: Journal, step: str, result: Result) -> None:
    """Keep the result of a step, unless it failed and is to be tried again."""
    if result.status != FAILED:
        journal.append(step, result.to_json())


def color_map(scan_map: ScanMap, paint: Paint, workers: Workers) -> ScanMap:
    """Return a map with other colours of its leaves; leaves without paint get colours from around them."""
    colors = np.asarray(paint.colors / np.float32(255.0), np.float32)
    painted = recolor(scan_map.octree, colors, (paint.num_photos > 0).astype(np.float32))
    return replace(
        change_colors(scan_map, painted, workers),
        surface_variance=scan_map.surface_variance + PAINT_STD**2 * np.eye(3),
        warnings=(*(note for note in scan_map.warnings if note != SHAPE_ALONE), PAINTED),
    )


def list_leaves(scan_map: ScanMap) -> Array32:
    """Return the positions (N, 3) of a map's leaves."""
    return np.ascontiguousarray(scan_map.octree.level(scan_map.octree.leaf_size)[:, :3])


def write_colored_scan(
    paths: Sequence[Path],
    scan_map: ScanMap,
    cloud_settings: CloudSettings,
    results: Sequence[Result],
    out: Path,
    workers: Workers,
) -> Colored:
    """Write the points of a scan's files in the colours of photos that were localized in its map.

    Points that no photo sees are black. Raises InputError if the scan is not of such files, if fewer than
    two photos are localized, and for an unknown suffix.
    """
    check_point_files(paths)
    check_colored_suffix(out)
    brushes = make_aligned_brushes(scan_map, results, workers)

    def color(points_world: Array) -> Paint:
        points_map = (points_world - scan_map.origin_world) @ scan_map.R_map_from_world.T
        return paint_points(points_map.astype(np.float32), brushes, Workers(workers.num_threads))

    cloud = open_cloud(paths, cloud_settings, workers.show)
    leaves_world = list_leaves(scan_map) @ scan_map.R_map_from_world + scan_map.origin_world
    box_world = np.stack([leaves_world.min(axis=0), leaves_world.max(axis=0)])
    counts = write_colored(cloud, color, box_world, out, scan_map.crs)
    for line in describe_unit(cloud, out, scan_map.crs):
        workers.warn(line)
    return Colored(len(brushes), *counts)


def color_if_enough(
    paths: Sequence[Path],
    scan_map: ScanMap,
    cloud_settings: CloudSettings,
    results: list[Result],
    out: Path,
    workers: Workers,
) -> Coloring:
    """Write a scan in the colours of photos, if enough of them are localized."""
    if sum(result.pose is not None for result in results) < LEAST_COLORING_PHOTOS:
        return Coloring(results, 0, 0)
    colored = write_colored_scan(paths, scan_map, cloud_settings, results, out, workers)
    return Coloring(results, colored.num_points, colored.num_colored)


def check_point_files(paths: Sequence[Path]) -> None:
    """Refuse a scan that was not read from files of points, but from a prepared map or arrays."""
    if find_prepared_map(paths) or not all(path.exists() for path in paths):
        raise InputError(f"{paths[0]}: found no files of points, wanted those of a scan to be coloured")


def check_colored_suffix(out: Path) -> None:
    """Refuse a name that does not say in which format a scan is to be written."""
    if out.suffix.lower() not in SUFFIXES:
        raise InputError(f"{out}: wanted a name that ends with {', '.join(SUFFIXES)}")


def make_aligned_brushes(scan_map: ScanMap, results: Sequence[Result], workers: Workers) -> list[Brush]:
    """Align the photos that are localized, and return the brushes that they are."""
    found = [(result, result.pose) for result in results if result.pose is not None]
    if len(found) < LEAST_COLORING_PHOTOS:
        wanted = f"wanted {LEAST_COLORING_PHOTOS} or more for colours"
        raise InputError(f"found {len(found)} localized photos, {wanted}")
    panoramas = [shrink(read_as_localized(found[0][0]), MAX_COLORING_WIDTH)]
    bytes_each = PIXEL_BYTES * panoramas[0].is_valid.size + PHOTO_BYTES + PAIR_BYTES * len(found)
    check_memory(len(found) * bytes_each, f"colouring by {len(found)} photos", "localize fewer at once")
    panoramas += workers.map(
        lambda result: shrink(read_as_localized(result), MAX_COLORING_WIDTH),
        [result for result, _ in found[1:]],
        "read",
    )
    poses = [scan_map.from_world(pose) for _, pose in found]
    anchors = [make_anchor(result, pose, at) for (result, pose), at in zip(found, poses, strict=True)]
    poses, gains = align(scan_map.octree, panoramas, poses, anchors, workers)
    panoramas = remove_passersby(scan_map.octree, panoramas, poses, gains, workers)
    return make_brushes(scan_map.octree, panoramas, poses, gains, workers)


def make_anchor(result: Result, pose_world: Pose, pose_map: Pose) -> Anchor:
    """Return the pose of a result and how exact it is, as the anchor of its photo."""
    turn, move = UNKNOWN_STD
    covariance = np.diag([turn**2] * 3 + [move**2] * 3)
    if result.covariance is not None:
        covariance = turn_positions(result.covariance.matrix, pose_world.R_cam_from_world)
    return Anchor(pose_map, np.linalg.inv(covariance))
