"""Poses that count as one: how near they must be, for each purpose."""

import math
from typing import NamedTuple

from .pose import MAX_ANGLE, MAX_DISTANCE, Pose, pose_errors


class Nearness(NamedTuple):
    """Limits of a distance and of an angle; poses within both are near."""

    distance: float  # [m]
    angle: float  # [rad]

    def holds(self, pose: Pose, other: Pose) -> bool:
        """Return True if two poses are near each other."""
        distance, angle = pose_errors(pose, other)
        return distance < self.distance and angle < self.angle


# of a search: rough poses of which one is enough to begin from
VOTED = Nearness(1.0, math.radians(30.0))  # by matches, before they are made exact
MATCHED = Nearness(0.3, math.radians(10.0))  # by matches, exact
STARTING = Nearness(0.5, math.radians(20.0))  # on the grid of candidates
STARTING_NARROW = Nearness(0.5, math.radians(14.0))  # and of a photo of a part of the sphere
DESCENDING = Nearness(0.15, math.radians(5.0))  # on prepared views
DESCENDED = Nearness(0.1, math.radians(5.0))  # on middle cells
# of results
RIGHT = Nearness(MAX_DISTANCE, MAX_ANGLE)  # the paper's line between correct and wrong
CONFIRMED = Nearness(0.3, math.radians(5.0))  # a pose that matches or another result confirm
ONE_ANSWER = Nearness(0.5, math.radians(15.0))  # of a photo: others are alternatives
ONE_IN_BUNDLE = Nearness(0.5, math.radians(6.0))  # of a photo, with the errors of relative poses
ONE_PLACE = Nearness(2.0, math.radians(45.0))  # of a walk: square rooms look alike turned by twice that
