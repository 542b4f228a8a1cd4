"""Seeded clouds in memory, and the points of files as readers find them."""

from pathlib import Path

import numpy as np

from piccolo.cloud.cloud_settings import IN_COLORS
from piccolo.cloud.readers.reader import PointSource, RawCloud
from piccolo.cloud.stream import CloudStream, open_source
from piccolo.geometry.pose import exp_so3

TURN = exp_so3(np.array([0.3, -0.7, 1.9]))
LEVEL = np.eye(3)


def seeded_cloud(seed, num_points=1500, size=(6.0, 5.0, 2.5), step=0.0):
    """Points in a box, float64, and colours; snapped to a grid of `step` if given, so that many coincide."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (num_points, 3)) * size
    if step:
        points = np.round(points / step) * step
    return RawCloud(points, rng.integers(0, 256, (num_points, 3), dtype=np.uint8))


def whole(open_file, path, options=IN_COLORS, *channel):
    """All points that a reader finds in a file."""
    none = RawCloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    chunks = list(open_file(path, options, *channel).read_chunks()) or [none]
    return RawCloud(*(np.concatenate(arrays) for arrays in zip(*chunks, strict=True)))


def read(path):
    """Points (N, 3) and colours (N, 3) of a file, by the reader that its content asks for."""
    raw = whole(open_source, path)
    return raw.points_world, raw.colors


def part(raw, indices):
    return RawCloud(raw.points_world[indices], raw.colors[indices])


def stream(*raws, chunk=10**9, scale=1.0):
    """A cloud of as many files, each handed on in chunks."""

    def source(k, raw):
        chunks = [part(raw, slice(lo, lo + chunk)) for lo in range(0, len(raw.colors), chunk)]
        return PointSource(Path(f"{k}.ply"), lambda: iter(chunks), len(raw.colors), units=(scale,) * 3)

    return CloudStream([source(k, raw) for k, raw in enumerate(raws)])
