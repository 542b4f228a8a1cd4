"""Photos of a group that are not sure, searched where the others were taken."""

from dataclasses import replace

import numpy as np
import pytest
import rooms
from groups import SEED, one_taken, true_places

from piccolo.geometry.pose import Pose, pose_errors
from piccolo.judge.belief import make_belief
from piccolo.judge.by_others import IS_NEARBY, believe_nearby
from piccolo.judge.reasons import Reason
from piccolo.judge.result import nothing_found
from piccolo.judge.result_parts import Alternative
from piccolo.localization.means import Means
from piccolo.scan_map.camera_positions import COARSE_SPACING
from piccolo.system.jobs.threads import Stopwatch
from piccolo.together.members import Shot
from piccolo.together.nearby import REACH, compute_odds_elsewhere, localize_nearby, narrow_around

TIER = "scene"


def test_a_place_is_as_much_likelier_as_less_of_the_scan_is_within_reach():
    near = make_belief([0.6, 0.1], within=0.95)
    found = believe_nearby(near, 0.0, gain=30.0)
    odds = np.array([0.6, 0.1]) / 0.3 * 30.0 * IS_NEARBY
    assert found.place == pytest.approx([*(odds / (odds.sum() + 1.0)), 1.0 / (odds.sum() + 1.0)])
    assert found.place[1] / found.place[0] == pytest.approx(1.0 / 6.0), (
        "which of the places there is not told"
    )


def test_others_make_no_pose_exact_of_which_the_photo_shows_little():
    """However little of the scan is within reach: a stranger has such a pose too."""
    for own in (0.001, 0.05, 0.3):
        assert believe_nearby(make_belief([own]), 0.0, gain=1e6).probabilities[0] < 0.85
    assert believe_nearby(make_belief([0.8]), 0.0, gain=1e6).probabilities[0] > 0.9


def test_a_photo_that_may_be_elsewhere_and_one_that_is_ruled_out_stay_so():
    near = make_belief([0.7])
    assert believe_nearby(near, 20.0, 10.0).place[0] < believe_nearby(near, 0.0, 10.0).place[0]
    mirrored = believe_nearby(replace(near, doubt=0.2).rule_out(Reason.MIRRORED), 0.0, 10.0)
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


def _nearby(located, alone, min_confidence=0.9):
    scan_map = rooms.scan_map(SEED)
    shot = Shot(one_taken(1)[0], replace(rooms.KNOWN, min_confidence=min_confidence))
    means = Means(rooms.KNOWN.effort, rooms.WORKERS, Stopwatch())
    return localize_nearby(scan_map, shot, alone, located, means)


def test_a_photo_is_found_where_the_others_were_taken():
    scan_map = rooms.scan_map(SEED)
    located = [scan_map.from_world(true_places()[k]) for k in (0, 2)]
    found = _nearby(located, nothing_found(), 0.5)
    distance, angle = pose_errors(scan_map.to_world(found.gaussian.pose), one_taken(1)[1])
    assert distance < 0.1
    assert np.degrees(angle) < 2.0
    assert found.status == "localized"
