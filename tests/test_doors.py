"""Poses and other input from outside are refused at every door, in one line; results are values."""

import dataclasses
import json
import math

import cv2
import numpy as np
import pytest
import rooms
from hypothesis import given, settings, strategies as st
from refusals import assert_input_error
from results import RESULT

import piccolo
from piccolo import Pose, Result
from piccolo.api.result_files import read_results
from piccolo.cli import localize as localize_command
from piccolo.geometry.points import pack_points
from piccolo.geometry.pose import check_pose, exp_so3
from piccolo.judge import result_parts
from piccolo.judge.belief import NOTHING, make_belief
from piccolo.judge.reasons import Reason
from piccolo.judge.result_parts import Alone, Gap, WalkFrame
from piccolo.optimize.sampling_loss import sampling_loss
from piccolo.photo.panorama.texels import pack_texels
from piccolo.photo.photo import GpsPrior
from piccolo.system.kernels.jit import whole
from piccolo.views.zbuffer import nearest_depth, render_view, visible_points

TIER = "scene"

I = np.eye(3)  # noqa: E741
HERE = np.zeros(3)
BAD = {
    "none": (None, "found NoneType, wanted a Pose"),
    "text": ("here", "found str, wanted a Pose"),
    "matrix": (np.eye(4), "found ndarray, wanted a Pose"),
    "lists": (Pose(I.tolist(), [0.0, 0.0, 0.0]), "found list and list, wanted arrays of numbers"),
    "list": (Pose(I, [0.0, 0.0, 0.0]), r"found float64 \(3, 3\) and list, wanted arrays"),
    "4 x 4": (Pose(np.eye(4), HERE), r"found float64 \(4, 4\) and float64 \(3,\), wanted arrays"),
    "words": (Pose(I.astype(str), HERE), r"found <U32 \(3, 3\) and float64 \(3,\), wanted arrays"),
    "reflection": (Pose(np.diag([1.0, 1.0, -1.0]), HERE), "found a matrix that is no rotation"),
    "2 I": (Pose(2.0 * I, HERE), "found a matrix that is no rotation"),
    "NaN in R": (Pose(np.full((3, 3), np.nan), HERE), "found a matrix that is no rotation"),
    "NaN": (Pose(I, np.full(3, np.nan)), r"found a position \[nan, nan, nan\], wanted finite"),
    "infinite": (Pose(I, np.array([0.0, -np.inf, 0.0])), "found a position .*-inf"),
    "far": (Pose(I, np.array([1e20, 0.0, 0.0])), r"found a position \[1e\+20, 0.0, 0.0\], wanted finite"),
    "farther": (Pose(I, np.array([0.0, 0.0, 1e30])), r"found a position .*1e\+30"),
    "at the limit": (Pose(I, np.array([0.0, 0.0, 2e8])), "found a position .* up to 1e.08 m"),
}


REFINED = piccolo.Photo(np.zeros((64, 128, 3), np.uint8), refine_focal=True)


@pytest.fixture
def scan():
    return rooms.scan(1)


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_pose_is_refused_at_every_door(scan, name):
    """Before any work: there are no such pictures."""
    pose, message = BAD[name]
    good = Pose(I, HERE)
    assert_input_error("^`pose`: ", scan.occlusion_mask, "none.jpg", pose)
    assert_input_error("^`pose`: ", scan.from_world, pose)
    assert_input_error("^`relative_poses`: ", scan.localize_bundle, ["a.jpg", "b.jpg"], [good, pose])
    assert_input_error(f"^it: {message}", check_pose, pose, "it")
    if pose is None:  # a frame may be without one
        return
    assert_input_error("^`odometry`: ", scan.localize_walk, ["a", "b"], odometry=[good, pose])
    walk = scan.track()
    assert_input_error("^`odometry`: ", walk.add, "a.jpg", odometry=pose)
    assert not walk.blanks


THREE = {"min_size": 3, "max_size": 3}


@given(st.lists(st.floats(-3.0, 3.0), **THREE), st.lists(st.floats(-9e7, 9e7), **THREE))
def test_a_pose_passes_with_every_bit_and_is_a_copy(w, center):
    pose = Pose(exp_so3(np.array(w)), np.array(center))
    passed = check_pose(pose, "it")
    assert passed.key == pose.key
    assert passed == pose
    assert hash(passed) == hash(pose)
    passed.center_world[0] += 1.0
    assert passed != pose
    whole_numbers = check_pose(Pose(np.eye(3, dtype=int), np.array([1, 2, 3])), "it")
    assert whole_numbers.center_world.dtype == whole_numbers.R_cam_from_world.dtype == np.float64


