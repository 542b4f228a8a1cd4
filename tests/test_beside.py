"""A photo localized beside another: matches, the covariance of their pose, and the average of poses."""

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import rooms
from test_verification import NUM_POINTS, SETTINGS, _beside, _narrow, _query, _true_pose

from piccolo.confidence.covariance import PoseCovariance
from piccolo.confidence.localization import Localization
from piccolo.geometry.pose import Pose
from piccolo.jobs.stopwatch import Stopwatch
from piccolo.jobs.threads import Workers
from piccolo.local_features.hypotheses import exact_pose
from piccolo.local_features.matching import NO_MATCHES
from piccolo.localization import verification
from piccolo.localization.beside import Beside, Picture, fuse, localize_beside, match_covariance
from piccolo.localization.bundle import ROBUST, subtract
from piccolo.localization.focal_length import FocalFit
from piccolo.localization.localize import Found
from piccolo.localization.selection import NOTHING
from piccolo.scan_map.prior import Prior


def test_a_photo_is_localized_beside_one_that_shows_the_same():
    """Without a pose of its own; and not beside one that shows nothing of it."""
    panorama = _narrow()[0]
    nothing = replace_keypoints(_beside(), np.arange(3))
    ask = functools.partial(localize_beside, rooms.scan_map(1, NUM_POINTS), panorama, [])
    found, names = ask(
        {"bare": Picture(nothing, 0.99, None), "beside": Picture(_beside(), 0.97, None)},
        SETTINGS,
        Workers(2),
        Stopwatch(),
    )
    assert names == ("beside",)
    assert found.status == "localized"
    assert found.confidence <= 0.97
    assert found.probability_none == pytest.approx(1.0 - found.confidence, abs=0.01)
    assert found.evidence.num_matches >= 20
    assert rooms.errors(found.pose, _narrow()[1])[0] < 0.03
    assert ask({"bare": Picture(nothing, 0.99, None)}, SETTINGS, Workers(2), Stopwatch()) == (
        Localization(),
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
        weights=np.ones(count, np.float32),
    )


@pytest.mark.parametrize(("noise", "count"), [(4e-3, 12), (4e-3, 60)])
def test_the_covariance_of_matches_is_that_of_poses_found_by_them(noise, count):
    rng = np.random.default_rng(3)
    true = _true_pose()
    squares = []
    for _ in range(100):
        matches = _matches_of(true, noise, rng, count)
        found = exact_pose(matches, true, None).pose
        step = subtract(true, found)
        squares.append(step @ np.linalg.solve(match_covariance(matches, found), step))
    assert 3.0 < np.median(squares) < 9.0  # of 6 parameters 5.3


def test_a_pose_is_averaged_with_that_by_a_photo_beside():
    """By their covariances; not if it is ruled out, nor against a prior."""
    rng = np.random.default_rng(1)
    scan_map = rooms.scan_map(1, NUM_POINTS)
    true = _true_pose()
    here = scan_map.to_world(true)
    off = Pose(here.R_cam_from_world, here.center_world + np.array([0.09, 0.0, 0.0]))
    wide, narrow = (PoseCovariance(np.diag([1e-6] * 3 + [s**2] * 3), "x") for s in (0.05, 0.01))
    judged = Localization("not_localized", 0.8, 0.2, off, covariance=wide)
    picture = Picture(verification.Located(_beside().keypoints, _beside().ranges, true), 0.99, narrow)
    other = Beside("b", picture, _matches_of(true, 1e-3, rng), true)
    ended = Found(_query(), NOTHING, None)
    fused = fuse(judged, other, ended, scan_map)
    distance = rooms.errors(fused.pose, here)[0]
    assert distance == pytest.approx(0.09 * 0.01**2 / (0.05**2 + 0.01**2), rel=0.3)
    assert fused.covariance.largest_std < 0.0105
    assert fused.confidence == pytest.approx(0.8 * math.erf(10.0 / 2**0.5) / math.erf(2.0 / 2**0.5), rel=1e-3)
    assert fused.confidence + fused.probability_none == pytest.approx(1.0)
    sure = PoseCovariance(np.diag([1e-6] * 3 + [0.01**2] * 3), "x")
    apart = fuse(replace(judged, covariance=sure), other, ended, scan_map)
    assert rooms.errors(apart.pose, here)[0] == pytest.approx(0.045, abs=0.004)
    excess = 0.09**2 / (2.0 * 0.01**2) - ROBUST + 1.0
    assert apart.covariance.largest_std == pytest.approx(0.01 * (excess / 2.0) ** 0.5, rel=0.1)
    assert apart.confidence < 0.8
    for same in (replace(judged, confidence=0.0), replace(judged, covariance=None)):
        assert fuse(same, other, ended, scan_map) is same
    away = replace(SETTINGS, prior=Prior(near_world=(*(here.center_world[:2] + 5.0), None), radius=0.5))
    against = Found(replace(_query(), settings=away), NOTHING, None)
    assert fuse(judged, other, against, scan_map) is judged
    motion = np.zeros((6, 1))
    motion[3] = 1.0
    fit = FocalFit(np.zeros(1), np.array([[0.03**2]]), motion, 0.0)
    widened = fuse(judged, other, ended._replace(fit=fit), scan_map)
    assert 0.03 < widened.covariance.largest_std < 0.033, "the focal length's error is common"


def replace_keypoints(located, kept):
    """The keypoints of a photo at some indices."""
    return verification.Located(located.keypoints.take(kept), located.ranges[kept], located.pose)
