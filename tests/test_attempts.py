"""Which photos whole views alone are enough for, how much search others need, and what the result says."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import rooms
from made_up import (
    PARTIAL,
    PROBLEM,
    WHOLE,
    WHOLE_SHAPE,
    drawn_at,
    exact_matches,
    make_candidate,
    make_selection,
    places,
)

from piccolo.evidence.examine import examine
from piccolo.geometry.nearness import RIGHT
from piccolo.geometry.pose import Pose, exp_so3, step
from piccolo.judge.probability import LOCALIZED, NOT_LOCALIZED
from piccolo.judge.reasons import MIRRORED, Reason
from piccolo.judge.selection import is_clear
from piccolo.local_features.matching import NO_MATCHES
from piccolo.localization import attempts, beam, run as method
from piccolo.localization.attempts import FIRST_BEAM
from piccolo.localization.means import NO_TRACE
from piccolo.localization.search import search_poses
from piccolo.photo.panorama import GPano, Panorama
from piccolo.photo.photo import Prior
from piccolo.problem.method import METHOD
from piccolo.problem.photo_images import MIRROR
from piccolo.problem.settings import CoarseToFineSettings, Effort
from piccolo.scan_map.drawn_places import DrawnPlaces
from piccolo.system.jobs.threads import Workers
from research.synthetic.world import mask_outside_field

TIER = "scene"

EFFORT = rooms.KNOWN.effort


def _localized(panorama, settings=rooms.KNOWN, scan_map=None):
    return method.localize(
        scan_map or rooms.scan_map(1), panorama, settings, rooms.means(settings, Workers(1))
    )


def _problem(panorama, settings=rooms.KNOWN):
    return rooms.ask(panorama, rooms.scan_map(1), settings)


def _turned_over(panorama):
    rgb, is_valid = (np.ascontiguousarray(image[:, ::-1]) for image in (panorama.rgb, panorama.is_valid))
    return replace(panorama, rgb=rgb, is_valid=is_valid)


def test_a_clear_photo_needs_no_features_and_the_result_says_so():
    taken = rooms.query(1)
    found = _localized(rooms.as_panorama(taken.rgb), scan_map=replace(rooms.scan_map(1), places=None))
    assert found.status == LOCALIZED
    assert RIGHT.holds(found.pose, taken.pose)
    assert (found.evidence.num_matches, found.evidence.alternative_matches) == (None, None)
    assert {a.num_matches for a in found.alternatives} <= {None}
    assert found.confidence + found.probability_none + sum(a.probability for a in found.alternatives) == (
        pytest.approx(1.0)
    )


@pytest.mark.parametrize("how", ["gravity unknown", "part of a sphere"])
def test_features_are_asked_of_what_is_not_clear(how):
    panorama = rooms.as_panorama(rooms.query(1).rgb)
    settings = rooms.KNOWN
    if how == "gravity unknown":
        settings = rooms.UNKNOWN
    else:
        is_valid = panorama.is_valid.copy()
        is_valid[:, : is_valid.shape[1] // 3] = False
        panorama = replace(panorama, is_valid=is_valid)
    found = _localized(panorama, settings)
    assert isinstance(found.evidence.num_matches, int)
    assert found.status == LOCALIZED


def test_a_photo_that_was_turned_over_is_searched_no_further():
    turned = _turned_over(rooms.as_panorama(rooms.query(1).rgb))
    found = _localized(turned, scan_map=replace(rooms.scan_map(1), places=None))
    assert (found.status, found.warnings, found.best_pose) == (NOT_LOCALIZED, (MIRRORED,), None)
    assert found.belief.ruled_out == {Reason.MIRRORED}


@pytest.mark.parametrize("is_turned", [False, True])
def test_a_mirrored_photo_must_explain_more_to_end_the_search(is_turned):
    panorama = rooms.as_panorama(rooms.query(1).rgb)
    problem = _problem(_turned_over(panorama) if is_turned else panorama).by_views().mirror()
    means = rooms.means(rooms.KNOWN)
    brief = means._replace(effort=means.effort.brief())
    best = max(one.score for one in attempts.search_and_refine(problem, "known", FIRST_BEAM, brief))
    for factor in (0.999, 1.001):
        known = [make_candidate(0.0, factor * best / METHOD.turned_over_ratio)]
        found, is_done = attempts.look_mirrored(problem, known, means)
        assert found is known
        assert is_done == (is_turned and factor < 1.0)
    assert attempts.was_turned_over(METHOD, 0.43, 0.5)
    assert not attempts.was_turned_over(METHOD, 0.1, 0.49)


@pytest.mark.parametrize(("score", "margin"), [(0.3, 0.51), (0.29, 0.51), (0.3, 0.49)])
def test_clear_are_score_and_margin(score, margin):
    found = make_selection(make_candidate(0.0, score), make_candidate(3.0, score * (1.0 - margin)))
    assert is_clear(WHOLE.by_views(), found) == (score >= 0.3 and margin >= 0.5)


@pytest.mark.parametrize("is_turned", [False, True])
def test_of_a_clear_photo_the_mirrored_one_must_start_a_tenth_worse(is_turned):
    """It is searched only where the photo is clear."""
    panorama = rooms.as_panorama(rooms.query(1).rgb)
    problem = _problem(_turned_over(panorama) if is_turned else panorama).by_views()
    workers, asked = rooms.listen()
    known = [examine(problem, step(rooms.scene(1)[2], np.array([0, 0, 2.0, 1.0, 0, 0])))]
    found, is_done = attempts.look_first(problem, known, rooms.means(rooms.KNOWN, workers))
    assert found[0] is known[0]
    assert len(found) > 1
    assert is_done == (not is_turned)
    once, own = rooms.listen()
    search_poses(problem, "known", EFFORT.brief(), once)
    searched, by_one = ([label for label, _ in done].count("search") for done in (asked, own))
    assert searched == (1 if is_turned else 2) * by_one
    assert attempts.beats_mirror(METHOD, 0.55, 0.5)
    assert not attempts.beats_mirror(METHOD, 0.54, 0.5)


def test_the_mirrored_problem_is_that_of_the_mirrored_photo():
    """Its tilt is mirrored with it; where it heads, nothing is known."""
    panorama = rooms.as_panorama(rooms.query(1).rgb)
    asked = replace(_problem(panorama), prior=Prior(heading_deg=30.0))
    photo = replace(asked.photo, R_cam_from_level=exp_so3(np.array([0.0, 0.3, 0.0])))
    tilted = replace(asked, photo=photo)
    mirror = tilted.mirror()
    other = _problem(_turned_over(panorama))
    for own, expected in zip(mirror.photo.images, other.photo.images, strict=True):
        levels = (image().rgbx.view(np.uint8).astype(int) for image in (own, expected))
        assert np.abs(np.subtract(*levels)).max() <= 1
    np.testing.assert_array_equal(mirror.photo.small.rgbx, other.photo.small.rgbx)
    np.testing.assert_array_equal(mirror.photo.panorama.is_valid, other.photo.panorama.is_valid)
    R = exp_so3(np.array([0.1, -0.2, 0.3]))
    (turned,) = replace(tilted, rotations=R[None]).mirror().rotations
    np.testing.assert_allclose(turned, MIRROR @ R @ MIRROR)
    assert mirror.prior == Prior()
    d = np.array([0.6, -0.2, 0.77])
    across = np.array([1.0, -1.0, 1.0])
    np.testing.assert_allclose(
        mirror.photo.R_cam_from_level @ (across * d), across * (tilted.photo.R_cam_from_level @ d), atol=1e-12
    )


def test_gravity_and_gps_alone_exclude_no_pose_that_is_searched_for():
    told = replace(rooms.as_panorama(rooms.query(1).rgb), gpano=GPano(0.0, 0.0))
    asked = _problem(told, replace(rooms.KNOWN, prior=Prior(use_gps=False)))
    workers, done = rooms.listen()
    assert attempts.search_beyond_prior(asked, rooms.scan_map(1), rooms.means(workers=workers)) == []
    assert done == []


def test_the_first_score_tells_a_photo_from_its_mirror():
    asked = _problem(rooms.as_panorama(rooms.query(1).rgb))
    scores = []
    for one in (asked, asked.mirror()):
        starts = search_poses(one, "known", EFFORT, rooms.WORKERS)
        scores.append(beam.score_starts(one, starts, rooms.WORKERS))
    own, other = scores
    assert own > 1.5 * other > 0.0


@pytest.mark.parametrize(("gravity", "is_brief"), [("auto", True), ("unknown", False)])
def test_a_tilted_sphere_without_features_is_found_by_whole_views(gravity, is_brief):
    """With the gravity `auto`, where the upright search came first, by a brief search."""
    taken = rooms.query(1, "tilt")
    problem = _problem(rooms.as_panorama(taken.rgb), CoarseToFineSettings(gravity=gravity))
    means = rooms.means()
    nowhere = DrawnPlaces(rooms.scan_map(1).octree, np.empty((0, 3)))
    problem = replace(problem, scan_map=replace(problem.scan_map, places=nowhere))
    found = method.find(problem, rooms.scan_map(1), means)
    pose = found.problem.scan_map.to_world(found.selection.best.pose)
    assert RIGHT.holds(pose, taken.pose)
    last = [made for made in means.trace.steps if made["step"] == "attempt"][-1]
    assert last["options"] == {"tilts": "any", "is_brief": is_brief}
    assert last["is_enough"]


def test_a_brief_search_keeps_what_little_a_prior_leaves():
    whole = rooms.scan_map(1)
    few = whole.narrow(np.arange(len(whole.sparse)) < 7)
    asked = _problem(rooms.as_panorama(rooms.query(1).rgb))
    assert attempts.thin_out(replace(asked, scan_map=few)).scan_map.sparse.tolist() == few.sparse.tolist()
    assert 0.3 < len(attempts.thin_out(asked).scan_map.sparse) / len(whole.sparse) < 0.7
    assert attempts.thin_effort(rooms.AUTO.effort) == Effort(48, 1000, 300)


def _list_attempts(problem):
    planned = attempts.plan_attempts(problem)
    return [
        (by.profile.uses_matches, run.func, run.keywords)
        if isinstance(run, partial)
        else (by.profile.uses_matches, run)
        for by, run in planned
        if by.is_mirrored == (run is attempts.look_mirrored)
    ]


LOOK = (False, attempts.look_first)
TURNED = (False, attempts.look_mirrored)
DRAWN = (True, attempts.draw_found)
PLACES = (True, attempts.search_features)
FIRST_UPRIGHT = (True, attempts.search_views, {"tilts": "known"})
FIRST_TILTED = (True, attempts.search_views, {"tilts": "any", "is_brief": True})
TILTED = (True, attempts.search_views, {"tilts": "any", "is_brief": False})
UPRIGHT = [(True, run, {"tilts": "known"}) for run in (attempts.search_briefly, attempts.search_views)]
ABOUT_LEVEL = [(True, run, {"tilts": "level"}) for run in (attempts.search_briefly, attempts.search_views)]


@pytest.mark.parametrize(
    ("profile", "has_tilt", "gravity", "expected"),
    [
        (WHOLE, False, "auto", [LOOK, TURNED, DRAWN, FIRST_UPRIGHT, FIRST_TILTED, PLACES]),
        (WHOLE, False, "known", [LOOK, TURNED, DRAWN, FIRST_UPRIGHT, PLACES]),
        (WHOLE, False, "unknown", [PLACES, TILTED]),
        (WHOLE, True, "auto", [LOOK, TURNED, DRAWN, FIRST_UPRIGHT, FIRST_TILTED, PLACES]),
        (PARTIAL, False, "auto", [*ABOUT_LEVEL, TILTED, PLACES]),
        (PARTIAL, False, "known", [*ABOUT_LEVEL, PLACES]),
        (PARTIAL, False, "unknown", [PLACES, *ABOUT_LEVEL, TILTED]),
        (PARTIAL, True, "auto", [*UPRIGHT, TILTED, PLACES]),
        (PARTIAL, True, "known", [*UPRIGHT, PLACES]),
    ],
)
def test_attempts_are_made_in_this_order(profile, has_tilt, gravity, expected):
    """Photos of a part of the sphere are searched about level, unless their tilt is known.

    The scan is drawn at its places last unless the tilt may be any: that takes long the first time.
    """
    photo = SimpleNamespace(has_tilt=has_tilt, mirror=lambda: None)
    assert _list_attempts(replace(PROBLEM, profile=profile, photo=photo, gravity=gravity)) == expected


def test_without_colours_whole_views_are_searched_alone():
    problem = replace(PROBLEM, profile=WHOLE_SHAPE)
    assert [run[1] for run in _list_attempts(problem)] == [attempts.search_views, attempts.search_views]


@pytest.mark.parametrize(("sure", "num_made"), [(1, 1), (2, 2), (None, 3)])
def test_attempts_are_made_until_one_is_sure(sure, num_made):
    """What is found adds up, by the evidence of the last attempt in the end."""

    def run(problem, known, means):
        num = len(problem.beside)
        return [*known, make_candidate(num, 0.5)], num == sure

    planned = [(replace(PROBLEM, beside=(NO_MATCHES,) * k), run) for k in (1, 2, 0)]
    asked, found = method.make_attempts(planned, rooms.means()._replace(trace=NO_TRACE))
    assert places(found) == [1, 2, 0][:num_made]
    assert len(asked.beside) == places(found)[-1]


@pytest.mark.parametrize(
    ("num_places", "place", "num_matches", "has_rival", "num_drawn", "is_sure"),
    [
        (2, 0, 40, False, 1, True),
        (2, 0, 39, False, 1, True),
        (3, 1, 40, False, 2, True),
        (3, 1, 39, False, 3, True),
        (2, 0, 40, True, 1, False),
        (2, 0, 3, False, 2, False),
        (1, 0, 39, True, 1, False),
        (1, 0, 39, False, 1, True),
    ],
)
def test_some_of_the_places_count_where_these_leave_no_doubt(
    num_places, place, num_matches, has_rival, num_drawn, is_sure, monkeypatch
):
    """The likely ones, or as many matches as a clear whole view is worth; no pose of the first look near."""
    true = rooms.scene(1)[2]
    exact = exact_matches(true, num_matches)
    monkeypatch.setattr(attempts, "PLACES_AT_ONCE", 1)
    monkeypatch.setattr(
        attempts, "match_located", lambda keypoints, picture: exact if picture == place else NO_MATCHES
    )
    problem = _problem(rooms.scene(1)[1], rooms.UNKNOWN)
    drawn = []
    pictures = SimpleNamespace(
        choose=lambda *_: np.arange(num_places), draw=lambda places, _: drawn.append(places) or places
    )
    problem = replace(problem, scan_map=replace(problem.scan_map, places=pictures))
    own = examine(problem, true)
    looked = replace(own, pose=step(true, np.array([0, 0, 1.5, 2.0, 0, 0])), score=0.9, num_matches=11)
    if has_rival:
        looked = replace(looked, num_matches=200)
    found, is_enough = attempts.search_features(problem, [looked], rooms.means())
    assert found[0].pose is looked.pose
    assert is_enough == is_sure
    assert drawn == [[0], [1], [2]][:num_drawn]
    assert len(found) == (1 if num_matches == 3 else 2)
    assert all(RIGHT.holds(h.pose, true) for h in found[1:])


@pytest.mark.parametrize("is_partial", [True, False])
def test_poses_of_a_part_of_the_sphere_are_verified(is_partial):
    """The best and eight alternatives; what matches more than chance does is added, scored where it went."""
    panorama = rooms.scene(1)[1]
    width = panorama.rgb.shape[1]
    narrow = Panorama(panorama.rgb, ~mask_outside_field(width, 70.0, 1.0))
    problem = _problem(narrow if is_partial else panorama)
    num_matches = {0: 6, 1: 7, 9: 99}
    known = []
    for k in range(10):
        candidate = make_candidate(float(k), 0.9 - 0.05 * k)
        moved = Pose(candidate.pose.R_cam_from_world, candidate.pose.center_world + np.array([0.1, 0.0, 0.0]))
        drawn = drawn_at(candidate.pose, exact_matches(moved, num_matches.get(k, 0)))
        known.append(replace(candidate, drawn=drawn))
    found = attempts.add_verified(problem, known, Workers(1))
    assert all(one.pose is before.pose for one, before in zip(found, known, strict=False))
    assert places(found[10:]) == pytest.approx([1.1] if is_partial else [], abs=1e-4)
    assert [h.score for h in found[10:]] == [examine(problem, h.pose).score for h in found[10:]]
    assert attempts.add_verified(problem, [], Workers(1)) == []
