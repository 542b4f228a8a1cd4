"""The frames of a walk: the poses that each may have, and their odds."""

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
MOST_ODDS = 8.0  # [log] that one frame may add: errors outside the model allow no more certainty
COPY_LOG_ODDS = 4.0  # copies of a place differ by up to this if one of them was scanned better
OTHER_LOG_ODDS = 6.0  # a pose that is worse than the best by this is no copy
MAX_SPEED = 2.0  # [m/s] of a walking person with a camera
MAX_ACCELERATION = 2.0  # [m/s^2]
MAX_STEP = 5.0  # [m] from one frame to the next, if nothing is known
NO_ACCELERATION = 1e3  # [m] of frames without times: nothing is known of it


@dataclass(frozen=True)
class Motion:
    """The motion of a carried camera."""

    max_speed: float = MAX_SPEED  # [m/s]; of frames without times [m] from one to the next
    max_acceleration: float = MAX_ACCELERATION  # [m/s^2] standard deviation along each axis
    is_timed: bool = True  # False if only the order of the frames is known
    is_guess: bool = False  # True if no distance between frames was given: the poses found will give it

    def __post_init__(self) -> None:
        """Refuse speeds and accelerations that are not above 0."""
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
    """A frame, and the poses found for it so far."""

    time: float  # [s] from any beginning
    states: list[State] = field(default_factory=list)
    how: How = "none"
    alone: Localization | None = None  # if it was searched without regard to the others

    def put(self, states: list[State], how: How) -> None:
        """Set the poses of the frame, and their origin."""
        self.states = states
        self.how = how

    @property
    def is_credible(self) -> bool:
        """True if the frame more likely has one of its poses than none."""
        return self.log_odds > 0.0

    @property
    def log_odds(self) -> float:
        """Log odds that any of the frame's poses is right."""
        return float(np.logaddexp.reduce([state.log_odds for state in self.states]))

    @property
    def is_telling(self) -> bool:
        """True if the whole scan was searched, and all copies of the best pose are listed."""
        if self.how != "alone" or not self.states:
            return False
        odds = [state.log_odds for state in self.states]
        return len(odds) <= MAX_ALTERNATIVES or min(odds) < max(odds) - COPY_LOG_ODDS

    @property
    def likely(self) -> list[State]:
        """Best pose of the frame, and those that may be copies of it."""
        best = max((state.log_odds for state in self.states), default=0.0)
        return [state for state in self.states if state.log_odds > best - COPY_LOG_ODDS]

    def to_json(self) -> dict[str, Any]:
        """Return the frame for JSON, without its result alone."""
        return {"time": self.time, "how": self.how, "states": [_state_json(state) for state in self.states]}

    @classmethod
    def from_json(cls, document: dict[str, Any], alone: Localization | None) -> "Frame":
        """Make a frame from the output of `to_json` and its result alone."""
        states = [_state_from_json(state) for state in document["states"]]
        return cls(float(document["time"]), states, document["how"], alone)


def check_times(times: Sequence[float]) -> None:
    """Refuse times that are not finite or do not rise."""
    if not all(math.isfinite(time) for time in times):
        raise InputError("times: found one that is no finite number, wanted seconds")
    for k, (before, after) in enumerate(pairwise(times)):
        if after <= before:
            raise InputError(f"times: found {after} after {before} at frame {k + 1}, wanted them to rise")


def list_states(scan_map: ScanMap, found: Localization) -> list[State]:
    """List a frame's poses from its own localization, with the probabilities of that."""
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
    """Return the log odds of two probabilities, limited to the evidence of one frame."""
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
    """Make a state from the output of `_state_json`."""
    pose = Pose(np.array(document["R_cam_from_map"]), np.array(document["center_map"]))
    covariance = None
    if document["covariance"] is not None:
        direction = str(document["least_constrained_direction"])
        covariance = PoseCovariance(np.array(document["covariance"]), direction)
    odds = float(document["log_odds"])
    return State(pose, odds, float(document["score"]), covariance, document["num_matches"])
