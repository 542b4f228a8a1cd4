"""Draw the sampling loss on a plan of the cloud: its minimum over height and rotation at each position.

Kim et al. (ICCV 2021) show such a surface to argue that their loss has a deep, wide minimum at the camera:

    S(x, y) = min over z in heights, R in rotations of L(R, (x, y, z)),    L the sampling loss, Eq. 2,

with L over the points that a camera at (x, y, z) sees, and the same rotations at each place.
"""

import math
import time
from argparse import ArgumentParser
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.ndimage import minimum_filter

from piccolo import InputError, Pose
from piccolo.api.result_files import read_results
from piccolo.cli.command import Arguments, check_outputs, check_suffix, checking_options, command, option
from piccolo.cli.options import add_cloud_options
from piccolo.cli.settings_given import cloud_settings_from
from piccolo.geometry.points import LocalCloud, PackedPoints
from piccolo.geometry.pose import uniform_rotations, uniform_yaws
from piccolo.optimize.sampling_loss import sampling_loss
from piccolo.photo.panorama import read_panorama
from piccolo.photo.panorama.panorama import shrink
from piccolo.photo.panorama.texels import Texels, pack_texels
from piccolo.scan_map.open_map import open_points
from piccolo.system.arrays import Array, Int64s, Mask
from piccolo.system.files.atomic import write_atomically
from piccolo.system.jobs.threads import Workers
from piccolo.views.zbuffer import is_free_space, visible_points

from ..evaluation.tables import figure_png, new_figure
from ..scene import read_scene

POOL_PER_POINT = 8  # points of which visible ones are taken, for one that is used
FREE_SPACE_WIDTH = 32  # [px] of the view that tests for free space
MIN_CLEARANCE = 0.2  # [m] to the nearest point
WALL_POINTS = 200_000  # of the cloud that are drawn
MARKS = {"true": ("*", "white", 260), "found": ("X", "red", 110), "lowest": ("o", "none", 130)}

KnownPoses = dict[str, Pose]  # those known of "true" and "found", in the frame of the points


class PoseGrid(NamedTuple):
    """All poses that are tried, in the frame of the points, z up."""

    x: Array  # (nx,) [m]
    y: Array  # (ny,) [m]
    heights: Array  # (nz,) [m]
    R_cam_from_local: Array  # (rotations, 3, 3)

    @property
    def num_poses(self) -> int:
        """Number of poses."""
        return len(self.x) * len(self.y) * len(self.heights) * len(self.R_cam_from_local)


class LossSurface(NamedTuple):
    """The best pose at each place of the plan."""

    loss: Array  # (ny, nx) [0, sqrt(3)], inf where masked pixels hide too much at every pose
    height: Array  # (ny, nx) [m] of the best pose
    rotation: Int64s  # (ny, nx) index of its rotation
    is_free: Mask  # (ny, nx) false too near to a point, or outside of the cloud

    def lowest(self) -> tuple[int, int]:
        """Return row and column of the least loss in free space; of all places if none is free.

        From outside a cloud few points are visible, and a plain wall has a low loss in a plain panorama.
        """
        is_free = self.is_free & np.isfinite(self.loss)
        loss = np.where(is_free, self.loss, np.inf) if is_free.any() else self.loss
        row, column = np.unravel_index(int(np.argmin(loss)), loss.shape)
        return int(row), int(column)

    def num_minima(self) -> int:
        """Count the places in free space whose loss is lower than at their eight neighbours."""
        others = np.arange(9).reshape(3, 3) != 4
        lowest_around = minimum_filter(self.loss, footprint=others, mode="constant", cval=np.inf)
        return int(((self.loss < lowest_around) & self.is_free).sum())


def loss_surface(
    points: PackedPoints, texels: Texels, grid: PoseGrid, max_points: int, workers: Workers
) -> LossSurface:
    """Find the least loss over heights and rotations at each place, over `max_points` visible from it."""
    pool = points.subsample(POOL_PER_POINT * max_points)

    def best(cell: int) -> tuple[float, float, int, bool]:
        row, column = divmod(cell, len(grid.x))
        tried = []
        for z in grid.heights:
            center = np.array([grid.x[column], grid.y[row], z])
            seen = visible_points(pool, center)
            is_free = is_free_space(seen, center, FREE_SPACE_WIDTH, MIN_CLEARANCE)
            some = seen.subsample(max_points)
            losses = [sampling_loss(some, texels, Pose(R, center)) for R in grid.R_cam_from_local]
            k = int(np.argmin(losses))
            tried.append((losses[k], float(z), k, is_free))
        return min(tried)

    shape = (len(grid.y), len(grid.x))
    cells = workers.map(best, range(math.prod(shape)), "loss surface")
    loss, height, rotation, is_free = (np.array(column).reshape(shape) for column in zip(*cells, strict=True))
    return LossSurface(loss=loss, height=height, rotation=rotation, is_free=is_free)


