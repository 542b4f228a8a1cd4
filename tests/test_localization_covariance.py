import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
import rooms
from made_up import PARTIAL, WHOLE
from rooms import WORKERS, as_panorama, errors, query
from scipy.linalg import eigh

from piccolo.cloud.readers.reader import PointSource, RawCloud
from piccolo.cloud.stream import CloudStream
from piccolo.evidence import blocks, covariance
from piccolo.evidence.examine import examine
from piccolo.geometry.nearness import ROOM_RANGE
from piccolo.geometry.pose import Pose, exp_so3, step, yaw_rotation
from piccolo.judge.candidate import Selection, Unoccluded
from piccolo.judge.pose_covariance import describe_errors
from piccolo.localization.claimed_geometry import calibrate_sphere
from piccolo.optimize.channel_loss import ChannelProblem
from piccolo.photo.panorama import Panorama
from piccolo.problem.method import METHOD
from piccolo.scan_map.scan_map import prepare_map
from piccolo.system.jobs.threads import Workers
from piccolo.views.view import Cells
from research.synthetic.places import make_alike
from research.synthetic.world import World, make_query, scan_world

TIER = "scene"


class Photo(NamedTuple):
    """A photo whose images must not be asked for."""

    panorama: Panorama


@pytest.fixture(scope="module")
def found():
    scan_map = rooms.scan_map(2)
    panorama = as_panorama(query(2).rgb)
    prepared = rooms.ask(panorama, scan_map, rooms.KNOWN)
    result = rooms.locate(panorama, scan_map, rooms.KNOWN)
    return prepared, scan_map.from_world(result.pose), result


def _points(prepared, pose):
    return prepared.view_at(pose, "points").around(pose.center_world)


def _gradients(problem, poses, center):
    gradients = np.empty((len(poses), 6))
    rotations = np.array([pose.R_cam_from_world for pose in poses])
    centers = np.array([pose.center_world for pose in poses]) - center
    covariance.write_gradients(problem, rotations, centers, gradients)
    return gradients


def test_gradients_as_left_out_are_those_at_the_pose_without_the_block():
    rng = np.random.default_rng(1)
    rows, wanted = rng.normal(size=(20, 4, 6)), rng.normal(size=(20, 4))
    matrices = np.swapaxes(rows, 1, 2) @ rows
    right = np.einsum("bni,bn->bi", rows, wanted)
    x = np.linalg.solve(matrices.sum(axis=0), right.sum(axis=0))
    gradients = np.einsum("bni,bn->bi", rows, rows @ x - wanted)
    found = blocks.jackknife_gradients(gradients, matrices)
    for k in (0, 7, 19):
        others = np.delete(np.arange(20), k)
        alone = np.linalg.solve(matrices[others].sum(axis=0), right[others].sum(axis=0))
        np.testing.assert_allclose(found[k], rows[k].T @ (rows[k] @ alone - wanted[k]), rtol=0.02, atol=0.02)


def test_hessian_predicts_the_gradient_a_step_away(found):
    prepared, pose, _ = found
    points = _points(prepared, pose)
    image = prepared.photo.images.full()
    levels = covariance.to_levels(points.channels)
    seen = points.offsets, levels, points.weights
    problem = ChannelProblem(*seen, image.rgbx, image.width, covariance.COVARIANCE_SCALE)
    hessian = covariance.compute_hessian(problem, pose, WHOLE.steps[0].turn, 3.0)
    for delta in ([0.001, 0, 0, 0, 0.003, 0], [0, -0.0015, 0.001, 0.003, 0, -0.004]):
        moved = step(pose, np.array(delta))
        before, after = _gradients(problem, (pose, moved), pose.center_world)
        expected = hessian @ delta
        assert np.linalg.norm(after - before - expected) < 0.5 * np.linalg.norm(expected)


def test_a_photos_grid_turns_it_and_does_not_move_it(found):
    """Its rows and columns displaced together are a turn, or a horizon, whose errors count by themselves."""
    prepared, pose, _ = found
    candidate = examine(prepared, pose)

    def tell(share):
        method = replace(METHOD, pixel_share=share)
        asked = replace(prepared, profile=replace(prepared.profile, method=method))
        return covariance.estimate_covariance(asked, candidate, WORKERS).gaussian.covariance

    added = tell(0.5) - tell(0.0)
    expected = np.diag(np.repeat([(0.5 * prepared.pixel) ** 2, 0.0], 3))
    np.testing.assert_allclose(added, expected, atol=1e-6 * expected.max())


