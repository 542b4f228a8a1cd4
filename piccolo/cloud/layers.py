"""Two layers of the same surfaces in a scan, as of stations that were registered badly.

In a patch of a surface that was scanned twice there is a second sheet beside the first, over the same
ground. A board on a wall hides what is behind it, so that the two share no ground; doors and thin walls have
two faces, but at distances that do not follow one rigid motion through all of the scan. The motion is found
from the gaps along the patches' normals. Their signs are not known, nor is which layer is right.
"""

from typing import NamedTuple

import numpy as np

from ..geometry.robust import weigh_absolute
from ..system.arrays import Array, Int8s, Int64s
from ..system.jobs.threads import Workers, one_blas_thread
from .octree import Octree
from .profiles import BIN, NUM_PROFILE_BINS, Profiles, measure_profiles

NUM_PATCHES = 3000
NUM_SAMPLED = 100  # of these, by which their radius is chosen
RADII = (0.2, 0.4)  # [m] of patches, and of those of thin scans
THICK = 60  # leaves in the median patch
CELL_LEVELS = 2  # above the leaves: patches begin in cells of 8 cm
LEAST_LEAVES = 25  # of a sheet
LEAST_QUARTER = 3  # of these, in each quarter of the patch
LEAST_MAIN = 0.3  # of all leaves of a profile, in its sheet: else it is noise
PEAK_EDGE = 0.25  # of the sheet's peak: a second one begins beyond where the profile falls below
LEAST_SHARED_SHEET = 0.35  # part of the sheet that a second one is over, too
DIP = 0.5  # of the second peak, between both
NOT_TOLD = 2  # bins beyond the edge, where a second sheet may merge with the first
LARGEST_GAP = 0.07  # [m] walls between rooms are thicker
MOST_TURN = np.radians(2.0)
MOST_MOVE = 0.3  # [m] in the middle of the scan
NUM_DRAWS = 3000
SINGLE_SHARE = 0.3  # of the draws' patches beyond the first are taken for single
LEAST_WALL_SPREAD = 0.5  # [m] determinant of three walls, by which a turn and a move differ
NUM_SCORED_PATCHES = 300  # patches, by which draws are compared
NUM_BEST = 10  # motions of walls that are refined
IS_WALL = 0.5  # most of a normal's vertical part
SEEN_GAP = 0.0125  # [m] gaps below this are not seen
PATCH_CHARGE = 0.12  # charged for each patch that tells, double or not: some are double by chance
# Of trials with single scans (rooms, buildings, noise of 0.5 to 4 cm, thinned) and with 1 of 2 to 6 stations
# moved by 3 and 5 cm; between them is a real scan that drifted (0.23 and 0.026)
LEAST_SHARE = 0.25  # double patches of those that tell; with a moved station 0.22 to 0.96
LEAST_DOUBLE = 50  # patches
LEAST_PART = 0.03  # double patches of all; in single scans up to 0.021, with a moved station from 0.042
SAME_GAP = 0.15  # relative range of gaps that are the thickness of things
BEYOND = 0.03  # charged for a patch whose gap would be too large to tell
TOLERANCES = (3, 2, 2, 2, 2)  # bins between expected and found gaps, by iteration
LEAST_GAP_RESIDUAL = 0.003  # [m] of gaps that fit
MOTION_RIDGE = np.array([0.1, 0.1, 1e-3, 1e-4, 1e-4, 1e-4])  # of the weights' sum: hardly any scan is tilted
TRIED_HEIGHTS = np.arange(0.0, 0.12, BIN / 2.0)  # [m] tried
NO_LAYERS = np.zeros((3, 3))  # motion of a scan that has one layer


class Layers(NamedTuple):
    """The rigid motion between two layers of a scan, in the map's frame."""

    motion: Array  # (3, 3): the place [m] of which the motion is given, turn [rad] and move [m] there
    share: float  # of the patches that can tell, those which are double
    distance: float  # [m] median of theirs from each other
    place: Array  # (3,) [m] where the distance is large


class Patches(NamedTuple):
    """Patches of a scan and the second sheets seen there."""

    by_motion: Array  # (N, 6) derivative of the gap by a motion: turn, move
    is_wall: Int64s  # (W,) indices of the upright ones
    is_double: (
        Int8s  # (N, NUM_PROFILE_BINS) by gap: 1 with a second sheet, 0 without, -1 if that can't be told
    )
    patch: Int64s  # (P,) of each second sheet
    gap: Array  # (P,) [m] its distance


def describe_layers(layers: Layers, place_world: Array) -> str:
    """Describe layers in a warning; most apart they are near a place (3,) of the world."""
    turn = np.degrees(np.linalg.norm(layers.motion[1]))
    apart = f"about {100.0 * layers.distance:.0f} cm and {turn:.1f} deg apart"
    where = "({:.1f}, {:.1f}, {:.1f})".format(*place_world)
    seen = f"in {100.0 * layers.share:.0f} % of the surfaces that can show it, most near {where}"
    advice = "register its stations again; poses are uncertain by half of that"
    return f"the scan has two layers of the same surfaces, {apart}, {seen}: {advice}"


