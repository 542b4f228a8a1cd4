"""Photos with known relative poses, localized as one camera: each step by itself, and a room."""

import functools
import math

import numpy as np
import pytest
import rooms
from made_up import at
from measuring.confidence import mask_outside_field
from poses import tilted_poses

from piccolo.geometry.pose import Pose, exp_so3, pose_errors, yaw_rotation
from piccolo.jobs.stopwatch import Stopwatch
from piccolo.jobs.threads import Workers
from piccolo.localization.bundle import (
    RELATIVE,
    Estimate,
    Member,
    Support,
    add,
    adjust_bundle,
    differentiate,
    fuse_pose,
    is_same_bundle,
    localize_bundle,
    move_origin_near,
    solve_bundle,
    subtract,
    weigh_bundles,
    weigh_robustly,
)
from piccolo.localization.localize import localize
from piccolo.localization.settings import CoarseToFineSettings
from piccolo.panorama import Panorama
from piccolo.scenes.synthetic.world import photograph

NEAR = np.array([2.0, -1.0, 0.5])
SEED = 5
SETTINGS = CoarseToFineSettings(gravity="known")
WHERE = (1, 2, 7)  # eighths of a turn; the first photo shows a bare wall


def _bundle():
    """Poses of three photos in a common frame, and a pose of it in the map, all tilted."""
    *cams_from_bundle, bundle = tilted_poses(4, NEAR)
    return cams_from_bundle, bundle


def _covariance(rng, std=0.01):
    A = std * rng.normal(size=(6, 6))
    return A @ A.T + std**2 * np.eye(6)


def _estimates(rng, noise):
    """Own poses of three photos, each off by a step; the bundle's pose."""
    cams_from_bundle, bundle = _bundle()
    own = [add(cam @ bundle, noise * rng.normal(size=6)) for cam in cams_from_bundle]
    return [Estimate(p, _covariance(rng), cam) for p, cam in zip(own, cams_from_bundle, strict=True)], bundle


def test_steps_are_added_and_subtracted():
    rng = np.random.default_rng(0)
    for pose in tilted_poses(5, NEAR):
        step = rng.normal(size=6)
        np.testing.assert_allclose(subtract(add(pose, step), pose), step, atol=1e-12)
        other = tilted_poses(6, NEAR)[-1]
        back = add(other, subtract(pose, other))
        np.testing.assert_allclose(back.R_cam_from_world, pose.R_cam_from_world, atol=1e-12)
        np.testing.assert_allclose(back.center_world, pose.center_world, atol=1e-12)


def test_the_derivative_is_that_of_differences():
    cams_from_bundle, bundle = _bundle()
    for cam in cams_from_bundle:
        columns = []
        for unit in np.eye(6):
            ahead = cam @ add(bundle, 1e-5 * unit)
            behind = cam @ add(bundle, -1e-5 * unit)
            columns.append(subtract(ahead, behind) / 2e-5)
        np.testing.assert_allclose(differentiate(bundle, cam), np.stack(columns, axis=1), atol=1e-8)


def test_an_improbable_step_counts_less():
    covariance = np.diag([1.0, 4.0, 1.0, 1.0, 1.0, 1.0])
    near = np.array([0.0, 4.0, 0.0, 0.0, 0.0, 0.0])  # squared deviations 4, then 64
    np.testing.assert_allclose(weigh_robustly(near, covariance), np.linalg.inv(covariance))
    far = weigh_robustly(4.0 * near, covariance)
    np.testing.assert_allclose(far, np.linalg.inv(covariance) * (12.6 / 64.0) ** 2)
    np.testing.assert_allclose(weigh_robustly(np.zeros(6), covariance), np.linalg.inv(covariance))


def _squares(bundle, estimates):
    """Weighted squares of all steps from a pose of the bundle."""
    total = 0.0
    for own in estimates:
        step = subtract(own.pose, own.cam_from_bundle @ bundle)
        total += step @ np.linalg.solve(own.covariance + RELATIVE, step)
    return total


