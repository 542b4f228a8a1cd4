"""Kernel speed against named references, as ratios within one run."""

import argparse
import time
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from piccolo.cli.command import option
from piccolo.cli.errors import UsageError
from piccolo.cloud import read_cloud
from piccolo.cloud.soa import PackedPoints, pack_points
from piccolo.cloud.voxels import morton_order
from piccolo.errors import InputError
from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.jobs.threads import Workers, num_cores
from piccolo.optimize.sampling_loss import sampling_equations, sampling_loss
from piccolo.panorama import read_panorama
from piccolo.panorama.texels import pack_texels
from piccolo.scenes.synthetic.world import make_query, make_world, scan_world

EPILOG = """\
example:
  python tools/benchmark.py kernels --cloud scan.ply --pano query.jpg

Every kernel is timed once in each round, so that a disturbance hits all; ratios are of the medians.
The reference is cv2.remap: 8-bit, 3 channels, bilinear, one thread, a coherent map, a pixel a point.
"""

Case = tuple[PackedPoints, NDArray[np.uint8], Pose]  # what is timed: points, image (H, W, 3), pose


def case_of(arguments: argparse.Namespace) -> Case:
    """A user's scan and panorama, or those of a made room; the camera at the middle of the points."""
    if arguments.cloud:
        cloud = read_cloud(arguments.cloud)
        points = cloud.points
        colors = cloud.colors
        rgb = read_panorama(arguments.pano).rgb
    else:
        workers = Workers(num_cores())
        world = make_world(0, np.array([8.0, 6.0, 3.0]))
        points, colors, _ = scan_world(world, arguments.points, workers)
        rgb = make_query(world, 0, "clean", 1024, workers).rgb
        order = morton_order(points, colors)
        points = points[order]
        colors = colors[order]
    if len(points) < arguments.points:
        raise InputError(f"{arguments.cloud}: found {len(points)} points, wanted --points {arguments.points}")
    chosen = np.linspace(0, len(points) - 1, arguments.points).astype(np.int64)
    pose = Pose(yaw_rotation(0.7), np.median(points, axis=0).astype(np.float64))
    return pack_points(points[chosen], colors[chosen]), rgb, pose


def coherent_map(num_pixels: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A smooth map of about `num_pixels` that runs over a whole image of `width` x width / 2."""
    side = round(num_pixels**0.5)
    u, v = np.meshgrid(np.linspace(4, width - 5, side), np.linspace(4, width // 2 - 5, side))
    return (u + 3 * np.sin(v / 50)).astype(np.float32), (v + 3 * np.sin(u / 50)).astype(np.float32)


def medians(contenders: dict[str, Callable[[], object]], num_rounds: int) -> dict[str, float]:
    """Median seconds of each kernel over the rounds."""
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for run in contenders.values():
        run()  # compiles, and warms the caches
    for _ in range(num_rounds):
        for name, run in contenders.items():
            begin = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - begin)
    return {name: float(np.median(values)) for name, values in seconds.items()}


def run_kernels(case: Case, num_rounds: int) -> None:
    """Print the table of the kernels."""
    cv2.setNumThreads(1)
    points, rgb, pose = case
    texels = pack_texels(rgb)
    map_u, map_v = coherent_map(len(points), rgb.shape[1])
    seconds = medians(
        {
            "cv2.remap, 1 thread": lambda: cv2.remap(rgb, map_u, map_v, cv2.INTER_LINEAR),
            "loss, 1 thread": lambda: sampling_loss(points, texels, pose, 1),
            "loss, 2 threads": lambda: sampling_loss(points, texels, pose, 2),
            "loss + gradient + normal matrix, 1 thread": lambda: sampling_equations(points, texels, pose, 1),
            "loss + gradient + normal matrix, 2 threads": lambda: sampling_equations(points, texels, pose, 2),
        },
        num_rounds,
    )
    reference = map_u.size / seconds["cv2.remap, 1 thread"]
    same = sampling_loss(points, texels, pose, 1) == sampling_loss(points, texels, pose, 2)
    print(f"{len(points)} points, {rgb.shape[1]} x {rgb.shape[0]} image, {num_cores()} cores\n")
    print("| kernel | Mpoint/s | of cv2.remap | of its one thread |")
    print("|---|---:|---:|---:|")
    for name, value in seconds.items():
        count = map_u.size if name.startswith("cv2") else len(points)
        alone = seconds[name.replace("2 threads", "1 thread")]
        speed = count / value
        print(f"| {name} | {speed / 1e6:.0f} | {speed / reference:.2f} | {alone / value:.2f} |")
    print(f"\nsame bits with 1 and 2 threads: {'yes' if same else 'NO'}")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    option(parser, "--cloud FILE", "a scan (default: a made room)")
    option(parser, "--pano FILE", "a panorama, with --cloud")
    option(parser, "--points N", default=1_000_000)
    option(parser, "--rounds N", "at least 7", default=15)


def run(arguments: argparse.Namespace) -> int:
    """Make the case, time the kernels."""
    if (arguments.cloud is None) != (arguments.pano is None):
        raise UsageError("--cloud and --pano go together")
    if arguments.rounds < 7 or arguments.points < 1000:
        raise UsageError("wanted --rounds of at least 7 and --points of at least 1000")
    run_kernels(case_of(arguments), arguments.rounds)
    return 0