@pytest.mark.usefixtures("searched_once")
def test_a_left_handed_scan_is_named_at_the_end_of_a_batch(tmp_path, capsys):
    """Its photos are localized mirrored; where one is localized as it is, nothing is tried.

    Both photos show the same, so that it is searched once.
    """
    photos = [str(tmp_path / f"{k}.png") for k in range(2)]
    for photo in photos:
        cv2.imwrite(photo, rooms.query(1).rgb[..., ::-1])
    left = rooms.write_cloud(tmp_path / "left.ply", 1, flip=(1.0, -1.0, 1.0))
    for name, cloud in (("right", rooms.map_path(1)), ("left", left)):
        words = ["--cloud", str(cloud), "--cache", "none", "--gravity", "known"]
        words += ["--jobs", "1", "--out", str(tmp_path / name), "--pano", *photos]
        code = localize_command.main(words)
        err = capsys.readouterr().err
        notes = [line for line in err.splitlines() if "are left-handed" in line]
        assert (code, len(notes)) == ((0, 0) if name == "right" else (1, 1)), err
    assert "which --up can't mend" in notes[0]
    assert len(read_results([tmp_path / "left"])) == 2


def test_a_pixel_that_is_no_number_is_no_index():
    """The kernels themselves survive poses that no door lets in."""
    octree = rooms.packed(1)
    for center in (np.nan, np.inf, 1e30):
        for R in (I, np.full((3, 3), np.nan)):
            pose = Pose(R, np.full(3, center))
            assert nearest_depth(octree, pose, 64).shape == (32, 64)
            assert render_view(octree, pose, 64).rgb.shape == (32, 64, 3)
            visible_points(octree, pose.center_world)
            texels = pack_texels(rooms.query(1).rgb)
            assert not sampling_loss(octree, texels, pose) < math.inf
    nothing = pack_points(np.full((5, 3), np.nan, np.float32), np.zeros((5, 3), np.uint8))
    assert not np.isfinite(nearest_depth(nothing, Pose(I, HERE), 64)).any()


@given(st.floats(-0.5, 60_000.0, width=32))
def test_the_whole_part_of_a_pixel_is_as_before(u):
    assert whole(np.float32(u)) == int(u)
    assert whole(np.float32(math.nan)) == 0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: piccolo.open_scan(None), "^`source`: found None, wanted a path or"),
        (lambda s: piccolo.open_scan("a.ply", cache=None), "^`cache`: found None, wanted True or False or"),
        (lambda s: piccolo.open_scan("a.ply", settings=None), "^`settings`: found None, wanted"),
        (lambda s: piccolo.Cloud(np.zeros((2000, 3)), units="mm"), "^`units`: found 'mm' for arrays"),
        (lambda s: piccolo.open_scan(np.full((2000, 3), "x")), "^points: found <U1, wanted numbers"),
        (lambda s: piccolo.open_scan(np.full((2000, 3), None)), "^points: found object, wanted numbers"),
        (lambda s: s.localize(None), "^`picture`: found None, wanted a path or an array"),
        (
            lambda s: s.localize(np.zeros((300, 400, 3), np.uint8)),
            "found uint8 of shape .300, 400, 3., wanted",
        ),
        (lambda s: s.localize(REFINED), "found a sphere or a part of one, wanted the photo of one"),
        (lambda s: s.localize_many(None), "^`photos`: found None, wanted a list"),
        (lambda s: piccolo.Motion(max_acceleration=None), "^`max_acceleration`: found None"),
        (lambda s: s.track().add(None), "^`picture`: found None, wanted a path or an array"),
        (lambda s: s.track().add("a.jpg", "soon"), "^`time`: found 'soon', wanted a number"),
        (lambda s: piccolo.Prior(heading_tolerance_deg=5.0), "^`heading_tolerance_deg`: only with"),
        (lambda s: s.save("no folder/a.piccolo-map"), "^no folder/a.piccolo-map: found no folder"),
        (lambda s: Result.from_json("{}"), "^result: found no format, wanted 'piccolo-pose/"),
        (lambda s: Result.from_json("[]"), "^result: found no format, wanted 'piccolo-pose/"),
        (lambda s: Result.from_json('"format"'), "^result: found no format, wanted 'piccolo-pose/"),
    ],
)
def test_other_input_is_refused_in_one_line(scan, call, message):
    assert_input_error(message, call, scan)


