"""Photos of a group that are not sure, searched where the others were taken."""

import math
from dataclasses import replace

import numpy as np
import pytest
import rooms
from groups import SEED, one_taken, true_places
from made_up import PROBLEM

from piccolo.geometry.pose import Pose, pose_errors, yaw_rotation
from piccolo.geometry.pose_gaussian import PoseGaussian
from piccolo.judge.belief import make_belief
from piccolo.judge.by_others import (
    IS_AT_SPOT,
    IS_NEARBY,
    MISSED,
    MISSED_TURNED,
    NearbyErrors,
    NearbyShares,
    Prospect,
    believe_exact,
    believe_nearby,
    local_share,
    log_odds_nearby,
    share_nearby,
    weigh_stray,
)
from piccolo.judge.candidate import NO_CANDIDATE, NO_CHOICE, Selection
from piccolo.judge.probability import SYMMETRIC, Mirrored, Standing
from piccolo.judge.reasons import Reason
from piccolo.judge.result import Result, nothing_found
from piccolo.judge.result_parts import Alternative
from piccolo.localization import judging
from piccolo.localization.judging import Found
from piccolo.localization.means import Means
from piccolo.problem.profile import PROFILES, WHOLE_BEAM
from piccolo.scan_map.camera_positions import COARSE_SPACING
from piccolo.system.jobs.threads import Stopwatch
from piccolo.together import nearby
from piccolo.together.members import Shot
from piccolo.together.nearby import (
    REACH,
    TAKEN_ELSEWHERE,
    Witness,
    compute_odds_elsewhere,
    doubt_stray,
    find_trust,
    keep_near,
    localize_nearby,
    narrow_around,
    recall_mirrored,
    search_nearby,
)

TIER = "scene"

TRUST = 0.999  # in the places of others


def test_a_place_is_as_much_likelier_as_less_of_the_scan_is_within_reach():
    near = make_belief([0.6, 0.1], within=0.95)
    found = believe_nearby(near, Prospect(0.0, 30.0, 1.0))
    odds = np.array([0.6, 0.1]) / 0.3 * 30.0 * IS_NEARBY
    assert found.place == pytest.approx([*(odds / (odds.sum() + 1.0)), 1.0 / (odds.sum() + 1.0)])
    assert found.place[1] / found.place[0] == pytest.approx(1.0 / 6.0), (
        "which of the places there is not told"
    )


def test_a_photo_is_no_surer_than_the_others_are_of_their_place():
    sure = believe_nearby(make_belief([0.999]), Prospect(0.0, 1e6, 0.95))
    assert sure.place[0] == pytest.approx(0.95)
    near, beside, far = (
        one._replace(probability=probability)
        for one, probability in zip(
            _measure([Pose(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 0.5, 9.0)]),
            (0.92, 0.94, 0.999),
            strict=True,
        )
    )
    assert find_trust([near, far], near.gaussian.pose) == 0.92, "of another place that one tells nothing"
    assert find_trust([near, beside, far], near.gaussian.pose) == 0.94
    assert find_trust([far], near.gaussian.pose) == 0.0


def test_others_make_no_pose_exact_of_which_the_photo_shows_little():
    """However little of the scan is within reach: a stranger has such a pose too."""
    elsewhere = NearbyShares(0.0, 0.01)
    errors = NearbyErrors(1.0, 1.0, 1.0)
    for odds in (0.001, 0.05, 0.4):
        assert believe_exact(elsewhere, errors, local_share(odds)) < 0.85
    assert believe_exact(elsewhere, errors, local_share(4.0)) > 0.9


def test_who_was_turned_to_all_sides_at_a_spot_has_seldom_missed_the_right_rotation():
    assert local_share(1.0) == pytest.approx(0.5 * MISSED)
    assert local_share(1.0, MISSED_TURNED) == pytest.approx(0.5 * MISSED_TURNED)
    assert MISSED_TURNED < 0.3 * MISSED


