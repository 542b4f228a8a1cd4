"""Time, memory and recall of the default method by the number of points and of rooms."""

import multiprocessing
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from piccolo.cloud import Cloud, read_cloud, stream_points
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
from piccolo.scene import Query, Scene

from ..evaluation.tables import Table
from ..synthetic.world import make_query, make_world, scan_world

NUM_QUERIES = 6
GRAVITIES: tuple[Gravity, ...] = ("known", "unknown")
COLUMNS = (
    "scan", "points", "prepare s", "features s", "map MB", "open ms", "known s", "right", "unknown s",
    "right", "peak MB",
)  # fmt: skip

Case = tuple[Cloud, list[tuple[Panorama, Pose]]]  # a cloud, and panoramas in it with their true poses


def clean_queries(scene: Scene, count: int) -> list[Query]:
    """Return the first queries of the variant clean, or of all if there is none."""
    clean = [query for query in scene.queries if query.variant == "clean"]
    return (clean or list(scene.queries))[:count]


def scene_case(scene: Scene, num_points: int) -> Case:
    """Resample a scene to `num_points` points: leave some out, or repeat them with 5 mm noise."""
    cloud = read_cloud(scene.cloud)
    rng = np.random.default_rng(0)
    index = rng.permutation(len(cloud.points))[:num_points]
    if num_points > len(index):
        index = np.resize(index, num_points)
    points = cloud.points[index]
    if num_points > len(cloud.points):
        points = points + rng.normal(0.0, 0.005, points.shape).astype(np.float32)
    taken = clean_queries(scene, NUM_QUERIES)
    queries = [(read_panorama(query.image), query.pose) for query in taken]
    raw = RawCloud(points + cloud.origin_world, cloud.colors[index])
    return stream_points(scene.cloud, raw).read(), queries


def rooms_case(num_rooms: int) -> Case:
    """Make seeded rooms side by side."""
    workers = Workers(num_cores())
    world = make_world(11, np.array([5.0, 4.0, 2.6]), num_rooms)
    points, colors, _ = scan_world(world, 50_000 * num_rooms, workers)
    taken = [make_query(world, k, "clean", 1024, workers) for k in range(NUM_QUERIES)]
    queries = [(Panorama(q.rgb, np.ones(q.rgb.shape[:2], dtype=bool)), q.pose) for q in taken]
    return stream_points(Path("rooms"), RawCloud(points.astype(np.float64), colors)).read(), queries


def measure_file(scan_map: ScanMap) -> tuple[str, str]:
    """Return the size [MB] of a map's file, and the time [ms] to open it once it has been checked."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scan.map"
        save_map(replace(scan_map, scan_sha256=64 * "0"), path)  # whatever the scan is
        load_map(path, remembers=True)
        begin = time.perf_counter()
        load_map(path, remembers=True)
        return f"{path.stat().st_size / 1e6:.1f}", f"{1000.0 * (time.perf_counter() - begin):.0f}"


def peak_memory_mb() -> float:
    """Return the peak of this process [MB]; getrusage would count its parent's, from before the exec."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1000.0


def measure(label: str, make: Callable[[], Case]) -> tuple[str, ...]:
    """Return one row of the table."""
    cloud, queries = make()
    workers = Workers(num_cores())
    every = max(1, len(cloud.points) // 20_000)
    small = Cloud(cloud.points[::every], cloud.colors[::every], cloud.origin_world)
    for gravity in GRAVITIES:  # compiles
        settings = CoarseToFineSettings(gravity=gravity)
        localize(prepare_map(small, workers), queries[0][0], settings, workers, Stopwatch())
    begin = time.perf_counter()
    scan_map = prepare_map(cloud, workers, has_features=False)
    columns = [label, f"{len(cloud.points):,}", f"{time.perf_counter() - begin:.1f}"]
    begin = time.perf_counter()
    scan_map.features_now(workers)
    columns.append(f"{time.perf_counter() - begin:.1f}")
    columns += measure_file(scan_map)
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
    return (*columns, f"{peak_memory_mb():.0f}")


def size_table(
    scene: Scene, points: Sequence[int], rooms: Sequence[int], show: Callable[[str], object]
) -> Table:
    """Measure each size in a process of its own: a scene with so many points, and so many made rooms."""
    cases = [(f"{scene.name}, resampled", partial(scene_case, scene, n)) for n in points]
    cases += [(f"made rooms: {n}", partial(rooms_case, n)) for n in rooms]
    rows = []
    spawned = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawned, max_tasks_per_child=1) as processes:
        for label, make in cases:
            rows.append(processes.submit(measure, label, make).result())
            show(" ".join(rows[-1]))
    return Table("", COLUMNS, tuple(rows))
