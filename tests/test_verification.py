"""Poses verified by drawing the scan: the right one has many matches, and a twin matches the features."""

import functools
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import rooms

from piccolo.cloud.stream import Cloud
from piccolo.cloud.voxels import morton_order
from piccolo.confidence.alternatives import Hypothesis
from piccolo.geometry.pose import MAX_DISTANCE, Pose, exp_so3, log_so3, step, yaw_rotation
from piccolo.geometry.pose_gaussian import LIKELY, subtract
from piccolo.geometry.sphere import compute_indices, pixel_rays
from piccolo.jobs.threads import Workers
from piccolo.local_features import matching
from piccolo.local_features.hypotheses import count_matches
from piccolo.local_features.keypoints import Keypoints
from piccolo.local_features.matching import NO_MATCHES
from piccolo.localization import judge, verification
from piccolo.localization.comparison import compare
from piccolo.localization.covariance import estimate_covariance, estimate_errors
from piccolo.localization.selection import Selection
from piccolo.optimize.sampling_loss import sampling_loss
from piccolo.panorama import Panorama
from piccolo.photo import Prior
from piccolo.scan_map.scan_map import prepare_map
from piccolo.views.zbuffer import visible_points
from research.synthetic.world import change_light, mask_outside_field, photograph, scan_world

NUM_POINTS = 200_000
WIDTH = 1024
SMALL = np.array([0.01, -0.02, 0.015, 0.05, -0.04, 0.03])  # [rad], [m]


def _narrow(seed=1, yaw=1.0):
    """A level photo of 70 degrees that looks along an azimuth, and its true pose in the world."""
    taken = rooms.query(seed, width=WIDTH)
    return Panorama(taken.rgb, ~mask_outside_field(WIDTH, 70.0, yaw)), taken.pose


def _asked(num_threads=2):
    """A query of its own, with an empty cache."""
    return rooms.ask(_narrow()[0], rooms.scan_map(1, NUM_POINTS), rooms.UNKNOWN, num_threads)


@functools.lru_cache
def _query():
    return _asked()


@functools.lru_cache
def _true_pose():
    return rooms.local(1, _narrow()[1], NUM_POINTS)


def _moved(offset, yaw=0.0):
    """The true pose, turned and moved [m]."""
    R = yaw_rotation(yaw) @ _true_pose().R_cam_from_world
    return Pose(R, _true_pose().center_world + np.array(offset))


@functools.lru_cache
def _beside():
    """The keypoints of a photo taken half a metre beside, with other noise and light, at its true pose."""
    world = rooms.room(1, NUM_POINTS)[0]
    here = _narrow()[1]
    pose = Pose(yaw_rotation(0.1) @ here.R_cam_from_world, here.center_world + np.array([0.3, 0.4, 0.0]))
    rng = np.random.default_rng(0)
    rgb = change_light(photograph(world.rooms[0], pose, WIDTH, Workers(2)), rng, rng)
    panorama = Panorama(rgb, _narrow()[0].is_valid)
    query = rooms.ask(panorama, rooms.scan_map(1, NUM_POINTS), rooms.UNKNOWN)
    return verification.place_keypoints(query, rooms.local(1, pose, NUM_POINTS))


def test_a_photo_is_matched_with_one_beside_it_on_the_scan():
    matches = verification.match_beside(_query(), _beside())
    agreeing = count_matches(matches, _true_pose(), verification.COS_AGREE)
    assert agreeing >= 20
    assert (np.diff(matches.query) >= 0).all()
    assert count_matches(matches, _moved((0.5, -0.4, 0.0)), verification.COS_AGREE) < 0.3 * agreeing
    cloud = np.asarray(rooms.room(1, NUM_POINTS)[1].points)
    nearest = [np.linalg.norm(cloud - point, axis=1).min() for point in matches.points]
    assert np.median(nearest) < 0.05


def test_what_moves_with_the_camera_is_no_match():
    """A photo matched with itself: of what is left, nothing is where the pose puts it."""
    matches = verification.match_beside(_query(), verification.place_keypoints(_query(), _true_pose()))
    assert len(matches.query) < 0.2 * len(_query().photo.seen().keypoints.rays)
    assert count_matches(matches, _true_pose(), verification.COS_AGREE) == 0


