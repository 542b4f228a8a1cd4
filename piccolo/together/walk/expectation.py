"""The pose at which a frame of a walk is expected, poses from which it is tracked, and ends that count."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...geometry.nearness import ONE_PLACE
from ...geometry.pose import Pose, carry, exp_so3, log_so3, multiply
from .frames import MOST_EXPECTED, Frame, How, Motion, State
from .path import COPY_LOG_ODDS

NUM_NARROW = 4  # chosen: places within reach from which a narrow photo is tracked
Place = tuple[Pose, float]  # pose in the map, as rough as the candidates' grid; log odds against another pose


class ExpectedFrame(NamedTuple):
    """The pose that a frame is expected to have, from the pose of another, and how far it may be away."""

    last: Pose  # pose of the other frame, moved by the odometry if there is one
    reach: float  # [m] that the frame may be from `last`
    pose: Pose  # the predicted pose

    def is_within(self, pose: Pose) -> bool:
        """Return True for a pose within reach."""
        return pose.distance(self.last) <= self.reach


class Start(NamedTuple):
    """A pose from which a frame is tracked."""

    pose: Pose
    must_be_sure: bool  # the end of tracking counts only if the photo is sure of it by itself


class Followed(NamedTuple):
    """The pose of a frame that was found from another frame's pose."""

    state: State
    how: How
    is_alone: bool  # False if the frame may be at another place within reach


def expect(frame: Frame, near: Sequence[tuple[Frame, Pose]], motion: Motion) -> ExpectedFrame:
    """Predict a frame's pose from other frames, the latest first: by odometry or at constant velocity."""
    before, last = near[0]
    seconds = frame.time - before.time
    reach = motion.reach(seconds)
    if frame.odometry is not None and before.odometry is not None:
        moved = carry(frame.odometry, before.odometry, last)
        return ExpectedFrame(moved, reach, moved)
    if len(near) == 1:
        return ExpectedFrame(last, reach, last)
    earlier, pose = near[1]
    return ExpectedFrame(last, reach, predict(last, pose, seconds / (before.time - earlier.time), reach))


def predict(last: Pose, earlier: Pose, ratio: float, max_distance: float) -> Pose:
    """Predict a camera's pose at constant velocity from an earlier pose and the last.

    `ratio` is the time since the last pose divided by the time between the two. The prediction is at most
    `max_distance` [m] away.
    """
    move = ratio * (last.center_world - earlier.center_world)
    move *= min(1.0, max_distance / max(float(np.linalg.norm(move)), 1e-9))
    turn = ratio * log_so3(multiply(last.R_cam_from_world, earlier.R_cam_from_world.T))
    return Pose(multiply(exp_so3(turn), last.R_cam_from_world), last.center_world + move)


def list_alike(expected: ExpectedFrame, places: Sequence[Place]) -> list[Pose]:
    """Return the places within reach that look hardly worse than the best one, as copies do."""
    alike = [pose for pose, behind in places if behind > -COPY_LOG_ODDS]
    return [pose for pose in alike if expected.is_within(pose)]


def list_starts(
    expected: ExpectedFrame, behind: float, alike: Sequence[Pose], is_narrow: bool, known: Sequence[Pose] = ()
) -> list[Start]:
    """Return the poses from which a frame is tracked, in the order in which they are tried.

    `behind` are the odds [log] by which the expected pose looks worse than the best place. Views determine
    little of a narrow photo, so that it has more starts, also the poses `known` by other evidence.
    """
    others = [*filter(expected.is_within, known), *alike[:NUM_NARROW]] if is_narrow else alike[:1]
    best = [Start(pose, False) for pose in others]
    if behind > -COPY_LOG_ODDS:
        return [Start(expected.pose, False), *best]
    return [*best, Start(expected.pose, True)] if is_narrow else best


def is_acceptable(state: State, expected: ExpectedFrame, must_be_sure: bool) -> bool:
    """Return True for a pose within reach that is sure by itself or, if it need not be, was expected."""
    is_expected = not must_be_sure and ONE_PLACE.holds(state.pose, expected.pose)
    is_sure = state.log_odds >= MOST_EXPECTED or is_expected
    return is_sure and expected.is_within(state.pose)


def describe_end(end: State, expected: ExpectedFrame, alike: Sequence[Pose]) -> Followed:
    """Describe how a frame was found."""
    how: How = "tracked" if ONE_PLACE.holds(end.pose, expected.pose) else "near"
    return Followed(end, how, all(ONE_PLACE.holds(pose, end.pose) for pose in alike))