def test_at_a_spot_a_local_optimum_is_another_rotation():
    at_spot = NearbyShares(0.7, 0.0)
    assert believe_exact(at_spot, NearbyErrors(1.0, 0.9, 0.0), MISSED) == pytest.approx(1.0 - 0.1 * MISSED)
    assert believe_exact(at_spot, NearbyErrors(1.0, 0.0, 0.0), MISSED) == pytest.approx(1.0 - MISSED)
    mixed = believe_exact(NearbyShares(0.3, 0.1), NearbyErrors(0.8, 0.8, 0.4), 0.0)
    assert mixed == pytest.approx(0.75 * 0.8 + 0.25 * 0.4)


def test_places_at_a_spot_are_likelier_than_elsewhere_and_together_as_likely_as_nearby():
    near = share_nearby([1.0], 50)
    far = share_nearby([0.0], 50)
    assert near.at_spot == IS_AT_SPOT
    assert near.elsewhere == far.elsewhere == pytest.approx((IS_NEARBY - IS_AT_SPOT) / 50)
    assert share_nearby([7.0], 50) == near, "a place holds at most what there is"
    assert share_nearby([1.0, 0.0], 50).at_spot == pytest.approx(IS_AT_SPOT / 2.0), "of two spots"
    assert log_odds_nearby(near, 50) > math.log(40.0)
    assert log_odds_nearby(far, 50) == pytest.approx(math.log((IS_NEARBY - IS_AT_SPOT) / IS_NEARBY))
    unknown = share_nearby([], 50)
    assert log_odds_nearby(unknown, 50) == pytest.approx(0.0), "without a spot all places are alike"
    assert unknown.of_spot == 0.0


def test_a_photo_that_may_be_elsewhere_and_one_that_is_ruled_out_stay_so():
    near = make_belief([0.7])
    assert (
        believe_nearby(near, Prospect(20.0, 10.0, 1.0)).place[0]
        < believe_nearby(near, Prospect(0.0, 10.0, 1.0)).place[0]
    )
    mirrored = believe_nearby(replace(near, doubt=0.2).rule_out(Reason.MIRRORED), Prospect(0.0, 10.0, 1.0))
    assert mirrored.ruled_out == {Reason.MIRRORED}
    assert mirrored.doubt == 0.2


def test_a_place_where_the_others_were_taken_is_not_elsewhere():
    """A photo was found there alone, but is not sure; another of its places is far away."""
    scan_map = rooms.scan_map(SEED)
    center = scan_map.centers[scan_map.sparse[0]]
    here = scan_map.to_world(Pose(np.eye(3), center + 0.5))
    far = scan_map.to_world(Pose(np.eye(3), center + 50.0))
    alone = replace(
        nothing_found(),
        best_pose=here,
        alternatives=(Alternative(far, 0.1, 5),),
        belief=make_belief([0.6, 0.3]),
    )
    located = [Pose(np.eye(3), center)]
    assert compute_odds_elsewhere(scan_map, alone, located) == pytest.approx(0.3 / 0.1)
    assert compute_odds_elsewhere(scan_map, nothing_found(), located) == 0.0


def test_only_what_is_within_reach_of_a_pose_is_searched():
    scan_map = rooms.scan_map(SEED)
    center = scan_map.centers[scan_map.sparse[0]]
    near = narrow_around(scan_map, [Pose(np.eye(3), center), Pose(np.eye(3), center + 0.1)])
    distances = np.linalg.norm(scan_map.centers[near.sparse] - center, axis=1)
    assert 0 < len(near.sparse) < len(scan_map.sparse)
    assert distances.max() <= REACH + COARSE_SPACING / 2 + np.sqrt(0.03)
    far = [Pose(np.eye(3), center + 1000.0)]
    assert len(narrow_around(scan_map, far).sparse) == 0
    assert _nearby(far, nothing_found()) is None


def _measure(poses, std=0.01):
    """Poses in the map, as sure photos tell them."""
    errors = np.diag(np.repeat([1e-4, std**2], 3))
    return [Witness(PoseGaussian(pose, errors, np.zeros((6, 6))), TRUST) for pose in poses]


