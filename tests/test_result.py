import dataclasses
import json

import numpy as np
import pytest

from piccolo.errors import InputError
from piccolo.pose import Pose, exp_so3
from piccolo.result import Result

RESULT = Result(
    status="localized",
    cloud="a scan.ply",
    pano="b.jpg",
    pose=Pose(exp_so3(np.array([0.3, -0.2, 0.9])), np.array([500_000.123, 4_000_000.456, 12.0])),
    loss=0.05,
    score=0.7,
    margin=0.5,
    inlier_share=0.8,
    inlier_residual=0.1,
    seconds={"read": 0.1, "search": 0.2},
    settings={"preset": "paper", "seed": 0},
    warnings=("odd",),
)


def test_json_round_trip_keeps_every_bit_of_the_pose():
    back = Result.from_json(RESULT.to_json())
    np.testing.assert_array_equal(back.pose.R_cam_from_world, RESULT.pose.R_cam_from_world)
    np.testing.assert_array_equal(back.pose.center_world, RESULT.pose.center_world)
    assert dataclasses.replace(back, pose=None) == dataclasses.replace(RESULT, pose=None)


def test_json_names_what_the_next_tool_needs():
    document = json.loads(RESULT.to_json())
    assert document["format"] == "piccolo-pose/1"
    T = np.array(document["T_world_from_cam"])
    np.testing.assert_allclose(T[:3, 3], RESULT.pose.center_world)
    np.testing.assert_allclose(T[:3, :3], np.array(document["R_cam_from_world"]).T)
    assert "R_cam_from_world @ (x_world - center_world)" in document["convention"]


def test_result_without_a_pose():
    none = dataclasses.replace(RESULT, status="not_localized", pose=None, loss=None, score=None, margin=None)
    assert json.loads(none.to_json())["T_world_from_cam"] is None
    assert Result.from_json(none.to_json()).pose is None


def test_several_files_of_a_cloud_are_a_list():
    several = dataclasses.replace(RESULT, cloud=("b.ply", "a.ply"), pose=None)
    assert json.loads(several.to_json())["cloud"] == ["b.ply", "a.ply"]
    assert Result.from_json(several.to_json()) == several
    for cloud in (7, ["a", 7], None):
        document = json.loads(several.to_json()) | {"cloud": cloud}
        with pytest.raises(InputError, match="neither a path nor a list of paths"):
            Result.from_json(json.dumps(document))


def test_nan_is_never_written():
    with pytest.raises(ValueError, match="not JSON compliant"):
        dataclasses.replace(RESULT, loss=float("nan")).to_json()


@pytest.mark.parametrize(
    "text", ["{", "[]", "{}", '{"format": "piccolo-pose/2"}', '{"format": "piccolo-pose/1"}']
)
def test_other_text_is_refused(text):
    with pytest.raises(InputError, match="piccolo-pose/1"):
        Result.from_json(text)
