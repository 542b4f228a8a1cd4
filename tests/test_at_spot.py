"""Poses of photos at a spot where others were taken."""

import math
from dataclasses import replace

import numpy as np
import pytest
import rooms
from groups import SEED, one_taken

from piccolo.evidence.examine import examine
from piccolo.geometry.pose import Pose, angle_between, exp_so3, yaw_rotation
from piccolo.geometry.pose_gaussian import PoseGaussian
from piccolo.judge.belief import make_belief
from piccolo.judge.by_others import share_nearby
from piccolo.judge.candidate import NO_CANDIDATE, NO_CHOICE, Selection
from piccolo.judge.case import Errors
from piccolo.judge.result import Result
from piccolo.localization import turning
from piccolo.localization.judging import Found
from piccolo.localization.search import list_rotations
from piccolo.problem.accuracy import Accuracy
from piccolo.together import at_spot
from piccolo.together.at_spot import (
    Nearby,
    average_each,
    fits_mirrored,
    hold_at_spots,
    hold_turned,
    search_rotations,
    spread_rotations,
    turn_at,
    turn_each,
)
from piccolo.together.spot import fit_spot
from piccolo.together.unsure import take_average

TIER = "scene"

HERE = np.array([3.0, -2.0, 1.5])
TURNS = (0.4, 1.6, 2.9, 4.1, 5.3)
NUM_NEAR = 40


def _gaussian(pose, std=0.01, std_deg=0.5):
    own = np.diag(np.repeat([np.radians(std_deg) ** 2, std**2], 3))
    return PoseGaussian(pose, own, np.zeros((6, 6)))


def _spot(center, arm=0.0):
    """Where somebody stands who turned about an axis through a centre."""
    rotations = [yaw_rotation(turn) for turn in TURNS]
    return fit_spot([_gaussian(Pose(R, center + arm * R[0])) for R in rotations])


def _nearby(*spots):
    return Nearby(spots, NUM_NEAR, Accuracy())


def _average(offset, std):
    """A photo that was found at an offset from a spot, and what it becomes there."""
    pose = Pose(yaw_rotation(2.2), HERE + offset)
    candidate = replace(NO_CANDIDATE, pose=pose)
    return _nearby(_spot(HERE)).hold(candidate, _gaussian(pose, std), _spot(HERE), 0.01)


def test_a_photo_is_averaged_with_the_spot_by_the_errors_of_both():
    loose = _average(np.array([0.06, 0.0, 0.0]), 0.06)
    tight = _average(np.array([0.06, 0.0, 0.0]), 0.02)
    offs = [held.gaussian.pose.center_world[0] - HERE[0] for held in (loose, tight)]
    assert 0.0 < offs[0] < 0.02
    assert offs[0] < offs[1] < 0.06
    assert all(held.gaussian.largest_std < std for held, std in ((loose, 0.06), (tight, 0.02)))
    assert loose.candidate.log_by_others > 3.0, "its place is likelier than others"
    assert loose.exact.at_spot > loose.exact.alone
    assert angle_between(loose.gaussian.pose.R_cam_from_world, yaw_rotation(2.2)) < 1e-6, "and not turned"


def test_a_photo_that_contradicts_the_spot_was_taken_elsewhere():
    """Half a metre beside, with an error of 2 cm the spot does not move it; with one as large it does."""
    beside = np.array([0.5, 0.0, 0.0])
    assert _average(beside, 0.02) is None
    held = _average(beside, 0.5)
    assert np.linalg.norm(held.gaussian.pose.center_world - HERE) < 0.05


def test_elsewhere_a_photo_has_its_own_pose_and_less_odds():
    pose = Pose(yaw_rotation(2.2), HERE)
    nearby = _nearby(_spot(HERE))
    held = nearby.take_elsewhere(replace(NO_CANDIDATE, pose=pose), _gaussian(pose, 0.05))
    assert held.gaussian.pose is pose
    assert held.shares == share_nearby([0.0], NUM_NEAR)
    assert held.candidate.log_by_others < 0.0
    assert held.exact.alone == pytest.approx(Accuracy().probability(_gaussian(pose, 0.05)))
    assert nearby.take_elsewhere(NO_CANDIDATE).gaussian is None


