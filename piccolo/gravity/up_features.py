"""What speaks for an axis of a cloud pointing up, as log-odds."""

from dataclasses import dataclass

import numpy as np

from ..geometry.pose import Array
from .normals import Surfaces, cosines_to

FACING_ANGLE = np.radians(8.0)  # of a normal to the axis, or of a wall to it
SHARP_ANGLE = np.radians(2.0)  # the same of what is built, not grown or slumped

BIN = 0.1  # of the histogram of heights, half a sheet's thickness [m]
MAX_BINS = 10_000
MAX_SHEETS = 6
MIN_SHEET = 0.1  # share of the largest sheet: of a floor, furniture may leave little to see
MIN_INNER = 0.5  # of the weaker of the outermost sheets, of one between them: a table is not a floor
CLOSE = 4  # bins: sheets closer than this are one that bends
MIN_STOREY, MAX_STOREY = 1.5, 5.0  # height [m]
MIN_WALLS = 0.05  # share of the flat surfaces
MISSING_CARRY = 0.5  # of what such a room carries, the share that counts
MAX_HALL = 15.0  # of a storey whose floor and ceiling are both there [m]
FAR = 0.5  # beyond a sheet, further than it bends [m]
TOPS = (0.3, 1.2)  # height of seats, beds, tables, boxes [m]
MIDDLE = (0.15, 0.5, 0.85)  # of a storey: skirting below, clutter or air, lamps and beams above

# Log-odds a unit of evidence: rounded from a fit to buildings made from seeds (synthetic/buildings.py), of
# which each kind weighs the same
SHEET_WEIGHT = 1.0  # of the logarithm of the share of the cloud in the sheets
SLANT_WEIGHT = 0.5  # of the logarithm of the share of flat surfaces that are aslant to the axis, against
LOOSE_WEIGHT = 2.0  # of the logarithm of the share that are more than 2 deg off, against
SKEW_WEIGHT = 4.0  # of the share of walls at odd angles, against: along a gable roof, all surfaces are walls
EXTENT_WEIGHT = 1.25  # of the logarithm of the extent, against
CLUTTER_WEIGHT = 2.5  # of the logarithm of clutter below to clutter above the middle of the storeys
MAX_CLUTTER = 1.2  # beyond which that logarithm says no more
TOPS_WEIGHT = 2.5  # of the logarithm of level tops above a floor to those below a ceiling
MAX_TOPS = 1.5
SENSE_SHARE = 0.5  # 0: what tells the senses apart speaks for the axis in full; 1: not at all
CARRY_WEIGHT = 2.5  # of what stands on all sheets less what hangs below all of them, as a share of both


@dataclass(frozen=True)
class Evidence:
    """What speaks for an axis in general, and for one of its senses."""

    axis: Array  # (3,) unit
    sheets: float  # root of the sum of squares of the sheets' shares of all points
    slanted: float  # share of the flat surfaces that neither face the axis nor stand along it
    loose: float  # share of the flat surfaces that do neither within 2 deg
    skewed: float  # share of the flat surfaces that stand along it at odd angles to the other walls
    explained: float  # share of all points that face the axis or stand along it
    sharpness: float  # share of these that do so within 2 deg
    extent: float  # of the cloud along the axis [m]
    clutter: float  # logarithm of clutter below to clutter above the middle of the storeys
    tops: float  # logarithm of level tops as high as furniture above a sheet to those as far below one
    carried: float  # [-1, 1] what lies above the last sheet less what lies below the first, to both

    @property
    def log_odds(self) -> float:
        """Of the axis pointing up, before any convention.

        Clutter and tops tell one sense of an axis from the other. What they say is shared out between the two
        by SENSE_SHARE, so that shelves along a wall do not make it a floor.
        """
        sense = CLUTTER_WEIGHT * np.clip(self.clutter, -MAX_CLUTTER, MAX_CLUTTER)
        sense += TOPS_WEIGHT * np.clip(self.tops, -MAX_TOPS, MAX_TOPS)
        return float(
            SHEET_WEIGHT * np.log(self.sheets + 0.03)
            - SLANT_WEIGHT * np.log(self.slanted + 0.05)
            - LOOSE_WEIGHT * np.log(self.loose + 0.02)
            - SKEW_WEIGHT * self.skewed
            - EXTENT_WEIGHT * np.log(self.extent + 0.1)
            + sense
            - SENSE_SHARE * np.log(2.0 * np.cosh(sense))
            + CARRY_WEIGHT * self.carried
        )


