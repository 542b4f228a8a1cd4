"""Kernel speed as ratios to cv2.remap in the same run."""

import time
from collections.abc import Callable

import cv2
import numpy as np

from piccolo.arrays import Array32, Bytes
from piccolo.cloud import Cloud
from piccolo.cloud.soa import pack_points
from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.optimize.sampling_loss import sampling_equations, sampling_loss
from piccolo.panorama.texels import pack_texels

from ..evaluation.tables import Table

NUM_ROUNDS = 15
MAX_POINTS = 1_000_000


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


def kernel_table(cloud: Cloud, rgb: Bytes) -> Table:
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
            "cv2.remap, 1 thread": lambda: cv2.remap(rgb, map_u, map_v, cv2.INTER_LINEAR),
            "loss, 1 thread": lambda: sampling_loss(points, texels, pose, 1),
            "loss, 2 threads": lambda: sampling_loss(points, texels, pose, 2),
            "loss + gradient + normal matrix, 1 thread": lambda: sampling_equations(points, texels, pose, 1),
            "loss + gradient + normal matrix, 2 threads": lambda: sampling_equations(points, texels, pose, 2),
        },
        NUM_ROUNDS,
    )
    reference = map_u.size / seconds["cv2.remap, 1 thread"]
    rows = []
    for name, value in seconds.items():
        count = map_u.size if name.startswith("cv2") else num_points
        alone = seconds[name.replace("2 threads", "1 thread")]
        speed = count / value
        rows.append((name, f"{speed / 1e6:.0f}", f"{speed / reference:.2f}", f"{alone / value:.2f}"))
    title = f"{num_points:,} points, {rgb.shape[1]} x {rgb.shape[0]} image, medians of {NUM_ROUNDS} rounds."
    return Table(title, ("kernel", "Mpoint/s", "of cv2.remap", "of its one thread"), tuple(rows))