def test_of_several_spots_the_likeliest_counts():
    here = _spot(HERE)
    there = _spot(HERE + 2.0)
    nearby = _nearby(here, there)
    assert nearby.find_likeliest(Pose(yaw_rotation(1.0), HERE + 0.1)) is here
    assert nearby.find_likeliest(Pose(yaw_rotation(1.0), HERE + 1.9)) is there
    assert _nearby().find_likeliest(Pose(yaw_rotation(1.0), HERE)) is None


def test_the_position_of_a_turned_photo_follows_the_arm():
    """Held out 40 cm, the camera moves as it turns: the end is where the spot expects its rotation."""
    problem, true_pose = _photo()
    spot = _spot(true_pose.center_world - 0.4 * true_pose.R_cam_from_world[0], arm=0.4)
    start = Pose(exp_so3(np.array([0.0, 0.0, 0.05])) @ true_pose.R_cam_from_world, true_pose.center_world)
    end = turn_at(problem, start, spot)
    expected = spot.attract(end.R_cam_from_world, start.center_world)
    np.testing.assert_array_equal(end.center_world, expected.center_world)
    assert np.linalg.norm(end.center_world - spot.place(end.R_cam_from_world).center) < 0.01
    rooms.assert_near(end, true_pose, 0.03, 1.0)


def test_a_photo_is_turned_only_where_it_fits():
    """A spot where the photo shows something else does not have it."""
    problem, true_pose = _photo()
    best = examine(problem, true_pose)
    here = _spot(true_pose.center_world)
    held = hold_turned(problem, best, [], here, _nearby(here), 0.9 * best.score, rooms.WORKERS)
    rooms.assert_near(held.gaussian.pose, true_pose, 0.04, 1.0)
    assert held.candidate.log_by_others > 2.0
    assert held.gaussian.largest_std < 0.1
    assert held.is_turned
    assert held.exact.likelihood_ratio == 1.0, "it began there"
    beside = _spot(true_pose.center_world + np.array([0.7, 0.4, 0.0]))
    start = examine(problem, turn_at(problem, true_pose, beside))
    assert hold_turned(problem, start, [], beside, _nearby(beside), 0.9 * best.score, rooms.WORKERS) is None


def test_rotations_at_a_spot_that_fit_alike_are_errors_of_each_other():
    """The nearer their odds, the more; far away, they are other answers."""
    problem, true_pose = _photo()
    best = examine(problem, true_pose)

    def spread_by(turn, score):
        """The standard deviation [rad] about the vertical by one other rotation."""
        R = yaw_rotation(turn) @ true_pose.R_cam_from_world
        scale = np.sqrt(score / best.score)
        alike = best.comparison._replace(correlation=scale * best.comparison.correlation)
        other = replace(best, pose=Pose(R, true_pose.center_world), score=score, comparison=alike)
        covariance = spread_rotations(problem, true_pose, best, [best, other])
        assert not covariance[3:].any(), "all are at one position"
        return math.sqrt(np.trace(covariance[:3, :3]))

    assert spread_by(0.1, best.score) == pytest.approx(0.1 / math.sqrt(2.0), rel=0.01)
    assert 0.0 < spread_by(0.1, 0.5 * best.score) < 0.03
    assert spread_by(0.3, best.score) == 0.0


def test_where_others_were_taken_decides_between_poses_that_fit_alike():
    """The worse of two poses is where the others are; the photo itself fixes both."""
    problem, true_pose = _photo()
    best = examine(problem, true_pose)
    far = examine(problem, Pose(true_pose.R_cam_from_world, true_pose.center_world + 0.02))
    far = replace(
        best, pose=Pose(far.pose.R_cam_from_world, true_pose.center_world + np.array([3.0, 0.0, 0.0]))
    )
    found = Found(problem, Selection(far, (best,)), None)
    _, alone = hold_at_spots(found, _nearby(), rooms.means(rooms.KNOWN))
    chosen, held = hold_at_spots(found, _nearby(_spot(true_pose.center_world)), rooms.means(rooms.KNOWN))
    assert alone.candidate.log_by_others == pytest.approx(0.0)
    assert held.candidate.pose is chosen.selection.best.pose
    rooms.assert_near(held.gaussian.pose, true_pose, 0.05, 1.0)


