"""Speed: of the default method by the number of points and rooms, with memory and recall; and of kernels."""

import multiprocessing
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

import piccolo
from piccolo.cloud.stream import CloudPoints, open_cloud
from piccolo.geometry.nearness import RIGHT
from piccolo.geometry.points import pack_points
from piccolo.geometry.pose import Gravity, Pose, yaw_rotation
from piccolo.optimize.sampling_loss import sampling_equations, sampling_loss
from piccolo.photo.panorama import read_panorama
from piccolo.photo.panorama.texels import pack_texels
from piccolo.system.arrays import Array32, Bytes, Floats
from piccolo.system.jobs.threads import Workers, num_cores

from ..evaluation.tables import Table
from ..scene import Query, Scene
from ..synthetic.world import make_query, make_world, scan_world

NUM_ROUNDS = 15
MAX_POINTS = 1_000_000
NUM_QUERIES = 6
GRAVITIES: tuple[Gravity, ...] = ("known", "unknown")
COLUMNS = (
    "scan", "points", "prepare s", "save s", "map MB", "open ms", "known s", "right", "first unknown s",
    "unknown s", "right", "peak MB",
)  # fmt: skip


class Case(NamedTuple):
    """A scan, and panoramas in it with their true poses."""

    points: Floats  # (N, 3) [m]
    colors: Bytes  # (N, 3)
    queries: list[tuple[Bytes, piccolo.Pose]]

    def open_scan(self, every: int = 1) -> piccolo.Scan:
        """Prepare one of `every` so many points."""
        return piccolo.open_scan(piccolo.Cloud(self.points[::every], colors=self.colors[::every]))


def clean_queries(scene: Scene, count: int) -> list[Query]:
    """Return the first queries of the variant clean, or of all if there is none."""
    clean = [query for query in scene.queries if query.variant == "clean"]
    return (clean or list(scene.queries))[:count]


def scene_case(scene: Scene, num_points: int, num_queries: int = NUM_QUERIES) -> Case:
    """Resample a scene to `num_points` points: leave some out, or repeat them with 5 mm noise."""
    cloud = open_cloud([scene.cloud]).read()
    rng = np.random.default_rng(0)
    index = rng.permutation(len(cloud.points))[:num_points]
    if num_points > len(index):
        index = np.resize(index, num_points)
    points = cloud.points[index]
    if num_points > len(cloud.points):
        points = points + rng.normal(0.0, 0.005, points.shape).astype(np.float32)
    queries = [(read_panorama(q.image).rgb, q.pose) for q in clean_queries(scene, num_queries)]
    return Case(points + cloud.origin_world, cloud.colors[index], queries)


def rooms_case(num_rooms: int, num_queries: int = NUM_QUERIES) -> Case:
    """Make seeded rooms side by side."""
    workers = Workers(num_cores())
    world = make_world(11, np.array([5.0, 4.0, 2.6]), num_rooms)
    points, colors, _ = scan_world(world, 50_000 * num_rooms, workers)
    taken = [make_query(world, k, "clean", 1024, workers) for k in range(num_queries)]
    return Case(points, colors, [(query.rgb, query.pose) for query in taken])


def peak_memory_mb() -> float:
    """Return the peak of this process [MB]; getrusage would count its parent's, from before the exec."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1000.0


def measure(label: str, make: Callable[[], Case]) -> tuple[str, ...]:
    """Return one row of the table."""
    case = make()
    small = case.open_scan(every=max(1, len(case.points) // 20_000))
    for gravity in GRAVITIES:  # compiles
        small.localize(case.queries[0][0], gravity=gravity)
    begin = time.perf_counter()
    scan = case.open_scan()
    columns = [label, f"{len(case.points):,}", f"{time.perf_counter() - begin:.1f}"]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scan.map"
        begin = time.perf_counter()
        scan.save(path)
        columns += [f"{time.perf_counter() - begin:.1f}", f"{path.stat().st_size / 1e6:.1f}"]
        piccolo.open_scan(path)  # which checks it
        begin = time.perf_counter()
        piccolo.open_scan(path)
        columns.append(f"{1000.0 * (time.perf_counter() - begin):.0f}")
    for gravity in GRAVITIES:
        times = []
        correct = 0
        for rgb, truth in case.queries:
            begin = time.perf_counter()
            found = scan.localize(rgb, gravity=gravity)
            times.append(time.perf_counter() - begin)
            correct += found.best_pose is not None and RIGHT.holds(found.best_pose, truth)
        if gravity == "unknown":  # for which the scan is drawn
            columns.append(f"{times[0]:.2f}")
        columns += [f"{np.median(times):.2f}", f"{correct}/{len(case.queries)}"]
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


def coherent_map(num_pixels: int, width: int) -> tuple[Array32, Array32]:
    """Return a smooth map of about `num_pixels` that runs over a whole image of `width` x width / 2."""
    side = round(num_pixels**0.5)
    u, v = np.meshgrid(np.linspace(4, width - 5, side), np.linspace(4, width // 2 - 5, side))
    return (u + 3 * np.sin(v / 50)).astype(np.float32), (v + 3 * np.sin(u / 50)).astype(np.float32)


def medians(contenders: dict[str, Callable[[], object]], num_rounds: int) -> dict[str, float]:
    """Return the median seconds of each kernel over rounds, so that a disturbance hits all."""
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for run in contenders.values():
        run()  # compiles, and warms the caches
    for _ in range(num_rounds):
        for name, run in contenders.items():
            begin = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - begin)
    return {name: float(np.median(values)) for name, values in seconds.items()}


def kernel_table(cloud: CloudPoints, rgb: Bytes) -> Table:
    """Time the kernels on a scan and a panorama (H, W, 3), the camera at the middle of the points.

    The reference is cv2.remap: 8-bit, 3 channels, bilinear, one thread, a coherent map, a pixel a point.
    """
    cv2.setNumThreads(1)
    num_points = min(MAX_POINTS, len(cloud.points))
    chosen = np.linspace(0, len(cloud.points) - 1, num_points).astype(np.int64)
    points = pack_points(cloud.points[chosen], cloud.colors[chosen])
    pose = Pose(yaw_rotation(0.7), np.median(cloud.points, axis=0).astype(np.float64))
    texels = pack_texels(rgb)
    map_u, map_v = coherent_map(num_points, rgb.shape[1])
    seconds = medians(
        {
            "cv2.remap": lambda: cv2.remap(rgb, map_u, map_v, cv2.INTER_LINEAR),
            "loss": lambda: sampling_loss(points, texels, pose),
            "loss + gradient + normal matrix": lambda: sampling_equations(points, texels, pose),
        },
        NUM_ROUNDS,
    )
    reference = map_u.size / seconds["cv2.remap"]
    rows = []
    for name, value in seconds.items():
        count = map_u.size if name.startswith("cv2") else num_points
        speed = count / value
        rows.append((name, f"{speed / 1e6:.0f}", f"{speed / reference:.2f}"))
    title = f"{num_points:,} points, {rgb.shape[1]} x {rgb.shape[0]} image, medians of {NUM_ROUNDS} rounds."
    return Table(title, ("kernel", "Mpoint/s", "of cv2.remap"), tuple(rows))