def _nearby(located, alone, min_confidence=0.9):
    scan_map = rooms.scan_map(SEED)
    shot = Shot(one_taken(1)[0], replace(rooms.KNOWN, min_confidence=min_confidence))
    means = Means(rooms.KNOWN.effort, rooms.WORKERS, Stopwatch())
    searched = search_nearby(scan_map, shot, located, means)
    if searched is None:
        return None
    found = localize_nearby(scan_map, searched, alone, _measure(located), means, shot.settings.demand)
    return found and found.result


def test_a_photo_is_searched_again_only_where_it_was_not(monkeypatch):
    scan_map = rooms.scan_map(SEED)
    shot = Shot(one_taken(1)[0], rooms.KNOWN)
    means = Means(rooms.KNOWN.effort, rooms.WORKERS, Stopwatch())
    first = scan_map.from_world(true_places()[0])
    beside, far = (replace(first, center_world=first.center_world + np.eye(3)[0] * x) for x in (0.4, 0.6))
    found = []

    def find(problem, scan_map, means):
        found.append(len(problem.scan_map.sparse))
        assert problem.profile == replace(PROFILES[1], beam=WHOLE_BEAM, thins_starts=True), "few places"
        return Found(problem, NO_CHOICE, None)

    monkeypatch.setattr(nearby, "find", find)
    before = search_nearby(scan_map, shot, [first], means)
    assert search_nearby(scan_map, shot, [first, beside], means, before) is before
    assert len(found) == 1
    again = search_nearby(scan_map, shot, [first, far], means, before)
    assert len(found) == 2
    assert again.gain == len(scan_map.sparse) / found[1] < before.gain == len(scan_map.sparse) / found[0]


def test_a_photo_is_found_where_the_others_were_taken():
    scan_map = rooms.scan_map(SEED)
    located = [scan_map.from_world(true_places()[k]) for k in (0, 2)]
    found = _nearby(located, nothing_found(), 0.5)
    distance, angle = pose_errors(scan_map.to_world(found.gaussian.pose), one_taken(1)[1])
    assert distance < 0.1
    assert np.degrees(angle) < 2.0
    assert found.status == "localized"


def test_a_mirrored_photo_that_fits_as_well_is_evidence_against_a_photo_near_others_too(monkeypatch):
    """It is searched where the photo is, and counts as it does for a photo by itself."""
    scan_map = rooms.scan_map(SEED)
    located = [scan_map.from_world(true_places()[k]) for k in (0, 2)]
    places = []
    for share in (0.0, 1.0):

        def find_mirrored(problem, best, *_, share=share):
            assert len(problem.scan_map.sparse) < len(scan_map.sparse)
            return replace(best, score=share * best.score) if share else None

        monkeypatch.setattr(judging, "find_mirrored", find_mirrored)
        places.append(sum(_nearby(located, nothing_found(), 0.05).belief.place[:-1]))
    without, with_mirrored = (TRUST / place - 1.0 for place in places)
    assert with_mirrored / without == pytest.approx(1.0 + 0.5 / SYMMETRIC, rel=0.01)


def test_a_mirrored_photo_need_not_have_been_taken_near_the_others():
    """What is known of it by the whole scan counts near others, if the photo was found at the same place."""
    scan_map = rooms.scan_map(SEED)
    pose = scan_map.from_world(true_places()[0])
    found = Found(replace(PROBLEM, scan_map=scan_map), NO_CHOICE, None)
    known = Mirrored(Standing(1.1, 0.6, 20, "drawn scan"))
    alone = Result(best_pose=scan_map.to_world(pose), mirrored=known)
    assert recall_mirrored(found, alone, pose) is known
    beside = replace(pose, center_world=pose.center_world + np.array([0.6, 0.0, 0.0]))
    assert recall_mirrored(found, alone, beside) is None
    assert recall_mirrored(found, nothing_found(), pose) is None


