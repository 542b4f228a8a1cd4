"""Intensity as a gray, for files that have no colours; labels as colours, in place of the file's own.

The unit of intensity is each scanner's own, and a few mirrors outshine everything. So a file's 1st percentile
becomes black and its 99th white: of all its points, in a reading of their own, whatever their order.
"""

import functools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ..label_colors import Labels, colors_of
from .reader import ChunkReader, CloudReadOptions, PointsWithScalar, RawCloud, ScalarReader

INTENSITY_NAMES = frozenset({"intensity", "scalar_intensity", "reflectance", "scalar_reflectance"})
OPTION = "--intensity-as-gray takes it for a gray"
BLACK, WHITE = 0.01, 0.99  # share of the points that are darker
LARGEST = float(np.finfo(np.float32).max)
NUM_BINS = 1 << 16
# as they stand in PLY files, in lower case; the first that is there counts. CloudCompare prefixes `scalar_`
LABEL_NAMES = ("label", "scalar_label", "class", "scalar_class", "classification", "scalar_classification")
MOST = 2.0**32  # labels are below it, and above its negative


def intensity_reader(path: Path, read_scalar: ScalarReader) -> ChunkReader:
    """What a PointSource wants as `read_chunks`, of a reader of points and their intensity."""
    limits = functools.cache(lambda: _limits(path, read_scalar()))

    def read_chunks() -> Iterator[RawCloud]:
        low, high = limits()
        for points, intensity in read_scalar():
            yield RawCloud(points, as_gray(intensity, low, high))

    return read_chunks


def check_option(path: Path, options: CloudReadOptions, wanted: str) -> None:
    """Refuse a file with intensity and no colours unless the user wants its intensity for a gray."""
    if not options.intensity_as_gray:
        raise InputError(f"{path}: has intensity and no colours, {wanted}; {OPTION}")


def as_gray(intensity: NDArray[np.float64], low: float, high: float) -> NDArray[np.uint8]:
    """Gray (N, 3) of intensity (N,): black up to `low`, white from `high` on; black where it is NaN."""
    share = (np.nan_to_num(intensity, nan=low) - low) / (high - low)
    gray = np.rint(255.0 * np.clip(share, 0.0, 1.0)).astype(np.uint8)
    return np.repeat(gray[:, None], 3, axis=1)


def _limits(path: Path, chunks: Iterator[PointsWithScalar]) -> tuple[float, float]:
    """Percentiles of the intensity of points that have a position, within 1 %, or exact up to 255."""
    histogram = np.zeros(NUM_BINS, np.int64)
    for points, intensity in chunks:
        is_measured = np.isfinite(points).all(axis=1) & np.isfinite(intensity)
        histogram += np.bincount(_bins(intensity[is_measured]), minlength=NUM_BINS)
    total = np.cumsum(histogram)
    if total[-1] == 0:  # no point has a position: others refuse that
        return 0.0, 1.0
    low, high = (_lower_edge(int(np.searchsorted(total, share * total[-1]))) for share in (BLACK, WHITE))
    if not low < high:
        raise InputError(f"{path}: the intensity is {low:g} nearly everywhere, wanted colours")
    return low, high


def _bins(values: NDArray[np.float64]) -> NDArray[np.int64]:
    """Bin (N,) of each value: the upper half of its bits as a float32, in ascending order."""
    # + 0.0 turns -0.0 into 0.0
    bits = (np.clip(values, -LARGEST, LARGEST) + 0.0).astype(np.float32).view(np.uint32)
    bits = np.where(bits >> 31, ~bits, bits | np.uint32(1 << 31))
    return (bits >> 16).astype(np.int64)


def _lower_edge(index: int) -> float:
    """The value nearest to 0 in a bin."""
    bits = (index << 16) ^ (1 << 31) if index >= NUM_BINS // 2 else ~(index << 16 | 0xFFFF) & 0xFFFFFFFF
    return float(np.array(bits, np.uint32).view(np.float32))


def label_reader(path: Path, read_scalar: ScalarReader, labels: Labels) -> ChunkReader:
    """What a PointSource wants as `read_chunks`, of a reader of points and their labels."""

    def read_chunks() -> Iterator[RawCloud]:
        for points, raw in read_scalar():
            values = np.where(np.isfinite(points).all(axis=1), raw, 0.0)  # the others are left out later
            is_whole = (np.abs(values) < MOST) & (values == np.floor(values))
            if not is_whole.all():
                wrong = f"found the label {values[np.argmin(is_whole)]:g}"
                raise InputError(f"{path}: {wrong}, wanted whole numbers")
            numbers = values.astype(np.int64)
            is_kept = labels.are_kept(numbers)
            yield RawCloud(points[is_kept], colors_of(numbers[is_kept]))

    return read_chunks