@one_blas_thread()
def find_layers(octree: Octree, workers: Workers) -> Layers | None:
    """Find two layers of the same surfaces in a scan whose z is up; None if they are not plain."""
    profiles = measure_sheets(octree, workers)
    if len(profiles.places) < LEAST_DOUBLE:
        return None
    middle = profiles.places.mean(axis=0)
    patches = see_second_sheets(profiles, middle)
    least = max(LEAST_DOUBLE, LEAST_PART * len(profiles.places))
    if len(patches.gap) < least:
        return None
    motion = find_motion(patches)
    gaps = np.abs(patches.by_motion @ motion)
    votes = vote_on_motions(patches, patches.by_motion, motion[None])[:, 0]
    tells = (votes >= 0) & (gaps > SEEN_GAP)
    double = np.flatnonzero(tells & (votes == 1))
    share = len(double) / max(int(np.count_nonzero(tells)), 1)
    if len(double) < least or share < LEAST_SHARE:
        return None
    low, median, high = np.quantile(gaps[double], [0.1, 0.5, 0.9])
    if high - low < SAME_GAP * median:
        return None
    places = profiles.places[double]
    distances = np.linalg.norm(motion[3:] + np.cross(motion[:3], places - middle), axis=1)
    far = places[np.argsort(distances, kind="stable")[9 * len(places) // 10]]
    return Layers(np.stack([middle, motion[:3], motion[3:]]), share, float(np.median(distances)), far)


def measure_sheets(octree: Octree, workers: Workers) -> Profiles:
    """Return the profiles of patches that one sheet fills, in all its quarters."""
    leaves = choose_leaves(octree)
    sample = measure_profiles(octree, leaves[:: 1 + len(leaves) // NUM_SAMPLED], RADII[0], workers)
    median = np.median(sample.counts.sum(axis=(1, 2))) if len(sample.counts) else 0.0
    profiles = measure_profiles(octree, leaves, RADII[int(median < THICK)], workers)
    total = profiles.counts.sum(axis=(1, 2))
    main = profiles.counts[:, :, NUM_PROFILE_BINS - 2 : NUM_PROFILE_BINS + 3].sum(axis=2)
    least = np.maximum(LEAST_LEAVES, LEAST_MAIN * total)
    is_full = (main.sum(axis=1) >= least) & (main.min(axis=1) >= LEAST_QUARTER)
    return Profiles(*(values[is_full] for values in profiles))


def choose_leaves(octree: Octree) -> Int64s:
    """Return leaves (N,), evenly spread over the surfaces."""
    start = octree.level_start
    level = len(start) - 2 - CELL_LEVELS
    num_cells = int(start[level + 1] - start[level])
    chosen = np.linspace(0, num_cells - 1, min(num_cells, NUM_PATCHES)).astype(np.int64) + start[level]
    for _ in range(CELL_LEVELS):
        chosen = octree.first_child[chosen]
    return np.asarray(chosen, np.int64)


def see_second_sheets(profiles: Profiles, middle: Array) -> Patches:
    """Find second sheets in profiles; the motion is that of the middle (3,) of the scan."""
    counts = profiles.counts.astype(np.float64)
    counts[..., 1:-1] += profiles.counts[..., :-2] + profiles.counts[..., 2:]
    shared = np.zeros((len(counts), NUM_PROFILE_BINS))
    is_told = np.ones(shared.shape, np.bool_)
    for over in (counts[..., NUM_PROFILE_BINS:-1], counts[..., NUM_PROFILE_BINS:0:-1]):
        first = over[..., :1]
        total = np.maximum(first.sum(axis=1), 1.0)
        both = np.minimum(over, first).sum(axis=1) / total
        least = np.minimum.accumulate(over.sum(axis=1) / total, axis=1)
        is_beyond = least < PEAK_EDGE
        is_second = is_beyond & (both > LEAST_SHARED_SHEET) & (least < DIP * both)
        shared = np.maximum(shared, np.where(is_second, both, 0.0))
        is_told[:, NOT_TOLD:] &= is_beyond[:, :-NOT_TOLD]
        is_told[:, :NOT_TOLD] = False
    patch, bins, gap = find_peaks(shared)
    is_near = np.zeros(shared.shape, np.bool_)
    for step in (-1, 0, 1):
        is_near[patch, bins + step] = True
    is_double = np.where(is_near, 1, np.where(is_told, 0, -1)).astype(np.int8)
    turned = np.cross(profiles.places - middle, profiles.normals)
    is_wall = np.flatnonzero(np.abs(profiles.normals[:, 2]) < IS_WALL)
    return Patches(np.hstack([turned, profiles.normals]), is_wall, is_double, patch, gap)


def find_peaks(values: Array) -> tuple[Int64s, Int64s, Array]:
    """Return row, column and gap [m] of positive local maxima, to LARGEST_GAP, in rows of values (N, B)."""
    inner = values[:, 1:-1]
    rows, columns = np.nonzero((inner > 0.0) & (inner >= values[:, :-2]) & (inner > values[:, 2:]))
    columns += 1
    around = np.stack([values[rows, columns + step] for step in (-1, 0, 1)])
    gaps = (columns + (around[2] - around[0]) / around.sum(axis=0)) * BIN
    is_small = gaps <= LARGEST_GAP
    return rows[is_small], columns[is_small], gaps[is_small]


def vote_on_motions(
    patches: Patches, by_motion: Array, motions: Array, some: Int64s | slice = slice(None)
) -> Int8s:
    """Return (S, M), as `is_double`, what some patches say to motions (M, K); -2 of too large gaps."""
    gaps = np.abs(by_motion[some] @ motions.T)
    bins = np.minimum((gaps / BIN + 0.5).astype(np.int64), NUM_PROFILE_BINS - 1)
    double = np.take_along_axis(patches.is_double[some], bins, axis=1)
    return np.where(gaps > LARGEST_GAP, -2, double).astype(np.int8)


def score_motions(
    patches: Patches, by_motion: Array, motions: Array, some: Int64s | slice = slice(None)
) -> Array:
    """Return scores (M,) of motions (M, K): double patches less those that there are by chance."""
    votes = vote_on_motions(patches, by_motion, motions, some)
    charged = np.where(votes == -2, BEYOND, np.where(votes >= 0, PATCH_CHARGE, 0.0))
    return np.asarray(((votes == 1) - charged).sum(axis=0) / max(len(votes), 1))


def find_motion(patches: Patches) -> Array:
    """Find the motion (6,) that explains most second sheets: by walls, then by all patches."""
    rng = np.random.default_rng(0)
    level = np.setdiff1d(np.arange(len(patches.by_motion)), patches.is_wall)
    by_wall = patches.by_motion[:, 2:5]
    drawn = draw_motions(patches, by_wall, rng)
    some = patches.is_wall
    some = rng.choice(some, min(len(some), NUM_SCORED_PATCHES), replace=False)
    best = drawn[np.argsort(-score_motions(patches, by_wall, drawn, some), kind="stable")[:NUM_BEST]]
    some = rng.choice(level, min(len(level), NUM_SCORED_PATCHES), replace=False)
    ends = []
    for three in best:
        motions = np.zeros((len(TRIED_HEIGHTS), 6))
        motions[:, 2:5] = three
        motions[:, 5] = TRIED_HEIGHTS
        of_level = score_motions(patches, patches.by_motion, motions, some) if len(some) else np.zeros(1)
        ends.append(refine_motion(patches, motions[of_level.argmax()]))
    return ends[int(score_motions(patches, patches.by_motion, np.array(ends)).argmax())]


def draw_motions(patches: Patches, by_wall: Array, rng: np.random.Generator) -> Array:
    """Draw motions (M, 3), turns about z and level moves, that explain three walls; the first is none."""
    none = np.zeros((1, 3))
    of_walls = np.flatnonzero(np.isin(patches.patch, patches.is_wall))
    if len(of_walls) == 0:
        return none
    drawn = rng.choice(of_walls, (NUM_DRAWS, 3))
    is_single = (rng.random(drawn.shape) < SINGLE_SHARE) & (np.arange(3) > 0)
    rows = np.where(is_single, rng.choice(patches.is_wall, drawn.shape), patches.patch[drawn])
    gaps = np.where(is_single, 0.0, patches.gap[drawn])
    is_spread = np.abs(np.linalg.det(by_wall[rows])) > LEAST_WALL_SPREAD
    signs = np.array([[1.0, 1.0, 1.0], [1.0, 1.0, -1.0], [1.0, -1.0, 1.0], [1.0, -1.0, -1.0]])
    signed = gaps[is_spread][:, None] * signs
    found = np.linalg.solve(by_wall[rows[is_spread]][:, None], signed[..., None]).reshape(-1, 3)
    is_likely = (np.abs(found[:, 0]) < MOST_TURN) & (np.hypot(found[:, 1], found[:, 2]) < MOST_MOVE)
    return np.concatenate([none, found[is_likely]])


def refine_motion(patches: Patches, motion: Array) -> Array:
    """Refine a motion (6,) on the gaps near those that it explains; return the step with the best score."""
    by_motion = patches.by_motion[patches.patch]
    best = score_motions(patches, patches.by_motion, motion[None])[0]
    moved: Array = motion
    for tolerance in TOLERANCES:
        expected = by_motion @ moved
        is_near = np.abs(patches.gap - np.abs(expected)) <= tolerance * BIN
        rows = by_motion[is_near]
        gaps = np.where(expected < 0.0, -patches.gap, patches.gap)[is_near]
        weights = weigh_absolute(gaps - expected[is_near], LEAST_GAP_RESIDUAL)
        normal_matrix = (rows * weights[:, None]).T @ rows + np.diag(MOTION_RIDGE * (weights.sum() + 1.0))
        moved = np.asarray(np.linalg.solve(normal_matrix, rows.T @ (weights * gaps)))
        found = score_motions(patches, patches.by_motion, moved[None])[0]
        if found >= best:
            motion = moved
            best = found
    return motion