def test_photos_of_one_spot_tell_where_another_was_taken():
    """Two photos tell that it is near them; four tell where, and that alone makes a doubtful photo sure."""
    scan_map = rooms.scan_map(SEED)
    true_pose = scan_map.from_world(one_taken(1)[1])
    rng = np.random.default_rng(6)
    turns = [yaw_rotation(turn) for turn in (0.9, 2.1, 3.2, 4.4)]
    around = [
        Pose(R @ true_pose.R_cam_from_world, true_pose.center_world + rng.normal(0.0, 0.01, 3)) for R in turns
    ]
    by_two, by_four = (_nearby(around[:count], nothing_found(), 0.05) for count in (2, 4))
    assert by_four.confidence > by_two.confidence
    assert by_four.confidence > 0.9
    assert by_four.gaussian.largest_std < by_two.gaussian.largest_std
    rooms.assert_near(by_four.gaussian.pose, true_pose, 0.04, 2.0)


def test_a_spot_elsewhere_in_the_room_moves_no_photo_there():
    """Others were taken half a metre beside: the photo is not sure to be there, and does not follow them."""
    scan_map = rooms.scan_map(SEED)
    true_pose = scan_map.from_world(one_taken(1)[1])
    beside = true_pose.center_world + np.array([0.5, 0.3, 0.0])
    turns = [yaw_rotation(turn) for turn in (0.9, 2.1, 3.2, 4.4)]
    around = [Pose(R @ true_pose.R_cam_from_world, beside) for R in turns]
    found = _nearby(around, nothing_found(), 0.05)
    assert found is None or found.gaussian.pose.distance(true_pose) < 0.15 or found.confidence < 0.5


@pytest.mark.parametrize(("offset", "is_moved"), [(0.0, True), (2.0, False)])
def test_a_photo_sure_of_another_place_is_doubted_and_goes_to_the_others_if_it_fits_there(offset, is_moved):
    """Others were taken at the true pose, or 2 m beside, where the photo does not fit."""
    scan_map = rooms.scan_map(SEED)
    shot = Shot(one_taken(1)[0], rooms.KNOWN)
    true_pose = scan_map.from_world(one_taken(1)[1])
    beside = true_pose.center_world + offset * np.array([0.6, 0.8, 0.0])
    around = [Pose(yaw_rotation(turn) @ true_pose.R_cam_from_world, beside) for turn in (0.9, 2.1, 3.2, 4.4)]
    far = scan_map.to_world(Pose(np.eye(3), true_pose.center_world + 9.0))
    alone = Result(status="localized", best_pose=far, belief=make_belief([0.95]))
    means = Means(rooms.KNOWN.effort, rooms.WORKERS, Stopwatch())
    found = doubt_stray(scan_map, shot, alone, _measure(around), 0, means)
    if is_moved:
        rooms.assert_near(scan_map.from_world(found.best_pose), true_pose, 0.05, 2.0)
    else:
        assert found.best_pose is far
        assert found.status == "not_localized"
        assert found.warnings == (TAKEN_ELSEWHERE,)
        assert found.belief.place[0] == pytest.approx(weigh_stray(0.0, 19.0, 4, 0)[1], abs=0.02)


def test_a_place_far_from_others_needs_more_evidence_the_fewer_are_elsewhere():
    far = [weigh_stray(0.0, 19.0, 6, count)[1] for count in (0, 2, 12)]
    assert 0.85 < far[0] < far[1] < far[2] < 0.95
    near, there = weigh_stray(40.0, 40.0, 8, 0)
    assert near == pytest.approx(9.0 * there)
    assert weigh_stray(0.0, 1e6, 8, 0)[1] > 0.999
    assert weigh_stray(0.0, 0.0, 8, 0) == (0.0, 0.0)


def test_poses_out_of_reach_are_left_out_unless_there_are_no_others():
    poses = [Pose(np.eye(3), np.array([x, 0.0, 0.0])) for x in (2.6, 0.3, -0.9)]
    first, *others = [replace(NO_CANDIDATE, pose=pose) for pose in poses]
    found = Found(None, Selection(first, tuple(others)), None)
    kept = keep_near(found, [Pose(np.eye(3), np.zeros(3))])
    assert [one.pose for one in kept.selection.candidates] == poses[1:]
    assert keep_near(found, [Pose(np.eye(3), np.full(3, 50.0))]) is found
