"""Checks that every cloud passes, whatever file it came from, and the shift to its local origin."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .model import Cloud
from .order import canonical_order
from .raw import RawCloud

MIN_POINTS = 1000
MAX_COORDINATE = 1e8  # [m], ten times the Earth: beyond it lie only broken numbers, and float32 gives way
MIN_BRIGHTEST = 2  # of 255; 16-bit fields that hold 8-bit values come out at 1
METRES_LIMIT = 2000.0  # [m], a scan wider than this along two axes is more likely in millimetres
FAR = 16_384.0  # [m] from the origin, where float32 steps by 2 mm
MAX_SAMPLES = 100_000  # points that the estimate of the extent looks at


def clean(path: Path, raw: RawCloud, scale: float) -> Cloud:
    """The cloud of a file's points, finite ones only, scaled to metres, shifted and in canonical order."""
    points_world, colors, num_dropped = _finite(raw)
    if len(points_world) < MIN_POINTS:
        raise InputError(
            f"{path}: found {len(points_world)} finite points ({num_dropped} with NaN or infinite "
            f"coordinates), wanted at least {MIN_POINTS}"
        )
    brightest = int(colors.max())
    if brightest < MIN_BRIGHTEST:
        raise InputError(
            f"{path}: all points are black (brightest value {brightest} of 255), wanted a coloured cloud; "
            "numbers without a declared range are 0-255, not 0-1"
        )
    points_world = points_world * scale
    low, high = points_world.min(axis=0), points_world.max(axis=0)
    farthest = float(max(-low.min(), high.max()))
    if farthest > MAX_COORDINATE:
        raise InputError(
            f"{path}: a coordinate of {farthest:.3g} m, wanted all within {MAX_COORDINATE:.0e} m; "
            "remove the broken points or set --scale"
        )
    # Rounded to metres, so that adding it back costs no digit; of the box, so that no order matters.
    origin_world = np.round(0.5 * (low + high)) + 0.0
    # + 0.0 turns -0.0 into 0.0: equal points have equal bits
    points = (points_world - origin_world + 0.0).astype(np.float32)
    order = canonical_order(points, colors)
    points, colors = points[order], colors[order]
    warnings = _unit_warnings(path, points)
    if num_dropped:
        warnings = (f"{path}: {num_dropped} points with NaN or infinite coordinates left out", *warnings)
    return Cloud(points, colors, origin_world, num_dropped, warnings)


def _finite(raw: RawCloud) -> tuple[NDArray[np.float64], NDArray[np.uint8], int]:
    """Points (N, 3) and colours (N, 3) without those that are not finite, and how many were left out."""
    is_finite: NDArray[np.bool_] = np.all(np.isfinite(raw.points_world), axis=1)
    num_dropped = len(is_finite) - int(np.count_nonzero(is_finite))
    if num_dropped == 0:
        return raw.points_world, raw.colors, 0
    return raw.points_world[is_finite], raw.colors[is_finite], num_dropped


def _unit_warnings(path: Path, points: NDArray[np.float32]) -> tuple[str, ...]:
    """A line if the cloud (N, 3), in canonical order, looks like millimetres or is too wide for float32.

    Millimetres: 98 % of the points span more than 2,000 along at least two axes.
    """
    samples = points[:: 1 + len(points) // MAX_SAMPLES]
    low, high = np.percentile(samples, [1.0, 99.0], axis=0)
    if np.count_nonzero(high - low > METRES_LIMIT) >= 2:
        size = " x ".join(f"{extent:.0f}" for extent in high - low)
        return (f"{path}: the cloud spans {size} m; if its unit is the millimetre, set --scale 0.001",)
    farthest = np.abs(points).max()
    if farthest > FAR:
        step = np.spacing(farthest)
        return (
            f"{path}: points {2 * farthest:.0f} m apart blur the rest to {step:.2g} m; remove the outliers",
        )
    return ()
