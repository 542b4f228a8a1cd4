import numpy as np

from piccolo.geometry.rotations import uniform_yaws
from piccolo.geometry.suppression import non_maximum_suppression


def test_kept_poses_are_the_first_of_their_neighbourhood():
    centers = np.array([[0.0, 0, 0], [0.1, 0, 0], [2, 0, 0], [0.1, 0, 0]])
    rotations = np.stack([uniform_yaws(36)[k] for k in (0, 1, 0, 9)])
    assert non_maximum_suppression(rotations, centers, 9, 0.5, np.radians(20)).tolist() == [0, 2, 3]
    assert non_maximum_suppression(rotations, centers, 2, 0.5, np.radians(20)).tolist() == [0, 2]
    assert non_maximum_suppression(rotations, centers, 9, 0.5, np.radians(5)).tolist() == [0, 1, 2, 3]
