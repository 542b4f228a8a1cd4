import dataclasses
import functools
import itertools
import re
from contextlib import ExitStack

import cv2
import numpy as np
import pytest
import rooms
from golden_poses import check_golden_poses
from rooms import as_panorama, errors, query, room, scan_map
from threadpoolctl import threadpool_limits

from piccolo.cloud.stream import CloudPoints, stream_of_arrays
from piccolo.geometry.pose import Pose, exp_so3, log_so3, uniform_yaws
from piccolo.photo.photo import Prior
from piccolo.problem.prior import allow_rotations, apply_prior, ball_of
from piccolo.scan_map import camera_positions
from piccolo.scan_map.camera_positions import find_supported_cells, heights_above_floor, top_surfaces
from piccolo.scan_map.scan_map import prepare_map
from piccolo.system.errors import InputError
from piccolo.system.jobs.threads import Workers

TIER = "scene"


def _localize(seed, rgb, settings, num_threads=2):
    return rooms.locate(as_panorama(rgb), scan_map(seed), settings, num_threads)


@functools.lru_cache
def _found(seed, variant):
    return _localize(seed, query(seed, variant).rgb, rooms.AUTO)


SEEDS, VARIANTS = (1, 2, 3), ("clean", "photo", "change", "tilt")


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("variant", VARIANTS)
def test_camera_is_found_within_millimetres(seed, variant):
    taken = query(seed, variant)
    found = _found(seed, variant)
    distance, angle_deg = errors(found.pose, taken.pose)
    assert found.status == "localized"
    # a 512 px panorama has pixels of 0.7 deg and the photo's is blurred and noisy
    assert distance < (0.015 if variant in ("photo", "change") else 0.010)
    assert angle_deg < (0.4 if variant in ("photo", "change") else 0.2)


@pytest.fixture
def of_libraries():
    """A function that sets the threads of BLAS and OpenCV."""
    before = cv2.getNumThreads()
    with ExitStack() as limits:

        def limit(num_threads):
            cv2.setNumThreads(num_threads)
            limits.enter_context(threadpool_limits(num_threads))

        yield limit
    cv2.setNumThreads(before)


def test_same_bits_for_any_number_of_threads(of_libraries):
    found = []
    for num_threads in (1, 2):
        of_libraries(num_threads)
        found.append(_localize(1, query(1).rgb, rooms.KNOWN, num_threads))
    one, two = found
    assert one.pose.key == two.pose.key
    assert (one.loss, one.evidence, one.confidence) == (two.loss, two.evidence, two.confidence)


@pytest.mark.parametrize("name", ["elsewhere", "black", "noise"])
def test_panorama_from_elsewhere_is_not_localized(name):
    noise = np.random.default_rng(0).integers(0, 256, (256, 512, 3), dtype=np.uint8)
    rgb = {"elsewhere": query(1).rgb, "black": np.zeros_like(noise), "noise": noise}[name]
    assert _localize(2, rgb, rooms.AUTO).status == "not_localized"


def test_nothing_that_counts_or_no_place_for_a_camera_is_no_error():
    panorama = dataclasses.replace(rooms.scene(1)[1], is_valid=np.zeros((256, 512), dtype=bool))
    found = rooms.locate(panorama, scan_map(1), rooms.KNOWN)
    assert found.status == "not_localized"
    assert found.pose is None
    rng = np.random.default_rng(0)
    solid = rng.uniform(0.0, 1.0, (20_000, 3)).astype(np.float32)
    cloud = stream_of_arrays(solid, rng.integers(0, 256, (20_000, 3), dtype=np.uint8))
    solid_map = prepare_map(cloud, Workers(1))
    found = rooms.locate(as_panorama(query(1).rgb), solid_map)
    assert found.status == "not_localized"


