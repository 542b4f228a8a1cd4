"""Draw the sampling loss over a plan of the cloud: its least value over height and rotation at each place."""

import argparse
import json
import time
from pathlib import Path

import numpy as np

from ..cloud.soa import FARTHEST, LocalCloud
from ..errors import InputError
from ..files.atomic import write_atomically
from ..geometry.pose import Array, Pose
from ..geometry.rotations import uniform_rotations, uniform_yaws
from ..jobs.threads import Workers, num_cores
from ..optimize.loss_surface import (
    KnownPoses,
    LossSurface,
    PoseGrid,
    loss_surface,
    plan_shift,
    surface_npz,
    surface_png,
)
from ..optional import new_figure
from ..panorama import read_panorama
from ..panorama.model import shrink
from ..panorama.texels import pack_texels
from ..result import read_results
from ..scan_map.open_map import open_points
from ..scenes.scene import read_scene
from .command import check_least, command, option, print_warnings
from .errors import checking_options
from .options import add_cloud_options, cloud_settings_from
from .outputs import check_outputs, check_suffix, print_report
from .progress import progress_bar

EPILOG = """\
example:
  python tools/loss_surface.py --cloud scan.ply --pano a.jpg --truth queries.json --out surface.png

At each place of a grid the least sampling loss (Eq. 2 of the paper) over --heights and --rotations is taken,
over the points seen from there. If a pose is known, the rotations are its own, turned evenly, and the heights
are about its own. z is up, or what --up or a prepared map says. Places too near to a point or outside of the
cloud are computed too, and drawn pale; the lowest place and the minima are of the others.

NPZ, in the world's axes turned so that z is up (R_plan_from_world, identity for clouds with z up): x (nx,)
and y (ny,) [m]; loss, height, is_free (ny, nx); R_cam_from_world (ny, nx, 3, 3) of the best pose; found_world
and true_world (3,), NaN where not known. One JSON object on stdout.
"""
MAX_CELLS = 1_000_000
HEIGHTS_ABOUT = (-0.15, 0.0, 0.15)  # [m] of the known one


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    add_cloud_options(parser, "coloured scan, as for localize.py, or a map by tools/prepare_map.py")
    option(parser, "--pano FILE", "the panorama", required=True)
    option(parser, "--result FILE", "JSON lines of localize.py: pose found")
    option(parser, "--truth FILE", "queries.json: true pose")
    option(parser, "--out PNG", "the picture; - is stdout")
    option(parser, "--npz FILE", "the surface as arrays; - is stdout")
    group = parser.add_argument_group("poses tried")
    option(group, "--step M", "of the grid", default=0.2)
    option(group, "--box X0 Y0 X1 Y1", "corners of the grid (default: all of the cloud)")
    text = "least, greatest and how many (default: about the pose known, else 5 in the middle of the room)"
    option(group, "--heights MIN MAX NUM", text)
    option(group, "--gravity", "yaws, or all of SO(3)", choices=["known", "unknown"], default="known")
    option(group, "--rotations N", "(default 64, of SO(3) 1000)")
    group = parser.add_argument_group("loss")
    option(group, "--width PX", "of the panorama", default=256)
    option(group, "--max-points N", "used at a position, of those seen from there", default=30_000)
    option(group, "--no-visibility", "see through walls")
    option(parser, "--threads N", default=num_cores())


def check_usage(arguments: argparse.Namespace) -> None:
    """Refuse options that make no sense, whatever the files hold."""
    cloud_settings_from(arguments)
    if not (arguments.out or arguments.npz):
        raise InputError("give --out, --npz or both")
    check_suffix("--out", arguments.out, (".png",))
    if not 0.0 < arguments.step < np.inf:
        raise InputError(f"--step {arguments.step}: wanted metres above 0")
    check_least(arguments, rotations=1, width=16, max_points=100, threads=1)
    x0, y0, x1, y1 = arguments.box or (0.0, 0.0, 1.0, 1.0)
    if not (x0 < x1 and y0 < y1 and np.isfinite([x0, y0, x1, y1]).all()):
        raise InputError(f"--box {arguments.box}: wanted X0 below X1 and Y0 below Y1")
    low, high, num = arguments.heights or (0.0, 0.0, 1.0)
    if not (low <= high and np.isfinite([low, high]).all() and num in range(1, 1001)):
        raise InputError(f"--heights {arguments.heights}: wanted MIN up to MAX and 1 to 1000 of them")


