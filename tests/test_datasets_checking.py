"""The ways in which poses may be meant, and what is said of a scene where another fits better."""

import numpy as np
import pytest
from poses import tilted_poses

from research.datasets import checking
from research.datasets.files import AXES, DIRECTIONS, pose_of_transform

ORIGIN = np.array([10.0, -4.0, 2.0])


def fit(score, best=checking.AS_GIVEN, best_score=None):
    return checking.ConventionCheck("images/a.jpg", score, score if best_score is None else best_score, best)


@pytest.mark.parametrize("axes", AXES)
@pytest.mark.parametrize("direction", DIRECTIONS)
@pytest.mark.parametrize("taken_axes", AXES)
def test_the_true_pose_is_among_the_readings_of_a_wrong_one(axes, direction, taken_axes):
    (pose,) = tilted_poses(1, center=np.array([11.0, -3.0, 3.5]))
    T = np.column_stack([pose.R_cam_from_world, pose.center_world])
    true = pose_of_transform("T", T, direction, axes)
    (other,) = set(DIRECTIONS) - {direction}
    for taken_direction in (direction, other):
        taken = pose_of_transform("T", T, taken_direction, taken_axes)
        local = type(taken)(taken.R_cam_from_world, taken.center_world - ORIGIN)
        found = checking.convention_variants(local, ORIGIN)
        assert any(
            np.allclose(p.R_cam_from_world, true.R_cam_from_world)
            and np.allclose(p.center_world + ORIGIN, true.center_world)
            for p in found.values()
        )


def test_more_than_half_must_fit_and_advice_names_the_way_that_fits_most():
    assert checking.Check((fit(0.5), fit(0.4), fit(0.02))).is_passed
    assert not checking.Check((fit(0.5), fit(0.02))).is_passed
    assert not checking.Check((fit(0.3, "axes are x", 0.4),)).is_passed
    wrong = fit(0.02, "the camera's x, y, z are z, x, y", 0.6)
    advice = checking.Check((wrong, wrong, fit(0.1))).advice
    assert "scores 0.02, 0.02, 0.10, wanted 0.1 or more; 0.60 if the camera's x, y, z are z, x, y" in advice
    fits = wrong, fit(0.02), fit(0.05, "others", 0.06)
    assert checking.Check(fits).advice.endswith("no other axes fit better")
