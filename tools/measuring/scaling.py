"""Time, memory and recall of the default method by the number of points and of rooms."""

import argparse
import multiprocessing
import resource
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from piccolo.cli.command import option
from piccolo.cli.errors import UsageError
from piccolo.cloud import Cloud, read_cloud, stream_of
from piccolo.cloud.readers.reader import RawCloud
from piccolo.geometry.pose import Pose, is_correct
from piccolo.geometry.rotations import Gravity
from piccolo.jobs.stopwatch import Stopwatch
from piccolo.jobs.threads import Workers, num_cores
from piccolo.localization.localize import localize
from piccolo.localization.settings import CoarseToFineSettings
from piccolo.panorama import Panorama, read_panorama
from piccolo.scan_map.map_file import load_map, save_map
from piccolo.scan_map.scan_map import ScanMap, prepare_map
from piccolo.scenes.scene import read_scene
from piccolo.scenes.synthetic.world import make_query, make_world, scan_world

EPILOG = """\
examples:
  python tools/benchmark.py scaling --scene BENCH/house --points 10000 100000 1000000
  python tools/benchmark.py scaling --rooms 1 4 16 64

--scene: a folder with cloud.ply, queries.json and images; more points than it has are made by repeating it
with 5 mm noise, fewer by leaving some out. --rooms: rooms of tools/make_room.py, 50,000 points each.
Each row is measured in a process of its own; local features, which come late, by themselves. Queries are the
first six clean ones, gravity known and unknown.
"""
NUM_QUERIES = 6
GRAVITIES: tuple[Gravity, ...] = ("known", "unknown")
COLUMNS = (
    "case", "points", "candidates", "prepare s", "map MB", "open ms", "features s", "known s", "found",
    "unknown s", "found", "peak MB", "before",
)  # fmt: skip

Case = tuple[Cloud, list[tuple[Panorama, Pose]]]  # a cloud, and panoramas in it with their true poses


def scene_case(folder: Path, num_points: int) -> Case:
    """A scene resampled to `num_points` points."""
    scene = read_scene(folder)
    cloud = read_cloud(scene.cloud)
    rng = np.random.default_rng(0)
    index = rng.permutation(len(cloud.points))[:num_points]
    if num_points > len(index):
        index = np.resize(index, num_points)
    points = cloud.points[index]
    if num_points > len(cloud.points):
        points = points + rng.normal(0.0, 0.005, points.shape).astype(np.float32)
    taken = [query for query in scene.queries if query.variant == "clean"][:NUM_QUERIES]
    queries = [(read_panorama(query.image), query.pose) for query in taken]
    raw = RawCloud(points + cloud.origin_world, cloud.colors[index])
    return stream_of(folder, raw).read(), queries


def rooms_case(num_rooms: int) -> Case:
    """Seeded rooms side by side."""
    workers = Workers(num_cores())
    world = make_world(11, np.array([5.0, 4.0, 2.6]), num_rooms)
    points, colors, _ = scan_world(world, 50_000 * num_rooms, workers)
    taken = [make_query(world, k, "clean", 1024, workers) for k in range(NUM_QUERIES)]
    queries = [(Panorama(q.rgb, np.ones(q.rgb.shape[:2], dtype=bool)), q.pose) for q in taken]
    return stream_of(Path("rooms"), RawCloud(points.astype(np.float64), colors)).read(), queries


def size_and_opening(scan_map: ScanMap) -> tuple[str, str]:
    """Size [MB] of a map's file, and how long it takes to open it [ms] once it has been checked."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scan.map"
        save_map(replace(scan_map, scan_sha256=64 * "0"), path)  # whatever the scan is
        load_map(path, remembers=True)
        begin = time.perf_counter()
        load_map(path, remembers=True)
        return f"{path.stat().st_size / 1e6:.1f}", f"{1000.0 * (time.perf_counter() - begin):.0f}"


def measure(label: str, make: Callable[[], Case]) -> str:
    """One row of the table."""
    cloud, queries = make()
    workers = Workers(num_cores())
    every = max(1, len(cloud.points) // 20_000)
    small = Cloud(cloud.points[::every], cloud.colors[::every], cloud.origin_world)
    for gravity in GRAVITIES:  # compiles
        settings = CoarseToFineSettings(gravity=gravity)
        localize(prepare_map(small, workers), queries[0][0], settings, workers, Stopwatch())
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    begin = time.perf_counter()
    scan_map = prepare_map(cloud, workers, has_features=False)
    columns = [label, str(len(cloud.points)), str(len(scan_map.centers))]
    columns.append(f"{time.perf_counter() - begin:.1f}")
    columns += size_and_opening(scan_map)
    begin = time.perf_counter()
    scan_map.features_now(workers)
    columns.append(f"{time.perf_counter() - begin:.1f}")
    for gravity in GRAVITIES:
        settings = CoarseToFineSettings(gravity=gravity)
        times = []
        correct = 0
        for panorama, truth in queries:
            begin = time.perf_counter()
            found = localize(scan_map, panorama, settings, workers, Stopwatch())
            times.append(time.perf_counter() - begin)
            correct += is_correct(found.pose, truth)
        columns += [f"{np.median(times):.2f}", f"{correct}/{len(queries)}"]
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return f"| {' | '.join([*columns, f'{peak_mb:.0f}', f'{before_mb:.0f}'])} |"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """All options."""
    option(parser, "--scene FOLDER", "with --points")
    option(parser, "--points N ...", "with --scene", default=[])
    option(parser, "--rooms N ...", "1 to 256", default=[])


def run(arguments: argparse.Namespace) -> int:
    """Print the table, each row measured in a process of its own."""
    if bool(arguments.scene) != bool(arguments.points) or not (arguments.points or arguments.rooms):
        raise UsageError("wanted --scene with --points, or --rooms")
    rows = [(f"{n} points", partial(scene_case, arguments.scene, n)) for n in arguments.points]
    rows += [(f"{n} rooms", partial(rooms_case, n)) for n in arguments.rooms]
    print(f"| {' | '.join(COLUMNS)} |")
    print("|---" + "|---:" * (len(COLUMNS) - 1) + "|")
    spawned = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawned, max_tasks_per_child=1) as processes:
        for label, make in rows:
            print(processes.submit(measure, label, make).result(), flush=True)
    return 0
