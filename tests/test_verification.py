"""Poses verified by drawing the scan: the right one has many matches, and a twin matches the features."""

import functools
import math
from dataclasses import replace

import cv2
import narrow_photo
import numpy as np
import pytest
import rooms
from made_up import drawn_at, exact_matches, make_candidate, make_selection
from rooms import WORKERS

from piccolo.cloud.stream import CloudPoints
from piccolo.cloud.voxels import morton_order
from piccolo.evidence import verification
from piccolo.evidence.covariance import estimate_covariance, estimate_pose_errors
from piccolo.evidence.examine import complete, count_agreeing, examine
from piccolo.evidence.measuring import measure
from piccolo.geometry.nearness import ROOM_RANGE
from piccolo.geometry.pose import MAX_DISTANCE, Pose, exp_so3, log_so3, step, yaw_rotation
from piccolo.geometry.pose_gaussian import LIKELY, subtract
from piccolo.geometry.sphere import compute_indices
from piccolo.local_features import matching
from piccolo.local_features.hypotheses import count_inliers
from piccolo.local_features.matching import NO_MATCHES
from piccolo.localization.copies import list_copies
from piccolo.localization.judging import Found, judge
from piccolo.optimize.sampling_loss import sampling_loss
from piccolo.photo.panorama import Panorama
from piccolo.photo.photo import Prior
from piccolo.problem.method import METHOD
from piccolo.problem.settings import CoarseToFineSettings
from piccolo.scan_map.scan_map import prepare_map
from piccolo.system.jobs.threads import Workers
from piccolo.together import bundle_search
from piccolo.together.bundle_search import find_supports
from piccolo.together.members import Member
from piccolo.views.zbuffer import visible_points
from research.synthetic.world import scan_world

TIER = "scene"

APART = np.float32([6.0, 0.0, 0.0])  # [m] of a room and its twin
SMALL = np.array([0.01, -0.02, 0.015, 0.05, -0.04, 0.03])  # [rad], [m]


def _draw(pose, workers=WORKERS):
    """The matches with the scan drawn near a pose."""
    return verification.draw_near(narrow_photo.problem(), pose, None, workers).matches


def _verify(pose, workers=WORKERS):
    return verification.verify(narrow_photo.problem(), pose, _draw(pose, workers))


def _count(problem, pose):
    return count_agreeing(problem, examine(problem, pose), WORKERS).num_matches


def _moved(offset, yaw=0.0):
    """The true pose, turned and moved [m]."""
    R = yaw_rotation(yaw) @ narrow_photo.true_pose().R_cam_from_world
    return Pose(R, narrow_photo.true_pose().center_world + np.array(offset))


def test_a_photo_is_matched_with_one_beside_it_on_the_scan():
    matches = verification.match_beside(narrow_photo.problem(), narrow_photo.beside(), WORKERS)
    agreeing = count_inliers(matches, narrow_photo.true_pose(), METHOD.cos_agree)
    assert agreeing >= 20
    assert (np.diff(matches.query) >= 0).all()
    assert count_inliers(matches, _moved((0.5, -0.4, 0.0)), METHOD.cos_agree) < 0.3 * agreeing
    cloud = np.asarray(rooms.room(1, narrow_photo.NUM_POINTS)[1].points)
    nearest = [np.linalg.norm(cloud - point, axis=1).min() for point in matches.points]
    assert np.median(nearest) < 0.05


def test_what_moves_with_the_camera_is_no_match():
    """A photo matched with itself: of what is left, nothing is where the pose puts it."""
    own = verification.place_keypoints(narrow_photo.problem(), narrow_photo.true_pose(), WORKERS)
    matches = verification.match_beside(narrow_photo.problem(), own, WORKERS)
    assert len(matches.query) < 0.2 * len(narrow_photo.problem().photo.features(WORKERS).keypoints.rays)
    assert count_inliers(matches, narrow_photo.true_pose(), METHOD.cos_agree) == 0


def test_a_mirrored_photo_has_no_matches_beside():
    """It has some without that rule, as many things are symmetric."""
    taken = Panorama(
        narrow_photo.take()[0].rgb[:, ::-1].copy(), narrow_photo.take()[0].is_valid[:, ::-1].copy()
    )
    mirrored = rooms.ask(taken, rooms.scan_map(1, narrow_photo.NUM_POINTS), rooms.UNKNOWN)
    own = mirrored.photo.features(WORKERS).keypoints
    assert len(matching.match_pictures(own, narrow_photo.beside().keypoints)[0]) > 0
    assert verification.match_beside(mirrored, narrow_photo.beside(), WORKERS) is NO_MATCHES