def evidence_for(surfaces: Surfaces, axis: Array) -> Evidence:
    """What speaks for `axis` pointing up."""
    cosines, is_flat = np.abs(cosines_to(surfaces.normals, axis)), surfaces.is_flat
    faces = is_flat & (cosines > np.cos(FACING_ANGLE))
    stands = is_flat & (cosines < np.sin(FACING_ANGLE))
    sharp = is_flat & ((cosines > np.cos(SHARP_ANGLE)) | (cosines < np.sin(SHARP_ANGLE)))
    heights = cosines_to(surfaces.points, axis)
    num_points, num_flat = len(heights), int(np.count_nonzero(is_flat))
    num_explained, num_sharp = int(np.count_nonzero(faces | stands)), int(np.count_nonzero(sharp))
    low, high = map(float, np.quantile(heights, [0.01, 0.99]))
    levels, shares = _sheets(heights[faces], num_points)
    # without walls there are no rooms: roofs and ground from above
    has_walls = np.count_nonzero(stands) > MIN_WALLS * num_flat
    storeys = _with_missing(levels, low, high) if has_walls else np.empty(0)
    above = int(np.count_nonzero(heights > levels.max() + FAR)) if len(levels) else 0
    below = int(np.count_nonzero(heights < levels.min() - FAR)) if len(levels) else 0
    carried = (above - below) / (above + below + 0.1 * num_points)
    if len(storeys) > len(
        levels
    ):  # a room of which floor or ceiling was not scanned: which one, its things say
        carried *= MISSING_CARRY
    return Evidence(
        axis=axis,
        sheets=float(np.sqrt(np.sum(shares**2))),
        slanted=1.0 - num_explained / num_flat,
        loose=1.0 - num_sharp / num_flat,
        skewed=_num_skewed(surfaces.normals[stands], axis) / num_flat,
        explained=num_explained / num_points,
        sharpness=num_sharp / max(num_explained, 1),
        extent=high - low,
        clutter=_clutter(heights[~stands], storeys, 0.003 * num_points),
        tops=_tops(heights[faces], storeys, 0.001 * num_points),
        carried=carried,
    )


def _sheets(heights: Array, num_points: int) -> tuple[Array, Array]:
    """Levels (S,) [m], ascending, of the largest sheets among `heights`, and their shares of all points."""
    if len(heights) == 0:
        return np.empty(0), np.empty(0)
    low, high = np.quantile(heights, [0.001, 0.999])  # strays, however far, cost neither memory nor fineness
    size = max(BIN, float(high - low) / MAX_BINS)
    places = (heights[(heights >= low) & (heights <= high)] - low) / size
    counts = np.bincount(places.astype(np.int64) + 1, minlength=3)
    pairs = (counts[:-1] + counts[1:]).astype(np.float64)  # so that no border of a bin splits a sheet
    found: list[tuple[float, float]] = []
    while len(found) < MAX_SHEETS and pairs.max() > 0:
        k = int(pairs.argmax())
        share = pairs[k] / num_points
        if found and share < MIN_SHEET * found[0][1]:
            break
        found.append((float(low) + k * size, share))
        pairs[max(k - CLOSE, 0) : k + CLOSE + 1] = 0
    if not found:  # a handful of heights, of which the quantiles left none
        return np.empty(0), np.empty(0)
    found.sort()
    least = MIN_INNER * min(found[0][1], found[-1][1])
    found = [sheet for sheet in found if sheet in (found[0], found[-1]) or sheet[1] > least]
    return np.array([level for level, _ in found]), np.array([share for _, share in found])


def _clutter(heights: Array, levels: Array, softening: float) -> float:
    """Logarithm of the number of `heights` below the middle of their storey to the number above it."""
    if len(levels) < 2:
        return 0.0
    upper_level = np.searchsorted(levels, heights)
    is_between = (upper_level > 0) & (upper_level < len(levels))
    floors, ceilings = levels[upper_level[is_between] - 1], levels[upper_level[is_between]]
    parts = (heights[is_between] - floors) / (ceilings - floors)
    parts = parts[(ceilings - floors > MIN_STOREY) & (ceilings - floors < MAX_HALL)]
    lower = np.count_nonzero((parts > MIDDLE[0]) & (parts < MIDDLE[1]))
    upper = np.count_nonzero((parts > MIDDLE[1]) & (parts < MIDDLE[2]))
    return float(np.log((lower + softening) / (upper + softening)))


def _tops(heights: Array, levels: Array, softening: float) -> float:
    """Logarithm of `heights` of level surfaces at a piece of furniture's above a sheet to those below one."""
    if len(levels) == 0:
        return 0.0
    place = np.searchsorted(levels, heights)
    above = np.where(place > 0, heights - levels[np.maximum(place - 1, 0)], np.inf)
    below = np.where(place < len(levels), levels[np.minimum(place, len(levels) - 1)] - heights, np.inf)
    lower = np.count_nonzero((above > TOPS[0]) & (above < TOPS[1]) & (below > TOPS[0]))
    upper = np.count_nonzero((below > TOPS[0]) & (below < TOPS[1]) & (above > TOPS[0]))
    return float(np.log((lower + softening) / (upper + softening)))


def _with_missing(levels: Array, low: float, high: float) -> Array:
    """The levels; where a storey's floor or ceiling was not scanned, the end of the cloud in its place."""
    if len(levels) == 0:
        return levels
    ends = [low] if MIN_STOREY < levels[0] - low < MAX_STOREY else []
    tops = [high] if MIN_STOREY < high - levels[-1] < MAX_STOREY else []
    return np.array([*ends, *levels, *tops])


def _num_skewed(normals: Array, axis: Array) -> int:
    """How many normals (N, 3) of walls are at odd angles to the main directions, two and perpendicular."""
    if len(normals) == 0:
        return 0
    a, b = np.linalg.svd(axis[None])[2][1:]
    yaw = np.degrees(np.arctan2(cosines_to(normals, b), cosines_to(normals, a))) % 90.0
    counts = np.bincount((yaw / 2.0).astype(np.int64) % 45, minlength=45)
    wide = np.sum([np.roll(counts, k) for k in range(-4, 5)], axis=0)  # 18 deg
    return len(normals) - int(wide.max())