def known_poses(arguments: argparse.Namespace, cloud: LocalCloud) -> KnownPoses:
    """The pose found and the true one of the panorama, as far as files are given."""
    name, known = arguments.pano.name, KnownPoses()
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
    """The poses to try, in the frame of the points."""
    shift = plan_shift(cloud)
    if arguments.box:
        corners = np.array(arguments.box).reshape(2, 2) - shift[:2]
    else:
        ends = [np.percentile(c, [0.5, 99.5]) for c in (cloud.points.x, cloud.points.y)]
        known_places = [pose.center_world[:2] for pose in known.values()]
        places = np.array([*np.transpose(ends), *known_places], np.float64)
        corners = np.stack([places.min(axis=0), places.max(axis=0)])
    counts = np.floor((corners[1] - corners[0]) / arguments.step) + 1.0
    if counts.prod() > MAX_CELLS:
        raise InputError(f"--step {arguments.step}: {counts.prod():.3g} places, wanted at most {MAX_CELLS}")
    heights = heights_from(arguments, cloud, known)
    if not max(np.abs(corners).max(), np.abs(heights).max()) < FARTHEST:
        raise InputError("--box, --heights: places too far from the cloud")
    x, y = (corners[0, k] + arguments.step * np.arange(counts[k]) for k in range(2))
    is_known = arguments.gravity == "known"
    spread, usual = (uniform_yaws, 64) if is_known else (uniform_rotations, 1000)
    rotations = spread(arguments.rotations or usual)
    # Turned from a pose that is known, so that it is among them.
    start = next(iter(known.values())).R_cam_from_world if known else np.eye(3)
    return PoseGrid(x, y, heights, start @ rotations @ rotations[0].T)


def heights_from(arguments: argparse.Namespace, cloud: LocalCloud, known: KnownPoses) -> Array:
    """The heights to try, in the frame of the points."""
    if arguments.heights:
        low, high, num = arguments.heights
        return np.asarray(np.linspace(low, high, int(num)) - plan_shift(cloud)[2])
    if known:
        return np.asarray(next(iter(known.values())).center_world[2] + np.array(HEIGHTS_ABOUT))
    floor, ceiling = np.percentile(cloud.points.z, [1.0, 99.0])
    return np.asarray(floor + (ceiling - floor) * np.linspace(0.25, 0.75, 5))


def summary(surface: LossSurface, grid: PoseGrid, cloud: LocalCloud, known: KnownPoses) -> dict[str, object]:
    """The surface's part of the JSON on stdout."""
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
        check_usage(arguments)
    outputs = {"--out": arguments.out, "--npz": arguments.npz}
    inputs = [*arguments.cloud, arguments.pano, *filter(None, (arguments.result, arguments.truth))]
    check_outputs(outputs, inputs)
    if arguments.out:
        new_figure()  # now: where matplotlib is missing, the work would be lost

    workers = Workers(arguments.threads, progress_bar(arguments.quiet))
    panorama = shrink(read_panorama(arguments.pano), arguments.width)
    texels = pack_texels(panorama.rgb, panorama.is_valid)
    cloud = open_points(arguments.cloud, cloud_settings_from(arguments), workers)
    print_warnings(arguments, cloud.warnings)
    known = known_poses(arguments, cloud)
    grid = grid_from(arguments, cloud, known)
    begin = time.perf_counter()
    see = not arguments.no_visibility
    surface = loss_surface(cloud.points, texels, grid, arguments.max_points, see, workers)
    seconds = time.perf_counter() - begin
    if not np.isfinite(surface.loss).any():
        raise InputError(f"{arguments.pano}: the loss is infinite at all poses; mask less of the panorama")
    if arguments.npz:
        write_atomically(arguments.npz, surface_npz(surface, grid, cloud, known))
    if arguments.out:
        write_atomically(arguments.out, surface_png(surface, grid, cloud, known, arguments.pano.name))
    line = {"seconds": round(seconds, 3), "poses_per_s": round(grid.num_poses / seconds)}
    files = {"out": arguments.out and str(arguments.out), "npz": arguments.npz and str(arguments.npz)}
    print_report(arguments, outputs, json.dumps(files | summary(surface, grid, cloud, known) | line))
    return 0
