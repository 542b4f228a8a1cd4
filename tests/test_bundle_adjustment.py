"""A bundle adjusted to its photos: least squares, scale, errors of relative poses, who contradicts."""

import math

import numpy as np
import pytest
from poses import covariance, tilted_poses
from scipy.special import chdtri

from piccolo.geometry.pose import Pose, exp_so3, yaw_rotation
from piccolo.geometry.pose_gaussian import PoseGaussian, add, subtract
from piccolo.poses.bundle_adjustment import (
    LIKELY,
    Bundle,
    Estimate,
    RelativeErrors,
    adjust,
    count_freedom,
    differentiate_bundle,
    estimate_errors,
    find_contradicting,
    find_limit,
    find_scale,
)

NEAR = np.array([2.0, -1.0, 0.5])
NONE = np.zeros((6, 6))
ERRORS = RelativeErrors()


def _estimates(seed, number=5, scale=1.0, turn=0.3, move=0.01, own=0.005):
    """Own poses of photos some metres apart, whose relative poses have errors [deg, m] and a scale."""
    rng = np.random.default_rng(seed)
    here = tilted_poses(1, NEAR)[0]
    std = np.repeat([math.radians(0.1), own], 3)
    found = []
    for _ in range(number):
        cam = Pose(exp_so3(rng.normal(size=3)), rng.normal(size=3) * 3.0)
        true = Bundle(here, math.log(scale)).place(cam)
        drawn = np.repeat([math.radians(turn), move], 3) * rng.normal(size=6)
        given = add(cam, drawn)
        noisy = add(true, std * rng.normal(size=6))
        found.append(Estimate(PoseGaussian(noisy, np.diag(std**2), NONE), given))
    return found, Bundle(here)


def test_the_derivative_is_that_of_differences():
    *cams, pose = tilted_poses(4, NEAR)
    bundle = Bundle(pose, 0.2)
    for cam in cams:
        J = differentiate_bundle(bundle, cam)
        for k, unit in enumerate(np.eye(7)):
            sides = [Bundle(add(pose, s * unit[:6]), 0.2 + s * unit[6]).place(cam) for s in (1e-5, -1e-5)]
            np.testing.assert_allclose(J[:, k], subtract(*sides) / 2e-5, atol=1e-8)


def test_no_photo_leaves_the_bundle_where_it_is():
    _, bundle = _estimates(1)
    found = adjust(bundle, [], ERRORS)
    np.testing.assert_allclose(subtract(found.bundle.pose, bundle.pose), 0.0, atol=1e-12)
    assert found.covariance[6, 6] == pytest.approx(ERRORS.log_scale**2)


def _squares(bundle, estimates):
    """Weighted squares of all steps from a pose of the bundle, and of its scale."""
    total = (bundle.log_scale / ERRORS.log_scale) ** 2
    for own, cam in estimates:
        step = subtract(own.pose, bundle.place(cam))
        total += step @ np.linalg.solve(own.own + ERRORS.covariance, step)
    return total


def test_the_bundle_is_adjusted_to_the_least_squares():
    rng = np.random.default_rng(1)
    estimates, bundle = _estimates(1)
    estimates = [Estimate(PoseGaussian(o.pose, covariance(rng), NONE), cam) for o, cam in estimates]
    begin = Bundle(add(bundle.pose, np.array([0.02, -0.01, 0.015, 0.02, 0.03, -0.02])))
    found = adjust(begin, estimates, ERRORS).bundle
    np.testing.assert_allclose(subtract(found.pose, bundle.pose), 0.0, atol=0.03)
    for unit in np.eye(7):
        sides = [Bundle(add(found.pose, s * unit[:6]), found.log_scale + s * unit[6]) for s in (1e-4, -1e-4)]
        ahead, behind = (_squares(side, estimates) for side in sides)
        curvature = ahead + behind - 2.0 * _squares(found, estimates)
        assert curvature > 0.0
        assert abs(ahead - behind) < 0.1 * curvature  # the minimum is within 5 % of 1e-4