def test_the_picture_with_the_most_matches_counts():
    with_other = verification.match_beside(narrow_photo.problem(), narrow_photo.beside(), WORKERS)
    problem = replace(narrow_photo.problem(), beside=(with_other, NO_MATCHES))
    found = verification.verify(problem, narrow_photo.true_pose(), _draw(narrow_photo.true_pose()))
    assert rooms.errors(found.pose, narrow_photo.true_pose())[0] < 0.03
    turned = _moved((0.0, 0.0, 0.0), 2.0)
    assert verification.verify(problem, turned, _draw(turned)).num_matches <= 6
    beside = verification.verify(problem, narrow_photo.true_pose(), NO_MATCHES)
    assert beside.num_matches >= 20
    assert rooms.errors(beside.pose, narrow_photo.true_pose())[0] < 0.1


@functools.lru_cache
def _beside_its_twin():
    """The problem in a scan of the room and its twin, scanned again, APART from it."""
    world, cloud = rooms.room(1, narrow_photo.NUM_POINTS)
    points, colors, _ = scan_world(world._replace(seed=99), narrow_photo.NUM_POINTS, Workers(2))
    twin = (points - cloud.origin_world).astype(np.float32) + APART
    both = CloudPoints(np.vstack([cloud.points, twin]), np.vstack([cloud.colors, colors]), cloud.origin_world)
    order = morton_order(both.points, both.colors)
    both = CloudPoints(both.points[order], both.colors[order], both.origin_world)
    return rooms.ask(narrow_photo.take()[0], prepare_map(rooms.stream(both), Workers(2)), rooms.UNKNOWN)


def test_copies_of_a_place_are_where_the_drawn_scan_looks_the_same(monkeypatch):
    """Not elsewhere in the twin, nor near in the room; what is drawn already is not drawn again."""
    problem = _beside_its_twin()
    here = problem.scan_map.from_world(narrow_photo.take()[1])
    moves = [(6.05, 0.0, 0.02), (6.9, -0.8, 0.0), (0.9, -0.8, 0.0)]
    others = [Pose(here.R_cam_from_world, here.center_world + move) for move in moves]
    away = Pose(yaw_rotation(2.0) @ here.R_cam_from_world, here.center_world + APART)
    one, *rivals = (replace(make_candidate(0.0, 0.5), pose=pose) for pose in (here, *others, away))
    found = verification.find_copies(problem, one, rivals, WORKERS)
    assert found == [True, False, False, False]
    assert verification.find_copies(problem, one, [], WORKERS) == []
    drawn = [
        replace(each, drawn=verification.draw_near(problem, each.pose, None, WORKERS))
        for each in (one, *rivals)
    ]
    monkeypatch.setattr(verification, "find_all_drawn", None)
    assert verification.find_copies(problem, drawn[0], drawn[1:], WORKERS) == found


def test_copies_are_looked_for_among_poses_that_could_win():
    problem = _beside_its_twin()
    here = problem.scan_map.from_world(narrow_photo.take()[1])
    twin = Pose(here.R_cam_from_world, here.center_world + APART)
    known = [(here, 0.5, 20), (twin, 0.4, 18), (twin, 0.2, 18)]
    found = make_selection(*(replace(make_candidate(0, *told), pose=pose) for pose, *told in known))
    assert list_copies(problem, found.candidates, 0, WORKERS) == [True, True, False]
    assert list_copies(problem, found.candidates, 1, WORKERS) == [True, True, False]
    workers, asked = rooms.listen()
    assert list_copies(problem.by_views(), found.candidates, 0, workers) == [False, False, False]
    assert asked == []


def test_copies_of_a_place_that_others_propose_have_the_same_matches(monkeypatch):
    """How many agree with each tells how well it was scanned, not which of them it is."""
    problem = _beside_its_twin()
    here = problem.scan_map.from_world(narrow_photo.take()[1])
    twin = Pose(here.R_cam_from_world, here.center_world + APART)
    own = examine(problem, here)
    found = make_selection(replace(own, num_matches=40), replace(examine(problem, twin), num_matches=9))
    alone = judge(Found(problem, found, None), rooms.means(), CoarseToFineSettings().demand)
    member = Member(Found(problem, found, None), alone)
    one, other = find_supports(member, problem, [here, twin], WORKERS)
    assert one.odds > 1.0
    assert 0.5 < one.odds / other.odds < 2.0
    monkeypatch.setattr(bundle_search, "list_copies", lambda problem, ranked, *_: [False] * len(ranked))
    one, other = find_supports(member, problem, [here, twin], WORKERS)
    assert one.odds > 5.0 * other.odds


