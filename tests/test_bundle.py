"""Photos with known relative poses, localized as one camera: each step by itself, and a room."""

import functools
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rooms
from made_up import PROBLEM, at, make_candidate
from poses import tilted_poses

from piccolo.geometry.pose import Pose, exp_so3, pose_errors, yaw_rotation
from piccolo.geometry.pose_gaussian import PoseGaussian, add
from piccolo.judge.belief import make_belief
from piccolo.judge.candidate import Selection
from piccolo.judge.reasons import Reason
from piccolo.judge.result import Result, nothing_found
from piccolo.judge.result_parts import Alternative
from piccolo.localization import judging
from piccolo.localization.judging import Found
from piccolo.photo.panorama import Panorama
from piccolo.poses import bundle_adjustment
from piccolo.poses.bundle_adjustment import UNKNOWN_SCALE, Bundle, RelativeErrors
from piccolo.system.jobs.threads import Stopwatch, Workers
from piccolo.together import bundle_search, members
from piccolo.together.bundle import (
    NOT_FOUND,
    UNSEEN,
    Posed,
    compare_errors,
    describe_scale,
    judge_member,
    localize_bundle,
    merge_places,
)
from piccolo.together.members import Shot

TIER = "scene"
pytestmark = pytest.mark.usefixtures("searched_once")

NEAR = np.array([2.0, -1.0, 0.5])
SEED = 5
ERRORS = RelativeErrors()
WHERE = (4, 1, 7)  # eighths of a turn; the first alone is not sure


def _support(odds, elsewhere=0.0, is_found=True):
    return bundle_search.Support(at(0.0, 0.5), None, is_found, odds, elsewhere, 100)


def _alone(*probabilities):
    """A photo with poses of its own."""
    poses = [at(float(k), 0.5) for k in range(len(probabilities))]
    likely = list(zip(poses, probabilities, strict=True))
    alternatives = tuple(Alternative(h.pose, h.score, None, p) for h, p in likely[1:])
    alone = Result(belief=make_belief(probabilities), best_pose=poses[0].pose, alternatives=alternatives)
    found = Found(None, Selection(poses[0], tuple(poses[1:])), None)
    return bundle_search.PosedMember(found, alone, tilted_poses(1, NEAR)[0])


MISSES = _support(0.0, is_found=False)
SURE = _support(999.0)
TEN = [_alone(0.1, 0.1, 0.1)] * 10  # 30 poses proposed, none of them likely


def test_one_sure_photo_is_enough_beside_misses():
    bundles = [[SURE, MISSES, MISSES], [_support(1e-3), MISSES, MISSES]]
    probabilities = bundle_search.weigh_bundles(bundles, TEN[:3])
    assert probabilities[0] > 0.98
    assert probabilities.sum() == pytest.approx(1.0)
    many = bundle_search.weigh_bundles(
        [[*bundles[0], *[MISSES] * 20]], TEN[:3]
    )  # bare walls: they count as one
    assert many[0] == pytest.approx(bundle_search.weigh_bundles(bundles[:1], TEN[:3])[0])


def test_weak_photos_that_coincide_beat_a_stronger_one():
    weak = [_support(0.43)] * 4
    strong = [_support(4.0), MISSES, MISSES, MISSES]
    together, alone, _ = bundle_search.weigh_bundles([weak, strong], TEN)
    assert together > 0.99
    assert alone < 0.01
    assert bundle_search.weigh_bundles([weak[:1]], TEN)[0] < 0.5


def test_two_poses_that_coincide_among_many_may_do_so_by_chance():
    pair = [_support(0.02), _support(0.02), MISSES]
    assert bundle_search.weigh_bundles([pair], TEN * 2)[0] < 0.5
    assert bundle_search.weigh_bundles([pair], [_alone(0.02)])[0] > 0.9


def test_where_nothing_is_found_none_is_likely():
    assert bundle_search.weigh_bundles([], []).tolist() == [1.0]
    assert bundle_search.weigh_bundles([[MISSES] * 3], TEN)[-1] > 0.9
    assert np.isfinite(bundle_search.weigh_bundles([[_support(1e6)] * 300, [MISSES] * 300], TEN)).all()


