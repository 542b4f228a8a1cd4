"""The check of all results finds each contradiction that it is for."""

import dataclasses
import json

import numpy as np
import pytest
from consistency import contradictions_of_line, find_contradictions, lines_of_results
from results import POSE, RESULT

from piccolo.geometry.pose import Pose
from piccolo.judge.belief import make_belief
from piccolo.judge.pose_covariance import PoseCovariance
from piccolo.judge.result_parts import Alternative, FocalLength, WalkFrame

SETTINGS = {"preset": "default", "cloud": {}, "panorama": {}}
SKEW = Pose(np.diag([1.0, 1.0, 1.01]), np.zeros(3))
MIRROR = Pose(np.diag([1.0, 1.0, -1.0]), np.zeros(3))
FOCAL = FocalLength(2770.0, 9.0, 2759.0, 8.0, 2773.0, 42.0, source="EXIF")
COVARIANCE = np.diag([1e-6, 1e-6, 1e-6, 4e-6, 9e-6, 16e-6])


def _changed(**changes):
    return dataclasses.replace(RESULT, settings=SETTINGS, **changes)


def _covariance(row, column, value):
    matrix = COVARIANCE.copy()
    matrix[row, column] = value
    return PoseCovariance(matrix, "up and down")


@pytest.fixture
def good():
    return _changed(focal_length=FOCAL)


BROKEN = {
    "add up to 1.0": {"probability_none": 0.01},
    "wanted 0 to 1": {"confidence": 1.2, "probability_none": -0.208},
    "beside the belief": {"belief": make_belief([0.98, 0.01])},
    "least 0.9, with": {"confidence": 0.5, "probability_none": 0.492},
    "with the error None": {"status": "unreadable"},
    "with the error 'why'": {"error": "why"},
    "without a pose": {"best_pose": None},
    "no rotation": {"best_pose": SKEW},
    "which is no rotation": {"alternatives": (Alternative(MIRROR, 0.2, 7, 0.008),)},
    "a camera at": {"best_pose": Pose(POSE.R_cam_from_world, np.array([np.nan, 0.0, 0.0]))},
    "the poses 0 and 1 are one": {"alternatives": (Alternative(POSE, 0.2, 7, 0.008),)},
    "not symmetric": {"covariance": _covariance(0, 1, 1e-9)},
    "wanted above 0": {"covariance": _covariance(2, 2, 0.0)},
    "not positive": {"covariance": PoseCovariance(COVARIANCE + 2e-6 * np.eye(6)[[1, 0, 2, 3, 4, 5]], "")},
    "2908.0 +- 9.0 px, where": {"focal_length": dataclasses.replace(FOCAL, px=2908.0)},
    "alone without its deviation": {"focal_length": dataclasses.replace(FOCAL, picture_std_px=None)},
    "of others without": {"focal_length": dataclasses.replace(FOCAL, others_px=2770.0)},
    "times": {"seconds": {"search": -0.1}},
    "a frame at -1.0 s": {"walk": WalkFrame(-1.0, 0, "alone", None, None)},
}  # fmt: skip


@pytest.mark.parametrize("words", BROKEN)
def test_each_contradiction_is_found(words, contradictions):
    found = find_contradictions(_changed(**BROKEN[words]))
    assert any(words in line for line in found), found
    assert any(words in line for line in contradictions), "it is found where it is made"
    contradictions.clear()


def test_a_sound_result_and_one_that_a_test_makes_up_have_none(good, contradictions):
    assert find_contradictions(good) == contradictions_of_line(good.to_json()) == contradictions == []
    assert find_contradictions(dataclasses.replace(RESULT, confidence=0.1)) == []


def test_lines_are_found_in_files_and_checked(good, tmp_path, contradictions):
    line = good.to_json()
    (tmp_path / "below").mkdir()
    made_up = RESULT.to_json()
    (tmp_path / "below" / "a.jsonl").write_text(f"{line}\n{made_up}\n{line[:-9]}\n{{}}\n")
    assert lines_of_results(tmp_path) == [line]
    broken = json.dumps(json.loads(line) | {"confidence": "high"})
    assert contradictions_of_line(broken) == ["'high' is not of type 'number'"]
    other = line.replace('"version": "', '"version": "9')
    assert contradictions_of_line(other) == [f"{other} is read as {line}"]
    assert contradictions == []