def test_poses_in_a_cloud_that_a_rotation_turns_upright_are_in_the_files_frame():
    cloud = room(1)[1]
    taken = query(1)
    turn = exp_so3(np.array([np.pi / 2, 0.0, 0.0])) @ exp_so3(np.array([0.3, 0.3, 0.0]))
    lying = CloudPoints((cloud.points @ turn.T).astype(np.float32), cloud.colors, cloud.origin_world)
    lying_map = prepare_map(rooms.stream(lying), Workers(2), turn.T)
    assert lying_map.warnings == ()
    found = rooms.locate(as_panorama(taken.rgb), lying_map, rooms.KNOWN)
    center = turn @ (taken.pose.center_world - cloud.origin_world) + cloud.origin_world
    rooms.assert_near(found.pose, Pose(taken.pose.R_cam_from_world @ turn.T, center), 0.01, 0.1)


def test_world_and_map_frames_are_inverse():
    turned = dataclasses.replace(scan_map(1), R_map_from_world=exp_so3(np.array([0.3, 1.0, -0.5])))
    pose = Pose(exp_so3(np.array([0.1, 0.2, 0.3])), np.array([5.0, 6.0, 7.0]))
    back = turned.from_world(turned.to_world(pose))
    np.testing.assert_allclose(back.R_cam_from_world, pose.R_cam_from_world, atol=1e-12)
    np.testing.assert_allclose(back.center_world, pose.center_world, atol=1e-12)


def test_priors_leave_what_they_say():
    whole = scan_map(1)
    origin = room(1)[1].origin_world
    turn = exp_so3(np.array([0.0, 0.0, 2.0]))  # of a map that was levelled
    turned = dataclasses.replace(whole, R_map_from_world=turn)
    near_it = Prior(near=tuple(origin + turn.T @ [0.5, 0, 0]), radius=1.0)
    near = apply_prior(turned, near_it)
    distance = np.linalg.norm(whole.centers - [0.5, 0, 0], axis=1)
    is_near = distance <= 1.3  # half a spacing more
    assert 0 < is_near.sum() < len(is_near)
    low = apply_prior(whole, Prior(height=(0.5, 1.0)))
    heights = heights_above_floor(whole.octree, whole.centers)
    is_low = (heights >= 0.2) & (heights <= 1.3)
    assert 0 < is_low.sum() < len(is_low)
    for left, is_left in ((near, is_near), (low, is_low)):
        cells = np.floor(whole.centers / 0.6)  # of the coarse grid
        is_kept = (cells[whole.sparse][:, None] == cells[is_left]).all(axis=2).any(axis=1)
        assert 0 < is_kept.sum() < len(is_kept)
        np.testing.assert_array_equal(left.sparse, whole.sparse[is_kept])
        np.testing.assert_array_equal(left.wide_features, whole.wide_features[is_kept])
        np.testing.assert_array_equal(left.wide_seen, whole.wide_seen[is_kept])
    both = apply_prior(turned, dataclasses.replace(near_it, height=(0.5, 1.0)))
    assert len(both.sparse) == len(np.unique(cells[is_near & is_low], axis=0))
    assert set(both.sparse) <= set(apply_prior(near, Prior(height=(0.5, 1.0))).sparse)
    np.testing.assert_array_equal(apply_prior(near, near_it).sparse, near.sparse)  # as walks do
    assert apply_prior(whole, Prior()) is whole


def test_a_prior_that_allows_nothing_says_what_was_left_out():
    whole = scan_map(1)
    origin = room(1)[1].origin_world
    num = len(whole.centers)
    heights = heights_above_floor(whole.octree, whole.centers)
    prior = Prior(near=tuple(whole.centers[0] + origin - [50.0, 0.0, 0.0]), radius=1.0, height=(0.5, 1.0))
    settings = dataclasses.replace(rooms.KNOWN, prior=prior)
    (text,) = _localize(1, query(1).rgb, settings).warnings
    num_low = ((heights >= 0.2) & (heights <= 1.3)).sum()
    counts = f"`near` allows 0, `height` allows {num_low}; "
    assert f"no position is left of the scan's {num}: {counts}" in text
    x, y, z, distance = map(float, re.search(r"is (\S+) (\S+) (\S+), (\S+) m away", text).groups())
    to_near = np.linalg.norm(whole.centers + origin - prior.near, axis=1)
    np.testing.assert_allclose((x, y, z), whole.centers[to_near.argmin()] + origin, atol=0.005)
    assert distance == pytest.approx(to_near.min(), abs=0.005)


