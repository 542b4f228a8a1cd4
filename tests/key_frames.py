"""Key frames of made-up walks, in space without walls."""

import numpy as np

from piccolo.geometry.pose import Pose, yaw_rotation
from piccolo.together.walk.frames import Frame, Motion, State

MOTION = Motion(max_speed=1.0)


class Open:
    """Space without walls, of which every place within reach is a share."""

    def __init__(self, share=0.01):
        self.share = share

    def distances(self, starts, ends, limit):
        straight = np.linalg.norm(ends[None] - starts[:, None], axis=2)
        return np.where(straight > limit, np.inf, straight)

    def fraction_within(self, center, radius):
        return self.share


def make_pose(*center, yaw=0.0):
    return Pose(yaw_rotation(yaw), np.array(center, float))


def make_key(time, *states, departs=0):
    """A key frame with poses at (x, y, z), each with log odds."""
    frame = Frame(
        time, [State(make_pose(*center), odds, 0.5) for center, odds in states], "alone", is_key=True
    )
    frame.departed = frame.states[departs].pose if frame.states else None
    return frame


def make_followed(time, key, center, odds=5.0):
    """A frame that was tracked from a key frame."""
    pose = make_pose(*center)
    return Frame(time, [State(pose, odds, 0.5)], "tracked", key=key, arrived=pose)