def test_sure_photos_elsewhere_speak_against_the_relative_poses():
    """Three photos that are sure alone, of which the bundle fits one."""
    out = _support(0.0, 30.0, is_found=False)
    members = [_alone(0.97)] * 3
    own = _support(30.0)
    assert bundle_search.weigh_bundles([[own, out, out]], members)[-1] > 0.9
    assert bundle_search.weigh_bundles([[own, own, out]], members)[0] > 0.9


def test_photos_that_show_the_same_count_as_one():
    """Four of a burst of one wall, a quarter of the weight each, are one witness; so are those against."""
    burst = [_support(9.0)._replace(weight=0.25)] * 4
    one = bundle_search.weigh_bundles([[_support(9.0)]], TEN[:1])
    assert bundle_search.weigh_bundles([burst], TEN[:1] * 4)[0] == pytest.approx(one[0], abs=0.02)
    assert bundle_search.weigh_bundles([[_support(9.0)] * 4], TEN[:4])[0] > 0.999
    elsewhere = [_support(30.0)._replace(weight=0.25).miss()] * 4
    sure = [_alone(0.97)] * 4
    assert bundle_search.weigh_bundles([elsewhere], sure)[-1] > 0.5


def test_a_photo_that_a_place_does_not_show_is_at_another():
    missed = _support(30.0, 2.0).miss()
    assert (missed.odds, missed.odds_elsewhere, missed.is_found) == (0.0, 32.0, False)
    assert missed.shares.argmax() == 3
    weak = _support(30.0)._replace(belongs=0.7)
    assert 0.9 < weak.shares[:2].sum() < _support(30.0).shares[:2].sum()


@pytest.mark.parametrize("std", [0.005, 0.06, 0.3])
def test_a_certain_place_counts_whole_however_inexact_the_pose_is(std):
    """How exact it is counts once, in the end."""
    problem = replace(PROBLEM, scan_map=SimpleNamespace(sparse=range(100)))
    best = make_candidate(0.0, 0.6, 80)
    other = make_candidate(3.0, 0.02)
    belief = make_belief([0.99, 0.001], within=0.5)
    gaussian = PoseGaussian(best.pose, np.diag([1e-6] * 3 + [std**2] * 3), np.zeros((6, 6)))
    alone = Result(
        belief=belief,
        best_pose=best.pose,
        alternatives=(Alternative(other.pose, other.score),),
        gaussian=gaussian,
        std_of_fit=0.00125,
    )
    found = Found(problem, Selection(best, (other,)), None)
    member = bundle_search.PosedMember(found, alone, Pose(np.eye(3), np.zeros(3)))
    (support,) = bundle_search.find_supports(member, problem, [best.pose], Workers())
    assert support.own.pose is best.pose
    assert support.odds > 5e4
    assert [p for _, p in member.own_poses] == [0.99, 0.001]
    first, second = bundle_search.find_supports(member, problem, [best.pose, other.pose], Workers())
    assert (first.odds, first.own) == (support.odds, support.own)
    assert first.odds_elsewhere == pytest.approx(second.odds), "all places are weighed at once"
    assert second.odds_elsewhere == pytest.approx(first.odds)


@pytest.mark.parametrize(("conflict", "is_measured"), [(5.0, True), (5.0, False), (3.0, True), (None, True)])
def test_what_a_photo_rules_out_stays_so_unless_others_know_its_focal_length(conflict, is_measured):
    given = SimpleNamespace(focal_prior=SimpleNamespace(is_measured=is_measured))
    fit = conflict and SimpleNamespace(conflict=conflict)
    alone = Result(belief=make_belief([0.9]).rule_out(Reason.MIRRORED), warnings=("mirrored",))
    member = _alone(0.9)
    found = member.found._replace(problem=replace(PROBLEM, given=given), fit=fit)
    member = replace(member, found=found, alone=alone)
    assert member.own_poses == []
    assert member.is_misplaced == (conflict == 5.0 and is_measured)
    if not member.is_misplaced:
        agreed = SimpleNamespace(warnings=("scale",))
        result = judge_member(member, 0, SURE, 0.9, agreed, [], np.array([1.0, 0.0]), rooms.means())
        assert result == replace(alone, warnings=("mirrored", "scale"))


