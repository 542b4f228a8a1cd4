"""Descents on the cells of a room's views."""

import functools

import numpy as np
import rooms

from piccolo.geometry.pose import Pose, step
from piccolo.geometry.sphere import make_grid
from piccolo.jobs.threads import Workers
from piccolo.localization import refinement
from piccolo.localization.query import images_of
from piccolo.localization.search import Starts
from piccolo.localization.settings import METHOD
from piccolo.views.view import Cells

FINE_BLOCKS = METHOD.fine_view.arrays.blocks
ALL = np.ones(len(FINE_BLOCKS), bool)


@functools.lru_cache
def _images():
    return images_of(rooms.scene(1)[1], METHOD.scales)


@functools.lru_cache
def _fine():
    """Fine cells about the true camera of a room, and its true pose."""
    true_pose = rooms.scene(1)[2]
    return rooms.view(rooms.scan_map(1).octree, true_pose.center_world, METHOD.fine_view, ALL), true_pose


def test_channels_in_levels_and_perturbations_to_the_corners_of_a_cube():
    np.testing.assert_allclose(refinement.as_levels(np.array([-2, 0, 2], np.float32)), [0, 127.5, 255])
    steps = refinement.perturbations(0.5)
    assert steps.shape == (9, 6)
    assert (steps[0] == 0).all()
    np.testing.assert_allclose(np.degrees(np.linalg.norm(steps[1:, :3], axis=1)), 4.0)
    np.testing.assert_allclose(np.linalg.norm(steps[1:, 3:], axis=1), 0.125)
    assert len(np.unique(np.sign(steps[1:, 3:]), axis=0)) == 8
    assert (np.sign(steps[1:, 3:]) == np.sign(steps[1:, 2::-1])).all()


def test_descent_finds_the_true_pose_again():
    (cells, true_pose), image = _fine(), _images().fine()
    off = step(true_pose, np.array([0.03, -0.02, 0.04, 0.06, -0.05, 0.04]))
    pose = refinement.descend(cells, image, off, (1.0, 30, 1e-5))
    assert rooms.errors(pose, true_pose)[0] < 0.01
    before, after = (refinement.fit_on(cells, FINE_BLOCKS, image, p).score for p in (off, pose))
    assert after > max(0.6, before)
    assert rooms.errors(refinement.descend(cells, image, off, (1.0, 1, 1e-5)), true_pose)[0] > 0.01


def test_perturbed_descents_lead_out_of_a_place_a_quarter_of_a_metre_off():
    (_, true_pose), images = _fine(), _images()
    off = step(true_pose, refinement.perturbations(1.0)[1])
    assert rooms.errors(off, true_pose)[0] > 0.2
    cells = rooms.view(rooms.scan_map(1).octree, off.center_world, METHOD.fine_view, ALL)
    problem = cells, FINE_BLOCKS, (images.search(), images.middle()), off, 1.0
    found, by_two = (refinement.descend_around(*problem, Workers(n)) for n in (1, 2))
    assert (found.pose.key, found.score) == (by_two.pose.key, by_two.score)
    assert rooms.errors(found.pose, true_pose)[0] < 0.06
    expected = refinement.fit_on(cells, FINE_BLOCKS, images.middle(), found.pose)
    np.testing.assert_allclose(found.score, expected.score, atol=1e-5)


def test_starts_descend_on_their_candidates_views_as_one_does_alone():
    scan_map, (_, true_pose), image = rooms.scan_map(1), _fine(), _images().search()
    distance = np.linalg.norm(scan_map.centers - true_pose.center_world, axis=1)
    k, far = int(np.argmin(distance)), int(np.argmax(distance))
    candidate, R = np.array([k, far, k]), true_pose.R_cam_from_world
    starts = Starts(np.stack([R] * 3), scan_map.centers[candidate], candidate)
    ends, scores = refinement.descend_all(scan_map, image, starts, 12, Workers(2))
    assert ends.candidate.tolist() == [k, k, far]  # the best first
    assert scores[0] == scores[1] > max(0.4, scores[2])
    (row,), views = scan_map.views.at(np.array([k]), Workers(1))
    offsets = (views.offsets[row] * views.offset_unit[row]).astype(np.float32)
    channels = views.features[row].astype(np.float32) / np.float32(63.75)
    weights = (views.is_seen[row] * make_grid(24).solid_angle).astype(np.float32)
    cells, center = Cells(offsets, channels, weights, scan_map.centers[k]), scan_map.centers[k]
    alone = refinement.descend(cells, image, Pose(R, center), (1.2, 12, 2e-3))
    np.testing.assert_allclose(ends.center_map[0], alone.center_world, atol=1e-4)
    np.testing.assert_allclose(ends.R_cam_from_map[0], alone.R_cam_from_world, atol=1e-4)
    assert rooms.errors(alone, true_pose)[0] < 0.1