@pytest.mark.parametrize("is_copy", [True, False])
def test_a_copy_of_its_place_that_is_likelier_becomes_the_best(is_copy):
    """The likelier pose is the true one; the best is a little beside its twin, or turned away."""
    problem = _beside_its_twin()
    here = problem.scan_map.from_world(narrow_photo.take()[1])
    R = here.R_cam_from_world if is_copy else yaw_rotation(2.0) @ here.R_cam_from_world
    off = Pose(R, here.center_world + APART + np.array([0.15, 0.1, 0.0]))
    found = make_selection(examine(problem, off), examine(problem, here))
    means = rooms.means()
    judged = judge(Found(problem, found, None), means, CoarseToFineSettings().demand)
    best = problem.scan_map.from_world(judged.best_pose)
    assert best.distance(here if is_copy else off) < 0.1
    assert len(judged.alternatives) == 1
    assert len(means.trace.steps[-1]["candidates"]) == 2


def test_keypoints_on_what_the_scan_does_not_show_are_left_out():
    rng = np.random.default_rng(0)
    panorama = narrow_photo.problem().photo.panorama
    hidden = np.zeros(panorama.is_valid.shape, bool)
    hidden[230:300, 310:390] = True
    assert panorama.is_valid[hidden].all()
    rgb = panorama.rgb.copy()
    poster = cv2.resize(rng.integers(0, 255, (14, 16, 3), np.uint8), (80, 70), interpolation=cv2.INTER_CUBIC)
    rgb[230:300, 310:390] = poster
    given = Panorama(rgb, panorama.is_valid)
    occluded = rooms.ask(given, rooms.scan_map(1, narrow_photo.NUM_POINTS), rooms.UNKNOWN)
    for asked, least, most in ((narrow_photo.problem(), 0.5, 1.0), (occluded, 0.0, 0.1)):
        seen = asked.photo.features(WORKERS).keypoints.rays
        kept = verification.place_keypoints(asked, narrow_photo.true_pose(), WORKERS).keypoints.rays
        num_seen, num_kept = (
            hidden[compute_indices(rays, narrow_photo.WIDTH)].sum() for rays in (seen, kept)
        )
        assert num_seen > 10
        assert least * num_seen <= num_kept <= most * num_seen


def test_the_true_pose_has_many_matches_and_wrong_ones_have_few():
    right = _verify(narrow_photo.true_pose())
    assert right.num_matches >= 20
    assert _count(narrow_photo.problem(), narrow_photo.true_pose()) == right.num_matches
    for wrong in (_moved((0.0, 0.0, 0.0), 2.0), _moved((1.0, -0.8, 0.0))):
        assert _verify(wrong).num_matches <= 6
        assert _count(narrow_photo.problem(), wrong) <= 6


def test_a_pose_is_refined_towards_the_truth():
    off = step(narrow_photo.true_pose(), SMALL)
    before = rooms.errors(off, narrow_photo.true_pose())
    found = _verify(off)
    after = rooms.errors(found.pose, narrow_photo.true_pose())
    assert after[0] < min(0.02, 0.4 * before[0])
    assert after[1] < 0.4 * before[1]
    assert found.num_matches >= 20


def test_matches_give_a_pose_whose_error_they_cover():
    squares = []
    for offset in (SMALL, -SMALL, 0.0 * SMALL):
        start = step(narrow_photo.true_pose(), offset)
        pose, covariance = verification.place_by_matches(METHOD, start, _draw(start))
        off = subtract(narrow_photo.true_pose(), pose)
        squares.append(off @ np.linalg.solve(covariance, off))
        assert rooms.errors(pose, narrow_photo.true_pose())[0] < 0.03
    assert max(squares) < LIKELY
    away = _moved((1.0, -0.8, 0.0))
    assert verification.place_by_matches(METHOD, away, _draw(away)) is None