def test_the_bundle_is_adjusted_to_the_least_squares():
    estimates, bundle = _estimates(np.random.default_rng(1), 0.004)
    begin = add(bundle, np.array([0.02, -0.01, 0.015, 0.02, 0.03, -0.02]))
    found = adjust_bundle(begin, estimates)
    np.testing.assert_allclose(subtract(found, bundle), 0.0, atol=0.02)
    assert _squares(found, estimates) < 12.6  # so that all photos count fully
    for unit in np.eye(6):
        ahead = _squares(add(found, 1e-4 * unit), estimates)
        behind = _squares(add(found, -1e-4 * unit), estimates)
        curvature = ahead + behind - 2.0 * _squares(found, estimates)
        assert curvature > 0.0
        assert abs(ahead - behind) < 1e-2 * curvature  # the minimum is within 0.5 % of 1e-4


def test_a_gross_outlier_hardly_moves_the_bundle():
    estimates, _ = _estimates(np.random.default_rng(2), 0.004)
    before = adjust_bundle(_bundle()[1], estimates)
    off = Pose(yaw_rotation(0.5) @ estimates[0].pose.R_cam_from_world, estimates[0].pose.center_world + 1.0)
    found = adjust_bundle(before, [*estimates, estimates[0]._replace(pose=off)])
    np.testing.assert_allclose(subtract(found, before), 0.0, atol=1e-3)


def _weighted_mean(expected, covariance, own):
    """Twin of the fusion: the mean of the steps to two poses, by their information."""
    information = np.linalg.inv(covariance)
    of_own = np.linalg.inv(own.covariance)
    together = np.linalg.inv(information + of_own)
    return add(expected, together @ of_own @ subtract(own.pose, expected)), together


def _by_rest(bundle, rest, cam):
    """Twin: a photo's pose and covariance by other photos, by least squares over stacked rows."""
    rows, values = [1e-3 * np.eye(6)], [np.zeros(6)]
    for other in rest:
        L = np.linalg.inv(np.linalg.cholesky(other.covariance + RELATIVE))
        rows.append(L @ differentiate(bundle, other.cam_from_bundle))
        values.append(L @ subtract(other.pose, other.cam_from_bundle @ bundle))
    A = np.concatenate(rows)
    step = np.linalg.lstsq(A, np.concatenate(values), rcond=None)[0]
    J = differentiate(add(bundle, step), cam)
    return cam @ add(bundle, step), J @ np.linalg.inv(A.T @ A) @ J.T + RELATIVE


def _assert_fused(found, expected):
    pose, covariance = found
    np.testing.assert_allclose(subtract(pose, expected[0]), 0.0, atol=1e-9)
    np.testing.assert_allclose(covariance, expected[1], rtol=1e-6, atol=1e-10)


def test_a_photo_is_the_weighted_mean_of_itself_and_the_others():
    (own, *rest), bundle = _estimates(np.random.default_rng(3), 0.002)
    by_rest = _by_rest(bundle, rest, own.cam_from_bundle)
    _assert_fused(fuse_pose(bundle, rest, own, own.cam_from_bundle), _weighted_mean(*by_rest, own))
    _assert_fused(fuse_pose(bundle, rest, None, own.cam_from_bundle), by_rest)


def test_without_others_a_photo_is_by_itself():
    """Also if the common frame begins far from it."""
    (own, *_), bundle = _estimates(np.random.default_rng(3), 0.002)
    for far in (0.0, 1e4):
        cam = Pose(own.cam_from_bundle.R_cam_from_world, own.cam_from_bundle.center_world + far)
        pose, covariance = fuse_pose(bundle, [], own._replace(cam_from_bundle=cam), cam)
        _assert_fused((pose, covariance), (own.pose, own.covariance))


def test_without_anything_nothing_is_known():
    cams_from_bundle, bundle = _bundle()
    pose, covariance = fuse_pose(bundle, [], None, cams_from_bundle[0])
    np.testing.assert_allclose(pose.center_world, (cams_from_bundle[0] @ bundle).center_world)
    assert np.linalg.eigvalsh(covariance)[0] > 1e4
    assert math.sqrt(solve_bundle(bundle, [])[1][0, 0]) == pytest.approx(1e3)


