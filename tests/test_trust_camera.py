"""What confirms the place of a photo whose focal length contradicts that of its camera's other photos."""

from types import SimpleNamespace

import numpy as np
import pytest

from piccolo.evidence.focal_length import FocalFit
from piccolo.geometry.pose import Pose
from piccolo.geometry.pose_gaussian import PoseGaussian
from piccolo.localization.judging import Found
from piccolo.together.bundle import MOST_STD_OF_OTHERS, is_confirmed, trust_camera

NOTHING = np.zeros((6, 6))


def _at(x, std):
    """A pose at (x, 0, 0) with its own error [m]."""
    own = np.diag([1e-6] * 3 + [std**2] * 3)
    return PoseGaussian(Pose(np.eye(3), np.array([x, 0.0, 0.0])), own, NOTHING)


def test_others_confirm_a_pose_where_they_expect_it_and_know_that_well():
    assert is_confirmed(_at(0.0, 0.02), _at(0.03, 0.02))
    assert not is_confirmed(_at(0.0, 0.02), _at(0.3, 0.02)), "elsewhere"
    assert not is_confirmed(_at(0.0, 0.02), _at(0.0, 1.1 * MOST_STD_OF_OTHERS)), "they hardly know"
    assert not is_confirmed(None, _at(0.0, 0.02))
    assert not is_confirmed(_at(0.0, 0.02), None)


def _found(is_measured):
    fit = FocalFit(np.zeros(1), np.array([[0.01**2]]), np.zeros((6, 1)), None, 7.0, 0.9)
    prior = None if is_measured is None else SimpleNamespace(is_measured=is_measured)
    return Found(SimpleNamespace(given=SimpleNamespace(focal_prior=prior)), None, fit)


@pytest.mark.parametrize(("is_measured", "conflict"), [(True, 0.0), (False, 7.0), (None, 7.0)])
def test_only_other_photos_of_the_camera_outweigh_a_photo_not_what_was_given(is_measured, conflict):
    found = trust_camera(_found(is_measured))
    assert found.fit.conflict == conflict
    assert found.fit.doubt == (0.0 if is_measured else 0.9)
    assert found.fit.deviation == pytest.approx(0.01), "how far the focal length may be off stays"


def test_a_photo_without_a_fitted_focal_length_stays_as_it_is():
    found = _found(True)._replace(fit=None)
    assert trust_camera(found) == found
