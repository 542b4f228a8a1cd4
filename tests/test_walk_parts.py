"""Parts of a walk: positions smoothed together, times from names, tables and EXIF, frames read again."""

import math
import time
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import rooms
from pictures import encoded, write, write_photo
from poses import judged
from refusals import assert_input_error

from piccolo.geometry.pose import Pose, exp_so3, log_so3
from piccolo.geometry.pose_gaussian import PoseGaussian
from piccolo.judge.belief import make_belief
from piccolo.judge.reasons import Reason
from piccolo.judge.result import Result, nothing_found
from piccolo.judge.result_parts import Alternative, Evidence
from piccolo.photo.photo import Photo
from piccolo.poses.times import times_of
from piccolo.problem.accuracy import PAPER_ACCURACY, Accuracy
from piccolo.problem.settings import CoarseToFineSettings
from piccolo.system.errors import InputError
from piccolo.together.walk.frames import MOST_ODDS, Frame, State, list_states
from piccolo.together.walk.path import NOTHING, Ranked
from piccolo.together.walk.results import check_odometry, make_localization, smooth_positions

TIER = "scene"

MAX_ACCELERATION = 0.5  # [m/s^2]
MAX_SPEED = 2.0  # [m/s]
TURN = exp_so3(np.array([0.1, -0.3, 1.0]))


def _located(centers, stds, coupling=0.0):
    """Poses at centres (N, 3), with deviations (N,) [m] and a correlation of turn and place."""
    found = []
    for center, std in zip(centers, stds, strict=True):
        matrix = np.diag([0.01**2] * 3 + [std**2] * 3)
        for k in range(3):
            matrix[k, 3 + k] = matrix[3 + k, k] = coupling * 0.01 * std
        found.append(PoseGaussian(Pose(TURN, np.array(center, float)), matrix, np.zeros((6, 6))))
    return found


def _dense(located, times, s):
    n = len(located)
    A = np.zeros((n - 2, n))
    for k in range(n - 2):
        before, after = times[k + 1] - times[k], times[k + 2] - times[k + 1]
        A[k, k : k + 3] = (
            2.0 / (before + after) * np.array([1 / before, -1 / before - 1 / after, 1 / after]) / s
        )
    own = np.diag([1.0 / one.own[3, 3] for one in located])
    centers = np.array([one.pose.center_world for one in located])
    covariance = np.linalg.inv(own + A.T @ A)
    return covariance @ own @ centers, covariance


def test_positions_and_deviations_are_those_of_dense_least_squares():
    rng = np.random.default_rng(3)
    times = np.cumsum(rng.uniform(0.3, 0.8, 12))
    located = _located(rng.normal(0.0, 0.3, (12, 3)) + times[:, None], rng.uniform(0.01, 0.4, 12))
    centers, covariance = _dense(located, times, MAX_ACCELERATION)
    found = smooth_positions(located, times, MAX_ACCELERATION, MAX_SPEED)
    np.testing.assert_allclose([one.pose.center_world for one in found], centers, atol=1e-8)
    variances = [one.own[4, 4] for one in found]
    np.testing.assert_allclose(variances, np.diag(covariance), rtol=1e-8)


def test_an_uncertain_frame_comes_to_the_others_and_turns_with_its_place():
    times = np.arange(5.0) / 4
    centers = np.outer(times, [1.0, 0.0, 0.0])
    centers[2, 1] += 0.2
    located = _located(centers, [0.005, 0.005, 0.3, 0.005, 0.005], coupling=0.9)
    found = smooth_positions(located, times, MAX_ACCELERATION, MAX_SPEED)[2]
    pose = found.pose
    assert abs(pose.center_world[1]) < 0.02
    assert found.largest_std < 0.04
    turn = log_so3(pose.R_cam_from_world @ TURN.T)
    np.testing.assert_allclose(turn[1], 0.9 * 0.01 / 0.3 * (pose.center_world[1] - 0.2), rtol=1e-3)
    assert np.linalg.eigvalsh(found.covariance)[0] > 0.0


@pytest.mark.parametrize("rate", [2, 10, 30])
def test_errors_of_the_scan_are_not_smoothed_away(rate):
    """Chi square of positions whose errors of 9 mm are in common, and 4.4 mm their own."""
    rng = np.random.default_rng(rate)
    own, common = (np.diag([1e-8] * 3 + [std**2] * 3) for std in (0.0044, 0.009))
    times = np.arange(40) / rate
    path = np.outer(times, [0.5, 0.0, 0.0])
    squares = []
    for _ in range(100):
        shift = 0.009 * rng.normal(size=3)
        found = [PoseGaussian(Pose(TURN, c + shift + 0.0044 * rng.normal(size=3)), own, common) for c in path]
        middle = smooth_positions(found, times, 2.0, MAX_SPEED)[20]
        error = path[20] - middle.pose.center_world
        squares.append(error @ np.linalg.solve(middle.covariance[3:, 3:], error) / 3.0)
    assert 0.7 < np.mean(squares) < 1.5


