"""Which photos whole views alone are enough for, how much search others need, and what the result says."""

from dataclasses import replace

import numpy as np
import pytest
import rooms
from made_up import PARTIAL, QUERY, TILTED_PARTIAL, TILTED_WHOLE, WHOLE, at, compared, place, places
from piccolo.localization.photo import ACROSS

from piccolo.confidence.confidence import LOCALIZED
from piccolo.evidence.verification import Verified
from piccolo.geometry.nearness import RIGHT
from piccolo.geometry.pose import exp_so3
from piccolo.jobs.threads import Stopwatch, Workers
from piccolo.judge.selection import is_clear
from piccolo.local_features.matching import NO_MATCHES
from piccolo.localization import attempts, beam, localize as method, query
from piccolo.localization.search import search_poses
from piccolo.panorama import GPano
from piccolo.photo import Prior
from piccolo.problem.settings import CoarseToFineSettings


def _localized(panorama, settings=rooms.KNOWN):
    return method.localize(rooms.scan_map(1), panorama, settings, Workers(1), Stopwatch())


def _query(panorama, settings=rooms.KNOWN):
    return rooms.ask(panorama, rooms.scan_map(1), settings)


def _turned_over(panorama):
    rgb, is_valid = (np.ascontiguousarray(image[:, ::-1]) for image in (panorama.rgb, panorama.is_valid))
    return replace(panorama, rgb=rgb, is_valid=is_valid)


def test_a_clear_photo_needs_no_features_and_the_result_says_so(monkeypatch):
    taken = rooms.query(1)
    monkeypatch.setattr(query, "match", lambda *_: pytest.fail("features of a clear photo"))
    found = _localized(rooms.as_panorama(taken.rgb))
    assert found.status == LOCALIZED
    assert RIGHT.holds(found.pose, taken.pose)
    assert (found.evidence.num_matches, found.evidence.alternative_matches) == (None, None)
    assert {a.num_matches for a in found.alternatives} <= {None}
    assert found.confidence + found.probability_none + sum(a.probability for a in found.alternatives) == (
        pytest.approx(1.0)
    )