def test_rotations_are_searched_at_a_spot_where_no_pose_was_found():
    """The search has found the photo elsewhere only, looking the other way."""
    problem, true_pose = _photo()
    away = Pose(yaw_rotation(2.0) @ true_pose.R_cam_from_world, true_pose.center_world)
    found = Found(problem, Selection(examine(problem, away), ()), None)
    here = _nearby(_spot(true_pose.center_world))
    held = turn_each(found, [], here.spots[0], here, True, rooms.means(rooms.KNOWN))
    best = max(held, key=lambda one: one.candidate.score)
    rooms.assert_near(best.gaussian.pose, true_pose, 0.03, 1.0)
    chosen, one = hold_at_spots(found, here, rooms.means(rooms.KNOWN))
    rooms.assert_near(chosen.selection.best.pose, true_pose, 0.1, 2.0)
    assert one.gaussian.largest_std < 0.1


def test_every_rotation_is_turned_at_a_spot(monkeypatch):
    """Roughly all, then those that fit best."""
    problem, true_pose = _photo()
    rough = []
    turned = []

    def listen_roughly(problem, pose):
        rough.append(pose.R_cam_from_world)
        return turning.turn_roughly(problem, pose)

    def listen(problem, pose):
        turned.append(pose)
        return turning.turn(problem, pose)

    monkeypatch.setattr(at_spot, "turn_roughly", listen_roughly)
    monkeypatch.setattr(at_spot, "turn", listen)
    found = search_rotations(problem, _spot(true_pose.center_world), rooms.means(rooms.KNOWN))
    np.testing.assert_array_equal(rough, list_rotations(problem, "level", rooms.KNOWN.effort))
    assert len(turned) == at_spot.ROUNDS_AT_SPOT * at_spot.NUM_SEARCHED
    assert len(found) == at_spot.NUM_SEARCHED
    assert np.diff([one.score for one in found]).max() <= 0.0
    rooms.assert_near(found[0].pose, true_pose, 0.1, 2.0)


def test_a_mirrored_photo_explains_more_at_the_spot_when_it_is_turned_over():
    """Only where no matches tell otherwise."""
    problem, true_pose = _photo()
    here = _nearby(_spot(true_pose.center_world))
    own = here.take_elsewhere(examine(problem, true_pose))
    assert not fits_mirrored(Found(problem, NO_CHOICE, None), own, here, rooms.means(rooms.KNOWN))
    over = problem.mirror()
    wrong = here.take_elsewhere(examine(over, true_pose))
    assert wrong.candidate.score < own.candidate.score
    assert fits_mirrored(Found(over, NO_CHOICE, None), wrong, here, rooms.means(rooms.KNOWN))
    matched = wrong._replace(candidate=replace(wrong.candidate, num_matches=30))
    assert not fits_mirrored(Found(over, NO_CHOICE, None), matched, here, rooms.means(rooms.KNOWN))


def test_sure_photos_are_averaged_with_the_spot_of_the_others():
    """One of six is 6 cm off, with an error of 4 cm; the others stay nearly where they are, one elsewhere."""
    poses = [Pose(yaw_rotation(turn), HERE) for turn in TURNS]
    off = Pose(yaw_rotation(6.0), HERE + np.array([0.06, 0.0, 0.0]))
    far = Pose(yaw_rotation(1.0), HERE + 7.0)
    given = [*map(_gaussian, poses), _gaussian(off, 0.04), _gaussian(far)]
    averaged = average_each(given)
    moved = [one.pose.distance(other.pose) for one, other in zip(given, averaged, strict=True)]
    assert max(moved[:5]) < 0.01
    assert moved[6] == 0.0
    assert averaged[6] is given[6]
    assert averaged[5].pose.distance(Pose(off.R_cam_from_world, HERE)) < 0.03
    assert averaged[5].largest_std < 0.03
    assert average_each(given[:3]) == given[:3], "three photos do not tell where a third was taken"