def test_a_pose_is_averaged_with_that_by_its_matches_unless_that_contradicts_the_prior():
    pose = step(narrow_photo.true_pose(), 0.5 * SMALL)
    candidate = examine(narrow_photo.problem(), pose)
    alone = estimate_covariance(narrow_photo.problem(), candidate, WORKERS)
    found = estimate_pose_errors(narrow_photo.problem(), candidate, WORKERS)
    assert (
        rooms.errors(found.gaussian.pose, narrow_photo.true_pose())[0]
        < rooms.errors(pose, narrow_photo.true_pose())[0]
    )
    assert found.std_of_fit == found.gaussian.largest_std / ROOM_RANGE < alone.std_of_fit
    moved = found.gaussian.pose.center_world - pose.center_world
    length = float(np.linalg.norm(moved))
    before = Pose(np.eye(3), pose.center_world - moved / length)  # a metre behind
    near = tuple(narrow_photo.problem().scan_map.to_world(before).center_world)
    prior = Prior(near=near, radius=1.0 + 0.5 * length - MAX_DISTANCE)
    told = estimate_pose_errors(replace(narrow_photo.problem(), prior=prior), candidate, WORKERS)
    assert told.gaussian.pose.key == pose.key


def test_the_loss_is_that_of_the_averaged_pose():
    problem = narrow_photo.problem()
    pose = step(narrow_photo.true_pose(), 0.5 * SMALL)
    candidate = examine(problem, pose)
    measured = measure(problem, make_selection(candidate), None, WORKERS)
    assert (
        measured.pose.key == estimate_pose_errors(problem, candidate, WORKERS).gaussian.pose.key != pose.key
    )
    points = visible_points(problem.surroundings_at(pose)[0], measured.pose.center_world)
    assert measured.loss == sampling_loss(points, problem.colors(), measured.pose)
    assert measured.loss < sampling_loss(points, problem.colors(), pose)


def test_verification_is_the_same_bits_at_any_number_of_threads():
    poses = [narrow_photo.true_pose(), step(narrow_photo.true_pose(), SMALL), _moved((1.0, -0.8, 0.0))]
    for pose in poses:
        a, b = (_verify(pose, Workers(num_threads)) for num_threads in (1, 2))
        assert a.num_matches == b.num_matches
        assert a.pose.key == b.pose.key


def test_the_scan_is_drawn_once_for_each_pose_of_the_grid():
    """At the grid's pose, wherever in its cell the pose lies."""
    middle = Pose(
        exp_so3(verification.TURN * np.array([3.0, -2.0, 8.0])),
        verification.PLACE * np.array([7.0, -4.0, 2.0]),
    )
    known = drawn_at(middle, NO_MATCHES)
    for share in (0.0, 0.4, -0.4):
        turn = log_so3(middle.R_cam_from_world) + share * verification.TURN
        near = Pose(exp_so3(turn), middle.center_world + share * verification.PLACE)
        on_grid = verification.round_pose(near)[1]
        np.testing.assert_allclose(on_grid.center_world, middle.center_world, atol=1e-12)
        np.testing.assert_allclose(on_grid.R_cam_from_world, middle.R_cam_from_world, atol=1e-9)
        assert verification.draw_near(narrow_photo.problem(), near, known, WORKERS) is known
    beside = Pose(middle.R_cam_from_world, middle.center_world + 0.6 * verification.PLACE)
    turned = exp_so3(log_so3(middle.R_cam_from_world) + np.array([0.0, 0.6 * verification.TURN, 0.0]))
    for other in (beside, Pose(turned, middle.center_world)):
        drawn = verification.draw_near(narrow_photo.problem(), other, known, WORKERS)
        key, on_grid = verification.round_pose(other)
        assert drawn.key == key != known.key
        picture = verification.find_all_drawn(narrow_photo.problem(), on_grid, WORKERS)
        expected = verification.match_located(
            narrow_photo.problem().photo.features(WORKERS).keypoints, picture
        )
        np.testing.assert_array_equal(drawn.matches.points, expected.points)


def test_for_a_photo_without_features_nothing_is_drawn(monkeypatch):
    panorama = narrow_photo.take()[0]
    blank = replace(panorama, rgb=np.full_like(panorama.rgb, 128))
    monkeypatch.setattr(verification, "find_all_drawn", None)
    problem = narrow_photo.problem().retake(blank)
    drawn = verification.draw_near(problem, narrow_photo.true_pose(), None, WORKERS)
    assert len(drawn.matches.points) == len(drawn.picture.ranges) == 0