@pytest.mark.parametrize(
    ("factor", "noise", "words"),
    [
        (1.1, 0.01, ("`odometry`: it is 10 % too long",)),
        (0.8, 0.01, ("`odometry`: it is 20 % too short",)),
        (1.01, 0.01, ()),
        (1.1, 0.6, ()),
    ],
)
def test_an_odometry_of_another_length_is_named(factor, noise, words):
    """Frames a step apart, seen to a noise [m]; one of them at another place is no reason."""
    rng = np.random.default_rng(0)
    centers = np.cumsum(rng.normal(size=(200, 3)) * [0.4, 0.4, 0.0], axis=0)
    frames = [Frame(float(k), odometry=Pose(TURN, factor * c)) for k, c in enumerate(centers)]
    seen = [Pose(TURN, c + noise * rng.normal(size=3)) for c in centers]
    found = [Result("localized", best_pose=pose) for pose in seen]
    found[7] = Result("localized", best_pose=Pose(TURN, centers[7] + 9.0))
    assert check_odometry(frames, found) == words
    assert check_odometry(frames[:3], found[:3]) == ()
    lost = [Result(best_pose=pose) for pose in seen]
    assert check_odometry(frames, lost) == ()


def _judged(belief):
    """A frame that was localized alone, with one alternative."""
    evidence = Evidence(0.5, 1.0, 0.5, 0.9, 0.3)
    away = Alternative(Pose(TURN, np.array([3.0, 0.0, 0.0])), 0.3)
    return judged("localized", belief, Pose(TURN, np.zeros(3)), evidence=evidence, alternatives=(away,))


def test_the_states_of_a_frame_have_the_odds_of_places_however_exact_the_pose_is():
    """Its focal length may be wrong, and then the place is."""
    scan_map = SimpleNamespace(from_world=lambda pose: pose)
    for within in (1.0, 0.1):
        best, other = list_states(scan_map, _judged(make_belief([0.9, 0.05], within, doubt=0.1)))
        none = 1.0 - 0.9 * 0.95
        assert best.log_odds == pytest.approx(math.log(0.9 * 0.9 / none))
        assert other.log_odds == pytest.approx(math.log(0.9 * 0.05 / none))
    assert (best.score, other.score) == (0.5, None)
    certain = list_states(scan_map, _judged(make_belief([1.0, 0.0])))
    assert [state.log_odds for state in certain] == [MOST_ODDS, pytest.approx(0.0)]
    refused = _judged(make_belief([0.9, 0.05]).rule_out(Reason.MIRRORED))
    assert {state.log_odds for state in list_states(scan_map, refused)} == {-2.0 * MOST_ODDS}
    assert list_states(scan_map, nothing_found()) == []


@pytest.mark.parametrize("std", [0.01, 0.08])
def test_a_frame_of_a_walk_is_believed_by_its_path_and_its_errors(std):
    """Of many places the likeliest are told; others count as none."""
    here = PoseGaussian(Pose(TURN, np.zeros(3)), np.diag([1e-6] * 3 + [std**2] * 3), np.zeros((6, 6)))
    states = [State(Pose(TURN, np.array([4.0 * k, 0.0, 0.0])), 0.0) for k in range(9)]
    states[0] = replace(states[0], score=0.5, gaussian=here)
    scan_map = SimpleNamespace(to_world=lambda pose: pose, R_map_from_world=np.eye(3))
    tracker = SimpleNamespace(scan_map=scan_map, settings=CoarseToFineSettings())
    found = make_localization(tracker, Frame(0.0), Ranked(states, np.array([0.92, *[0.01] * 8])))
    assert found.belief == make_belief([0.92, *[0.01] * 5], PAPER_ACCURACY.probability(here))
    assert found.belief.place[-1] == pytest.approx(0.03)
    assert (found.status == "localized") == (std == 0.01)
    assert len(found.alternatives) == 5
    tracker.settings = CoarseToFineSettings(accuracy=Accuracy(0.25))
    wide = make_localization(tracker, Frame(0.0), Ranked(states, np.array([0.92, *[0.01] * 8])))
    assert (wide.status, wide.place_probability) == ("localized", found.place_probability)


def test_a_frame_that_is_sure_beyond_reach_of_the_walk_is_told_but_not_believed():
    tracker = SimpleNamespace(settings=CoarseToFineSettings())
    sure = _judged(make_belief([0.98, 0.01]))
    told = make_localization(tracker, Frame(0.0, alone=sure), NOTHING)
    assert (told.status, told.best_pose) == ("not_localized", sure.best_pose)
    assert told.confidence == pytest.approx(0.49)
    unsure = replace(sure, status="ambiguous")
    assert make_localization(tracker, Frame(0.0, alone=unsure), NOTHING) is unsure


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_frames_stay_as_they_are(count):
    located = _located(np.zeros((count, 3)), [0.1] * count)
    assert smooth_positions(located, np.arange(count), MAX_ACCELERATION, MAX_SPEED) == located


