"""Draw the sampling loss on a plan of the cloud: its minimum over height and rotation at each position."""

import argparse
import json
import time
from pathlib import Path

import numpy as np

from piccolo.cli.command import command, option, print_warnings
from piccolo.cli.errors import checking_options
from piccolo.cli.options import add_cloud_options, cloud_settings_from
from piccolo.cli.outputs import check_outputs, check_suffix, print_report
from piccolo.cli.progress import progress_bar
from piccolo.cloud.soa import LocalCloud
from piccolo.errors import InputError
from piccolo.files.atomic import write_atomically
from piccolo.geometry.pose import Pose
from piccolo.geometry.rotations import uniform_rotations, uniform_yaws
from piccolo.jobs.threads import Workers, num_cores
from piccolo.optional import new_figure
from piccolo.panorama import read_panorama
from piccolo.panorama.model import shrink
from piccolo.panorama.texels import pack_texels
from piccolo.result import read_results
from piccolo.scan_map.open_map import open_points
from piccolo.scene import read_scene

from ..experiments.loss_surface import KnownPoses, LossSurface, PoseGrid, loss_surface, surface_png

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


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    add_cloud_options(parser, "coloured scan as for localize.py, or a map of tools/prepare_map.py")
    option(parser, "--pano FILE", "the panorama", required=True)
    option(parser, "--result FILE", "result of localize.py with the estimated pose")
    option(parser, "--truth FILE", "queries.json with the true pose")
    option(parser, "--out PNG", "write the picture here; - is stdout", required=True)
    option(parser, "--step M", "spacing of the grid", default=0.2)
    text = "known: rotations about z only; unknown: all of SO(3)"
    option(parser, "--gravity", text, choices=["known", "unknown"], default="known")


def read_known_poses(arguments: argparse.Namespace, cloud: LocalCloud) -> KnownPoses:
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


def grid_from(arguments: argparse.Namespace, cloud: LocalCloud, known: KnownPoses) -> PoseGrid:
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
def main(arguments: argparse.Namespace) -> int:
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

    workers = Workers(num_cores(), progress_bar(arguments.quiet))
    panorama = shrink(read_panorama(arguments.pano), WIDTH)
    texels = pack_texels(panorama.rgb, panorama.is_valid)
    cloud = open_points(arguments.cloud, cloud_settings, workers)
    print_warnings(arguments, cloud.warnings)
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
    print_report(arguments, outputs, json.dumps(report))
    return 0