def surface_png(
    surface: LossSurface, grid: PoseGrid, cloud: LocalCloud, known: KnownPoses, title: str
) -> bytes:
    """Draw the surface over the plan, with the known poses marked, and return the PNG."""
    shift = cloud.R_map_from_world @ cloud.origin_world  # (3,) [m] to the plan, with the world's origin
    x = grid.x + shift[0]
    y = grid.y + shift[1]
    aspect = (y[-1] - y[0] + 1.0) / (x[-1] - x[0] + 1.0)
    figure = new_figure(figsize=(10.0, float(np.clip(8.5 * aspect + 1.0, 4.0, 16.0))), layout="constrained")
    axes = figure.add_subplot()
    loss = np.where(np.isfinite(surface.loss), surface.loss, np.nan)
    mesh = axes.pcolormesh(x, y, loss, cmap="viridis", shading="nearest")
    pale = np.zeros((*surface.is_free.shape, 4))
    pale[~surface.is_free] = (1.0, 1.0, 1.0, 0.55)
    axes.pcolormesh(x, y, pale, shading="nearest")
    p = cloud.points.subsample(WALL_POINTS)
    floor, ceiling = np.percentile(p.z, [1.0, 99.0])
    is_wall = np.abs(p.z - (floor + ceiling) / 2) < 0.35 * (ceiling - floor)  # walls and furniture
    axes.plot(p.x[is_wall] + shift[0], p.y[is_wall] + shift[1], "k,", alpha=0.3, zorder=2)
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    row, column = surface.lowest()
    marks = {"lowest": (x[column], y[row])}
    for name in ("found", "true"):
        if name in known:
            x_known, y_known = known[name].center_world[:2] + shift[:2]
            marks[name] = (x_known, y_known)
    for name, (x_mark, y_mark) in marks.items():
        symbol, color, size = MARKS[name]
        edge = "red" if color == "none" else "black"
        axes.scatter(
            x_mark, y_mark, s=size, marker=symbol, facecolor=color, edgecolor=edge, zorder=3, label=name
        )
    axes.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title=title)
    axes.legend(loc="upper right")
    figure.colorbar(mesh, ax=axes, label="least sampling loss over height and rotation", shrink=0.8)
    return figure_png(figure)


EPILOG = """\
example:
  python tools/loss_surface.py --cloud scan.ply --pano a.jpg --truth queries.json --out surface.png

Shows at each position of a horizontal grid the minimum of the sampling loss (Eq. 2 of the paper) over heights
and rotations, for the points visible from there. If a pose is given, the rotations are evenly spaced around
its own, and the heights are near its own. z is up unless --up or a prepared map says otherwise. Positions
too close to a point or outside of the cloud are drawn pale and are not counted among the minima. Prints one
JSON object to stdout.
"""
MAX_CELLS = 1_000_000
WIDTH = 256  # of the panorama [px]
MAX_POINTS = 30_000  # used at a position, of those seen from there
NUM_YAWS = 64
NUM_ROTATIONS = 1000  # of SO(3)
HEIGHTS_ABOUT = (-0.15, 0.0, 0.15)  # [m] of the known one


def add_arguments(parser: ArgumentParser) -> None:
    """All options."""
    add_cloud_options(parser, "coloured scan as for localize.py, or a map of tools/prepare_map.py")
    option(parser, "--pano FILE", "the panorama", required=True)
    option(parser, "--result FILE", "result of localize.py with the estimated pose")
    option(parser, "--truth FILE", "queries.json with the true pose")
    option(parser, "--out PNG", "write the picture here; - is stdout", required=True)
    option(parser, "--step M", "spacing of the grid", default=0.2)
    text = "known: rotations about z only; unknown: all of SO(3)"
    option(parser, "--gravity", text, choices=["known", "unknown"], default="known")