def test_a_photo_belongs_to_the_others_or_does_not():
    assert _support(30.0).shares.argmax() == 0
    assert _support(30.0).shares[0] > 0.95
    assert 0.7 < _support(0.1).shares[0] < 0.9, "it shows the place, but its own pose may be a little off"
    assert _support(0.1).shares[:2].sum() > 0.95
    assert MISSES.shares.argmax() == 1, "shows nothing"
    assert MISSES.shares[1] < 0.9, "so it may be of another place"
    assert _support(0.0, 30.0, is_found=False).shares.argmax() == 3, "it is surely elsewhere"
    weak = _support(0.01)
    assert weak._replace(odds_exchanged=0.01).shares.argmax() == 0, "no likelier at another photo's place"
    assert weak._replace(odds_exchanged=3.0).shares.argmax() == 3, "they may have been exchanged"


def test_an_own_pose_far_from_the_one_expected_is_doubted():
    pose = tilted_poses(1, NEAR)[0]
    expected = PoseGaussian(pose, np.diag([0.01**2] * 3 + [0.03**2] * 3), np.zeros((6, 6)))
    ratios = []
    for off in (0.0, 0.05, 0.12, 0.2):
        own = add(pose, np.array([0.0, 0.0, 0.0, off, 0.0, 0.0]))
        ratios.append(compare_errors(expected, PoseGaussian(own, 1e-6 * np.eye(6), np.zeros((6, 6)))))
    assert ratios == sorted(ratios, reverse=True)
    assert ratios[0] > 10.0
    assert ratios[-1] < 1e-3


def _members(far):
    """Two photos whose common frame begins `far` [m] from them."""
    cams = [Pose(pose.R_cam_from_world, pose.center_world + far) for pose in tilted_poses(2, NEAR)]
    return [bundle_search.PosedMember(Found(None, None, None), nothing_found(), cam) for cam in cams]


@pytest.mark.parametrize("far", [0.0, 1e3])
def test_bundles_are_the_same_where_the_photos_are(far):
    """A turn about a far origin, however small, moves the photos; with the right move it does not."""
    members = _members(far)
    bundle = Bundle(members[0].cam_from_bundle.inverse() @ tilted_poses(1, NEAR)[0])
    own = bundle.place(members[0].cam_from_bundle)
    turned = Pose(exp_so3(np.array([0.0, 0.0, 0.02])) @ own.R_cam_from_world, own.center_world)
    about_photo = Bundle(members[0].cam_from_bundle.inverse() @ turned)
    assert bundle_search.is_same_bundle(members, bundle, bundle)
    assert bundle_search.is_same_bundle(members, bundle, about_photo)
    about_origin = Bundle(add(bundle.pose, np.array([0.0, 0.0, 0.02, 0.0, 0.0, 0.0])))
    assert bundle_search.is_same_bundle(members, bundle, about_origin) == (far == 0.0)
    moved = Bundle(add(bundle.pose, np.array([0.0, 0.0, 0.0, 0.6, 0.0, 0.0])))
    assert not bundle_search.is_same_bundle(members, bundle, moved)


def test_the_common_frame_is_moved_near():
    cams = [member.cam_from_bundle for member in _members(1e6)]
    moved = bundle_adjustment.move_origin_near(cams)
    assert np.linalg.norm(np.mean([pose.center_world for pose in moved], axis=0)) < 1e-9
    there = moved[1].center_world - moved[0].center_world
    np.testing.assert_allclose(there, cams[1].center_world - cams[0].center_world, atol=1e-9)
    assert all((a.R_cam_from_world == b.R_cam_from_world).all() for a, b in zip(cams, moved, strict=True))


