import numpy as np

from piccolo.confidence import alternatives
from piccolo.geometry.pose import Pose, yaw_rotation


def _at(x, score, yaw_deg=0.0):
    return alternatives.Hypothesis(Pose(yaw_rotation(np.radians(yaw_deg)), np.array([x, 0.0, 0.0])), score)


def test_alternatives_are_apart_from_the_best_and_from_each_other():
    best = _at(0.0, 0.9)
    near, turned, far, beside_far = _at(0.4, 0.8), _at(0.1, 0.3, 20.0), _at(3.0, 0.5), _at(3.2, 0.4)
    assert alternatives.alternative_poses(best.pose, [best, near, turned, far, beside_far]) == [far, turned]
    found = alternatives.alternative_poses(_at(0, 1.0).pose, [_at(2.0 * k, 0.5) for k in range(1, 20)])
    assert len(found) == alternatives.MAX_ALTERNATIVES


def test_best_distinct_keeps_the_better_of_two_that_are_near():
    a, b, c = _at(0.0, 0.5), _at(0.05, 0.6), _at(1.0, 0.1)
    assert alternatives.best_distinct([a, b, c], 5, 0.1, 0.1) == [b, c]
    assert alternatives.best_distinct([a, b, c], 1, 0.1, 0.1) == [b]