def test_noisy_surfaces_move_a_camera_and_do_not_turn_it(found):
    prepared, pose, _ = found
    candidate = examine(prepared, pose)
    surface = np.diag([4e-4, 1e-4, 2e-4])

    def tell(scan_map):
        return covariance.estimate_covariance(
            replace(prepared, scan_map=scan_map), candidate, WORKERS
        ).gaussian

    clean = replace(prepared.scan_map, surface_variance=np.zeros((3, 3)))
    noisy = tell(replace(clean, surface_variance=surface))
    expected = np.zeros((6, 6))
    expected[3:, 3:] = surface
    np.testing.assert_allclose(noisy.common - tell(clean).common, expected, atol=1e-12)
    np.testing.assert_allclose(noisy.covariance - tell(clean).covariance, expected, atol=1e-9)


def test_steps_displace_near_points_as_much_as_turns_do(found, monkeypatch):
    """A tenth of the points is near: they tell most of a position, and the median range would ignore them."""
    prepared, pose, _ = found
    points = _points(prepared, pose)
    scale = np.where(np.arange(points.offsets.shape[1]) % 10 == 0, 2.0, 20.0).astype(np.float32)
    points = points._replace(offsets=points.offsets * scale)
    ranges = []
    monkeypatch.setattr(covariance, "compute_hessian", lambda *rest: ranges.append(rest[3]) or np.eye(6))
    covariance.compute_covariance(prepared.photo, points, pose, WHOLE)
    median = np.median(np.linalg.norm(points.offsets, axis=0))
    assert set(ranges) == {covariance.compute_acting_range(points)}
    assert max(ranges) < 0.5 * median


def test_sandwich_of_independent_blocks_is_the_textbook_covariance():
    rng = np.random.default_rng(0)
    hessian = np.diag([4.0, 5.0, 6.0, 1.0, 2.0, 3.0])
    gradients = rng.normal(size=(5000, 6)) * np.sqrt(np.diag(hessian) / 5000)
    found = covariance.sandwich_covariance(hessian, gradients)
    np.testing.assert_allclose(found, np.linalg.inv(hessian), atol=0.05)


def test_errors_weighed_by_a_covariance_of_few_blocks_are_right_in_the_mean():
    rng = np.random.default_rng(0)
    squares = []
    for _ in range(4000):
        known = covariance.sandwich_covariance(np.eye(6), rng.normal(size=(20, 6)))
        error = np.sqrt(20.0) * rng.normal(size=6)
        squares.append(error @ np.linalg.solve(covariance.few_blocks_factor(20) * known, error))
    assert np.mean(squares) == pytest.approx(6.0, rel=0.05)


def test_no_covariance_without_a_minimum_or_with_few_blocks():
    gradients = np.random.default_rng(0).normal(size=(100, 6))
    assert covariance.sandwich_covariance(np.diag([1.0, 1, 1, 1, 1, -0.1]), gradients) is None
    for least, count, is_known in ((1, 12, False), (1, 13, True), (1e-10, 100, False), (1e-8, 100, True)):
        found = covariance.sandwich_covariance(np.diag([1.0, 1, 1, 1, 1, least]), gradients[:count])
        assert (found is not None) == is_known


def test_covariance_is_in_the_worlds_axes(found):
    prepared, pose, result = found
    R = exp_so3(np.array([0.2, -0.5, 1.1]))
    own = result.covariance.matrix
    candidate = examine(prepared, pose)
    told = covariance.estimate_covariance(prepared, candidate, WORKERS)
    fit = calibrate_sphere(prepared, Selection(candidate, ()), WORKERS)[2]
    other = describe_errors(told.widen(fit.pose_covariance).gaussian, R.T).matrix
    np.testing.assert_allclose(other[:3, :3], own[:3, :3], rtol=1e-6)
    np.testing.assert_allclose(R @ other[3:, 3:] @ R.T, own[3:, 3:], rtol=1e-6, atol=1e-12)


def test_in_a_place_ten_times_as_large_a_position_is_known_a_tenth_as_well(found):
    prepared, pose, _ = found
    points = _points(prepared, pose)
    places = [points._replace(offsets=points.offsets * np.float32(size)) for size in (4.0, 40.0)]
    small, large = (covariance.compute_covariance(prepared.photo, place, pose, WHOLE) for place in places)
    per_metre = np.repeat([1.0, 0.1], 3)
    np.testing.assert_allclose(large * np.outer(per_metre, per_metre), small, rtol=0.02, atol=1e-9)