def test_a_heading_has_a_tolerance():
    assert piccolo.Prior(heading_deg=10.0).tolerance_deg == 20.0
    assert piccolo.Prior(heading_deg=10.0, heading_tolerance_deg=5.0).tolerance_deg == 5.0


@pytest.mark.parametrize("times", [(0.0, None), (None, 1.0)])
def test_times_are_given_for_all_frames_or_for_none(scan, times):
    walk = scan.track()
    walk.add("missing.jpg", times[0])
    message = rf"^`time`: found {times[1]} at frame 1, wanted it of all frames"
    assert_input_error(message, walk.add, "b.jpg", times[1])
    assert len(walk.blanks) == len(walk.tracker.frames) == 1
    walk.add("c.jpg", None if times[0] is None else 1.0)


FRAME = WalkFrame(1.5, 3, "alone", Alone("localized", 0.99, RESULT.best_pose), Gap(12.5, 0.5))


def _changed(**changes):
    return dataclasses.replace(RESULT, **changes)


def test_results_are_equal_by_value():
    again = Result.from_json(RESULT.to_json())
    assert again == RESULT
    assert hash(again) == hash(RESULT)
    assert len({again, RESULT}) == 1
    moved = Pose(RESULT.best_pose.R_cam_from_world, RESULT.best_pose.center_world + 1e-9)
    wider = dataclasses.replace(RESULT.covariance, matrix=2.0 * RESULT.covariance.matrix)
    for other in (_changed(best_pose=moved), _changed(covariance=wider), _changed(alternatives=())):
        assert other != RESULT
    assert RESULT.best_pose != "a pose"
    assert Pose(I, HERE) == Pose(I, -HERE)
    assert hash(Pose(I, HERE)) == hash(Pose(I, -HERE))


def test_a_result_can_not_be_changed_by_its_arrays():
    result = Result.from_json(_changed(walk=FRAME).to_json())
    before = result.to_json()
    for array in (
        result.pose.center_world,
        result.pose.R_cam_from_world,
        result.alternatives[0].pose.center_world,
        result.covariance.matrix,
        result.walk.alone.pose.center_world,
    ):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 99.0
    assert result.to_json() == before


NUMBERS = st.floats(-1e6, 1e6)
PROBABILITIES = st.floats(0.0, 1.0)
MAYBE = {
    "loss": st.none() | PROBABILITIES,
    "probability_none": st.none() | PROBABILITIES,
    "belief": st.just(NOTHING)
    | st.builds(make_belief, st.just([0.5, 0.25]), PROBABILITIES, PROBABILITIES).map(
        lambda belief: belief.rule_out(Reason.NEAR)
    ),
    "storey": st.none() | st.integers(1, 9),
    "height_above_floor": st.none() | NUMBERS,
    "scan": st.none() | st.text(max_size=5),
    "status": st.sampled_from(["localized", "ambiguous", "not_localized"]),
    "confidence": PROBABILITIES,
    "cloud": st.text(max_size=5) | st.tuples(st.text(max_size=5), st.text(max_size=5)),
    "warnings": st.lists(st.text(max_size=9), max_size=3).map(tuple),
    "walk": st.sampled_from([None, FRAME, dataclasses.replace(FRAME, alone=None, gap=None)]),
    "gps_prior": st.sampled_from([None, GpsPrior((1.5, -2.0), 30.0, False)]),
    "covariance": st.sampled_from([None, RESULT.covariance]),
    "evidence": st.sampled_from([None, RESULT.evidence]),
    "beside": st.sampled_from([None, result_parts.Beside(("a.jpg", "b.jpg"), "0" * 64)]),
    "focal_length": st.sampled_from([None, result_parts.FocalLength(800.0, 2.0, 810.0, 8.0)]),
}


@settings(max_examples=60)
@given(st.fixed_dictionaries(MAYBE))
def test_nothing_of_a_result_is_lost_in_json(changes):
    result = _changed(**changes)
    assert Result.from_json(result.to_json()) == result


@pytest.mark.parametrize("place", ["", "best_guess", "alternatives"])
@pytest.mark.parametrize("center", [[0, 0, 1e30], [0, 0], "here", [None, 0, 0]])
def test_a_pose_in_a_file_of_results_is_checked(place, center):
    document = json.loads(_changed(status="ambiguous" if place == "best_guess" else "localized").to_json())
    part = document[place] if place else document
    (part[0] if place == "alternatives" else part)["center_world"] = center
    assert_input_error("^result: found", Result.from_json, json.dumps(document))