def test_a_scan_too_large_is_refused_or_prepared_where_the_prior_says(monkeypatch):
    cloud = rooms.stream(room(1)[1])
    whole = scan_map(1)
    center = whole.centers[0]
    is_near = np.linalg.norm(whole.centers - center, axis=1) <= 1.0
    num = len(find_supported_cells(top_surfaces(whole.octree)))
    for most in (10, num - 1):  # known from the surfaces alone, or when all have been counted
        monkeypatch.setattr(camera_positions, "MAX_POSITIONS", most)
        with pytest.raises(InputError, match=rf"more than {most} camera positions, .*`units`, .*`near`"):
            prepare_map(cloud, Workers(1))
    prior = Prior(near=tuple(center + whole.origin_world), radius=1.0)
    said = []
    part = prepare_map(cloud, Workers(1, warn=said.append), part=ball_of(prior))
    assert part.is_partial
    assert said == list(part.warnings)
    assert "prepared within 1 m of `near`" in said[0]
    assert 0 < len(part.centers) < len(whole.centers)
    left = {tuple(c) for c in apply_prior(part, prior).centers}
    assert {tuple(c) for c in whole.centers[is_near]} <= left
    far = Prior(near=(900.0, 0.0, 0.0), radius=1.0)
    assert len(prepare_map(cloud, Workers(1), part=ball_of(far)).centers) == 0


def test_a_long_preparation_is_announced(monkeypatch):
    monkeypatch.setattr(camera_positions, "LONG", 0.0)
    said = []
    camera_positions.candidate_centers(scan_map(1).octree, Workers(1, warn=said.append))
    assert re.fullmatch(r"the scan: \d+ camera positions, about \d+ min to prepare, once", said[0])


def test_heading_counts_clockwise_from_y():
    yaws = uniform_yaws(36)
    east = allow_rotations(yaws, Prior(heading_deg=90.0, heading_tolerance_deg=1.0))
    np.testing.assert_allclose(east[0, 0], [1.0, 0.0, 0.0], atol=1e-9)
    assert len(allow_rotations(yaws, Prior(heading_deg=0.0, heading_tolerance_deg=25.0))) == 5
    assert len(allow_rotations(yaws, Prior(heading_deg=4.0, heading_tolerance_deg=0.1))) == 1


def test_heading_of_the_truth_keeps_it_and_another_makes_nothing_sure():
    taken = query(1)
    forward = taken.pose.R_cam_from_world[0]
    heading = float(np.degrees(np.arctan2(forward[0], forward[1])))
    for off, is_right in ((0.0, True), (180.0, False)):
        settings = dataclasses.replace(rooms.KNOWN, prior=Prior(heading_deg=heading + off))
        found = _localize(1, taken.rgb, settings)
        assert (found.status == "localized") == is_right
        assert is_right or "away from the heading given" in found.warnings[-1]


def test_deviations_are_of_the_size_of_the_errors():
    """Squared errors, weighed by their covariance: 5.3 in the median for six numbers if all is right."""
    squares = []
    for seed, variant in itertools.product(SEEDS, VARIANTS):
        taken = query(seed, variant)
        found = _found(seed, variant)
        turn = log_so3(taken.pose.R_cam_from_world @ found.pose.R_cam_from_world.T)
        error = np.concatenate([turn, taken.pose.center_world - found.pose.center_world])
        squares.append(error @ np.linalg.solve(found.covariance.matrix, error))
    assert 2.8 < np.median(squares) < 7.0, squares  # deviations at most 1.15 too small, 1.4 too large


def test_golden_poses():
    def arrays(seed):
        m = scan_map(seed)
        return m.octree.nodes, m.centers, m.wide_features, m.wide_seen

    check_golden_poses("localization.json", arrays, _found)
