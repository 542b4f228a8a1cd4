"""Features of a cloud along a direction, and the log-odds with which they say that it points up."""

from typing import NamedTuple

import numpy as np

from ..geometry.pose import Array
from .planes import PointNormals, dot
from .sheet_features import SheetFeatures, Sides, sheet_features

# Lengths and angles of buildings, by hand. On 138 clouds (twelve made-up places of each kind, two turns each
# of the scenes house, hospital and hall) one of them halved or doubled changes at most 7 answers, but for
# FURNITURE up to 2.4 m (11) and a MIDDLE without margins (10 of 69).
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
FURNITURE = (0.3, 1.2)  # height of seats, beds, tables, boxes [m]
MIDDLE = (0.15, 0.5, 0.85)  # fractions of a storey: skirting below, clutter or air, lamps and beams above
# fractions of the points added to both counts of a ratio, so that a handful of points says little
CLUTTER_SOFTENING, FURNITURE_SOFTENING, BALANCE_SOFTENING = 0.003, 0.001, 0.1


class Weights(NamedTuple):
    """Log-odds a unit of each cue, in the order of UpFeatures.cues."""

    level_energy: float
    off_axis: float
    misaligned: float
    non_manhattan: float
    extent: float
    balance: float
    steps: float
    clutter: float
    furniture: float
    holes: float
    tops: float
    roofs: float


NUM_SENSE_CUES = 5  # the last ones: what tells one sense of an axis from the other
# By a fit as that of tools/calibrate_gravity.py, on seeds 0 to 9 of all kinds, without tops, weighed
# by hand: made-up things have no undersides, and in house, hospital and hall tops speak against the truth.
WEIGHTS = Weights(0.0, 0.0, 1.05, 0.0, 5.65, 3.5, 20.55, 2.81, 2.33, 0.35, 1.0, 3.04)
SENSE_SHARING = 0.13  # 0: what tells the senses of an axis apart speaks for the axis in full; 1: not at all


class UpFeatures(NamedTuple):
    """What a cloud looks like along an axis, and along one of its senses."""

    axis: Array  # (3,) unit
    level_energy: float  # root of the sum of squares of the levels' fractions of all points
    off_axis_fraction: float  # of the flat points: neither floor nor wall
    misaligned_fraction: float  # of the flat points: neither floor nor wall within 2 deg
    non_manhattan_fraction: float  # of the flat points: walls at odd angles to the other walls
    aligned_fraction: float  # of all points: floor or wall
    sharp_fraction: float  # of the aligned points: floor or wall within 2 deg
    extent: float  # of the cloud along the axis [m]
    clutter_log_ratio: float  # of clutter below to clutter above the middle of the storeys
    furniture_log_ratio: float  # of level tops as high as furniture above a level to those as far below one
    above_below_balance: float  # [-1, 1] points above the last level less those below the first, to both
    sheets: SheetFeatures  # what is above and below sheets

    @property
    def cues(self) -> Array:
        """Numbers (12,) of which the log-odds are a sum, in the order of Weights."""
        return np.array(
            [
                np.log(self.level_energy + 0.03),
                -np.log(self.off_axis_fraction + 0.05),
                -np.log(self.misaligned_fraction + 0.02),
                -self.non_manhattan_fraction,
                -np.log(self.extent + 2.0),
                self.above_below_balance,
                np.clip(self.sheets.steps - 0.15, 0.0, 0.3),
                np.clip(self.clutter_log_ratio, -1.2, 1.2),
                np.clip(self.furniture_log_ratio, -1.5, 1.5),
                np.clip(self.sheets.hole_log_ratio, -2.5, 2.5),
                np.clip(self.sheets.top_log_ratio, -1.5, 1.5),
                np.clip(self.sheets.roof_log_ratio, -2.0, 2.0),
            ]
        )