def test_a_mirrored_photo_has_no_matches_beside():
    """It has some without that rule, as many things are symmetric."""
    taken = Panorama(_narrow()[0].rgb[:, ::-1].copy(), _narrow()[0].is_valid[:, ::-1].copy())
    mirrored = rooms.ask(taken, rooms.scan_map(1, NUM_POINTS), rooms.UNKNOWN)
    assert len(matching.match_pictures(mirrored.photo.seen().keypoints, _beside().keypoints)[0]) > 0
    assert verification.match_beside(mirrored, _beside()) is NO_MATCHES


def test_the_picture_with_the_most_matches_counts(monkeypatch):
    query = replace(_query(), beside=(verification.match_beside(_query(), _beside()), NO_MATCHES))
    assert rooms.errors(verification.verify(query, _true_pose()).pose, _true_pose())[0] < 0.03
    assert verification.verify(query, _moved((0.0, 0.0, 0.0), 2.0)).num_matches <= 6
    monkeypatch.setattr(verification, "matches_near", lambda *_: NO_MATCHES)
    beside = verification.verify(query, _true_pose())
    assert beside.num_matches >= 20
    assert rooms.errors(beside.pose, _true_pose())[0] < 0.1


def test_copies_of_a_place_are_where_the_drawn_scan_looks_the_same():
    """In a scan of a room and its twin, scanned again: not elsewhere in the twin, nor near in the room."""
    world, cloud = rooms.room(1, NUM_POINTS)
    apart = np.float32([6.0, 0.0, 0.0])
    points, colors, _ = scan_world(world._replace(seed=99), NUM_POINTS, Workers(2))
    twin = (points - cloud.origin_world).astype(np.float32) + apart
    both = Cloud(np.vstack([cloud.points, twin]), np.vstack([cloud.colors, colors]), cloud.origin_world)
    order = morton_order(both.points, both.colors)
    both = Cloud(both.points[order], both.colors[order], both.origin_world)
    query = rooms.ask(_narrow()[0], prepare_map(rooms.stream(both), Workers(2)), rooms.UNKNOWN)
    here = query.scan_map.from_world(_narrow()[1])
    moves = [(6.05, 0.0, 0.02), (6.9, -0.8, 0.0), (0.9, -0.8, 0.0)]
    others = [Pose(here.R_cam_from_world, here.center_world + move) for move in moves]
    away = Pose(yaw_rotation(2.0) @ here.R_cam_from_world, here.center_world + apart)
    assert verification.find_copies(query, here, [*others, away]) == [True, False, False, False]
    assert verification.find_copies(query, here, []) == []


def test_keypoints_on_what_the_scan_does_not_show_are_left_out():
    rng = np.random.default_rng(0)
    query = _asked()
    panorama = query.photo.panorama
    hidden = np.zeros(panorama.is_valid.shape, bool)
    hidden[230:300, 310:390] = True
    assert panorama.is_valid[hidden].all()
    rgb = panorama.rgb.copy()
    poster = cv2.resize(rng.integers(0, 255, (14, 16, 3), np.uint8), (80, 70), interpolation=cv2.INTER_CUBIC)
    rgb[230:300, 310:390] = poster
    given = Panorama(rgb, panorama.is_valid)
    occluded = rooms.ask(given, rooms.scan_map(1, NUM_POINTS), rooms.UNKNOWN)
    for asked, least, most in ((query, 0.5, 1.0), (occluded, 0.0, 0.1)):
        seen = asked.photo.seen().keypoints.rays
        kept = verification.place_keypoints(asked, _true_pose()).keypoints.rays
        num_seen, num_kept = (hidden[compute_indices(rays, WIDTH)].sum() for rays in (seen, kept))
        assert num_seen > 10
        assert least * num_seen <= num_kept <= most * num_seen


def test_the_true_pose_has_many_matches_and_wrong_ones_have_few():
    right = verification.verify(_query(), _true_pose())
    assert right.num_matches >= 20
    assert verification.count_agreeing(_query(), _true_pose()) == right.num_matches
    for wrong in (_moved((0.0, 0.0, 0.0), 2.0), _moved((1.0, -0.8, 0.0))):
        assert verification.verify(_query(), wrong).num_matches <= 6
        assert verification.count_agreeing(_query(), wrong) <= 6


