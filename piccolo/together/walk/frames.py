"""The frames of a walk: the poses that each may have, and their odds; and the motion of the camera.

A key frame was compared with the whole scan: its states are all the places that look like its photo, each
once, most of them only as exact as the grid of candidates. The frames after it are tracked, and have one pose
each: their motion relative to the key frame is the same, wherever the key frame is.
"""

import math
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Literal

import numpy as np

from ...geometry.nearness import ONE_ANSWER
from ...geometry.pose import Pose
from ...geometry.pose_gaussian import PoseGaussian
from ...judge.candidate import Candidate
from ...judge.probability import LOCALIZED
from ...judge.result import Result
from ...judge.sure import SURE_ODDS
from ...scan_map.camera_positions import COARSE_SPACING
from ...scan_map.scan_map import ScanMap
from ...system.arguments import MAX_SPEED, MAX_STEP, check_fields
from ...system.arrays import Array
from ...system.errors import InputError

How = Literal["alone", "near", "tracked", "none"]
MOST_EXPECTED = 3.0  # [log] that a frame gains at most by being where it was expected
MOST_ODDS = 8.0  # [log] that one frame may add: errors outside the model allow no more certainty
MAX_ACCELERATION = 2.0  # [m/s^2]
REACH_SLACK = COARSE_SPACING / 2.0  # [m] added to the distance walked: places are as rough as their grid
JUMP_LOG = -9.0  # log odds of a jump to any place: lift, cut, pocket, a place that was not scanned


@dataclass(frozen=True)
class State:
    """A pose that a frame may have."""

    pose: Pose  # in the map's frame
    log_odds: float  # against none of the frame's poses being right
    score: float | None = None  # as in Evidence; None if the pose was not refined
    gaussian: PoseGaussian | None = None  # the pose with its covariance, in the map
    end: Candidate | None = None  # the end of tracking; None if the pose was found by a search
    gain: float = 0.0  # [log] for being found among the few places within reach

    @property
    def is_refined(self) -> bool:
        """True if the pose was refined as that of a photo alone is."""
        return self.score is not None

    @property
    def is_sure(self) -> bool:
        """True if the photo is sure of the pose, by itself or by a frame beside that confirms it."""
        return self.log_odds + self.gain >= SURE_ODDS


@dataclass
class Frame:
    """A frame, and the poses found for it so far."""

    time: float  # [s] from any beginning
    states: list[State] = field(default_factory=list)
    how: How = "none"
    alone: Result | None = None  # the result without the other frames, if it was searched so
    is_key: bool = False
    key: int | None = None  # number of the key frame from which it was tracked, perhaps by way of others
    arrived: Pose | None = None  # pose by tracking from the key frame, if this is at its `departed`
    departed: Pose | None = None  # pose of a key frame from which the frames after it were tracked
    odometry: Pose | None = None  # in the frame of the odometry [m]

    @property
    def log_odds(self) -> float:
        """Log odds that any of the frame's poses is right."""
        return max((state.log_odds for state in self.states), default=-math.inf)

    @property
    def is_sure(self) -> bool:
        """True if the photo is sure of any pose, supposing that the place it was tracked from is right."""
        return any(state.is_sure for state in self.states)

    @property
    def tracking_pose(self) -> Pose | None:
        """Pose from which the next frames are tracked; None if the frame was not found."""
        return self.departed or self.arrived

    @property
    def is_localized_alone(self) -> bool:
        """True if the photo is sure without the others."""
        return self.alone is not None and self.alone.status == LOCALIZED


def list_states(scan_map: ScanMap, found: Result) -> list[State]:
    """List a frame's poses by its own localization; the alternatives, without covariance, count as rough."""
    if found.best_pose is None or found.evidence is None:
        return []
    poses = [found.best_pose, *(alternative.pose for alternative in found.alternatives)]
    *places, none = found.belief.sound_places.tolist()
    odds = [log_ratio(place, none) for place in places]
    best, *others = [State(scan_map.from_world(pose), o) for pose, o in zip(poses, odds, strict=True)]
    return [replace(best, score=found.evidence.score, gaussian=found.gaussian), *others]


def log_ratio(probability: float, other: float) -> float:
    """Return the log odds of two probabilities, limited to the evidence of one frame."""
    ratio = math.log(max(probability, 1e-12) / max(other, 1e-12))
    return min(max(ratio, -2.0 * MOST_ODDS), MOST_ODDS)


def put_state(states: Sequence[State], state: State) -> list[State]:
    """Return the states with another one, which replaces those at the same pose."""
    return [state, *(s for s in states if not ONE_ANSWER.holds(s.pose, state.pose))]


def state_centers(states: Sequence[State]) -> Array:
    """Return the positions (N, 3) [m] of states."""
    return np.array([state.pose.center_world for state in states]).reshape(-1, 3)


@dataclass(frozen=True)
class Motion:
    """The motion of a carried camera.

    Parameters
    ----------
    max_speed
        Largest speed of the camera [m/s], 2 by default. If frames have no times, it is the largest
        distance [m] between consecutive frames, 5 by default.
    max_acceleration
        Standard deviation of the acceleration along each axis [m/s^2]: less smooths the path more.
    is_timed
        False if the times of the frames are only their order.
    """

    _: KW_ONLY
    max_speed: float | None = None
    max_acceleration: float = MAX_ACCELERATION
    is_timed: bool = True

    def __post_init__(self) -> None:
        """Refuse speeds and accelerations that are not above 0."""
        check_fields(self)
        for name in ("max_speed", "max_acceleration"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < math.inf:
                raise InputError(f"`{name}`: found {value}, wanted a number above 0")

    @property
    def speed(self) -> float:
        """Largest speed [m/s]; of frames without times largest step [m]."""
        return self.max_speed or (MAX_SPEED if self.is_timed else MAX_STEP)

    def reach(self, seconds: float) -> float:
        """Return how far [m] the camera may be from where it was `seconds` before or after."""
        return self.speed * abs(seconds) + REACH_SLACK

    @property
    def jump_log(self) -> float:
        """Log odds of a jump, from a frame to a later one; frames without times may be anywhere."""
        return JUMP_LOG if self.is_timed else 0.0
