"""Which way is up in a cloud.

Every axis that many surfaces face is a candidate, in both senses. For each of these hypotheses the evidence
is added up as log-odds (evidence.py): how much of the cloud lies in a few sheets across it (floors,
ceilings), how little is aslant to it (floors and walls are not), how low the cloud is along it, whether
clutter and level tops lie at the bottom of the storeys, whether one sheet carries everything, and the
convention that scans have z up.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cloud.settings import UpAxis
from ..geometry.pose import Array
from .axes import MIN_POINTS, candidate_axes
from .normals import Surfaces, surfaces_of
from .up_features import Evidence, evidence_for

PRIOR_ANGLE = np.radians(10.0)  # of +z to a direction that the convention speaks for
SNAP_ANGLE = np.radians(0.2)  # of +z to a direction that is called +z itself
CHANCE = 0.15  # share of directions in space that face an axis or stand along it, within FACING_ANGLE
CHANCE_SHARP = 0.25  # share of these that do so within 2 deg
CLEAR, BLURRED = 1.0, 2.5  # reach of neighbourhoods from which on furniture fades, and can't be seen [m]
DOUBT = 0.05  # odds that it is none of the hypotheses
OPEN = 0.3  # carried at least by a plane with open space on one side: ground, or the front of a house
OPEN_RIVAL = 0.2  # size of such a plane across the winner's axis, to its own, from which on they are mixed up
WIDE_OPEN, WIDE_RIVAL = 0.8, 0.15  # the same where the winner has no open space before it
OPEN_DOUBT = 0.6  # factor on the confidence
SLAB = 2.0  # extent along up [m] below which nobody stands in the scan: a front, a table
SLAB_DOUBT = 0.6  # factor on the confidence
ODD = 0.2  # share of walls at odd angles from which on they may be a gable roof, seen along its ridge
ODD_DOUBT = 0.6  # factor on the confidence
# Below it up is not relied on. Of places made from seeds the surest wrong answer was 0.69.
MIN_CONFIDENCE = 0.8
Z_UP = 1.5  # log-odds of the convention that scans have z up


@dataclass(frozen=True)
class Up:
    """Which way is up in a cloud, and how far that can be relied on."""

    direction_world: Array  # (3,) unit vector that points up, in the cloud's frame
    confidence: float  # [0, 1] share of the evidence for this direction; below 0.5 it is a mere guess
    reason: str  # one line for a person


def find_up(points: NDArray[np.float32], z_up_log_odds: float = Z_UP) -> Up:
    """The direction that points up in a cloud (N, 3) [m], thinned evenly in space (5 to 20 cm).

    By convention scans have z up: `z_up_log_odds` count for a direction within 10 deg of +z, decide between
    close alternatives and often the sense; within 0.2 deg of it, +z itself is returned. In a frame turned at
    random the convention speaks for a wall or the ground below one time in 25, and sometimes misleads: with 0
    no direction is favoured, and none is rounded to +z.

    The confidence is the winner's share of the odds of all directions, less where few surfaces are flat or
    they face about it, and where ground and a house front could be mixed up. A bare room turned at random
    stays below 0.5, for its floor may be its ceiling.

    Raises
    ------
    InputError
        The shape is not (N, 3), or a coordinate is not finite.
    """
    return up_of(surfaces_of(points), z_up_log_odds)


def up_of(surfaces: Surfaces, z_up_log_odds: float = Z_UP) -> Up:
    """As find_up, from surfaces that are known."""
    if len(surfaces.points) < MIN_POINTS:
        return Up(np.array([0.0, 0.0, 1.0]), 0.0, f"only {len(surfaces.points)} points: +z is assumed")
    axes = candidate_axes(surfaces)
    if not axes:
        return Up(np.array([0.0, 0.0, 1.0]), 0.0, "no direction that flat surfaces share: +z is assumed")
    hypotheses = [evidence_for(surfaces, sense * axis) for axis in axes for sense in (1.0, -1.0)]
    return _verdict(hypotheses, z_up_log_odds, surfaces.reach)


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
    return np.asarray((-1.0 if up.startswith("-") else 1.0) * np.eye(3)["xyz".index(up[-1])])


def _verdict(hypotheses: list[Evidence], z_up_log_odds: float, reach: float) -> Up:
    """The hypothesis that the evidence favours, with its share of the odds."""
    log_odds = np.array([h.log_odds + z_up_log_odds * (h.axis[2] > np.cos(PRIOR_ANGLE)) for h in hypotheses])
    odds = np.exp(log_odds - log_odds.max())
    odds /= odds.sum() + DOUBT
    rank = np.argsort(-odds, kind="stable")
    best, second = hypotheses[rank[0]], hypotheses[rank[1]]
    quality = np.clip((best.explained - CHANCE) / CHANCE, 0.0, 1.0)
    quality *= np.clip((best.sharpness - CHANCE_SHARP) / CHANCE_SHARP, 0.0, 1.0)
    quality *= np.clip((BLURRED - reach) / (BLURRED - CLEAR), 0.0, 1.0)
    if is_open := _is_open(best, hypotheses):
        quality *= OPEN_DOUBT
    if is_slab := best.extent < SLAB:
        quality *= SLAB_DOUBT
    if is_odd := best.skewed > ODD:
        quality *= ODD_DOUBT
    rival = "upside down" if best.axis @ second.axis < -0.9 else "another axis"
    reason = (
        f"{best.explained:.0%} of the points are flat across or along it,"
        f" {best.sharpness:.0%} of these sharply;"
        f" clutter below to above {np.exp(best.clutter):.1f} : 1, level tops {np.exp(best.tops):.1f} : 1;"
        f" next is {rival}, {odds[rank[1]]:.0%}"
    )
    reason += f"; points so sparse that 24 neighbours reach {reach:.1f} m" if reach > CLEAR else ""
    reason += "; ground and the front of a building look alike" if is_open else ""
    reason += f"; only {best.extent:.1f} m high, maybe a wall" if is_slab else ""
    reason += "; walls at odd angles, maybe a roof" if is_odd else ""
    is_z = z_up_log_odds > 0.0 and best.axis[2] > np.cos(SNAP_ANGLE)
    return Up(np.array([0.0, 0.0, 1.0]) if is_z else best.axis, float(odds[rank[0]] * quality), reason)


def _is_open(best: Evidence, hypotheses: list[Evidence]) -> bool:
    """True if a plane across the best one has open space before it, and so may be the ground."""
    least, rival = (OPEN, OPEN_RIVAL) if best.carried > OPEN else (WIDE_OPEN, WIDE_RIVAL)
    return any(
        other.carried > least and other.sheets > rival * best.sheets
        for other in hypotheses
        if abs(other.axis @ best.axis) < 0.3
    )
