"""Photos of one camera, each found by itself: what the sure ones say of the others."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
from made_up import PROBLEM, make_candidate, make_selection, place

from piccolo.evidence.focal_length import FocalFit
from piccolo.judge.belief import make_belief
from piccolo.judge.candidate import Selection
from piccolo.judge.reasons import Reason
from piccolo.judge.result import Result
from piccolo.localization.judging import Found
from piccolo.problem.settings import CoarseToFineSettings
from piccolo.system.jobs.threads import Stopwatch, Workers
from piccolo.together import members
from piccolo.together.members import Member, Shot

TIER = "pure"

SURE = Result(belief=make_belief([0.99]), status="localized")
REFUSED = Result(belief=make_belief([0.95]).rule_out(Reason.CALIBRATION))
FIT = FocalFit(None, None, None, None, conflict=5.0)


def _shot(name):
    """A photo of a camera, of which nothing but its picture's width is known."""
    camera = SimpleNamespace(width=len(name), height=1)
    panorama = SimpleNamespace(
        focal_prior=SimpleNamespace(source=name, focal=500.0), cameras=[SimpleNamespace(camera=camera)]
    )
    return Shot(panorama, CoarseToFineSettings())


def _find(monkeypatch, results, cameras):
    """Photos with these results by themselves, and how the contradicting ones are judged."""
    given = dict(enumerate(results))
    asked = []

    def find_alone(scan_map, shot, workers, watch, before):
        number = len(asked)
        asked.append(shot)
        found = Found(replace(PROBLEM), Selection(make_candidate(0.0, 0.5), ()), FIT)
        return Member(found, given[number])

    def judge(found, means, demand, may_promote):
        return replace(SURE, warnings=(f"conflict {found.fit.conflict:g}",))

    monkeypatch.setattr(members, "find_alone", find_alone)
    monkeypatch.setattr(members, "judge", judge)
    monkeypatch.setattr(members, "expect_focal", lambda panoramas, alone: {})
    monkeypatch.setattr(Found, "forget", lambda self: self)
    shots = [_shot(camera) for camera in cameras]
    return members.find_members(None, shots, Workers(1), Stopwatch())


@pytest.mark.parametrize("num_sure", [2, 3])
def test_one_photo_does_not_contradict_what_enough_others_say_of_their_camera(monkeypatch, num_sure):
    alone, found, asked = _find(monkeypatch, [*[SURE] * num_sure, REFUSED], ["phone"] * (num_sure + 1))
    is_confirmed = num_sure == 3
    assert [shot.is_confirmed for shot in asked] == [is_confirmed] * (num_sure + 1)
    assert alone[-1] == found[num_sure].alone
    assert alone[-1].warnings == (("conflict 0",) if is_confirmed else ())
    assert alone[:-1] == [SURE] * num_sure


def test_photos_of_another_camera_say_nothing_of_it(monkeypatch):
    alone, _, asked = _find(monkeypatch, [SURE, SURE, SURE, REFUSED], ["a", "a", "a", "bb"])
    assert alone[-1] is REFUSED
    assert [shot.is_confirmed for shot in asked] == [True, True, True, False]


@pytest.mark.parametrize(("focal", "is_searched"), [(505.0, False), (480.0, False), (530.0, True)])
def test_a_photo_is_searched_again_only_with_another_focal_length(monkeypatch, focal, is_searched):
    """With about the same one, the poses that were found are refined."""
    poses = make_selection(make_candidate(0.0, 0.5), make_candidate(2.0, 0.4))
    before = Member(Found(_with_focal(500.0), poses, None), SURE)
    done = []

    def search(problem, scan_map, means):
        done.append("searched")
        return before.found

    def refine_known(problem, poses, means):
        done.append([place(pose) for pose in poses])
        return before.found

    monkeypatch.setattr(Found, "forget", lambda self: self)
    monkeypatch.setattr(members, "prepare_search", lambda *_: PROBLEM)
    monkeypatch.setattr(members, "find", search)
    monkeypatch.setattr(members, "refine_known", refine_known)
    monkeypatch.setattr(members, "judge", lambda *_, **__: SURE)
    shot = Shot(_with_focal(focal).given, CoarseToFineSettings())
    found = members.find_alone(None, shot, Workers(1), Stopwatch(), before)
    assert done == (["searched"] if is_searched else [[0.0, 2.0]])
    assert found == before


def _with_focal(focal):
    """A problem of a photo with a focal length."""
    camera = SimpleNamespace(focal=(focal, focal))
    given = SimpleNamespace(focal_prior=None, cameras=[SimpleNamespace(camera=camera)])
    return replace(PROBLEM, given=given)


def test_other_reasons_against_a_photo_stay(monkeypatch):
    mirrored = Result(belief=make_belief([0.95]).rule_out(Reason.MIRRORED))
    alone, _, _ = _find(monkeypatch, [SURE, SURE, SURE, mirrored], ["a"] * 4)
    assert alone[-1] is mirrored