def _support(probability, none, is_found=True):
    return Support(at(0.0, 0.5), is_found, probability, none)


MISSES = _support(0.0, 1.0, False)


def test_one_sure_photo_is_enough_beside_misses():
    bundles = [[_support(0.999, 1e-3), MISSES, MISSES], [_support(1e-3, 0.999), MISSES, MISSES]]
    probabilities = weigh_bundles(bundles, 30)
    assert probabilities[0] > 0.98
    assert probabilities.sum() == pytest.approx(1.0)
    many = weigh_bundles([[*bundles[0], *[MISSES] * 20]], 30)  # bare walls lie together, and count as one
    assert many[0] == pytest.approx(weigh_bundles(bundles[:1], 30)[0])


def test_weak_photos_that_coincide_beat_a_stronger_one():
    weak = [_support(0.3, 0.7)] * 4
    strong = [_support(0.8, 0.2), MISSES, MISSES, MISSES]
    together, alone, _ = weigh_bundles([weak, strong], 30)
    assert together > 0.99
    assert alone < 0.01
    assert weigh_bundles([weak[:1]], 30)[0] < 0.5


def test_two_poses_that_coincide_among_many_may_do_so_by_chance():
    pair = [_support(0.02, 0.98), _support(0.02, 0.98), MISSES]
    assert weigh_bundles([pair], 50)[0] < 0.5
    assert weigh_bundles([pair], 1)[0] > 0.9


def test_where_nothing_is_found_none_is_likely():
    assert weigh_bundles([], 0).tolist() == [1.0]
    assert weigh_bundles([[MISSES] * 3], 30)[-1] > 0.9
    assert np.isfinite(weigh_bundles([[_support(1.0, 1e-6)] * 300, [MISSES] * 300], 30)).all()


def _members(far):
    """Two photos whose common frame begins `far` [m] from them."""
    cams = [Pose(pose.R_cam_from_world, pose.center_world + far) for pose in _bundle()[0][:2]]
    return [Member(None, None, cam) for cam in cams]


@pytest.mark.parametrize("far", [0.0, 1e3])
def test_bundles_are_the_same_where_the_photos_are(far):
    """A turn about a far origin, however small, moves the photos; with the right move it does not."""
    members = _members(far)
    bundle = members[0].cam_from_bundle.inverse() @ tilted_poses(1, NEAR)[0]
    own = members[0].cam_from_bundle @ bundle
    turned = Pose(exp_so3(np.array([0.0, 0.0, 0.02])) @ own.R_cam_from_world, own.center_world)
    about_photo = members[0].cam_from_bundle.inverse() @ turned
    assert is_same_bundle(members, bundle, bundle)
    assert is_same_bundle(members, bundle, about_photo)
    about_origin = add(bundle, np.array([0.0, 0.0, 0.02, 0.0, 0.0, 0.0]))
    assert is_same_bundle(members, bundle, about_origin) == (far == 0.0)
    moved = add(bundle, np.array([0.0, 0.0, 0.0, 0.6, 0.0, 0.0]))
    assert not is_same_bundle(members, bundle, moved)


def test_the_common_frame_is_moved_near():
    cams = [member.cam_from_bundle for member in _members(1e6)]
    moved = move_origin_near(cams)
    assert np.linalg.norm(np.mean([pose.center_world for pose in moved], axis=0)) < 1e-9
    there = moved[1].center_world - moved[0].center_world
    np.testing.assert_allclose(there, cams[1].center_world - cams[0].center_world, atol=1e-9)
    assert all(
        np.array_equal(a.R_cam_from_world, b.R_cam_from_world) for a, b in zip(cams, moved, strict=True)
    )


