"""Features of a cloud along a direction, and the log-odds with which they say that it points up."""

from typing import NamedTuple

import numpy as np

from ..geometry.pose import Array
from .planes import PointNormals, dot
from .sheet_features import SheetFeatures, Sides, sheet_features

# Lengths and angles of buildings, by hand
ALIGNED_ANGLE = np.radians(8.0)  # of a normal to the axis (floors), or to the plane across it (walls)
SHARP_ANGLE = np.radians(2.0)  # the same of what is built, not grown or slumped
BIN = 0.1  # of the histogram of heights, half a level's thickness [m]
MAX_BINS = 10_000  # for 1 km; coarser beyond
MIN_LEVEL = 0.1  # fraction of the largest level: of a floor, furniture may leave little to see
MIN_INNER = 0.5  # of the weaker of the outermost levels, of one between them: a table is not a floor
CLOSE = 4  # bins: levels closer than this are one that bends
MIN_STOREY = 1.5  # height, lower than any room [m]
MAX_STOREY = 5.0  # height of one whose floor or ceiling was not scanned [m]
UNSEEN_END_FACTOR = 0.5  # on the balance above and below for such a storey
FAR = 0.5  # beyond a level, further than it bends [m]
CLUTTER = (0.25, 2.0)  # height of what people use: skirting below, lamps and beams above [m]
FURNITURE = (0.3, 1.6)  # height of the tops of seats, tables, shelves, counters, cars [m]
FURNITURE_BIN = 0.05  # [m]
MAX_FURNITURE = 0.002  # fraction of the points that counts in a bin: furniture has many heights, beams one
# fractions of the points added to both counts of a ratio, so that a handful of points says little
CLUTTER_SOFTENING, FURNITURE_SOFTENING, BALANCE_SOFTENING = 0.003, 0.001, 0.1


class Weights(NamedTuple):
    """Log-odds a unit of each cue, in the order of UpFeatures.cues."""

    misaligned: float
    extent: float
    balance: float
    steps: float
    clutter: float
    furniture: float
    passages: float
    holes: float
    roofs: float


# By tools/calibrate_gravity.py --fit 10 20
WEIGHTS = Weights(1.92, 6.35, 5.29, 33.14, 1.36, 1.9, 2.36, 2.15, 3.06)


class UpFeatures(NamedTuple):
    """What a cloud looks like along an axis, and along one of its senses."""

    axis: Array  # (3,) unit
    level_energy: float  # root of the sum of squares of the levels' fractions of all points
    misaligned_fraction: float  # of the flat points: neither floor nor wall within 2 deg
    extent: float  # of the cloud along the axis [m]
    clutter_log_ratio: float  # of what stands on the levels to what hangs from them
    furniture_log_ratio: float  # of level faces as high as furniture above a level to those as far below one
    above_below_balance: float  # [-1, 1] points above the last level less those below the first, to both
    sheets: SheetFeatures  # what is above and below sheets

    @property
    def cues(self) -> Array:
        """Numbers (9,) of which the log-odds are a sum, in the order of Weights."""
        return np.array(
            [
                -np.log(self.misaligned_fraction + 0.02),
                -np.log(self.extent + 2.0),
                self.above_below_balance,
                np.clip(self.sheets.steps - 0.15, 0.0, 0.3),
                np.clip(self.clutter_log_ratio, -1.5, 1.5),
                np.clip(self.furniture_log_ratio, -2.0, 2.0),
                np.clip(self.sheets.passage_log_ratio, -1.5, 1.5),
                np.clip(self.sheets.hole_log_ratio, -2.5, 2.5),
                np.clip(self.sheets.roof_log_ratio, -2.0, 2.0),
            ]
        )