def test_a_pose_is_refined_towards_the_truth():
    off = step(_true_pose(), SMALL)
    before = rooms.errors(off, _true_pose())
    found = verification.verify(_query(), off)
    after = rooms.errors(found.pose, _true_pose())
    assert after[0] < min(0.02, 0.4 * before[0])
    assert after[1] < 0.4 * before[1]
    assert found.num_matches >= 20


def test_matches_give_a_pose_whose_error_they_cover():
    squares = []
    for offset in (SMALL, -SMALL, 0.0 * SMALL):
        pose, covariance = verification.place_by_matches(_query(), step(_true_pose(), offset))
        off = subtract(_true_pose(), pose)
        squares.append(off @ np.linalg.solve(covariance, off))
        assert rooms.errors(pose, _true_pose())[0] < 0.03
    assert max(squares) < LIKELY
    assert verification.place_by_matches(_query(), _moved((1.0, -0.8, 0.0))) is None


def test_a_pose_is_averaged_with_that_by_its_matches_unless_that_contradicts_the_prior():
    pose = step(_true_pose(), 0.5 * SMALL)
    alone = estimate_covariance(_query(), pose, compare(_query(), pose))
    found = estimate_errors(_query(), pose)
    assert rooms.errors(found.gaussian.pose, _true_pose())[0] < rooms.errors(pose, _true_pose())[0]
    assert found.std_of_fit == found.gaussian.largest_std < alone.std_of_fit
    moved = found.gaussian.pose.center_world - pose.center_world
    length = float(np.linalg.norm(moved))
    before = Pose(np.eye(3), pose.center_world - moved / length)  # a metre behind
    near = tuple(_query().scan_map.to_world(before).center_world)
    prior = Prior(near=near, radius=1.0 + 0.5 * length - MAX_DISTANCE)
    asked = replace(_query(), settings=replace(_query().settings, prior=prior))
    assert estimate_errors(asked, pose).gaussian.pose.key == pose.key


def test_the_loss_is_that_of_the_averaged_pose():
    query = _query()
    pose = step(_true_pose(), 0.5 * SMALL)
    measured = judge.measure(query, Selection(Hypothesis(pose, 0.5), ()), None)
    assert measured.pose.key == estimate_errors(query, pose).gaussian.pose.key != pose.key
    points = visible_points(query.surroundings_at(pose)[0], measured.pose.center_world)
    assert measured.loss == sampling_loss(points, query.colors(), measured.pose)
    assert measured.loss < sampling_loss(points, query.colors(), pose)


def test_verification_is_the_same_bits_at_any_number_of_threads():
    poses = [_true_pose(), step(_true_pose(), SMALL), _moved((1.0, -0.8, 0.0))]
    queries = _asked(1), _asked(2)
    one, two = (q.workers.map(functools.partial(verification.verify, q), poses, "verify") for q in queries)
    for a, b in zip(one, two, strict=True):
        assert a.num_matches == b.num_matches
        assert a.pose.key == b.pose.key


def test_the_scan_is_drawn_once_for_each_pose_of_the_grid(monkeypatch):
    """At the grid's pose, wherever in its cell the pose lies; a masked photo is matched again."""
    drawn = []

    def match_drawn(query, pose):
        drawn.append(pose)
        return len(drawn)

    monkeypatch.setattr(verification, "match_drawn", match_drawn)
    query = _asked()
    middle = Pose(
        exp_so3(verification.TURN * np.array([3.0, -2.0, 8.0])),
        verification.PLACE * np.array([7.0, -4.0, 2.0]),
    )
    for share in (0.0, 0.4, -0.4):
        turn = log_so3(middle.R_cam_from_world) + share * verification.TURN
        near = Pose(exp_so3(turn), middle.center_world + share * verification.PLACE)
        assert verification.matches_near(query, near) == 1
    assert len(drawn) == 1
    np.testing.assert_allclose(drawn[0].center_world, middle.center_world, atol=1e-12)
    np.testing.assert_allclose(drawn[0].R_cam_from_world, middle.R_cam_from_world, atol=1e-9)
    beside = Pose(middle.R_cam_from_world, middle.center_world + 0.6 * verification.PLACE)
    assert verification.matches_near(query, beside) == 2
    turned = exp_so3(log_so3(middle.R_cam_from_world) + np.array([0.0, 0.6 * verification.TURN, 0.0]))
    assert verification.matches_near(query, Pose(turned, middle.center_world)) == 3
    masked = query.mask(np.zeros((8, 16), bool))
    assert verification.matches_near(masked, middle) == 4
    assert verification.matches_near(query, middle) == 1


