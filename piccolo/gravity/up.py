"""Which way is up in a cloud.

Every axis that many flat points face is a candidate, in both senses. What speaks for each of these hypotheses
is added up as log-odds (up_features.py): how much of the cloud lies in a few levels across it (floors,
ceilings), how little is aslant to it (floors and walls are not), how low the cloud is along it, whether
clutter and furniture are at the bottom of the storeys, whether one level carries everything, and the
convention that scans have z up, where z is square to the cloud's own levels.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ..cloud.settings import UpAxis
from ..geometry.pose import Array
from .planes import PointNormals, dot
from .up_features import ALIGNED_ANGLE, SENSE_SHARING, WEIGHTS, UpFeatures, log_odds, up_features

# Chosen by hand: the sphere in cells finer than the spread of a noisy plane's normals (3 to 8 deg)
MIN_POINTS = 300  # of a cloud
NUM_CELLS = 4000  # of the sphere of directions, about 3 deg wide
CELLS_PER_MODE = 12  # neighbouring cells whose votes are one direction's, 6 deg around it
MAX_MODES = 6  # twice the three directions of a box
MIN_MODE = 0.02  # fraction of the flat points
DISTINCT_ANGLE = np.radians(15.0)  # between two candidates: twice the angle of the first refinement
INLIER_ANGLES = np.radians([8.0, 4.0, 2.0, 2.0])  # of a normal to the axis or across it, step by step
Z_UP_LOG_ODDS = float(np.log(1000.0))  # of z up against z down: scanners level themselves
OTHER_LOG_ODDS = float(np.log(3.0))  # of any other axis against z down: meshes with y up are not so rare
PRIOR_ANGLE = np.radians(10.0)  # of +z to a direction that the convention speaks for
SNAP_ANGLE = np.radians(0.2)  # of +z to a direction that is called +z itself
NONE_ODDS = 0.05  # that it is none of the hypotheses, to those of the best one
# Below it up is not relied on. The surest wrong answer of tools/evaluate_gravity.py has 0.69.
MIN_CONFIDENCE = 0.8

# Fraction of directions drawn at random that are within ALIGNED_ANGLE of an axis or of the plane across it
RANDOM_ALIGNED = 1.0 - np.cos(ALIGNED_ANGLE) + np.sin(ALIGNED_ANGLE)

# What lowers the confidence, by hand. On 330 places of tools/evaluate_gravity.py a factor of 1 accepts a
# wrong roof, and the surest wrong front has 0.72; a factor of 0.3 changes no answer.
CLEAR_RADIUS, BLURRED_RADIUS = 1.0, 2.5  # of neighbourhoods where furniture fades, and is gone [m]
OPEN_BALANCE = 0.3  # above_below_balance of a plane with open space before it: ground or a front
OPEN_ENERGY_RATIO = 0.2  # of its level energy to the winner's, from which on they are mixed up
SLAB_EXTENT = 2.0  # along up, below which nobody stands in the scan: one wall, a table [m]
ROOF_THRESHOLD = 0.2  # fraction of walls at odd angles, from which on they may be a roof along its ridge
DOUBT_FACTOR = 0.6  # on the confidence, for each of these


def candidate_axes(cloud: PointNormals) -> list[Array]:
    """Unit vectors (3,) that many flat points face, and those perpendicular to two such axes; either sign."""
    normals = cloud.normals[cloud.is_flat]
    k = np.arange(NUM_CELLS) + 0.5  # directions (NUM_CELLS, 3) evenly over the sphere, a Fibonacci spiral
    azimuth, z = k * np.pi * (3.0 - np.sqrt(5.0)), 1.0 - 2.0 * k / NUM_CELLS
    radius = np.sqrt(1.0 - z * z)
    cells = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=1)
    tree = cKDTree(cells)
    nearest = tree.query(np.concatenate([normals, -normals]))[1]
    counts = np.bincount(nearest, minlength=NUM_CELLS)
    votes = counts[tree.query(cells, CELLS_PER_MODE)[1]].sum(axis=1)
    modes: list[Array] = []
    while len(modes) < MAX_MODES and votes.max() > max(MIN_MODE * len(normals), MIN_POINTS // 10):
        axis = cells[votes.argmax()]
        votes[np.abs(dot(cells, axis)) > np.cos(DISTINCT_ANGLE)] = 0
        modes.append(axis)
    axes: list[Array] = []
    for axis in [*modes, *_perpendicular(modes)]:
        refined = _refine(normals, axis)
        if all(abs(refined @ other) < np.cos(DISTINCT_ANGLE) for other in axes):
            axes.append(refined)
    return axes


def _perpendicular(axes: list[Array]) -> Iterator[Array]:
    """Unit vectors perpendicular to any two of `axes` that are not near parallel."""
    for i, a in enumerate(axes):
        for b in axes[:i]:
            normal = np.cross(a, b)
            length = np.linalg.norm(normal)
            if length > 0.5:
                yield normal / length


def _refine(normals: Array, axis: Array) -> Array:
    """`axis` by least squares: parallel to normals that face it, perpendicular to those of walls."""
    for angle in INLIER_ANGLES:
        cosines = np.abs(dot(normals, axis))
        facing, along = normals[cosines > np.cos(angle)], normals[cosines < np.sin(angle)]
        spread = np.einsum("ni,nj->ij", along, along) - np.einsum("ni,nj->ij", facing, facing)
        axis = np.linalg.eigh(spread)[1][:, 0]
    return np.asarray(axis)


class Up(NamedTuple):
    """Which way is up in a cloud, and how far that can be relied on."""

    direction_world: Array  # (3,) unit vector that points up, in the cloud's frame
    confidence: float  # [0, 1] part of the odds for this direction; below 0.5 it is a mere guess
    reason: str  # one line for a person


def find_up(cloud: PointNormals, z_up_log_odds: float = Z_UP_LOG_ODDS) -> Up:
    """The direction that points up in a cloud, thinned evenly in space (5 to 20 cm).

    By convention scans have z up. Where a hypothesis is within 10 deg of +z, upside down needs evidence of a
    thousand to one against it, any other axis hundreds to one; within 0.2 deg of it, +z itself is returned.
    `z_up_log_odds` is the logarithm of that thousand: with 0 no direction is favoured, none rounded to +z.

    The confidence is the winner's part of the odds of all directions, less where few points are flat or
    they face about it, and where ground and a house front could be mixed up. A bare room turned at random
    stays below 0.5, for its floor may be its ceiling.
    """
    if len(cloud.points) < MIN_POINTS:
        return Up(np.array([0.0, 0.0, 1.0]), 0.0, f"only {len(cloud.points)} points: +z is assumed")
    hypotheses = up_hypotheses(cloud)
    if not hypotheses:
        return Up(np.array([0.0, 0.0, 1.0]), 0.0, "no axis that flat points face: +z is assumed")
    return _choose(hypotheses, z_up_log_odds, cloud.neighborhood_radius)


def up_hypotheses(cloud: PointNormals) -> list[UpFeatures]:
    """The features of a cloud along every axis that may be upright, in both senses."""
    return [up_features(cloud, sense * axis) for axis in candidate_axes(cloud) for sense in (1.0, -1.0)]


def rotation_to_z_up(direction_world: Array) -> Array:
    """The smallest rotation R (3, 3) with `R @ direction_world = +z` for a unit vector (3,).

    Identity for +z, half a turn about x for -z.
    """
    x, y, z = direction_world
    largest = max(abs(x), abs(y))
    if largest == 0.0:
        return np.diag([1.0, 1.0, 1.0] if z > 0.0 else [1.0, -1.0, -1.0])
    # Rodrigues by sine and cosine themselves: an angle near pi would lose digits
    a, b = np.array([y, -x]) / largest / np.hypot(x / largest, y / largest)  # numbers near 1e-310 have few
    versine = 1.0 - z
    return np.array(
        [
            [z + versine * a * a, versine * a * b, -x],
            [versine * a * b, z + versine * b * b, -y],
            [x, y, z],
        ]
    )


def R_z_from_axis(up: UpAxis) -> Array:
    """The rotation (3, 3) that turns a named axis to z; identity for auto."""
    if up == "auto":
        return np.eye(3)
    return np.round(rotation_to_z_up(named_axis(up))) + 0.0


def named_axis(up: UpAxis) -> Array:
    """The unit vector (3,) that a name other than auto stands for."""
    return np.asarray((-1.0 if up.startswith("-") else 1.0) * np.eye(3)["xyz".index(up[-1])] + 0.0)


def _choose(hypotheses: list[UpFeatures], z_up_log_odds: float, neighborhood_radius: float) -> Up:
    """The hypothesis of the largest odds, its part of all odds less what makes it doubtful, and why."""
    logits = log_odds(np.array([h.cues for h in hypotheses]), np.array(WEIGHTS), SENSE_SHARING)
    logits += _convention(np.array([h.axis[2] for h in hypotheses]), z_up_log_odds)
    odds = np.exp(logits - logits.max())
    odds /= odds.sum() + NONE_ODDS
    rank = np.argsort(-odds, kind="stable")
    best, second = hypotheses[rank[0]], hypotheses[rank[1]]
    factor, doubts = _doubts(best, hypotheses, neighborhood_radius)
    alternative = "upside down" if best.axis @ second.axis < -0.9 else "another axis"
    reason = (
        f"{best.aligned_fraction:.0%} of the points are floor or wall,"
        f" {best.sharp_fraction:.0%} of these within 2 deg;"
        f" clutter in lower to upper halves of storeys {np.exp(best.clutter_log_ratio):.1f} : 1,"
        f" furniture on floors to ceilings {np.exp(best.furniture_log_ratio):.1f} : 1;"
        f" next best is {alternative}, {odds[rank[1]]:.0%}"
    )
    is_z = z_up_log_odds > 0.0 and best.axis[2] > np.cos(SNAP_ANGLE)
    direction = np.array([0.0, 0.0, 1.0]) if is_z else best.axis
    return Up(direction, float(odds[rank[0]] * factor), "; ".join([reason, *doubts]))


def _convention(heights: Array, z_up_log_odds: float) -> Array:
    """Log-odds (H,) by convention of directions whose z are given; all 0 where none is near +z."""
    is_z, is_flipped = heights > np.cos(PRIOR_ANGLE), heights < -np.cos(PRIOR_ANGLE)
    if not is_z.any():
        return np.zeros(len(heights))
    return np.where(is_z, z_up_log_odds, np.where(is_flipped, 0.0, min(OTHER_LOG_ODDS, z_up_log_odds)))


def _doubts(
    best: UpFeatures, hypotheses: list[UpFeatures], neighborhood_radius: float
) -> tuple[float, list[str]]:
    """A factor [0, 1] on the confidence in the best hypothesis, and the reasons to doubt it."""
    factor = np.clip(best.aligned_fraction / RANDOM_ALIGNED - 1.0, 0.0, 1.0)
    factor *= np.clip((BLURRED_RADIUS - neighborhood_radius) / (BLURRED_RADIUS - CLEAR_RADIUS), 0.0, 1.0)
    doubts = []
    if neighborhood_radius > CLEAR_RADIUS:
        doubts.append(f"points so sparse that 24 neighbours reach {neighborhood_radius:.1f} m")
    across = [other for other in hypotheses if abs(other.axis @ best.axis) < 0.3]
    energy = OPEN_ENERGY_RATIO * best.level_energy
    if any(h.above_below_balance > OPEN_BALANCE and h.level_energy > energy for h in across):
        factor *= DOUBT_FACTOR
        doubts.append("ground and the front of a building look alike")
    if best.extent < SLAB_EXTENT:
        factor *= DOUBT_FACTOR
        doubts.append(f"only {best.extent:.1f} m high, maybe a wall")
    if best.non_manhattan_fraction > ROOF_THRESHOLD:
        factor *= DOUBT_FACTOR
        doubts.append("walls at odd angles, maybe a roof")
    return float(factor), doubts