def test_an_averaged_photo_stays_as_sure_as_it_was():
    """Its place is its own; its position is more exact, and it is no less so than before."""
    scan_map = rooms.scan_map(SEED)
    own = _gaussian(Pose(yaw_rotation(1.0), HERE), 0.05)
    mean = _gaussian(Pose(yaw_rotation(1.0), HERE + 0.01), 0.02)
    result = Result(
        belief=make_belief([0.95], within=0.97), status="localized", gaussian=own, best_pose=own.pose
    )
    demand = rooms.KNOWN.demand
    assert take_average(result, own, scan_map, demand) is result
    averaged = take_average(result, mean, scan_map, demand)
    assert averaged.gaussian is mean
    assert averaged.status == "localized"
    assert averaged.belief.place == result.belief.place
    assert averaged.confidence > result.belief.probabilities[0]
    assert averaged.best_pose.distance(scan_map.to_world(mean.pose)) < 1e-9
    loose = take_average(result, _gaussian(own.pose, 0.5), scan_map, demand)
    assert loose.belief.within == 0.97


def _photo():
    """A photo as it is asked for in the map, and its true pose there."""
    panorama, pose = one_taken(1)
    scan_map = rooms.scan_map(SEED)
    return rooms.ask(panorama, scan_map, rooms.KNOWN), scan_map.from_world(pose)


def test_a_mean_far_from_where_a_photo_was_found_is_turned_instead(monkeypatch):
    """Over 25 cm the covariance of the pose that was found tells nothing of the rotation."""
    problem, true_pose = _photo()
    beside = Pose(true_pose.R_cam_from_world, true_pose.center_world + np.array([0.25, 0.0, 0.0]))
    candidate = examine(problem, beside)
    loose = Errors(_gaussian(beside, 0.3), 0.01)
    monkeypatch.setattr(at_spot, "estimate_pose_errors", lambda *_: loose)
    monkeypatch.setattr(at_spot, "spread_optima", lambda *_: np.zeros((6, 6)))
    found = Found(problem, Selection(candidate, ()), None)
    here = _nearby(_spot(true_pose.center_world))
    assert at_spot.hold_best(found, candidate, here, rooms.WORKERS).shares.at_spot == 0.0
    (held,) = turn_each(found, [candidate], here.spots[0], here, False, rooms.means(rooms.KNOWN))
    assert held.candidate.pose.distance(beside) > 0.1
    rooms.assert_near(held.gaussian.pose, true_pose, 0.05, 1.0)
    close = Errors(_gaussian(true_pose, 0.3), 0.01)
    monkeypatch.setattr(at_spot, "estimate_pose_errors", lambda *_: close)
    assert at_spot.hold_best(found, examine(problem, true_pose), here, rooms.WORKERS).std_of_fit == 0.01
    assert held.std_of_fit is None
    assert held.moves_by(beside) > 0.1
    assert here.take_elsewhere(candidate).moves_by(beside) == math.inf


@pytest.mark.parametrize(("std", "is_searched"), [(0.3, True), (0.01, False)])
def test_other_rotations_are_searched_unless_the_photo_itself_tells_that_it_is_at_the_spot(
    monkeypatch, std, is_searched
):
    """One that was turned there may fit better turned away."""
    problem, true_pose = _photo()
    off = 0.25 if is_searched else 0.0
    pose = Pose(true_pose.R_cam_from_world, true_pose.center_world + np.array([off, 0.0, 0.0]))
    asked = []
    monkeypatch.setattr(at_spot, "estimate_pose_errors", lambda *_: Errors(_gaussian(pose, std), 0.01))
    monkeypatch.setattr(at_spot, "spread_optima", lambda *_: np.zeros((6, 6)))
    monkeypatch.setattr(at_spot, "search_rotations", lambda *given: asked.append(given) or [])
    found = Found(problem, Selection(examine(problem, pose), ()), None)
    nearby = _nearby(_spot(true_pose.center_world))
    _, held = hold_at_spots(found, nearby, rooms.means(rooms.KNOWN))
    assert held.shares.of_spot > 0.5
    assert held.is_turned == is_searched
    assert len(asked) == is_searched
