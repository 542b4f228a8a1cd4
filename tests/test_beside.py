"""A photo localized beside another: matches, the covariance of their pose, and the average of poses."""

import functools
from dataclasses import replace

import narrow_photo
import numpy as np
import pytest
import rooms

from piccolo.evidence import verification
from piccolo.evidence.focal_length import FocalFit
from piccolo.geometry.pose import Pose
from piccolo.geometry.pose_gaussian import LIKELY, PoseGaussian, subtract
from piccolo.judge.belief import make_belief
from piccolo.judge.candidate import NO_CHOICE
from piccolo.judge.reasons import Reason
from piccolo.judge.result import Result, nothing_found
from piccolo.local_features.hypotheses import exact_pose
from piccolo.local_features.matching import NO_MATCHES
from piccolo.localization.judging import Found
from piccolo.photo.photo import Prior
from piccolo.system.jobs.threads import Stopwatch, Workers
from piccolo.together.beside import Neighbor, SurePhoto, fuse, localize_beside

TIER = "scene"


def test_a_photo_is_localized_beside_one_that_shows_the_same():
    """Without a pose of its own; and not beside one that shows nothing of it."""
    panorama = narrow_photo.take()[0]
    nothing = replace_keypoints(narrow_photo.beside(), np.arange(3))
    ask = functools.partial(localize_beside, rooms.scan_map(1, narrow_photo.NUM_POINTS), panorama, [])
    found, names = ask(
        {"bare": SurePhoto(nothing, 0.99, None), "beside": SurePhoto(narrow_photo.beside(), 0.97, None)},
        rooms.UNKNOWN,
        Workers(2),
        Stopwatch(),
    )
    assert names == ("beside",)
    assert found.status == "localized"
    assert found.confidence <= 0.97
    assert found.probability_none == pytest.approx(1.0 - found.confidence, abs=0.01)
    assert found.evidence.num_matches >= 20
    assert rooms.errors(found.pose, narrow_photo.take()[1])[0] < 0.03
    assert ask({"bare": SurePhoto(nothing, 0.99, None)}, rooms.UNKNOWN, Workers(2), Stopwatch()) == (
        nothing_found(),
        (),
    )


def _matches_of(pose, noise, rng, count=60):
    """Matches with points around a pose, with an error of their rays [rad] along each axis."""
    rays = rng.normal(size=(count, 3))
    rays /= np.linalg.norm(rays, axis=1)[:, None]
    points = pose.center_world + rng.uniform(2.0, 5.0, (count, 1)) * (rays @ pose.R_cam_from_world)
    found = rays + noise * rng.normal(size=rays.shape)
    found /= np.linalg.norm(found, axis=1)[:, None]
    tangents = np.cross(found, [0.3, 0.4, 0.5])
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    given = NO_MATCHES._replace(query=np.arange(count, dtype=np.int32), rays=np.float32(found))
    sizes = np.float32(np.linalg.norm(points - pose.center_world, axis=1))
    return given._replace(
        ray_tangents=np.float32(tangents),
        angles=np.ones(count, np.float32),
        points=np.float32(points),
        tangents=np.float32(tangents @ pose.R_cam_from_world),
        sizes=sizes,
    )


@pytest.mark.parametrize(("noise", "count"), [(4e-3, 12), (4e-3, 60)])
def test_the_covariance_of_matches_is_that_of_poses_found_by_them(noise, count):
    rng = np.random.default_rng(3)
    true = narrow_photo.true_pose()
    squares = []
    for _ in range(100):
        matches = _matches_of(true, noise, rng, count)
        found = exact_pose(matches, true).pose
        step = subtract(true, found)
        squares.append(step @ np.linalg.solve(verification.match_covariance(matches, found), step))
    assert 3.0 < np.median(squares) < 9.0  # of 6 parameters 5.3


def _at(pose, std):
    """A pose in the map with its own error [m], none in common."""
    return PoseGaussian(pose, np.diag([1e-6] * 3 + [std**2] * 3), np.zeros((6, 6)))


def _fused(judged, of_photo, settings=rooms.UNKNOWN, fit=None):
    """The mean of a result's pose and that by a photo beside, at the true pose."""
    matches = _matches_of(narrow_photo.true_pose(), 1e-3, np.random.default_rng(1))
    located = verification.Located(
        narrow_photo.beside().keypoints, narrow_photo.beside().ranges, of_photo.pose
    )
    other = Neighbor("b", SurePhoto(located, 0.99, of_photo), matches, narrow_photo.true_pose())
    return fuse(judged, other, Found(replace(narrow_photo.problem(), prior=settings.prior), NO_CHOICE, fit))


def test_a_pose_is_averaged_with_that_by_a_photo_beside():
    """By their covariances; not if it is ruled out, nor against a prior."""
    true = narrow_photo.true_pose()
    off = Pose(true.R_cam_from_world, true.center_world + np.array([0.09, 0.0, 0.0]))
    judged = Result(belief=make_belief([0.8]), best_pose=off, gaussian=_at(off, 0.05))
    fused = _fused(judged, _at(true, 0.01))
    expected = 0.09 * 0.01**2 / (0.05**2 + 0.01**2)
    assert fused.pose.distance(true) == pytest.approx(expected, rel=0.3)
    assert fused.largest_std < 0.0105
    apart = _fused(replace(judged, gaussian=_at(off, 0.01)), _at(true, 0.01))
    assert apart.pose.distance(true) == pytest.approx(0.045, abs=0.004)
    excess = 0.09**2 / (2.0 * 0.01**2) - LIKELY + 1.0
    assert apart.largest_std == pytest.approx(0.01 * (excess / 2.0) ** 0.5, rel=0.1)
    assert _fused(replace(judged, belief=judged.belief.rule_out(Reason.MIRRORED)), _at(true, 0.01)) is None
    assert _fused(replace(judged, gaussian=None), _at(true, 0.01)) is None
    here = rooms.scan_map(1, narrow_photo.NUM_POINTS).to_world(true).center_world
    away = replace(rooms.UNKNOWN, prior=Prior(near=(*(here[:2] + 5.0), None), radius=0.5))
    assert _fused(judged, _at(true, 0.01), away) is None
    motion = np.zeros((6, 1))
    motion[3] = 1.0
    fit = FocalFit(np.zeros(1), np.array([[0.03**2]]), motion, None, 0.0)
    of_camera = fit.pose_covariance
    widened = _fused(replace(judged, gaussian=_at(off, 0.05).widen(of_camera)), _at(true, 0.01), fit=fit)
    assert 0.03 < widened.largest_std < 0.033, "the focal length's error is common"


def replace_keypoints(located, kept):
    """The keypoints of a photo at some indices."""
    return verification.Located(located.keypoints.take(kept), located.ranges[kept], located.pose)