def test_matches_lie_on_the_scan_where_the_photo_sees_them():
    """At the true pose many rays lead to their points, and sizes and tangents are those of the photo."""
    true = narrow_photo.true_pose()
    matches = _draw(true)
    offsets = matches.points - true.center_world
    distances = np.linalg.norm(offsets, axis=1)
    rays = offsets @ true.R_cam_from_world.T / distances[:, None]
    fits = (rays * matches.rays).sum(axis=1) > METHOD.cos_agree
    assert fits.sum() >= 20
    np.testing.assert_allclose(np.linalg.norm(matches.directions, axis=1), 1.0, atol=1e-5)
    turned = matches.tangents @ true.R_cam_from_world.T
    assert np.median((turned * matches.ray_tangents).sum(axis=1)[fits]) > 0.97
    assert 0.8 < np.median((matches.sizes / distances / matches.angles)[fits]) < 1.25
    cloud = np.asarray(rooms.room(1, narrow_photo.NUM_POINTS)[1].points)
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
def test_matches_with_which_a_pose_moves_away_are_anothers(offset, yaw_deg, expected):
    """By 0.3 m or 5 degrees."""
    moved = _moved(offset, math.radians(yaw_deg))
    drawn = drawn_at(narrow_photo.true_pose(), exact_matches(moved, 30))
    candidate = replace(examine(narrow_photo.problem(), narrow_photo.true_pose()), drawn=drawn)
    assert count_agreeing(narrow_photo.problem(), candidate, WORKERS).num_matches == expected


@pytest.mark.parametrize("offset", [(0.0, -0.4, 0.0), (0.4, 0.4, 0.1), (-0.4, 0.2, 0.0)])
def test_half_a_metre_off_the_matches_are_those_of_the_true_pose(offset):
    off = _moved(offset, math.radians(8.0))
    found = _verify(off)
    assert found.num_matches >= 12
    assert rooms.errors(found.pose, narrow_photo.true_pose())[0] < 0.1
    assert _count(narrow_photo.problem(), off) == 0


def test_the_scan_is_drawn_for_whole_photos_too_but_not_for_whole_views_alone():
    whole = rooms.ask(rooms.scene(1)[1], rooms.scan_map(1, narrow_photo.NUM_POINTS), rooms.UNKNOWN)
    assert len(whole.photo.features(WORKERS).views) == 4
    assert _count(whole, narrow_photo.true_pose()) > 20
    assert _count(whole, _moved((1.0, 0.5, 0.0))) < 6
    found = make_selection(examine(whole, narrow_photo.true_pose()))
    workers, asked = rooms.listen()
    assert complete(whole.by_views(), found, workers) is found
    assert asked == []
    complete(whole, found, workers)
    assert "draw" in [label for label, _ in asked]


@pytest.mark.parametrize(
    ("seed", "yaw", "most", "most_deg"), [(1, -3.0, 0.05, 1.0), (2, 2.0, 0.015, 0.25), (3, -3.0, 0.015, 0.25)]
)
def test_a_narrow_photo_of_unknown_gravity_is_found(seed, yaw, most, most_deg):
    """70 degrees of a room, with furniture and pictures in view."""
    photo, true_pose = narrow_photo.take(seed, yaw)
    found = rooms.locate(photo, rooms.scan_map(seed, narrow_photo.NUM_POINTS), rooms.UNKNOWN)
    assert found.status == "localized"
    rooms.assert_near(found.pose, true_pose, most, most_deg)


@pytest.mark.parametrize(("by_chance", "is_counted"), [(6, True), (10_000, False)])
def test_matches_with_a_pose_count_though_the_best_pose_is_farther_away(by_chance, is_counted, monkeypatch):
    """It may be where surfaces are far; then those that agree with the pose itself, if not by chance."""
    pose = narrow_photo.true_pose()
    away = Pose(pose.R_cam_from_world, pose.center_world + np.array([0.4, 0.0, 0.0]))
    monkeypatch.setattr("piccolo.evidence.examine.verify", lambda *_: verification.Verified(away, 50))
    profile = replace(narrow_photo.problem().profile, method=replace(METHOD, chance_matches=by_chance))
    at_pose = count_inliers(_draw(pose), pose, METHOD.cos_agree)
    assert METHOD.sure_matches < at_pose != 50
    assert _count(replace(narrow_photo.problem(), profile=profile), pose) == (at_pose if is_counted else 0)
