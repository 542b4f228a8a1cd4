"""Checks applied to every chunk of points, whatever file it came from."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .readers.reader import RawCloud

MIN_POINTS = 1000
MAX_COORDINATE = 1e8  # [m], ten times the Earth: beyond it lie only broken numbers, and float32 gives way
MIN_BRIGHTEST = 2  # of 255; 16-bit fields that hold 8-bit values come out at 1
METRES_LIMIT = 2000.0  # [m], a scan wider than this along two axes is more likely in millimetres
FAR = 16_384.0  # [m] from the origin, where float32 steps by 2 mm
MAX_SAMPLES = 100_000  # points that the estimate of the extent looks at

Chunk = tuple[NDArray[np.float64], NDArray[np.uint8]]  # finite points (N, 3) [m], colours (N, 3)


@dataclass
class PointValidator:
    """What is known of a file's points so far."""

    path: Path
    scale: float  # metres per unit of the file
    num_finite: int = 0
    num_dropped: int = 0  # with NaN or infinite coordinates
    brightest: int = 0

    def filter(self, raw: RawCloud) -> Chunk:
        """The finite points of a chunk, after they have been counted."""
        points, colors = raw.points_world, raw.colors
        is_finite: NDArray[np.bool_] = np.all(np.isfinite(points), axis=1)
        num_finite = int(np.count_nonzero(is_finite))
        if num_finite < len(points):
            points, colors = points[is_finite], colors[is_finite]
        self.num_finite += num_finite
        self.num_dropped += len(is_finite) - num_finite
        if num_finite:
            points = points * self.scale
            self.brightest = max(self.brightest, int(colors.max()))
            self._check_coordinates(points)
        return points, colors

    def _check_coordinates(self, points: NDArray[np.float64]) -> None:
        farthest = max(-float(points.min()), float(points.max()))
        if farthest > MAX_COORDINATE:
            found = f"a coordinate of {farthest:.3g} m, wanted all within {MAX_COORDINATE:.0e} m"
            raise InputError(f"{self.path}: {found}; remove broken points or set --units or --scale")

    def check(self) -> None:
        """Refuse points that are no coloured cloud, when all have passed."""
        if self.num_finite < MIN_POINTS:
            found = f"found {self.num_finite} finite points ({self.num_dropped} with NaN or infinity)"
            raise InputError(f"{self.path}: {found}, wanted at least {MIN_POINTS}")
        if self.brightest < MIN_BRIGHTEST:
            found = f"all points are black (brightest value {self.brightest} of 255)"
            raise InputError(f"{self.path}: {found}; numbers without a declared range are 0-255, not 0-1")

    def warnings(self) -> tuple[str, ...]:
        """A line if points were left out."""
        if self.num_dropped:
            return (f"{self.path}: {self.num_dropped} points with NaN or infinite coordinates left out",)
        return ()


def unit_warnings(label: str, points: NDArray[np.float32]) -> tuple[str, ...]:
    """A line if points (N, 3), in Morton order, look like millimetres or are too far apart for float32.

    Millimetres: 98 % of the points span more than 2,000 along at least two axes.
    """
    samples = points[:: 1 + len(points) // MAX_SAMPLES]
    low, high = np.percentile(samples, [1.0, 99.0], axis=0)
    if np.count_nonzero(high - low > METRES_LIMIT) >= 2:
        size = " x ".join(f"{extent:.0f}" for extent in high - low)
        return (f"{label}: the cloud spans {size} m; if its unit is the millimetre, set --units mm",)
    farthest = float(np.abs(points).max())
    if farthest > FAR:
        blur = f"blur the rest to {np.spacing(np.float32(farthest)):.2g} m"
        return (f"{label}: points {2 * farthest:.0f} m apart {blur}; remove the outliers",)
    return ()