def test_a_gross_outlier_hardly_moves_the_bundle():
    estimates, bundle = _estimates(2)
    before = adjust(bundle, estimates, ERRORS).bundle
    own = estimates[0].own
    off = Pose(yaw_rotation(0.5) @ own.pose.R_cam_from_world, own.pose.center_world + 1.0)
    found = adjust(before, [*estimates, estimates[0]._replace(own=PoseGaussian(off, own.own, NONE))], ERRORS)
    np.testing.assert_allclose(subtract(found.bundle.pose, before.pose), 0.0, atol=1e-3)


def test_predicted_poses_scatter_as_stated():
    """Chi square of a photo's pose by four others, relative errors as expected, and with errors in common."""
    squares = []
    for seed in range(60):
        estimates, bundle = _estimates(seed, turn=0.5, move=0.02)
        (own, cam), *rest = estimates
        expected = adjust(bundle, rest, ERRORS).predict(cam, ERRORS)
        squares.append(expected.square_distance(own))
    assert 4.5 < np.mean(squares) < 8.0
    common = np.diag([0.0] * 3 + [0.009**2] * 3)
    shared = [Estimate(PoseGaussian(o.pose, o.own, common), cam) for o, cam in estimates]
    np.testing.assert_allclose(adjust(bundle, shared, ERRORS).predict(cam, ERRORS).common, common)


@pytest.mark.parametrize("scale", [0.8, 0.97, 1.03, 1.1])
def test_photos_tell_the_scale(scale):
    estimates, bundle = _estimates(3, scale=scale)
    log_scale, std = find_scale(bundle, estimates, ERRORS)
    assert abs(log_scale - math.log(scale)) < 3.0 * std
    assert std < 0.01
    assert find_scale(bundle, estimates[:1], ERRORS) == (0.0, math.inf)


@pytest.mark.parametrize(("turn", "move"), [(0.3, 0.1), (2.0, 0.01), (1.0, 0.3)])
def test_photos_tell_the_errors_of_relative_poses(turn, move):
    found = []
    for seed in range(20):
        estimates, bundle = _estimates(seed, turn=turn, move=move)
        errors = estimate_errors(bundle, estimates, ERRORS)
        found.append([math.degrees(errors.turn), errors.move])
    medians = np.median(found, axis=0)
    for median, true, expected in zip(medians, (turn, move), (0.5, 0.02), strict=True):
        most = 1.6 if true > expected else 2.0  # an error of the one blurs the other
        assert max(true, expected) / 1.6 < median < most * max(true, expected)


def test_errors_as_expected_stay():
    found = [estimate_errors(bundle, estimates, ERRORS) for estimates, bundle in map(_estimates, range(20))]
    assert sum(errors == ERRORS for errors in found) >= 19


def test_one_photo_that_contradicts_is_found():
    estimates, bundle = _estimates(4)
    assert find_contradicting(bundle, estimates, ERRORS) is None
    own, cam = estimates[2]
    off = PoseGaussian(add(own.pose, np.array([0.0, 0.0, 0.0, 0.0, 0.4, 0.0])), own.own, NONE)
    assert find_contradicting(bundle, [*estimates[:2], Estimate(off, cam), *estimates[3:]], ERRORS) == 2
    assert find_contradicting(bundle, estimates[:2], ERRORS) is None
    noisy, bundle = _estimates(5, move=0.15)
    assert find_contradicting(bundle, noisy, ERRORS) is None, "all are off: no one is to blame"


def test_limits_of_chi_square():
    for freedom in (2.0, 5.0, 23.0):
        assert find_limit(freedom) == pytest.approx(chdtri(freedom, 0.05), rel=0.01)
    assert math.isinf(find_limit(0.0))
    assert find_limit(6.0) == pytest.approx(LIKELY, rel=0.01)
    assert count_freedom(3).tolist() == [6.0, 5.0]