@pytest.mark.parametrize("how", ["mirrored", "gravity unknown", "part of a sphere"])
def test_features_are_asked_of_what_is_not_clear(how):
    panorama, settings = rooms.as_panorama(rooms.query(1).rgb), rooms.KNOWN
    if how == "mirrored":
        panorama = _turned_over(panorama)
    elif how == "gravity unknown":
        settings = rooms.UNKNOWN
    else:
        is_valid = panorama.is_valid.copy()
        is_valid[:, : is_valid.shape[1] // 3] = False
        panorama = replace(panorama, is_valid=is_valid)
    found = _localized(panorama, settings)
    assert isinstance(found.evidence.num_matches, int)
    assert (found.status == LOCALIZED) == (how != "mirrored")


@pytest.mark.parametrize(("score", "margin"), [(0.3, 0.51), (0.29, 0.51), (0.3, 0.49)])
def test_clear_are_score_and_margin(monkeypatch, score, margin):
    other = score * (1.0 - margin)
    asked = compared(monkeypatch, {0.0: score, 3.0: other}, {}).by_views()
    assert is_clear(asked, [at(0.0, score), at(3.0, other)]) == (score >= 0.3 and margin >= 0.5)


@pytest.mark.parametrize(
    ("is_clear", "own", "is_enough", "num_asked"),
    [(True, 0.55, True, 1), (True, 0.54, False, 1), (False, 0.9, False, 0)],
)
def test_of_a_clear_photo_the_mirrored_one_must_start_a_tenth_worse(
    monkeypatch, is_clear, own, is_enough, num_asked
):
    """It is searched only where the photo is clear."""
    asked = []
    monkeypatch.setattr(attempts, "search_poses", lambda query, gravity: None)
    monkeypatch.setattr(attempts, "refine_starts", lambda query, starts, beam: [at(3.0, 0.5)])
    monkeypatch.setattr(attempts, "is_clear", lambda query, found: is_clear)
    monkeypatch.setattr(attempts, "score_starts", lambda query, starts: own)
    monkeypatch.setattr(attempts, "score_mirror", lambda query: asked.append(query) or 0.5)
    found, is_done = attempts.look_first(QUERY, [at(0.0, 0.2)], Stopwatch())
    assert places(found) == [0.0, 3.0]
    assert (is_done, asked) == (is_enough, [QUERY] * num_asked)


def test_the_mirrored_query_is_that_of_the_mirrored_photo():
    """Its tilt is mirrored with it; where it heads, nothing is known."""
    panorama = rooms.as_panorama(rooms.query(1).rgb)
    asked = _query(panorama, replace(rooms.KNOWN, prior=Prior(heading_deg=30.0)))
    photo = replace(asked.photo, R_cam_from_level=exp_so3(np.array([0.0, 0.3, 0.0])))
    tilted = replace(asked, photo=photo)
    mirror = tilted.mirror()
    other = _query(_turned_over(panorama))
    for own, expected in zip(mirror.photo.images, other.photo.images, strict=True):
        levels = (image().rgbx.view(np.uint8).astype(int) for image in (own, expected))
        assert np.abs(np.subtract(*levels)).max() <= 1
    np.testing.assert_array_equal(mirror.photo.small.rgbx, other.photo.small.rgbx)
    np.testing.assert_array_equal(mirror.photo.panorama.is_valid, other.photo.panorama.is_valid)
    R = exp_so3(np.array([0.1, -0.2, 0.3]))
    (turned,) = tilted.with_rotations(R[None]).mirror().rotations
    np.testing.assert_allclose(turned, ACROSS @ R @ ACROSS)
    assert mirror.settings.prior == Prior()
    d = np.array([0.6, -0.2, 0.77])
    across = np.array([1.0, -1.0, 1.0])
    np.testing.assert_allclose(
        mirror.photo.R_cam_from_level @ (across * d), across * (tilted.photo.R_cam_from_level @ d), atol=1e-12
    )


def test_gravity_and_gps_alone_exclude_no_pose_that_is_searched_for(monkeypatch):
    monkeypatch.setattr(attempts, "search_poses", lambda *_: pytest.fail("a search beyond gravity"))
    told = replace(rooms.as_panorama(rooms.query(1).rgb), gpano=GPano(0.0, 0.0))
    asked = _query(told, replace(rooms.KNOWN, prior=Prior(use_gps=False)))
    assert attempts.search_beyond_prior(asked, rooms.scan_map(1), Stopwatch()) == []


def test_the_first_score_tells_a_photo_from_its_mirror():
    asked = _query(rooms.as_panorama(rooms.query(1).rgb))
    mirror = asked.mirror()
    own, other = (beam.score_starts(q, search_poses(q, "known")) for q in (asked, mirror))
    assert own > 1.5 * other > 0.0


BRIEF = {"num_rotations": 1000, "max_starts": 300}


@pytest.mark.parametrize(("gravity", "changes"), [("auto", BRIEF), ("unknown", {})])
def test_a_tilted_sphere_without_features_is_found_by_whole_views(monkeypatch, gravity, changes):
    """With the gravity `auto`, where the upright search came first, by a brief search."""
    made = []

    def searched(query, tilts):
        made.append((tilts, query.settings, len(query.scan_map.sparse)))
        return search_poses(query, tilts)

    monkeypatch.setattr(attempts, "search_poses", searched)
    monkeypatch.setattr(query, "match", lambda *_: NO_MATCHES)
    taken, settings = rooms.query(1, "tilt"), CoarseToFineSettings(gravity=gravity)
    found = _localized(rooms.as_panorama(taken.rgb), settings)
    assert RIGHT.holds(found.pose, taken.pose)
    how, asked, num_searched = made[-1]
    num_candidates = len(rooms.scan_map(1).sparse)
    assert (how, asked) == ("any", replace(settings, **changes))
    assert 0.3 < num_searched / num_candidates < 0.7 if changes else num_searched == num_candidates


def test_a_brief_search_keeps_what_little_a_prior_leaves():
    whole = rooms.scan_map(1)
    few = whole.narrow(np.arange(len(whole.sparse)) < 7)
    asked = _query(rooms.as_panorama(rooms.query(1).rgb))
    assert attempts.thin_query(replace(asked, scan_map=few)).scan_map.sparse.tolist() == few.sparse.tolist()
    assert 0.3 < len(attempts.thin_query(asked).scan_map.sparse) / len(whole.sparse) < 0.7


def _name_attempts(query):
    found = attempts.plan_attempts(query)
    return [(len(by.features), getattr(run, "__name__", None) or run.keywords) for by, run in found]


LOOK = (0, "look_first")
HALF = (1, "search_part")
ALL = (2, "search_matches")
DRAWN = (0, "draw_found")
FIRST_UPRIGHT = (0, {"tilts": "known"})
FIRST_TILTED = (0, {"tilts": "any", "is_brief": True})
UPRIGHT = (2, {"tilts": "known"})
ABOUT_LEVEL = (2, {"tilts": "level"})
TILTED = (2, {"tilts": "any", "is_brief": False})


@pytest.mark.parametrize(
    ("photo", "gravity", "expected"),
    [
        (WHOLE, "auto", [LOOK, DRAWN, FIRST_UPRIGHT, FIRST_TILTED, HALF, ALL]),
        (WHOLE, "known", [LOOK, DRAWN, FIRST_UPRIGHT, HALF, ALL]),
        (WHOLE, "unknown", [HALF, ALL, TILTED]),
        (TILTED_WHOLE, "auto", [LOOK, DRAWN, FIRST_UPRIGHT, FIRST_TILTED, HALF, ALL]),
        (PARTIAL, "auto", [HALF, ALL, ABOUT_LEVEL, TILTED]),
        (PARTIAL, "known", [HALF, ALL, ABOUT_LEVEL]),
        (PARTIAL, "unknown", [HALF, ALL, ABOUT_LEVEL, TILTED]),
        (TILTED_PARTIAL, "auto", [HALF, ALL, UPRIGHT, TILTED]),
        (TILTED_PARTIAL, "known", [HALF, ALL, UPRIGHT]),
    ],
)
def test_attempts_are_made_in_this_order(photo, gravity, expected):
    """Photos of a part of the sphere are searched about level, unless their tilt is known."""
    settings = CoarseToFineSettings(gravity=gravity)
    query = replace(QUERY, photo=photo, settings=settings)
    assert _name_attempts(query) == expected


@pytest.mark.parametrize(("photo", "upright"), [(WHOLE, "known"), (PARTIAL, "level")])
def test_without_features_of_the_map_whole_views_are_searched_alone(photo, upright):
    query = replace(QUERY, photo=photo, features=())
    assert _name_attempts(query) == [(0, {"tilts": upright}), (0, {"tilts": "any", "is_brief": False})]


@pytest.mark.parametrize(("sure", "num_made"), [(1, 1), (2, 2), (None, 3)])
def test_attempts_are_made_until_one_is_sure(monkeypatch, sure, num_made):
    """What is found adds up, and as many features are asked in the end as in the last attempt."""

    def run(query, hypotheses, watch):
        num = len(query.features)
        return [*hypotheses, at(num, 0.5)], num == sure

    def plan(query):
        return [(replace(query, features=query.features[:k]), run) for k in (1, 2, 0)]

    monkeypatch.setattr(method, "plan_attempts", plan)
    monkeypatch.setattr(method, "refine_best", lambda query, found: found)
    monkeypatch.setattr(method, "fit_camera", lambda query, found: method.Found(query, found, None))
    monkeypatch.setattr(method, "judge", lambda query, found, fit: (len(query.features), found))
    how = rooms.AUTO, Workers(1), Stopwatch()
    num_parts, found = method.localize(rooms.scan_map(1), rooms.scene(1)[1], *how)
    assert places(found) == [1, 2, 0][:num_made]
    assert num_parts == places(found)[-1]


@pytest.mark.parametrize(
    ("num_parts", "num_matches", "is_sure", "kept"),
    [
        (1, 40, True, [9, 1]),
        (1, 39, True, [9]),
        (1, 40, False, [9]),
        (1, None, True, [9]),
        (2, 39, False, [9, 2]),
        (2, 5, True, [9, 2]),
    ],
)
def test_half_of_the_features_count_where_these_leave_no_doubt(
    monkeypatch, num_parts, num_matches, is_sure, kept
):
    """As many matches as a clear whole view is worth, and no pose of the first look near it."""
    looked = at(9, 0.2)
    monkeypatch.setattr(attempts, "match_poses", lambda query, watch: [] if num_matches is None else ["pose"])
    monkeypatch.setattr(attempts, "count_matches", lambda matches, pose: num_matches)
    monkeypatch.setattr(attempts, "is_sure", lambda query, found: found[0] is looked and is_sure)
    monkeypatch.setattr(attempts, "refine_matches", lambda query, poses: [at(num_parts, 0.5)])
    search = attempts.search_part if num_parts == 1 else attempts.search_matches
    found, is_enough = search(QUERY, [looked], Stopwatch())
    assert places(found) == kept
    assert is_enough == (is_sure and len(kept) == 2)


@pytest.mark.parametrize(
    ("photo", "expected"),
    [(PARTIAL, [*range(10), 1.5]), (TILTED_PARTIAL, [*range(10), 1.5]), (WHOLE, range(10))],
)
def test_poses_of_a_part_of_the_sphere_are_verified(monkeypatch, photo, expected):
    """The best and eight alternatives; what matches more than chance does is added, scored where it went."""
    num_matches = {0.0: 6, 1.0: 7, 9.0: 99}
    asked = []
    scored = []

    def verify(query, pose):
        asked.append(place(pose))
        return Verified(at(place(pose) + 0.5, 0.0).pose, num_matches.get(place(pose), 0))

    monkeypatch.setattr(attempts, "verify", verify)
    monkeypatch.setattr(attempts, "score_pose", lambda _, pose: scored.append(place(pose)) or at(1.5, 0.7))
    known = [at(k, 0.9 - 0.05 * k) for k in range(10)]
    query = replace(QUERY, photo=photo)
    found = attempts.add_verified(query, known)
    assert places(found) == list(expected)
    assert found[:10] == known
    assert asked == (list(range(9)) if photo.is_partial else [])
    assert scored == ([1.5] if photo.is_partial else [])
    assert attempts.add_verified(query, []) == []
