"""The frames of a walk: poses that each may have, and how likely each of them is."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from ..confidence.alternatives import MAX_ALTERNATIVES
from ..confidence.covariance import PoseCovariance
from ..confidence.localization import Localization
from ..errors import InputError
from ..geometry.pose import Array, Pose
from ..scan_map.scan_map import ScanMap

How = Literal["alone", "near", "tracked", "none"]
MOST_ODDS = 8.0  # [log] that one frame may add: what is surer is not so of errors that no model has
COPY_LOG_ODDS = 4.0  # copies of a place differ by as much where one of them was scanned better
OTHER_LOG_ODDS = 6.0  # behind the best: no copy
MAX_SPEED = 2.0  # [m/s] of a walking person with a camera
MAX_ACCELERATION = 2.0  # [m/s^2]
MAX_STEP = 5.0  # [m] from one frame to the next, if nothing is known
NO_ACCELERATION = 1e3  # [m] of frames without times: nothing is known of it


@dataclass(frozen=True)
class Motion:
    """The motion of a camera that is carried."""

    max_speed: float = MAX_SPEED  # [m/s]; of frames without times [m] from one to the next
    max_acceleration: float = MAX_ACCELERATION  # [m/s^2] standard deviation along each axis
    is_timed: bool = True  # False if only the order of the frames is known
    is_guess: bool = False  # True if nobody said how far from one to the next: the poses found will

    def __post_init__(self) -> None:
        """Refuse what means nothing."""
        for name in ("max_speed", "max_acceleration"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise InputError(f"{name}: found {value}, wanted a number above 0")


@dataclass(frozen=True)
class State:
    """A pose that a frame may have."""

    pose: Pose  # in the map's frame
    log_odds: float  # against none of the frame's poses being right
    score: float
    covariance: PoseCovariance | None = None  # in the world
    num_matches: int | None = None  # local features that agree with it


@dataclass
class Frame:
    """A frame, and what has been found of it so far."""

    time: float  # [s] from any beginning
    states: list[State] = field(default_factory=list)
    how: How = "none"
    alone: Localization | None = None  # if it was searched without regard to the others

    def put(self, states: list[State], how: How) -> None:
        """Set its poses, and where they come from."""
        self.states = states
        self.how = how

    @property
    def is_credible(self) -> bool:
        """True if its poses are more likely than that it has none."""
        return self.log_odds > 0.0

    @property
    def log_odds(self) -> float:
        """Log odds of its poses together against that it has none."""
        return float(np.logaddexp.reduce([state.log_odds for state in self.states]))

    @property
    def is_telling(self) -> bool:
        """True if the whole scan was searched, and the list of poses does not end in a copy."""
        if self.how != "alone" or not self.states:
            return False
        odds = [state.log_odds for state in self.states]
        return len(odds) <= MAX_ALTERNATIVES or min(odds) < max(odds) - COPY_LOG_ODDS

    @property
    def likely(self) -> list[State]:
        """Its best pose, and those that may be copies."""
        best = max((state.log_odds for state in self.states), default=0.0)
        return [state for state in self.states if state.log_odds > best - COPY_LOG_ODDS]

    def to_json(self) -> dict[str, Any]:
        """All but what it was alone."""
        return {"time": self.time, "how": self.how, "states": [_state_json(state) for state in self.states]}

    @classmethod
    def from_json(cls, document: dict[str, Any], alone: Localization | None) -> "Frame":
        """Read back what `to_json` wrote."""
        states = [_state_from_json(state) for state in document["states"]]
        return cls(float(document["time"]), states, document["how"], alone)


def check_times(times: Sequence[float]) -> None:
    """Refuse times that do not rise."""
    if not all(math.isfinite(time) for time in times):
        raise InputError("times: found one that is no finite number, wanted seconds")
    for k, (before, after) in enumerate(pairwise(times)):
        if after <= before:
            raise InputError(f"times: found {after} after {before} at frame {k + 1}, wanted them to rise")


def list_states(scan_map: ScanMap, found: Localization) -> list[State]:
    """List the poses that a frame has alone, with its own probabilities."""
    if found.pose is None or found.probability_none is None or found.evidence is None:
        return []
    none = max(found.probability_none, 1e-9)
    odds = log_ratio(found.confidence, none)
    evidence = found.evidence
    pose = scan_map.from_world(found.pose)
    best = State(pose, odds, evidence.score, found.covariance, evidence.num_matches)
    others = []
    for a in found.alternatives:
        odds = log_ratio(a.probability or 0.0, none)
        others.append(State(scan_map.from_world(a.pose), odds, a.score, None, a.num_matches))
    return [best, *others]


def log_ratio(probability: float, other: float) -> float:
    """Logarithm of the odds of two probabilities, within what one frame may add."""
    ratio = math.log(max(probability, 1e-12) / max(other, 1e-12))
    return min(max(ratio, -2.0 * MOST_ODDS), MOST_ODDS)


def state_centers(states: Sequence[State]) -> Array:
    """Return the positions (N, 3) [m] of states."""
    return np.array([state.pose.center_world for state in states]).reshape(-1, 3)


def _state_json(state: State) -> dict[str, Any]:
    covariance = state.covariance
    return {
        "R_cam_from_map": state.pose.R_cam_from_world.tolist(),
        "center_map": state.pose.center_world.tolist(),
        "log_odds": state.log_odds,
        "score": state.score,
        "covariance": covariance and covariance.matrix.tolist(),
        "least_constrained_direction": covariance and covariance.least_constrained_direction,
        "num_matches": state.num_matches,
    }


def _state_from_json(document: dict[str, Any]) -> State:
    """Read back what `Frame.to_json` wrote of a state."""
    pose = Pose(np.array(document["R_cam_from_map"]), np.array(document["center_map"]))
    covariance = None
    if document["covariance"] is not None:
        direction = str(document["least_constrained_direction"])
        covariance = PoseCovariance(np.array(document["covariance"]), direction)
    odds = float(document["log_odds"])
    return State(pose, odds, float(document["score"]), covariance, document["num_matches"])