def test_matches_lie_on_the_scan_where_the_photo_sees_them():
    """At the true pose many rays lead to their points, and sizes and tangents are those of the photo."""
    true = _true_pose()
    matches = verification.matches_near(_query(), true)
    offsets = matches.points - true.center_world
    distances = np.linalg.norm(offsets, axis=1)
    rays = offsets @ true.R_cam_from_world.T / distances[:, None]
    fits = (rays * matches.rays).sum(axis=1) > verification.COS_AGREE
    assert fits.sum() >= 20
    np.testing.assert_allclose(np.linalg.norm(matches.directions, axis=1), 1.0, atol=1e-5)
    turned = matches.tangents @ true.R_cam_from_world.T
    assert np.median((turned * matches.ray_tangents).sum(axis=1)[fits]) > 0.97
    assert 0.8 < np.median((matches.sizes / distances / matches.angles)[fits]) < 1.25
    cloud = np.asarray(rooms.room(1, NUM_POINTS)[1].points)
    nearest = [np.linalg.norm(cloud - point, axis=1).min() for point in matches.points]
    assert np.median(nearest) < 0.05


@pytest.mark.parametrize(
    ("offset", "yaw_deg", "expected"),
    [
        ((0.29, 0.0, 0.0), 0.0, 30),
        ((0.31, 0.0, 0.0), 0.0, 0),
        ((0.0, 0.0, 0.0), 4.9, 30),
        ((0, 0, 0), 5.1, 0),
    ],
)
def test_matches_with_which_a_pose_moves_away_are_anothers(monkeypatch, offset, yaw_deg, expected):
    """By 0.3 m or 5 degrees."""
    moved = _moved(offset, math.radians(yaw_deg))
    monkeypatch.setattr(verification, "verify", lambda *_: verification.Verified(moved, 30))
    assert verification.count_agreeing(_query(), _true_pose()) == expected


@pytest.mark.parametrize("offset", [(0.0, -0.4, 0.0), (0.4, 0.4, 0.1), (-0.4, 0.2, 0.0)])
def test_half_a_metre_off_the_matches_are_those_of_the_true_pose(offset):
    off = _moved(offset, math.radians(8.0))
    found = verification.verify(_query(), off)
    assert found.num_matches >= 12
    assert rooms.errors(found.pose, _true_pose())[0] < 0.1
    assert verification.count_agreeing(_query(), off) == 0


def test_the_scan_is_drawn_for_whole_photos_too_but_not_for_whole_views_alone(monkeypatch):
    whole = rooms.ask(rooms.scene(1)[1], rooms.scan_map(1, NUM_POINTS), rooms.UNKNOWN)
    assert len(whole.photo.seen().views) == 4
    assert verification.count_agreeing(whole, _true_pose()) > 20
    assert verification.count_agreeing(whole, _moved((1.0, 0.5, 0.0))) < 6
    monkeypatch.setattr(verification, "verify", lambda *_: pytest.fail("drawn"))
    assert verification.count_agreeing(whole.by_views(), _true_pose()) == 0


@pytest.mark.parametrize(("count", "expected"), [(12, 2), (11, 6)])
def test_a_pose_that_explains_less_than_half_of_a_sure_one_is_not_drawn(monkeypatch, count, expected):
    monkeypatch.setattr(verification, "count_agreeing", lambda query, pose: count)
    asked = _query()
    best, *others = (Hypothesis(_true_pose(), score) for score in (0.8, 0.5, 0.4, 0.39, 0.3, 0.2, 0.1))
    assert verification.list_rivals(asked, best, others) == others[:expected]
    assert verification.list_rivals(asked.by_views(), best, others) == []