def test_frames_far_apart_say_nothing_of_each_other():
    located = _located([[0, 0, 0], [0, 1, 0], [0, 0, 0]], [0.1] * 3)
    found = smooth_positions(located, [0.0, 10.0, 20.0], MAX_ACCELERATION, MAX_SPEED)
    np.testing.assert_allclose([one.pose.center_world[1] for one in found], [0, 1, 0], atol=1e-12)


def test_times_by_names_tables_and_exif(tmp_path):
    frames = [tmp_path / f"walk_{text}.jpg" for text in ("10.5", "11", "13.25")]
    assert times_of(frames, "names") == [10.5, 11.0, 13.25]
    assert times_of(frames, "order") is None
    assert times_of(frames, None) is None  # no file, no EXIF
    (tmp_path / "t.csv").write_text("name,time\nwalk_10.5.jpg,3\nwalk_11.jpg,4\n")
    assert times_of(frames[:2], str(tmp_path / "t.csv")) == [3.0, 4.0]
    with pytest.raises(InputError, match=r"t\.csv: found no time of .*walk_13\.25\.jpg, wanted a CSV file"):
        times_of(frames, str(tmp_path / "t.csv"))
    (tmp_path / "t.csv").write_text("name,when\na,3\n")
    with pytest.raises(InputError, match=r"t\.csv: found KeyError 'time', wanted a CSV file"):
        times_of(frames, str(tmp_path / "t.csv"))
    assert_input_error("wanted them to rise", times_of, frames[::-1], "names")
    with pytest.raises(InputError, match=r"^`times` names: found no number in walk\.jpg"):
        times_of([tmp_path / "walk.jpg"], "names")
    assert_input_error(r"^`times` exif: found a frame without a time in EXIF", times_of, frames, "exif")


@pytest.mark.parametrize("zone", ["UTC", "Europe/Berlin", "America/New_York"])
def test_times_of_exif_are_those_of_no_machine(tmp_path, monkeypatch, zone):
    """An hour that summer time repeats or leaves out folds no walk."""
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    spring = "2026:03:29 01:59:50", "2026:03:29 02:00:10", "2026:03:29 03:00:10"
    autumn = "2026:10:25 01:59:50", "2026:10:25 02:30:10", "2026:10:25 03:00:10"
    moved = "2026:05:01 10:00:00", "2026:05:01 09:00:02", "2026:05:01 10:00:05"
    walks = {
        "spring": (spring, ("", "", ""), 3600.0),
        "autumn": (autumn, ("", "", ""), 1800.0),
        "two zones": (moved, ("+02:00", "+01:00", "+02:00"), 3.0),
        "one without": (spring, ("+02:00", "", "+02:00"), 3600.0),
    }
    rgb = np.zeros((8, 16, 3), np.uint8)
    for name, (stamps, offsets, last_step) in walks.items():
        frames = [
            write_photo(tmp_path / f"{name} {k}.jpg", rgb, time=(stamp, "", offset))
            for k, (stamp, offset) in enumerate(zip(stamps, offsets, strict=True))
        ]
        found = times_of(frames, None)
        assert found is not None
        assert found[2] - found[1] == last_step
    monkeypatch.undo()
    time.tzset()


def test_a_frame_that_is_gone_or_another_is_not_read_again(tmp_path):
    pictures = [encoded(rooms.query(3, index=k).rgb, ".png") for k in range(2)]
    path = write(tmp_path / "latest.png", pictures[0])
    walk = rooms.scan(3).track(gravity="known")
    walk.add(path, 0.0)
    np.testing.assert_array_equal(walk.tracker.read(0).rgb, cv2.imread(str(path))[..., ::-1])
    path.write_bytes(pictures[1])
    assert walk.tracker.read(0) is None
    path.unlink()
    assert walk.tracker.read(0) is None
    assert [result.status for result in walk.finish()] == ["localized"]


def test_the_result_of_a_narrow_frame_has_its_camera_and_name(tmp_path):
    photo = Photo(tmp_path / "photo.png", focal_px=140.0)
    cv2.imwrite(photo.name, np.random.default_rng(0).integers(0, 255, (120, 160, 3), dtype=np.uint8))
    walk, again = (rooms.scan(3).track(gravity="known") for _ in range(2))
    walk.add(photo, 0.0, "a name")
    again.restore(walk.last_to_json(), photo)
    for result in (*walk.finish(), *again.finish()):
        assert result.pano == "a name"
        assert result.cameras[0].camera.focal == (140.0, 140.0)