@functools.lru_cache
def _taken(seed, eighths=WHERE):
    """Photos of 60 degrees in a room, each with its true pose in the world."""
    world = rooms.room(seed)[0]
    base = rooms.query(seed).pose
    taken = []
    for k in eighths:
        center_world = base.center_world + np.random.default_rng(k).uniform(-0.3, 0.3, 3)
        pose = Pose(yaw_rotation(k * math.pi / 4.0) @ base.R_cam_from_world, center_world)
        rgb = photograph(world.rooms[0], pose, rooms.WIDTH, Workers(2))
        taken.append((Panorama(rgb, ~mask_outside_field(rooms.WIDTH, 60.0, 0.0)), pose))
    return taken


def _relative(poses, far=0.0):
    """Poses in a common frame, off by 1 cm and 0.3 degrees."""
    rng = np.random.default_rng(0)
    std = np.repeat([math.radians(0.3), 0.01], 3) / math.sqrt(3.0)
    common_from_world = Pose(exp_so3(np.array([1.0, -2.0, 0.5])), np.array([3.0, -1.0, 2.0]))
    noisy = [add(pose, std * rng.normal(size=6)) @ common_from_world.inverse() for pose in poses]
    return [Pose(pose.R_cam_from_world, pose.center_world + far) for pose in noisy]


@functools.lru_cache
def _localized(seed, num_threads=2, far=0.0, eighths=WHERE):
    """Results in room SEED of photos of a room."""
    photos, poses = zip(*_taken(seed, eighths), strict=True)
    workers = Workers(num_threads)
    return localize_bundle(
        rooms.scan_map(SEED), photos, _relative(poses, far), SETTINGS, workers, Stopwatch()
    )


def _bits(found):
    return [(f.status, f.confidence, f.pose.key, f.covariance.matrix.tobytes()) for f in found]


def test_photos_are_localized_together_of_which_one_is_not_alone():
    photos, poses = zip(*_taken(SEED), strict=True)
    alone = localize(rooms.scan_map(SEED), photos[0], SETTINGS, Workers(2), Stopwatch())
    assert alone.status == "not_localized"
    assert pose_errors(alone.pose, poses[0])[0] > 1.0
    found = _localized(SEED)
    assert [f.status for f in found] == ["localized"] * 3
    for f, pose in zip(found, poses, strict=True):
        distance, angle = pose_errors(f.pose, pose)
        assert distance < 0.05
        assert math.degrees(angle) < 1.5
        assert distance < 4.0 * f.covariance.largest_std
        probabilities = [f.confidence, f.probability_none, *(a.probability for a in f.alternatives)]
        assert sum(probabilities) == pytest.approx(1.0)


def test_photos_of_another_room_are_not_localized():
    for found in _localized(6):
        assert found.status == "not_localized"
        assert found.confidence < 0.5


def test_bundles_are_the_same_bits_at_any_number_of_threads():
    assert _bits(_localized(SEED, 1)) == _bits(_localized(SEED, 2))


def test_it_does_not_matter_where_the_common_frame_begins():
    for near, far in zip(_localized(SEED), _localized(SEED, far=1e6), strict=True):
        assert pose_errors(near.pose, far.pose)[0] < 1e-5
        assert near.confidence == pytest.approx(far.confidence, abs=1e-4)


def test_photos_that_fit_nowhere_are_as_alone():
    """A single photo, of a bare wall."""
    (found,) = _localized(SEED, eighths=WHERE[:1])
    photo, _ = _taken(SEED)[0]
    alone = localize(rooms.scan_map(SEED), photo, SETTINGS, Workers(2), Stopwatch())
    assert alone.covariance is None
    assert (found.confidence, found.pose.key) == (alone.confidence, alone.pose.key)


def test_a_photo_that_shows_nothing_is_not_localized():
    """The others are."""
    photos, poses = zip(*_taken(SEED), strict=True)
    nothing = Panorama(photos[0].rgb, np.zeros_like(photos[0].is_valid))
    found = localize_bundle(
        rooms.scan_map(SEED), [nothing, *photos[1:]], _relative(poses), SETTINGS, Workers(2), Stopwatch()
    )
    assert [f.status for f in found] == ["not_localized", "localized", "localized"]
    assert found[0].pose is None