def up_features(cloud: PointNormals, sides: Sides, axis: Array) -> UpFeatures:
    """Features of a cloud along a unit vector `axis` (3,)."""
    cosines, is_flat = np.abs(dot(cloud.normals, axis)), cloud.is_flat
    is_level = is_flat & (cosines > np.cos(ALIGNED_ANGLE))
    is_wall = is_flat & (cosines < np.sin(ALIGNED_ANGLE))
    is_sharp = is_flat & ((cosines > np.cos(SHARP_ANGLE)) | (cosines < np.sin(SHARP_ANGLE)))
    heights = dot(cloud.points, axis)
    num_points = len(heights)
    low, high = map(float, np.quantile(heights, [0.01, 0.99]))
    levels, fractions = _find_levels(heights[is_level], num_points)
    storeys, balance = levels, 0.0
    if len(levels):
        above = int(np.count_nonzero(heights > levels[-1] + FAR))
        below = int(np.count_nonzero(heights < levels[0] - FAR))
        balance = (above - below) / (above + below + BALANCE_SOFTENING * num_points)
        # where a storey's floor or ceiling was not scanned, the end of the cloud stands in its place
        floor = [low] if MIN_STOREY < levels[0] - low < MAX_STOREY else []
        ceiling = [high] if MIN_STOREY < high - levels[-1] < MAX_STOREY else []
        storeys = np.array([*floor, *levels, *ceiling])
    if len(storeys) > len(levels):  # what was not scanned, floor or ceiling, clutter tells better
        balance *= UNSEEN_END_FACTOR
    return UpFeatures(
        axis=axis,
        level_energy=float(np.sqrt(np.sum(fractions**2))),
        misaligned_fraction=1.0 - np.count_nonzero(is_sharp) / np.count_nonzero(is_flat),
        extent=high - low,
        clutter_log_ratio=_clutter_log_ratio(heights[~is_wall], storeys, num_points),
        furniture_log_ratio=_furniture_log_ratio(heights[is_level], storeys, num_points),
        above_below_balance=balance,
        sheets=sheet_features(cloud, sides, axis, is_level, levels),
    )


def _find_levels(heights: Array, num_points: int) -> tuple[Array, Array]:
    """Levels (L,) [m], ascending, at which most of the `heights` lie, and their fractions of all points."""
    if len(heights) == 0:
        return np.empty(0), np.empty(0)
    low, high = np.quantile(heights, [0.001, 0.999])  # strays, however far, cost neither memory nor fineness
    size = max(BIN, float(high - low) / MAX_BINS)
    places = (heights[(heights >= low) & (heights <= high)] - low) / size
    counts = np.bincount(places.astype(np.int64) + 1, minlength=3)
    pairs = (counts[:-1] + counts[1:]).astype(np.float64)  # so that no border of a bin splits a level
    found: list[tuple[float, float]] = []
    while pairs.max() > 0:
        k = int(pairs.argmax())
        fraction = pairs[k] / num_points
        if found and fraction < MIN_LEVEL * found[0][1]:
            break
        found.append((float(low) + k * size, fraction))
        pairs[max(k - CLOSE, 0) : k + CLOSE + 1] = 0
    if not found:  # a handful of heights, of which the quantiles left none
        return np.empty(0), np.empty(0)
    levels, fractions = np.array(sorted(found)).T
    is_kept = fractions > MIN_INNER * min(fractions[0], fractions[-1])
    is_kept[[0, -1]] = True
    return levels[is_kept], fractions[is_kept]


def _distances_to_levels(heights: Array, levels: Array) -> tuple[Array, Array]:
    """How far `heights` (N,) are above the next level, and below the next; inf where there is none [m]."""
    next_level = np.searchsorted(levels, heights)
    return heights - np.append(-np.inf, levels)[next_level], np.append(levels, np.inf)[next_level] - heights


def _clutter_log_ratio(heights: Array, levels: Array, num_points: int) -> float:
    """Logarithm of the number of `heights` between levels that are near the lower to those near the upper."""
    above, below = _distances_to_levels(heights, levels)
    is_between = np.isfinite(above) & np.isfinite(below)
    low, high = CLUTTER
    lower = np.count_nonzero(is_between & (above > low) & (above < np.minimum(high, below)))
    upper = np.count_nonzero(is_between & (below > low) & (below < np.minimum(high, above)))
    softening = CLUTTER_SOFTENING * num_points
    return float(np.log((lower + softening) / (upper + softening)))


def _furniture_log_ratio(heights: Array, levels: Array, num_points: int) -> float:
    """Logarithm of the number of `heights` at a piece of furniture's above a level to those below one.

    Of those at the same height only so many count: rows of beams or lamps are no more than one table.
    """
    above, below = _distances_to_levels(heights, levels)
    low, high = FURNITURE
    lower = _spread_count(above[(above > low) & (above < np.minimum(high, below))], num_points)
    upper = _spread_count(below[(below > low) & (below < np.minimum(high, above))], num_points)
    softening = FURNITURE_SOFTENING * num_points
    return float(np.log((lower + softening) / (upper + softening)))


def _spread_count(heights: Array, num_points: int) -> float:
    """The number of `heights` [m], of which no more than a fraction of all points counts in a bin."""
    counts = np.bincount((heights / FURNITURE_BIN).astype(np.int64))
    return float(np.minimum(counts, MAX_FURNITURE * num_points).sum())
