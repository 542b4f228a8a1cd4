"""Two layers of the same surfaces in a scan, such as of stations that were registered badly.

Where a surface was scanned twice, a patch of it has a second sheet of points parallel to the first, over the
same area. Other things with two sheets differ. A board on a wall hides the wall behind it, so that the two do
not share their area; doors and thin walls have two faces, but their gaps do not follow one rigid motion
through the whole scan. The motion is found from the gaps along the patches' normals. The signs of the gaps
are not known, nor is it known which layer is right.
"""

from typing import NamedTuple

import numpy as np

from ..geometry.robust import weigh_absolute
from ..system.arrays import Array, Int8s, Int64s
from ..system.jobs.threads import Workers, one_blas_thread
from .octree import Octree
from .profiles import BIN, NUM_PROFILE_BINS, Profiles, measure_profiles

NUM_PATCHES = 3000  # patches of a scan, at most
NUM_SAMPLED = 100  # of these, as many as choose the radius of all
RADII = (0.2, 0.4)  # [m] radius of patches in dense and in thin scans
THICK = 60  # a scan is dense if the median patch has so many leaves
CELL_LEVELS = 2  # levels above the leaves: there is at most one patch in a cell of 8 cm
LEAST_LEAVES = 25  # in the main sheet of a patch
LEAST_QUARTER = 3  # of these, in each quarter of the patch
LEAST_MAIN = 0.3  # fraction of a profile's leaves that are in its main sheet: with less it is noise
PEAK_EDGE = 0.25  # of the main sheet's peak: a second sheet begins where the profile has fallen below this
LEAST_SHARED_SHEET = 0.35  # fraction of the main sheet's area that a second sheet covers
DIP = 0.5  # the profile between both sheets falls below this fraction of the second peak
NOT_TOLD = 2  # bins beyond the edge in which a second sheet may merge with the first: nothing is known there
LARGEST_GAP = 0.07  # [m] walls between rooms are thicker
MOST_TURN = np.radians(2.0)  # of a motion
MOST_MOVE = 0.3  # [m] of a motion, at the middle of the scan
NUM_DRAWS = 3000  # of three walls, by which a motion is solved
SINGLE_SHARE = 0.3  # of a draw's second and third walls are taken to have no second sheet
LEAST_WALL_SPREAD = 0.5  # [m] least determinant of three walls, or they can't tell a turn from a move
NUM_SCORED_PATCHES = 300  # patches by which draws are compared
NUM_BEST = 10  # motions of walls that are refined
IS_WALL = 0.5  # a wall's normal has a smaller vertical part
SEEN_GAP = 0.0125  # [m] smaller gaps can't be seen
PATCH_CHARGE = 0.12  # subtracted for each patch that can tell, double or not: some are double by chance
# By trials with scans of one layer (rooms, buildings, noise of 0.5 to 4 cm, thinned) and with scans in which
# 1 of 2 to 6 stations was moved by 3 or 5 cm. A real scan that drifted lies between (0.23 and 0.026).
LEAST_SHARE = 0.25  # of double patches among those that can tell; with a moved station it is 0.22 to 0.96
LEAST_DOUBLE = 50  # double patches
LEAST_PART = 0.03  # of double patches among all; with one layer up to 0.021, with a moved station from 0.042
SAME_GAP = 0.15  # gaps with a smaller relative range are the thickness of things
BEYOND = 0.03  # subtracted for a patch whose expected gap is too large to be seen
TOLERANCES = (3, 2, 2, 2, 2)  # [bins] between expected and observed gaps, by iteration
LEAST_GAP_RESIDUAL = 0.003  # [m] a smaller residual of a gap weighs like this
MOTION_RIDGE = np.array([0.1, 0.1, 1e-3, 1e-4, 1e-4, 1e-4])  # by the weights' sum; hardly any scan is tilted
TRIED_HEIGHTS = np.arange(0.0, 0.12, BIN / 2.0)  # [m] vertical moves that are tried
NO_LAYERS = np.zeros((3, 3))  # motion of a scan with one layer


class Layers(NamedTuple):
    """The rigid motion between two layers of a scan, in the map's frame."""

    motion: Array  # (3, 3) rows: a place [m], the turn [rad], and the move [m] at that place
    share: float  # of double patches among those that can tell
    distance: float  # [m] median distance of the two layers in the double patches
    place: Array  # (3,) [m] where this distance is large