@pytest.mark.parametrize("free", [False, True])
def test_two_photos_propose_the_scale(free):
    """Of positions in metres only one that is not absurd."""
    one, other = _members(0.0)
    here = tilted_poses(3, NEAR)[-1]
    errors = RelativeErrors(log_scale=UNKNOWN_SCALE if free else 0.01)
    for scale, is_tried in ((1.3, True), (5.0, free)):
        true = Bundle(here, math.log(scale))
        pair = [true.place(m.cam_from_bundle) for m in (one, other)]
        found = bundle_search.propose_with_scale(one, pair[0], other, pair[1], errors)
        assert len(found) == is_tried
        for bundle in found:
            assert bundle.log_scale == pytest.approx(math.log(scale))
            assert pose_errors(bundle.pose, here)[0] < 1e-9
    turned = Pose(yaw_rotation(0.3) @ pair[1].R_cam_from_world, pair[1].center_world)
    assert bundle_search.propose_with_scale(one, pair[0], other, turned, errors) == []


@functools.lru_cache
def _taken(seed, eighths=WHERE):
    """Photos of 60 degrees that were taken near each other."""
    return rooms.take_photos(seed, 60.0, {k: np.random.default_rng(k).uniform(-0.3, 0.3, 3) for k in eighths})


def _relative(poses, far=0.0):
    """Poses in a common frame, off by 1 cm and 0.3 degrees."""
    rng = np.random.default_rng(0)
    std = np.repeat([math.radians(0.3), 0.01], 3) / math.sqrt(3.0)
    common_from_world = Pose(exp_so3(np.array([1.0, -2.0, 0.5])), np.array([3.0, -1.0, 2.0]))
    noisy = [add(pose, std * rng.normal(size=6)) @ common_from_world.inverse() for pose in poses]
    return [Pose(pose.R_cam_from_world, pose.center_world + far) for pose in noisy]


def _together(photos, poses, num_threads=2):
    """Results in room SEED of photos with relative poses."""
    posed = [Posed(photo, pose, rooms.KNOWN) for photo, pose in zip(photos, poses, strict=True)]
    return localize_bundle(rooms.scan_map(SEED), posed, Workers(num_threads), Stopwatch(), ERRORS)


@functools.lru_cache
def _localized(seed, num_threads=2, far=0.0, eighths=WHERE):
    """Results in room SEED of photos of a room."""
    photos, poses = zip(*_taken(seed, eighths), strict=True)
    return _together(photos, _relative(poses, far), num_threads)


def _bits(found):
    return [(f.status, f.confidence, f.pose.key, f.covariance.matrix.tobytes()) for f in found]


def test_photos_are_localized_together_of_which_one_is_not_alone():
    (narrow,) = rooms.take_photos(SEED, 35.0, {2: np.random.default_rng(2).uniform(-0.3, 0.3, 3)})
    photos, poses = zip(narrow, *_taken(SEED, (1, 7)), strict=True)
    shot = Shot(photos[0], rooms.KNOWN)
    alone = members.find_alone(rooms.scan_map(SEED), shot, rooms.WORKERS, Stopwatch()).alone
    assert alone.status == "not_localized"
    assert pose_errors(alone.best_pose, poses[0])[0] > 1.0
    found = _together(photos, _relative(poses))
    assert [f.status for f in found] == ["localized"] * 3
    for f, pose in zip(found, poses, strict=True):
        distance, angle = pose_errors(f.pose, pose)
        assert distance < 0.05
        assert math.degrees(angle) < 1.5
        assert distance < 4.0 * f.covariance.largest_std
        probabilities = [f.confidence, f.probability_none, *(a.probability for a in f.alternatives)]
        assert sum(probabilities) == pytest.approx(1.0)


