"""Which way is up in a cloud.

Every axis that many flat points face is a candidate, in both senses. What speaks for each of these hypotheses
is added up as log-odds (up_features.py, sheet_features.py): how little is aslant to it (floors and walls are
not), how low the cloud is along it, whether one level carries everything, whether heights repeat as stairs
do, whether things and level faces of many heights stand on the levels rather than hang from them, whether one
can walk on them from room to room, holes under scanners, roofs, and the convention that scans have z up,
where z is square to the cloud's own levels.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ..cloud.settings import UpAxis
from ..geometry.pose import Array
from .planes import PointNormals, dot
from .sheet_features import sides_of
from .up_features import WEIGHTS, UpFeatures, Weights, up_features

# Chosen by hand: the sphere in cells finer than the spread of a noisy plane's normals (3 to 8 deg)
MIN_POINTS = 300  # of a cloud
NUM_CELLS = 4000  # of the sphere of directions, about 3 deg wide
CELLS_PER_MODE = 12  # neighbouring cells whose votes are one direction's, 6 deg around it
MAX_MODES = 6  # twice the three directions of a box
MIN_MODE = 0.02  # fraction of the flat points
DISTINCT_ANGLE = np.radians(15.0)  # between two candidates: twice the angle of the first refinement
INLIER_ANGLES = np.radians([8.0, 4.0, 2.0, 2.0])  # of a normal to the axis or across it, step by step
Z = np.array([0.0, 0.0, 1.0])
Z_UP_LOG_ODDS = float(np.log(1000.0))  # of z up against z down: scanners level themselves
OTHER_LOG_ODDS = float(np.log(3.0))  # of any other axis against z down: meshes with y up are not so rare
STATION_LOG_ODDS = float(np.log(300.0))  # of the z of scanners that a file tells: they level themselves
PRIOR_ANGLE = np.radians(10.0)  # of +z, or a scanner's z, to a direction that it speaks for
SNAP_ANGLE = np.radians(0.2)  # of +z to a direction that is called +z itself
NONE_ODDS = 0.08  # that it is none of the hypotheses, to those of the best one
# Below it up is not relied on; how many above it are wrong is in BENCHMARK.md.
MIN_CONFIDENCE = 0.8

# What lowers the confidence, by hand on seeds 10 to 19 of tools/evaluate_gravity.py
CLEAR_RADIUS, BLURRED_RADIUS = 1.0, 2.5  # of neighbourhoods where furniture fades, and is gone [m]
OPEN_BALANCE = 0.3  # above_below_balance of a plane with open space before it: ground or a front
OPEN_ENERGY_RATIO = 0.2  # of its level energy to the winner's, from which on they are mixed up
MIN_FURNITURE = 0.7  # log-ratio, from which on things stand on the ground, and not a front's window sills
SLAB_EXTENT = 2.0  # along up, below which nobody stands in the scan: one wall, a table [m]
MIN_ROOFS = -0.17  # log-ratio, below which what is slanted speaks for another direction
MIN_ROOF_OF_Z = 0.65  # log-ratio along +z, from which on that may be up though nothing is square to it
SURE = 0.9  # confidence without such a doubt: level ground with trees, on its side, is like a roof to +z too
DOUBT_FACTOR = 0.6  # on the confidence, for each of these


def candidate_axes(cloud: PointNormals) -> list[Array]:
    """Unit vectors (3,) that many flat points face, and those perpendicular to two such axes; either sign."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  # only who asks for up waits for it

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


class Hypothesis(NamedTuple):
    """A direction that may be up."""

    direction_world: Array  # (3,) unit vector
    probability: float  # all and "none of these" add up to 1, before what makes the best one doubtful
    evidence: dict[str, float]  # log-odds by cue, which count by their differences between hypotheses


class Up(NamedTuple):
    """Which way is up in a cloud, and how far that can be relied on."""

    direction_world: Array  # (3,) unit vector that points up, in the cloud's frame
    confidence: float  # [0, 1] part of the odds for this direction; below 0.5 it is a mere guess
    reason: str  # one line for a person
    hypotheses: tuple[Hypothesis, ...] = ()  # all that were compared, the likeliest first


def find_up(
    cloud: PointNormals, z_up_log_odds: float = Z_UP_LOG_ODDS, station_axes: Array | None = None
) -> Up:
    """The direction that points up in a cloud, thinned evenly in space (5 to 20 cm).

    By convention scans have z up. Where a hypothesis is within 10 deg of +z, upside down needs evidence of a
    thousand to one against it, any other axis hundreds to one; within 0.2 deg of it, +z itself is returned.
    `z_up_log_odds` is the logarithm of that thousand: with 0 no direction is favoured, none rounded to +z.
    The z axes (S, 3) of scanners, as E57 and PTX files tell them, count three hundred to one where all agree.

    The confidence is the winner's part of the odds of all directions, less where few points are flat or
    they face about it, and where ground and a house front could be mixed up. A bare room turned at random
    stays below 0.5, for its floor may be its ceiling.
    """
    if len(cloud.points) < MIN_POINTS:
        return Up(Z.copy(), 0.0, f"only {len(cloud.points)} points: +z is assumed")
    hypotheses = up_hypotheses(cloud)
    if not hypotheses:
        return Up(Z.copy(), 0.0, "no axis that flat points face: +z is assumed")
    axes = np.array([h.axis for h in hypotheses])
    priors = _priors(axes, z_up_log_odds, station_axes)
    up = _choose(hypotheses, priors, z_up_log_odds > 0.0, cloud.neighborhood_radius)
    is_in_doubt = z_up_log_odds > 0.0 and not priors.any() and up.confidence < SURE
    if is_in_doubt and sides_of(cloud).roof_log_ratio(Z) > MIN_ROOF_OF_Z:
        reason = f"{up.reason}; +z is square to nothing, and yet what is slanted to it is a roof"
        return up._replace(confidence=DOUBT_FACTOR * up.confidence, reason=reason)
    return up


