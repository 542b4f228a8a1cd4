import dataclasses
import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from refusals import assert_input_error
from results import ALTERNATIVE, POSE, RESULT

from piccolo.api.photo_reader import unreadable_result
from piccolo.api.result_files import read_results
from piccolo.apps.report.site import NOT_TOLD
from piccolo.judge.reasons import Reason
from piccolo.judge.result import Result
from piccolo.judge.result_parts import Source

ROOT = Path(__file__).resolve().parents[1]
WITHOUT_ARRAYS = {"status": "not_localized", "best_pose": None, "alternatives": (), "covariance": None}


def test_json_round_trip_keeps_every_bit_of_the_pose():
    back = Result.from_json(RESULT.to_json())
    assert back.pose.key == RESULT.pose.key
    found, kept = (a.pose.R_cam_from_world for a in (back.alternatives[0], ALTERNATIVE))
    np.testing.assert_array_equal(found, kept)
    np.testing.assert_array_equal(back.covariance.matrix, RESULT.covariance.matrix)
    assert dataclasses.replace(back.alternatives[0], pose=POSE) == dataclasses.replace(ALTERNATIVE, pose=POSE)
    assert back.covariance.least_constrained_direction == "up and down"
    plain = dataclasses.replace(RESULT, **WITHOUT_ARRAYS)
    assert dataclasses.replace(back, **WITHOUT_ARRAYS) == plain


def test_json_names_what_the_next_tool_needs_in_its_units():
    document = json.loads(RESULT.to_json())
    assert document["std_mm"] == pytest.approx([2.0, 3.0, 4.0])
    assert document["std_deg"] == pytest.approx([np.degrees(1e-3)] * 3)
    assert "R_true = exp([w]x) R_cam_from_world" in document["covariance_convention"]
    assert document["format"] == "piccolo-pose/13"
    assert (document["storey"], document["height_above_floor_m"]) == (2, 1.51)
    T = np.array(document["T_world_from_cam"])
    np.testing.assert_allclose(T[:3, 3], RESULT.pose.center_world)
    np.testing.assert_allclose(T[:3, :3], np.array(document["R_cam_from_world"]).T)
    assert "R_cam_from_world @ (x_world - center_world)" in document["convention"]


def test_summary_says_what_a_person_asks_first():
    text = dataclasses.replace(RESULT, status="ambiguous").summary()
    assert "ambiguous with the best guess (500000.123, 4000000.456, 12.000) m" in text
    assert "confidence 0.990" in text
    assert "one sigma 4.0 mm up and down, rotation" in text
    assert "or (1.000, 2.000, 3.000) m, probability 0.01" in text
    tiny = dataclasses.replace(ALTERNATIVE, probability=0.0049)
    assert "or (" not in dataclasses.replace(RESULT, status="ambiguous", alternatives=(tiny,)).summary()
    assert "or (" not in RESULT.summary()


def test_reasons_are_those_of_the_schema_and_of_the_page():
    """What was told of a photo is named on the page."""
    schema = json.loads((ROOT / "docs" / "result.schema.json").read_text())
    belief = schema["properties"]["belief"]["anyOf"][0]["properties"]
    assert belief["ruled_out"]["items"]["enum"] == list(Reason)
    words = re.search(r"type Told = (.*);", (ROOT / "page" / "src" / "types.ts").read_text())[1]
    assert set(re.findall(r'"(\w+)"', words)) == set(Reason) - NOT_TOLD


def test_json_says_how_far_probabilities_hold():
    document = json.loads(RESULT.to_json())
    assert document["alternatives"][0]["probability"] == 0.008
    assert (document["probability_none"], document["calibrated"]) == (0.002, True)
    by_paper = dataclasses.replace(RESULT, settings={"preset": "paper"})
    assert not json.loads(by_paper.to_json())["calibrated"]


@pytest.mark.parametrize("status", ["ambiguous", "not_localized"])
def test_a_pose_that_is_not_sure_is_a_best_guess_only(status):
    unsure = dataclasses.replace(RESULT, status=status)
    document = json.loads(unsure.to_json())
    assert all(document[name] is None for name in document["best_guess"])
    np.testing.assert_array_equal(document["best_guess"]["center_world"], POSE.center_world)
    back = Result.from_json(unsure.to_json())
    assert back.pose is None
    assert (back.best_guess.center_world == POSE.center_world).all()
    assert (RESULT.pose, RESULT.best_guess) == (POSE, None)


def test_unreadable_photo_has_a_reason_and_nothing_else():
    result = unreadable_result("b.jpg: is empty", "a.ply", "b.jpg", settings={}, source=Source("0" * 64))
    assert Result.from_json(result.to_json()) == result
    assert result.summary() == "b.jpg: unreadable\n  b.jpg: is empty"


def test_any_name_that_a_file_may_have_comes_back_from_ascii(tmp_path):
    names = ["a\nb\t.jpg", os.fsdecode(b"caf\xe9.jpg"), "\u2028\x7f.jpg", "x" * 5000, "nul\0.jpg"]
    text = "".join(f"{dataclasses.replace(RESULT, pano=name).to_json()}\n" for name in names)
    file = tmp_path / "poses.jsonl"
    file.write_text(text, "ascii")
    assert [os.fsencode(result.pano) for result in read_results([file])] == [os.fsencode(n) for n in names]
    for name, text in (("half a character \ud83d", "wanted a file's name as"), (7, "Expected str, got int")):
        file.write_text(json.dumps(json.loads(RESULT.to_json()) | {"pano": name}))
        assert_input_error(text, read_results, [file])


def test_result_without_a_pose_or_with_nan():
    none = dataclasses.replace(RESULT, loss=None, evidence=None, **WITHOUT_ARRAYS)
    assert json.loads(none.to_json())["T_world_from_cam"] is None
    assert Result.from_json(none.to_json()).pose is None
    with pytest.raises(ValueError, match="not JSON compliant"):
        dataclasses.replace(RESULT, loss=float("nan")).to_json()


def test_a_notebook_shows_status_pose_and_confidence():
    shown = dataclasses.replace(RESULT, pano="a<b>.jpg", warnings=("one",))._repr_html_()
    x, y, z = RESULT.best_pose.center_world
    place = f"({x:.3f}, {y:.3f}, {z:.3f}) m"
    for text in ("a&lt;b&gt;.jpg", RESULT.status, f"{RESULT.confidence:.3f}", place, "one"):
        assert f"<td>{text}" in shown
    none = dataclasses.replace(RESULT, error="a.jpg: no such file", **WITHOUT_ARRAYS)
    assert "<th>error</th><td>a.jpg: no such file</td>" in none._repr_html_()
    assert "heading" not in none._repr_html_()


def test_several_files_of_a_cloud_are_a_list():
    several = dataclasses.replace(RESULT, cloud=("b.ply", "a.ply"), **WITHOUT_ARRAYS)
    assert json.loads(several.to_json())["cloud"] == ["b.ply", "a.ply"]
    assert Result.from_json(several.to_json()) == several
    for cloud in (7, ["a", 7], None):
        document = json.loads(several.to_json()) | {"cloud": cloud}
        assert_input_error(r"at .*cloud", Result.from_json, json.dumps(document))


@pytest.mark.parametrize("text", ["{", "[]", "{}", *(f'{{"format": "piccolo-pose/{k}"}}' for k in (3, 10))])
def test_other_text_is_refused(text):
    assert_input_error("piccolo-pose/13", Result.from_json, text)
