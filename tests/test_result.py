import dataclasses
import json

import numpy as np
import pytest

from piccolo.confidence.alternatives import Hypothesis
from piccolo.confidence.covariance import PoseCovariance
from piccolo.confidence.score import Evidence
from piccolo.errors import InputError
from piccolo.geometry.pose import Pose, exp_so3
from piccolo.result import Result

POSE = Pose(exp_so3(np.array([0.3, -0.2, 0.9])), np.array([500_000.123, 4_000_000.456, 12.0]))
EVIDENCE = Evidence(0.7, 0.5, 0.8, 0.6, 0.9, 0.5)
ALTERNATIVE = Hypothesis(Pose(exp_so3(np.array([0.1, 0.2, -2.0])), np.array([1.0, 2.0, 3.0])), 0.2)
RESULT = Result(
    status="localized",
    confidence=0.99,
    cloud="a scan.ply",
    pano="b.jpg",
    pose=POSE,
    loss=0.05,
    evidence=EVIDENCE,
    alternatives=(ALTERNATIVE,),
    covariance=PoseCovariance(np.diag([1e-6, 1e-6, 1e-6, 4e-6, 9e-6, 16e-6]), "up and down"),
    seconds={"read": 0.1, "search": 0.2},
    settings={"preset": "paper", "seed": 0},
    warnings=("odd",),
)
WITHOUT_ARRAYS = {"pose": None, "alternatives": (), "covariance": None}


def test_json_round_trip_keeps_every_bit_of_the_pose():
    back = Result.from_json(RESULT.to_json())
    np.testing.assert_array_equal(back.pose.R_cam_from_world, RESULT.pose.R_cam_from_world)
    np.testing.assert_array_equal(back.pose.center_world, RESULT.pose.center_world)
    found, kept = (a.pose.R_cam_from_world for a in (back.alternatives[0], ALTERNATIVE))
    np.testing.assert_array_equal(found, kept)
    np.testing.assert_array_equal(back.covariance.matrix, RESULT.covariance.matrix)
    assert (back.alternatives[0].score, back.covariance.least_constrained_direction) == (0.2, "up and down")
    plain = dataclasses.replace(RESULT, **WITHOUT_ARRAYS)
    assert dataclasses.replace(back, **WITHOUT_ARRAYS) == plain


def test_json_names_what_the_next_tool_needs_in_its_units():
    document = json.loads(RESULT.to_json())
    assert document["std_mm"] == pytest.approx([2.0, 3.0, 4.0])
    assert document["std_deg"] == pytest.approx([np.degrees(1e-3)] * 3)
    assert "R_true = exp([w]x) R_cam_from_world" in document["covariance_convention"]
    assert document["format"] == "piccolo-pose/3"
    T = np.array(document["T_world_from_cam"])
    np.testing.assert_allclose(T[:3, 3], RESULT.pose.center_world)
    np.testing.assert_allclose(T[:3, :3], np.array(document["R_cam_from_world"]).T)
    assert "R_cam_from_world @ (x_world - center_world)" in document["convention"]


def test_summary_says_what_a_person_asks_first():
    text = dataclasses.replace(RESULT, status="ambiguous").summary()
    assert "ambiguous at (500000.123, 4000000.456, 12.000) m" in text
    assert "confidence 0.990" in text
    assert "one sigma 4.0 mm (up and down)" in text
    assert "or (1.000, 2.000, 3.000) m, score 0.20" in text
    assert "or (" not in RESULT.summary()


def test_a_result_without_a_pose_is_written_and_nan_never():
    none = dataclasses.replace(RESULT, status="not_localized", loss=None, evidence=None, **WITHOUT_ARRAYS)
    assert json.loads(none.to_json())["T_world_from_cam"] is None
    assert Result.from_json(none.to_json()).pose is None
    with pytest.raises(ValueError, match="not JSON compliant"):
        dataclasses.replace(RESULT, loss=float("nan")).to_json()


def test_several_files_of_a_cloud_are_a_list():
    several = dataclasses.replace(RESULT, cloud=("b.ply", "a.ply"), **WITHOUT_ARRAYS)
    assert json.loads(several.to_json())["cloud"] == ["b.ply", "a.ply"]
    assert Result.from_json(several.to_json()) == several
    for cloud in (7, ["a", 7], None):
        document = json.loads(several.to_json()) | {"cloud": cloud}
        with pytest.raises(InputError, match="neither a path nor a list of paths"):
            Result.from_json(json.dumps(document))


@pytest.mark.parametrize("text", ["{", "[]", "{}", *(f'{{"format": "piccolo-pose/{k}"}}' for k in (2, 3))])
def test_other_text_is_refused(text):
    with pytest.raises(InputError, match="piccolo-pose/3"):
        Result.from_json(text)