def up_hypotheses(cloud: PointNormals) -> list[UpFeatures]:
    """The features of a cloud along every axis that may be upright, in both senses."""
    if not (axes := candidate_axes(cloud)):
        return []
    sides = sides_of(cloud)
    return [up_features(cloud, sides, sense * axis) for axis in axes for sense in (1.0, -1.0)]


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


def _choose(hypotheses: list[UpFeatures], priors: Array, rounds_to_z: bool, neighborhood_radius: float) -> Up:
    """The hypothesis of the largest odds, its part of all odds less what makes it doubtful, and why."""
    terms = np.column_stack([priors, np.array([h.cues for h in hypotheses]) * np.array(WEIGHTS)])
    logits = terms.sum(axis=1)
    odds = np.exp(logits - logits.max())
    odds /= odds.sum() + NONE_ODDS
    rank = np.argsort(-odds, kind="stable")
    names = ("convention", "stations", *Weights._fields)
    ranked = tuple(
        Hypothesis(hypotheses[k].axis, float(odds[k]), dict(zip(names, terms[k].tolist(), strict=True)))
        for k in rank
    )
    best = hypotheses[rank[0]]
    is_told = bool(np.any(priors[rank[0]] > priors.min(axis=0)))
    factor, doubts = _doubts(best, hypotheses, neighborhood_radius, is_told)
    is_z = rounds_to_z and best.axis[2] > np.cos(SNAP_ANGLE)
    direction = Z.copy() if is_z else best.axis
    return Up(direction, ranked[0].probability * factor, "; ".join([_explained(ranked), *doubts]), ranked)


def _explained(ranked: tuple[Hypothesis, ...]) -> str:
    """The evidence for the best hypothesis against the next one, cue by cue, the strongest first."""
    best, second = ranked[:2]
    is_flip = best.direction_world @ second.direction_world < -0.9
    against = f"{'upside down' if is_flip else 'another axis'} ({second.probability:.0%})"
    differences = {name: value - second.evidence[name] for name, value in best.evidence.items()}
    told = [
        f"{n} {d:+.1f}" for n, d in sorted(differences.items(), key=lambda x: -abs(x[1])) if abs(d) > 0.05
    ]
    return f"log-odds against {against}: {', '.join(told) or 'none'}"


def _priors(axes: Array, z_up_log_odds: float, station_axes: Array | None) -> Array:
    """Log-odds (H, 2) of directions (H, 3) by convention, 0 where none is near +z, and by scanners' axes."""
    is_z, is_flipped = axes[:, 2] > np.cos(PRIOR_ANGLE), axes[:, 2] < -np.cos(PRIOR_ANGLE)
    priors = np.zeros((len(axes), 2))
    if is_z.any():
        other = np.where(is_flipped, 0.0, min(OTHER_LOG_ODDS, z_up_log_odds))
        priors[:, 0] = np.where(is_z, z_up_log_odds, other)
    if station_axes is not None and len(station_axes):
        cosines = np.einsum("hi,si->hs", axes, station_axes)
        priors[:, 1] = STATION_LOG_ODDS * (cosines > np.cos(PRIOR_ANGLE)).mean(axis=1)
    return priors


def _doubts(
    best: UpFeatures, hypotheses: list[UpFeatures], neighborhood_radius: float, is_told: bool
) -> tuple[float, list[str]]:
    """A factor [0, 1] on the confidence in the best hypothesis, and the reasons to doubt it.

    Where the convention or the scanners speak for it, what misleads the other cues is no reason.
    """
    factor = float(
        np.clip((BLURRED_RADIUS - neighborhood_radius) / (BLURRED_RADIUS - CLEAR_RADIUS), 0.0, 1.0)
    )
    doubts = []
    if neighborhood_radius > CLEAR_RADIUS:
        doubts.append(f"points so sparse that 24 neighbours reach {neighborhood_radius:.1f} m")
    across = [other for other in hypotheses if abs(other.axis @ best.axis) < 0.3]
    energy, balance = OPEN_ENERGY_RATIO * best.level_energy, max(OPEN_BALANCE, best.above_below_balance)
    is_open = any(h.above_below_balance > balance and h.level_energy > energy for h in across)
    reasons = {
        "ground and the front of a building look alike": is_open and best.furniture_log_ratio < MIN_FURNITURE,
        "what is slanted is open upwards": best.sheets.roof_log_ratio < MIN_ROOFS,
        f"only {best.extent:.1f} m high, maybe a wall": best.extent < SLAB_EXTENT,
    }
    found = [] if is_told else [reason for reason, holds in reasons.items() if holds]
    return factor * DOUBT_FACTOR ** len(found), doubts + found
