from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rooms
from rooms import as_panorama, errors, query, room

from piccolo.cloud import stream_of
from piccolo.cloud.readers.reader import RawCloud
from piccolo.coarse_to_fine.covariance import (
    PROBES,
    SHARP_STD,
    block_gradients,
    certainty_at,
    covariance_of,
    disagreement_of_halves,
    gradient_at,
    has_bottom,
    hessian_at,
    points_at,
)
from piccolo.coarse_to_fine.localize import localize
from piccolo.coarse_to_fine.query import look_for
from piccolo.coarse_to_fine.scan_map import prepare_map
from piccolo.coarse_to_fine.settings import CoarseToFineSettings
from piccolo.geometry.pose import Pose, exp_so3, log_so3, step
from piccolo.runtime.stopwatch import Stopwatch
from piccolo.runtime.threads import Workers
from piccolo.scenes.synthetic.repeated import REPEATED_KINDS, make_repeated
from piccolo.scenes.synthetic.world import World, make_query, scan_world

SETTINGS = CoarseToFineSettings(gravity="known")


@pytest.fixture(scope="module")
def found():
    """A look at a room, and the pose found in the map's frame."""
    scan_map, panorama = prepare_map(room(2)[1], Workers(2)), as_panorama(query(2).rgb)
    look = look_for(panorama, scan_map, SETTINGS, Workers(2))
    result = localize(scan_map, panorama, SETTINGS, Workers(2), Stopwatch())
    return look, scan_map.from_world(result.pose), result


def test_gradients_of_blocks_add_up(found):
    look, pose, _ = found
    points = points_at(look, pose)
    total = gradient_at(look.images[0], points, pose.R_cam_from_world, np.zeros(3))
    parts = block_gradients(look.images[0], points, pose)
    assert len(parts) > 100
    tolerance = 1e-3 * np.abs(parts).sum(axis=0).max()
    np.testing.assert_allclose(parts.sum(axis=0), total, rtol=1e-3, atol=tolerance)


def test_hessian_predicts_the_gradient_a_step_away(found):
    look, pose, _ = found
    points = points_at(look, pose)
    hessian = hessian_at(look.images[0], points, pose, PROBES[0])
    for delta in ([0.001, 0, 0, 0, 0.003, 0], [0, -0.0015, 0.001, 0.003, 0, -0.004]):
        moved = step(pose, np.array(delta))
        before = gradient_at(look.images[0], points, pose.R_cam_from_world, np.zeros(3))
        shift = moved.center_world - pose.center_world
        after = gradient_at(look.images[0], points, moved.R_cam_from_world, shift)
        expected = hessian @ delta
        assert np.linalg.norm(after - before - expected) < 0.5 * np.linalg.norm(expected)


def test_sandwich_of_independent_blocks_is_the_textbook_covariance():
    rng = np.random.default_rng(0)
    hessian = np.diag([4.0, 5.0, 6.0, 1.0, 2.0, 3.0])
    gradients = rng.normal(size=(5000, 6)) * np.sqrt(np.diag(hessian) / 5000)
    np.testing.assert_allclose(covariance_of(hessian, gradients), np.linalg.inv(hessian), atol=0.05)


def test_no_covariance_without_a_bottom_or_with_few_blocks():
    gradients = np.random.default_rng(0).normal(size=(100, 6))
    assert covariance_of(np.diag([1.0, 1, 1, 1, 1, -0.1]), gradients) is None
    assert covariance_of(np.eye(6), gradients[:10]) is None


def test_covariance_is_in_the_worlds_axes(found):
    """A map turned against the world: the same deviations, turned along."""
    look, pose, result = found
    points, R = points_at(look, pose), exp_so3(np.array([0.2, -0.5, 1.1]))
    turned = replace(look, scan_map=replace(look.scan_map, R_map_from_world=R))
    own, other = result.certainty.covariance, certainty_at(turned, points, pose).covariance
    np.testing.assert_allclose(other[:3, :3], own[:3, :3], rtol=1e-6)
    np.testing.assert_allclose(R @ other[3:, 3:] @ R.T, own[3:, 3:], rtol=1e-6, atol=1e-12)


def test_deviations_are_of_the_size_of_the_errors():
    """Squared errors, weighed by their covariance: 5.3 in the median for six numbers if all is right."""
    squares = []
    for seed in (1, 2, 3):
        scan_map = prepare_map(room(seed)[1], Workers(2))
        for variant in ("clean", "tilt", "change"):
            taken = query(seed, variant)
            how = CoarseToFineSettings(gravity="unknown" if variant == "tilt" else "known")
            result = localize(scan_map, as_panorama(taken.rgb), how, Workers(2), Stopwatch())
            turn = log_so3(taken.pose.R_cam_from_world @ result.pose.R_cam_from_world.T)
            error = np.concatenate([turn, taken.pose.center_world - result.pose.center_world])
            squares.append(error @ np.linalg.solve(result.certainty.covariance, error))
    assert 1.0 < np.median(squares) < 15.0


def test_halves_agree_at_the_right_pose_only(found):
    look, pose, result = found
    assert disagreement_of_halves(look, points_at(look, pose), pose)[0] < 0.02
    assert has_bottom(look, pose, 0.8)
    assert has_bottom(look, pose, 0.0) == (result.certainty.largest_std < SHARP_STD)  # where little is alike
    wrong = Pose(exp_so3(np.array([0.0, 0.0, 2.0])) @ pose.R_cam_from_world, pose.center_world)
    assert not has_bottom(look, wrong, 0.8)


@pytest.mark.parametrize("kind", REPEATED_KINDS)
def test_truth_is_among_the_poses_of_a_place_that_repeats(kind):
    world = World(1, make_repeated(kind, 1, np.array(rooms.SIZE)))
    points, colors, _ = scan_world(world, 80_000 * len(world.rooms), Workers(2))
    cloud = stream_of(Path("repeated"), RawCloud(points.astype(float), colors))
    taken = make_query(world, 0, "clean", rooms.WIDTH, Workers(2))
    result = localize(
        prepare_map(cloud, Workers(2)),
        as_panorama(taken.rgb),
        CoarseToFineSettings(),
        Workers(2),
        Stopwatch(),
    )
    distances = [errors(pose, taken.pose)[0] for pose in (result.pose, *(r.pose for r in result.rivals))]
    assert min(distances) < 0.1
    assert result.status == "ambiguous" or distances[0] < 0.1
    assert 1 <= len(result.rivals) <= 5