def read_known_poses(arguments: Arguments, cloud: LocalCloud) -> KnownPoses:
    """Return the pose found and the true one of the panorama, as far as files are given."""
    name = arguments.pano.name
    known: KnownPoses = {}
    if arguments.truth:
        queries = read_scene(arguments.truth).by_name
        if name not in queries:
            raise InputError(f"{arguments.truth}: no true pose of {name}")
        known["true"] = cloud.from_world(queries[name].pose)
    if arguments.result:
        poses = [r.pose for r in read_results([arguments.result]) if Path(r.pano).name == name and r.pose]
        if len(poses) != 1:
            raise InputError(f"{arguments.result}: {len(poses)} poses of {name}, wanted one")
        known["found"] = cloud.from_world(poses[0])
    return known


def grid_from(arguments: Arguments, cloud: LocalCloud, known: KnownPoses) -> PoseGrid:
    """Return the poses to try over all of the cloud, in the frame of the points."""
    points = cloud.points
    ends = [np.percentile(c, [0.5, 99.5]) for c in (points.x, points.y)]
    places = np.array([*np.transpose(ends), *(pose.center_world[:2] for pose in known.values())], np.float64)
    low = places.min(axis=0)
    counts = np.floor((places.max(axis=0) - low) / arguments.step) + 1.0
    if counts.prod() > MAX_CELLS:
        raise InputError(f"--step {arguments.step}: {counts.prod():.3g} places, wanted at most {MAX_CELLS}")
    x, y = (low[k] + arguments.step * np.arange(counts[k]) for k in range(2))
    is_known = arguments.gravity == "known"
    rotations = uniform_yaws(NUM_YAWS) if is_known else uniform_rotations(NUM_ROTATIONS)
    if not known:
        floor, ceiling = np.percentile(points.z, [1.0, 99.0])
        heights = floor + (ceiling - floor) * np.linspace(0.25, 0.75, 5)
        return PoseGrid(x, y, heights, rotations @ rotations[0].T)
    pose = next(iter(known.values()))
    heights = pose.center_world[2] + np.array(HEIGHTS_ABOUT)
    # turned from a pose that is known, so that it is among them
    return PoseGrid(x, y, heights, pose.R_cam_from_world @ rotations @ rotations[0].T)


def summary(surface: LossSurface, grid: PoseGrid, cloud: LocalCloud, known: KnownPoses) -> dict[str, object]:
    """Return the surface's part of the JSON on stdout."""
    row, column = surface.lowest()
    lowest = np.array([grid.x[column], grid.y[row], surface.height[row, column]])
    pose = cloud.to_world(Pose(grid.R_cam_from_local[surface.rotation[row, column]], lowest))
    line: dict[str, object] = {
        "places": [len(grid.y), len(grid.x)],
        "poses": grid.num_poses,
        "lowest_world": np.round(pose.center_world, 6).tolist(),
        "lowest_loss": float(surface.loss[row, column]),
        "median_loss": float(np.median(surface.loss[np.isfinite(surface.loss)])),
        "num_minima": surface.num_minima(),
    }
    for name, other in sorted(known.items()):
        line[f"distance_to_{name}"] = round(float(np.linalg.norm(lowest - other.center_world)), 6)
    return line


@command(__file__, __doc__, EPILOG, add_arguments)
def main(arguments: Arguments) -> int:
    """Read, compute, write."""
    with checking_options():
        cloud_settings = cloud_settings_from(arguments)
        check_suffix("--out", arguments.out, (".png",))
        if not 0.0 < arguments.step < np.inf:
            raise InputError(f"--step {arguments.step}: wanted metres above 0")
    outputs = {"--out": arguments.out}
    inputs = [*arguments.cloud, arguments.pano, arguments.result, arguments.truth]
    check_outputs(outputs, filter(None, inputs))
    new_figure()  # now: where matplotlib is missing, the work would be lost

    workers = arguments.workers()
    panorama = shrink(read_panorama(arguments.pano), WIDTH)
    texels = pack_texels(panorama.rgb, panorama.is_valid)
    cloud = open_points(arguments.cloud, cloud_settings, workers)
    arguments.warn(cloud.warnings)
    known = read_known_poses(arguments, cloud)
    grid = grid_from(arguments, cloud, known)
    begin = time.perf_counter()
    surface = loss_surface(cloud.points, texels, grid, MAX_POINTS, workers)
    seconds = time.perf_counter() - begin
    if not np.isfinite(surface.loss).any():
        raise InputError(f"{arguments.pano}: the loss is infinite at all poses; mask less of the panorama")
    write_atomically(arguments.out, surface_png(surface, grid, cloud, known, arguments.pano.name))
    report = {"out": str(arguments.out)} | summary(surface, grid, cloud, known)
    report |= {"seconds": round(seconds, 3), "poses_per_s": round(grid.num_poses / seconds)}
    arguments.report(outputs, report)
    return 0
