"""The numbers of the method: each is read, handed on from the settings, and repeated by results."""

import ast
import json
import math
from dataclasses import fields, replace
from pathlib import Path

import pytest
import rooms
from made_up import WHOLE, make_candidate, make_selection

from piccolo.batch.results_file import describe_changes
from piccolo.judge.selection import is_clear, is_sure
from piccolo.problem.method import METHOD, Method
from piccolo.problem.settings import CoarseToFineSettings
from piccolo.system.errors import InputError

TIER = "scene"

PICCOLO = Path(__file__).resolve().parents[1] / "piccolo"
NAMES = [field.name for field in fields(Method)]


def test_every_number_is_read():
    trees = [ast.parse(path.read_text()) for path in PICCOLO.rglob("*.py")]
    read = {node.attr for tree in trees for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    assert set(NAMES) <= read


def test_results_repeat_the_numbers():
    told = json.loads(json.dumps(CoarseToFineSettings(method=replace(METHOD, sure_odds=3.6)).to_json()))
    assert list(told["method"]) == NAMES
    assert Method(**told["method"]) == replace(METHOD, sure_odds=3.6)


def test_they_are_handed_on_from_the_settings():
    method = replace(METHOD, first_starts=77, clear_margin=0.3)
    settings = CoarseToFineSettings(method=method)
    assert settings.effort.brief().max_starts == 77
    _, panorama, _ = rooms.scene(1)
    problem = rooms.ask(panorama, rooms.scan_map(1), settings)
    for one in (problem, problem.by_views(), problem.mirror(), problem.retake(panorama)):
        assert one.method == one.profile.method == method


@pytest.mark.parametrize(("margin", "expected"), [(0.5, False), (0.3, True)])
def test_a_number_decides(margin, expected):
    profile = replace(WHOLE, method=replace(METHOD, clear_margin=margin))
    found = make_selection(make_candidate(0.0, 0.5, 20), rival_ratio=0.6)
    assert is_clear(profile, found) == expected
    assert is_sure(profile, found)
    assert not is_sure(replace(WHOLE, method=replace(METHOD, sure_matches=21)), found)


def test_an_angle_has_the_cosine_by_which_matches_agree():
    assert METHOD.cos_agree == math.cos(math.radians(0.5))


def test_a_number_of_a_wrong_type_is_refused():
    with pytest.raises(InputError, match=r"`?sure_matches`?: found '12'"):
        Method(sure_matches="12")


def test_another_number_is_told_of_a_file_that_goes_on():
    before, after = ({"method": {"sure_odds": value, "near_score": 0.6}} for value in (3.0, 3.6))
    assert describe_changes(before, after) == "with sure_odds 3, now sure_odds 3.6"