def test_what_is_known_of_the_mirrored_photos_is_not_searched_again(monkeypatch):
    photos, poses = zip(*_taken(SEED, WHERE[1:]), strict=True)
    for photo in photos:
        found = members.find_alone(rooms.scan_map(SEED), Shot(photo, rooms.KNOWN), rooms.WORKERS, Stopwatch())
        assert found.alone.mirrored is not None
    monkeypatch.setattr(judging, "find_mirrored", lambda *_: pytest.fail("searched again"))
    assert [one.status for one in _together(photos, _relative(poses))] == ["localized"] * 2


def test_photos_of_another_room_are_not_localized():
    for found in _localized(6, eighths=WHERE[:2]):
        assert found.status == "not_localized"
        assert found.confidence < 0.5


def test_bundles_are_the_same_bits_at_any_number_of_threads():
    one, two = (_localized(SEED, num_threads, 0.0, WHERE[1:]) for num_threads in (1, 2))
    assert _bits(one) == _bits(two)


def test_it_does_not_matter_where_the_common_frame_begins():
    both = (_localized(SEED, 2, far, WHERE[1:]) for far in (0.0, 1e6))
    for near, far in zip(*both, strict=True):
        assert pose_errors(near.pose, far.pose)[0] < 1e-5
        assert near.confidence == pytest.approx(far.confidence, abs=1e-4)


def test_photos_that_fit_nowhere_have_no_pose():
    """A single photo, of a bare wall: its own guess is far away."""
    (found,) = _localized(SEED, eighths=WHERE[:1])
    assert (found.status, found.confidence, found.pose) == ("not_localized", 0.0, None)
    assert found.warnings == (NOT_FOUND,)


def test_a_stranger_is_named_and_lowers_nobody():
    photos, poses = zip(*_taken(SEED, (*WHERE[1:], WHERE[0])), strict=True)
    ((stranger, _),) = _taken(6, WHERE[:1])
    *right, other = _together([*photos[:2], stranger], _relative(poses))
    pair = _localized(SEED, 2, 0.0, WHERE[1:])
    assert other.status == "not_localized"
    assert other.warnings == (UNSEEN,)
    for with_stranger, without in zip(right, pair, strict=True):
        assert with_stranger.status == without.status
        assert with_stranger.confidence > without.confidence - 0.02
        assert not with_stranger.warnings


def test_positions_that_are_too_long_are_named():
    """Positions of spheres 1 m apart by 20 %: each is as by itself."""
    apart = {2: [0.0, 0.0, 0.0], 4: [0.8, 0.5, 0.1], 6: [0.8, -0.3, 0.0]}
    photos, poses = zip(*rooms.take_photos(SEED, 60.0, apart), strict=True)
    spheres = [rooms.as_panorama(photo.rgb) for photo in photos]
    wrong = [Pose(p.R_cam_from_world, 1.2 * p.center_world) for p in _relative(poses)]
    for found, pose in zip(_together(spheres, wrong), poses, strict=True):
        assert found.status == "localized"
        assert pose_errors(found.pose, pose)[0] < 0.05
        assert any("too long" in warning for warning in found.warnings)


def test_how_much_distances_are_wrong_is_said_in_per_cent():
    assert describe_scale(-math.log(1.2)) == "20 % too long"
    assert describe_scale(-math.log(0.9)) == "10 % too short"


def test_a_photo_that_shows_nothing_is_not_localized():
    """The others are."""
    photos, poses = zip(*_taken(SEED), strict=True)
    nothing = Panorama(photos[0].rgb, np.zeros_like(photos[0].is_valid))
    found = _together([nothing, *photos[1:]], _relative(poses))
    assert [f.status for f in found] == ["not_localized", "localized", "localized"]
    assert found[0].pose is None


def test_places_that_are_one_for_a_photo_are_one_alternative():
    """Of bundles whose other photos differ."""
    near = Pose(np.eye(3), np.array([0.05, 0.0, 0.0]))
    far = Pose(np.eye(3), np.array([3.0, 0.0, 0.0]))
    places, probabilities = merge_places(
        Pose(np.eye(3), np.zeros(3)), [far, near, far], np.array([4, 3, 2, 1, 6])
    )
    assert places == [far]
    assert probabilities.tolist() == [6.0, 4.0, 6.0]