@pytest.mark.parametrize("num_rough", [0, 1, 2, 3])
def test_where_the_finest_images_have_no_minimum_the_next_one_tells(found, num_rough):
    """Of those that have one the one that tells more counts."""
    prepared, pose, _ = found
    points = _points(prepared, pose)
    ways = (*WHOLE.steps, WHOLE.rough_steps)
    assert [steps.image for steps in ways] == ["full", "fine", "middle"]
    rough = [steps.image for steps in ways[:num_rough]]
    asked = []

    def image(name):
        asked.append(name)
        seen = prepared.photo.image(name)
        return seen._replace(rgbx=np.zeros_like(seen.rgbx)) if name in rough else seen

    def by(*steps):
        profile = replace(WHOLE, steps=steps)
        return covariance.compute_covariance(prepared.photo, points, pose, profile)

    matrix = covariance.compute_covariance(SimpleNamespace(image=image), points, pose, WHOLE)
    assert asked == ["full", "fine", "middle"][: 2 if num_rough < 2 else 3]
    if num_rough == 3:
        assert matrix is None
    else:
        told = [by(steps) for steps in ways[num_rough : max(num_rough + 1, 2)]]
        np.testing.assert_allclose(matrix, told_more(*told), rtol=1e-6, atol=1e-12)


def told_more(one, other=None):
    """The covariance that tells more in each direction, by the axes in which both have no correlations."""
    if other is None:
        return one
    ratios, axes = eigh(one, other)  # axes^T other axes = 1
    back = np.linalg.inv(axes)
    return back.T @ np.diag(np.minimum(ratios, 1.0)) @ back


def test_a_part_of_the_sphere_has_few_blocks_that_tell(found):
    prepared, pose, _ = found
    points = _points(prepared, pose)
    ahead = blocks.take(points, pose.R_cam_from_world[0] @ points.offsets > 0.0)
    whole, part = (
        covariance.compute_covariance(prepared.photo, ahead, pose, profile) for profile in (WHOLE, PARTIAL)
    )
    num_blocks = np.count_nonzero(np.diff(blocks.sort_by_block(ahead)[1]))
    np.testing.assert_allclose(part, covariance.few_blocks_factor(num_blocks) * whole, rtol=5e-3)
    assert covariance.few_blocks_factor(100) == pytest.approx(100.0 / 93.0)


def test_errors_of_upright_edges_go_together():
    """Points of a column have one error; of points that are not all around those of a block."""
    rng = np.random.default_rng(6)
    offsets = rng.normal(size=(3, 20_000)).astype(np.float32)
    points = Cells(offsets, offsets + 1.0, np.ones(20_000, np.float32), np.zeros(3))
    found, begins = blocks.sort_by_column(points)
    assert len(begins) == 25
    azimuths = np.degrees(np.arctan2(found.offsets[1], found.offsets[0])) + 180.0
    assert np.ptp(azimuths[begins[7] : begins[8]]) <= 15.0
    assert np.ptp(found.offsets[2, begins[7] : begins[8]]) > 5.0
    np.testing.assert_array_equal(np.sort(found.offsets), np.sort(offsets))
    some = blocks.take(points, offsets[0] > 0.0)
    for found, expected in zip(blocks.sort_by_column(some), blocks.sort_by_block(some), strict=True):
        np.testing.assert_array_equal(found[0], expected[0])


def test_a_direction_that_one_image_does_not_tell_is_told_by_the_other():
    blind = np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 1e12])
    for told in ((blind, 4.0 * np.eye(6)), (4.0 * np.eye(6), blind)):
        merged = covariance.merge_covariances(*told)
        np.testing.assert_allclose(merged, np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 4.0]), rtol=1e-9)


def test_a_deviation_counts_as_an_angle_beyond_rooms():
    error = np.diag([1e-6, 1e-6, 1e-6, 0.01, 0.04, 0.02]) ** 2
    near, room, far = (covariance.compute_std_of_fit(error, k * ROOM_RANGE) for k in (0.5, 1.0, 4.0))
    assert near == room == pytest.approx(0.04 / ROOM_RANGE)
    assert far == pytest.approx(room / 4.0)


def test_points_that_occluders_hide_are_removed():
    offsets = np.float32([[2.0, 0.0, -3.0, 0.0], [0.1, 1.0, 0.2, -1.0], [0.0, 0.1, 0.5, 0.2]])
    points = Cells(offsets, offsets + 1.0, np.ones(4, np.float32), np.zeros(3))
    is_valid = np.ones((8, 16), bool)
    is_valid[:, :8] = False  # the left half, which shows y < 0 to a camera that looks along -x
    pose = Pose(yaw_rotation(math.pi), np.zeros(3))
    left = covariance.remove_hidden(points, is_valid, pose)
    np.testing.assert_array_equal(left.offsets, offsets[:, :3])
    np.testing.assert_array_equal(left.channels, offsets[:, :3] + 1.0)
    assert left.weights.shape == (3,)