def log_odds(cues: Array, weights: Array, sense_sharing: float) -> Array:
    """Log-odds (...) of directions with the cues (..., 12) pointing up, before any convention.

    The last cues tell one sense of an axis from the other. What they say is shared out between the two by
    `sense_sharing`, so that shelves along a wall do not make it a floor.
    """
    terms = cues * weights
    sense = terms[..., -NUM_SENSE_CUES:].sum(axis=-1)
    return np.asarray(terms.sum(axis=-1) - sense_sharing * np.log(2.0 * np.cosh(sense)))


def up_features(cloud: PointNormals, sides: Sides, axis: Array) -> UpFeatures:
    """Features of a cloud along a unit vector `axis` (3,)."""
    cosines, is_flat = np.abs(dot(cloud.normals, axis)), cloud.is_flat
    is_level = is_flat & (cosines > np.cos(ALIGNED_ANGLE))
    is_wall = is_flat & (cosines < np.sin(ALIGNED_ANGLE))
    is_sharp = is_flat & ((cosines > np.cos(SHARP_ANGLE)) | (cosines < np.sin(SHARP_ANGLE)))
    heights = dot(cloud.points, axis)
    num_points, num_flat = len(heights), int(np.count_nonzero(is_flat))
    num_aligned, num_sharp = int(np.count_nonzero(is_level | is_wall)), int(np.count_nonzero(is_sharp))
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
        off_axis_fraction=1.0 - num_aligned / num_flat,
        misaligned_fraction=1.0 - num_sharp / num_flat,
        non_manhattan_fraction=_num_non_manhattan(cloud.normals[is_wall], axis) / num_flat,
        aligned_fraction=num_aligned / num_points,
        sharp_fraction=num_sharp / max(num_aligned, 1),
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


def _clutter_log_ratio(heights: Array, levels: Array, num_points: int) -> float:
    """Logarithm of the number of `heights` below the middle of their storey to the number above it."""
    if len(levels) < 2:
        return 0.0
    upper_level = np.searchsorted(levels, heights)
    is_between = (upper_level > 0) & (upper_level < len(levels))
    floors, ceilings = levels[upper_level[is_between] - 1], levels[upper_level[is_between]]
    parts = (heights[is_between] - floors) / (ceilings - floors)
    parts = parts[ceilings - floors > MIN_STOREY]
    lower = np.count_nonzero((parts > MIDDLE[0]) & (parts < MIDDLE[1]))
    upper = np.count_nonzero((parts > MIDDLE[1]) & (parts < MIDDLE[2]))
    softening = CLUTTER_SOFTENING * num_points
    return float(np.log((lower + softening) / (upper + softening)))


def _furniture_log_ratio(heights: Array, levels: Array, num_points: int) -> float:
    """Logarithm of the number of `heights` at a piece of furniture's above a level to those below one."""
    if len(levels) == 0:
        return 0.0
    low, high = FURNITURE
    next_level = np.searchsorted(levels, heights)
    above = heights - np.append(-np.inf, levels)[next_level]
    below = np.append(levels, np.inf)[next_level] - heights
    lower = np.count_nonzero((above > low) & (above < high) & (below > low))
    upper = np.count_nonzero((below > low) & (below < high) & (above > low))
    softening = FURNITURE_SOFTENING * num_points
    return float(np.log((lower + softening) / (upper + softening)))


def _num_non_manhattan(normals: Array, axis: Array) -> int:
    """How many normals (N, 3) of walls are at odd angles to the main directions, two and perpendicular."""
    if len(normals) == 0:
        return 0
    a, b = np.linalg.svd(axis[None])[2][1:]
    yaw = np.degrees(np.arctan2(dot(normals, b), dot(normals, a))) % 90.0
    counts = np.bincount((yaw / 2.0).astype(np.int64) % 45, minlength=45)
    wide = np.sum([np.roll(counts, k) for k in range(-4, 5)], axis=0)  # 18 deg
    return len(normals) - int(wide.max())