def test_the_least_distance_elsewhere_is_that_of_a_plain_search():
    rng = np.random.default_rng(5)
    rays = rng.normal(size=(40, 3)).astype(np.float32) * [1.0, 0.03, 0.03] + [1.0, 0.0, 0.0]
    rays = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).astype(np.float32)
    distances = rng.integers(0, 1000, (30, 40)).astype(np.float32)
    nearest = distances.argmin(axis=1)
    found = np.empty(30, np.float32)
    matching.find_elsewhere(distances, np.ascontiguousarray(rays.T), nearest, found)
    cosines = rays[nearest].astype(np.float64) @ rays.astype(np.float64).T
    expected = np.where(cosines > math.cos(math.radians(2.0)), np.inf, distances).min(axis=1)
    np.testing.assert_array_equal(found, expected)
    assert (expected > distances.min(axis=1)).any()


def _keypoints(rays, descriptors):
    rays = np.asarray(rays, np.float32)
    return Keypoints(rays, np.zeros_like(rays), np.ones(len(rays), np.float32), descriptors)


def _match_one_by_one(own, drawn):
    """By the angle [rad] to the best match, which of the others are elsewhere."""
    found = []
    for k, descriptor in enumerate(own.descriptors.astype(float)):
        distances = np.linalg.norm(drawn.descriptors - descriptor, axis=1)
        best = int(np.argmin(distances))
        cosines = drawn.rays.astype(float) @ drawn.rays[best].astype(float)
        others = distances[np.arccos(np.clip(cosines, -1, 1)) > math.radians(2.0)]
        if distances[best] < 0.8 * others.min(initial=math.inf):
            found.append((k, best))
    return found


@pytest.mark.parametrize("seed", [0, 1])
def test_pictures_are_matched_as_their_twin(seed):
    """Half of the features are seen again; of these some look like another one next to them, or elsewhere."""
    rng = np.random.default_rng(seed)
    descriptors = rng.integers(0, 60, (120, 128)).astype(np.uint8)
    rays = pixel_rays(256).reshape(-1, 3)[rng.permutation(128 * 256)[:120]]
    rays[:20] = rays[20:40] + rng.normal(0.0, 0.005, (20, 3))  # within two degrees
    descriptors[:40] = np.concatenate([descriptors[20:40]] * 2)
    descriptors[40:60] = descriptors[60:80]  # elsewhere
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    noise = rng.integers(0, 12, (90, 128)).astype(np.uint8)
    unknown = rng.integers(0, 60, (60, 128)).astype(np.uint8)
    own = _keypoints(np.zeros((150, 3)), np.concatenate([descriptors[:90] + noise, unknown]))
    drawn = _keypoints(rays, descriptors)
    mine, theirs = matching.match_pictures(own, drawn)
    assert list(zip(mine, theirs, strict=True)) == _match_one_by_one(own, drawn)
    assert set(range(40)) | set(range(80, 90)) <= set(mine)
    assert not set(range(40, 80)) & set(mine)
    assert len(mine) < 100


def test_without_features_nothing_matches_and_a_lone_one_is_distinct():
    rng = np.random.default_rng(0)
    own = _keypoints(np.eye(3), rng.integers(0, 60, (3, 128)).astype(np.uint8))
    nothing = own.take(np.empty(0, np.int64))
    for a, b in ((own, nothing), (nothing, own), (nothing, nothing)):
        assert [len(found) for found in matching.match_pictures(a, b)] == [0, 0]
    mine, theirs = matching.match_pictures(own, own.take(np.array([1])))
    assert (mine.tolist(), theirs.tolist()) == ([0, 1, 2], [0, 0, 0])


@pytest.mark.parametrize(
    ("seed", "yaw", "most", "most_deg"), [(1, -3.0, 0.05, 1.0), (2, 2.0, 0.015, 0.25), (3, -3.0, 0.015, 0.25)]
)
def test_a_narrow_photo_of_unknown_gravity_is_found(seed, yaw, most, most_deg):
    """70 degrees of a room, with furniture and pictures in view."""
    photo, true_pose = _narrow(seed, yaw)
    found = rooms.locate(photo, rooms.scan_map(seed, NUM_POINTS), rooms.UNKNOWN)
    assert found.status == "localized"
    rooms.assert_near(found.pose, true_pose, most, most_deg)