def test_a_view_from_nearby_tells_the_covariance_without_what_occluders_hide(found):
    prepared, pose, _ = found
    clear = examine(prepared, pose)
    own, near = (covariance.estimate_covariance(prepared, clear, WORKERS, place) for place in (None, pose))
    assert near.gaussian.covariance.tobytes() == own.gaussian.covariance.tobytes()
    rgb = query(2).rgb.copy()
    rgb[120:180, 100:180] = np.random.default_rng(0).integers(0, 256, (60, 80, 3))
    hidden = rooms.ask(as_panorama(rgb), prepared.scan_map, rooms.KNOWN)
    candidate = examine(hidden, pose)
    shown = covariance.mask_occluders(hidden, candidate.comparison)
    assert shown.photo is not hidden.photo
    masked = covariance.estimate_covariance(hidden, candidate, WORKERS)
    unasked = Unoccluded(shown.contradicts, Photo(shown.photo.panorama))
    given = replace(candidate, unoccluded=unasked)
    left_out = covariance.estimate_covariance(hidden, given, WORKERS, pose)  # by the images that are there
    variances = [np.diag(found.gaussian.covariance)[3:] for found in (left_out, masked)]
    np.testing.assert_allclose(*np.sqrt(variances), rtol=0.1)


@pytest.mark.parametrize("kind", ["hall", "doors"])
def test_truth_is_among_the_poses_of_a_place_that_repeats(kind):
    world = World(1, make_alike(kind, 1, 0.0))
    points, colors, _ = scan_world(world, 80_000 * len(world.rooms), Workers(2))
    cloud = CloudStream(
        [PointSource(Path("repeated"), lambda: iter([RawCloud(points.astype(float), colors)]))]
    )
    taken = make_query(world, 0, "clean", rooms.WIDTH, Workers(2))
    built = prepare_map(cloud, Workers(2))
    panorama = as_panorama(taken.rgb)
    result = rooms.locate(panorama, built)
    poses = [result.best_pose, *(h.pose for h in result.alternatives)]
    distances = [errors(pose, taken.pose)[0] for pose in poses]
    assert min(distances) < 0.1
    assert result.status == "ambiguous" or distances[0] < 0.1
    assert 1 <= len(result.alternatives) <= 5


@pytest.mark.parametrize(("near", "expected"), [(3.0, 3.0), (1.0, 1.342), (0.001, 0.352)])
def test_near_points_bring_the_range_nearer_at_which_moves_act(near, expected):
    """By as much as they are displaced more; but hardly by what is as near as no camera stands."""
    offsets = np.zeros((3, 2000), np.float32)
    offsets[0, :1000] = near
    offsets[1, 1000:] = 3.0
    found = covariance.compute_acting_range(SimpleNamespace(offsets=offsets))
    assert found == pytest.approx(expected, rel=1e-3)


def test_a_point_at_a_pole_of_the_photo_tells_nothing(found):
    """Its pixels are so narrow that it would outweigh all others."""
    prepared, pose, _ = found
    taken = prepared.view_at(pose, "points").around(pose.center_world)
    down = -pose.R_cam_from_world[2] + 0.002 * pose.R_cam_from_world[0]
    away = -pose.R_cam_from_world[2] + 0.1 * pose.R_cam_from_world[0]
    wrong = np.array([2.0, -2.0, 2.0], np.float32)

    def with_one_at(direction):
        offsets = np.concatenate([taken.offsets, 1.5 * direction[:, None]], axis=1).astype(np.float32)
        channels = np.concatenate([taken.channels, wrong[:, None]], axis=1)
        return type(taken)(offsets, channels, np.ones(offsets.shape[1], np.float32), taken.center_map)

    kept = [len(covariance.remove_poles(with_one_at(d), pose).weights) for d in (down, away)]
    assert kept[1] == kept[0] + 1
    candidate = examine(prepared, pose)
    expected = covariance.estimate_covariance(prepared, candidate, WORKERS).gaussian.covariance
    with_pole = replace(prepared, views=SimpleNamespace(points=lambda *_: with_one_at(down)))
    told = covariance.estimate_covariance(with_pole, candidate, WORKERS).gaussian.covariance
    np.testing.assert_allclose(told, expected, rtol=0.02)