class Patches(NamedTuple):
    """N patches of a scan and the P second sheets found in them."""

    by_motion: Array  # (N, 6) derivative of the gap by a motion, turn [rad] then move [m]
    is_wall: Int64s  # (W,) indices of the upright patches
    # (N, NUM_PROFILE_BINS) for each gap: 1 with a second sheet there, 0 without, -1 if that can't be told
    is_double: Int8s
    patch: Int64s  # (P,) index of the patch of each second sheet
    gap: Array  # (P,) [m] distance of each second sheet from the main one


def describe_layers(layers: Layers, place_world: Array) -> str:
    """Word the warning of two layers; their distance is large near a place (3,) [m] of the world."""
    turn = np.degrees(np.linalg.norm(layers.motion[1]))
    apart = f"about {100.0 * layers.distance:.0f} cm and {turn:.1f} deg apart"
    where = "({:.1f}, {:.1f}, {:.1f})".format(*place_world)
    extent = f"in {100.0 * layers.share:.0f} % of the surfaces that can show it, most near {where}"
    advice = "register its stations again; poses are uncertain by half of that"
    return f"the scan has two layers of the same surfaces, {apart}, {extent}: {advice}"


@one_blas_thread()
def find_layers(octree: Octree, workers: Workers) -> Layers | None:
    """Find two layers of the same surfaces in a scan whose z is up; None if they are not clear."""
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
    """Return the profiles of the patches whose main sheet fills all four quarters."""
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
    """Return the indices (N,) of leaves that are evenly spread over the surfaces."""
    start = octree.level_start
    level = len(start) - 2 - CELL_LEVELS
    num_cells = int(start[level + 1] - start[level])
    chosen = np.linspace(0, num_cells - 1, min(num_cells, NUM_PATCHES)).astype(np.int64) + start[level]
    for _ in range(CELL_LEVELS):
        chosen = octree.first_child[chosen]
    return np.asarray(chosen, np.int64)


def see_second_sheets(profiles: Profiles, middle: Array) -> Patches:
    """Find the second sheets in profiles; motions are given at the middle (3,) [m] of the scan."""
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
    """Return row, column and gap [m] of positive local maxima, to LARGEST_GAP, in values (N, B)."""
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
    """Return the votes (S, M) of some patches on motions (M, K).

    A vote is 1 if the patch has a second sheet at the gap that the motion predicts, 0 if not, -1 if that
    can't be told, and -2 if the predicted gap is too large. `by_motion` (N, K) are derivatives of the gaps.
    """
    gaps = np.abs(by_motion[some] @ motions.T)
    bins = np.minimum((gaps / BIN + 0.5).astype(np.int64), NUM_PROFILE_BINS - 1)
    double = np.take_along_axis(patches.is_double[some], bins, axis=1)
    return np.where(gaps > LARGEST_GAP, -2, double).astype(np.int8)


def score_motions(
    patches: Patches, by_motion: Array, motions: Array, some: Int64s | slice = slice(None)
) -> Array:
    """Return the scores (M,) of motions (M, K): the share of double patches less that expected by chance."""
    votes = vote_on_motions(patches, by_motion, motions, some)
    charged = np.where(votes == -2, BEYOND, np.where(votes >= 0, PATCH_CHARGE, 0.0))
    return np.asarray(((votes == 1) - charged).sum(axis=0) / max(len(votes), 1))


def find_motion(patches: Patches) -> Array:
    """Find the motion (6,) that explains most second sheets: first by walls, then by all patches."""
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
    """Draw motions (M, 3), a turn about z and a level move, each of which explains the gaps of three walls.

    The first is no motion.
    """
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
    solved = np.linalg.solve(by_wall[rows[is_spread]][:, None], signed[..., None]).reshape(-1, 3)
    is_likely = (np.abs(solved[:, 0]) < MOST_TURN) & (np.hypot(solved[:, 1], solved[:, 2]) < MOST_MOVE)
    return np.concatenate([none, solved[is_likely]])


def refine_motion(patches: Patches, motion: Array) -> Array:
    """Refine a motion (6,) on the gaps near those that it predicts; return the best-scored iterate."""
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
        score = score_motions(patches, patches.by_motion, moved[None])[0]
        if score >= best:
            motion = moved
            best = score
    return motion
