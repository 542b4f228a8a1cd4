"""The first look: which photos whole views alone are enough for, and what the result then says."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rooms

from piccolo.confidence.alternatives import Hypothesis
from piccolo.confidence.confidence import LOCALIZED
from piccolo.geometry.pose import Pose, exp_so3, is_correct
from piccolo.jobs.once import Once
from piccolo.jobs.stopwatch import Stopwatch
from piccolo.jobs.threads import Workers
from piccolo.local_features.matching import NO_MATCHES
from piccolo.localization import first_look, query, refinement
from piccolo.localization import localize as method
from piccolo.localization.query import prepare_query
from piccolo.localization.search import search_poses
from piccolo.localization.search_result import SearchResult
from piccolo.localization.settings import CoarseToFineSettings
from piccolo.scan_map.prior import Prior

KNOWN = CoarseToFineSettings(gravity="known")


def _localized(panorama, settings=KNOWN):
    return method.localize(rooms.scan_map(1), panorama, settings, Workers(1), Stopwatch())


def _query(panorama, settings=KNOWN):
    return prepare_query(panorama, rooms.scan_map(1), settings, Workers(1))


def _turned_over(panorama):
    rgb, is_valid = (np.ascontiguousarray(image[:, ::-1]) for image in (panorama.rgb, panorama.is_valid))
    return replace(panorama, rgb=rgb, is_valid=is_valid)


def test_a_clear_photo_needs_no_features_and_the_result_says_so(monkeypatch):
    taken = rooms.query(1)
    monkeypatch.setattr(query, "match", lambda *_: pytest.fail("features of a clear photo"))
    found = _localized(rooms.as_panorama(taken.rgb))
    assert found.status == LOCALIZED
    assert is_correct(found.pose, taken.pose)
    assert (found.evidence.num_matches, found.evidence.alternative_matches) == (None, None)
    assert {a.num_matches for a in found.alternatives} <= {None}
    assert found.confidence + found.probability_none + sum(a.probability for a in found.alternatives) == (
        pytest.approx(1.0)
    )


@pytest.mark.parametrize("how", ["mirrored", "gravity unknown", "part of a sphere"])
def test_features_are_asked_of_what_is_not_clear(how):
    panorama, settings = rooms.as_panorama(rooms.query(1).rgb), KNOWN
    if how == "mirrored":
        panorama = _turned_over(panorama)
    elif how == "gravity unknown":
        settings = CoarseToFineSettings(gravity="unknown")
    else:
        is_valid = panorama.is_valid.copy()
        is_valid[:, : is_valid.shape[1] // 3] = False
        panorama = replace(panorama, is_valid=is_valid)
    found = _localized(panorama, settings)
    assert isinstance(found.evidence.num_matches, int)
    assert (found.status == LOCALIZED) == (how != "mirrored")


@pytest.mark.parametrize(
    ("score", "margin", "first", "mirrored", "is_clear"),
    [
        (0.3, 0.5, 0.221, 0.2, True),
        (0.29, 0.5, 0.22, 0.2, False),
        (0.3, 0.49, 0.22, 0.2, False),
        (0.3, 0.5, 0.21, 0.2, False),
    ],
)
def test_clear_are_score_margin_and_the_mirrored_photo(monkeypatch, score, margin, first, mirrored, is_clear):
    best = Hypothesis(Pose(np.eye(3), np.zeros(3)), score)
    other = Hypothesis(Pose(np.eye(3), np.ones(3)), score * (1.0 - margin))
    own, mirror = SimpleNamespace(), SimpleNamespace()
    monkeypatch.setattr(first_look, "fairly_selected", lambda query, found: found)
    monkeypatch.setattr(first_look, "found_among", lambda some, count: SearchResult(best, (other,)))
    monkeypatch.setattr(first_look, "mirrored", lambda query: mirror)
    monkeypatch.setattr(first_look, "search_poses", lambda query, gravity: "starts of its own")
    scores = {(id(own), "starts"): first, (id(mirror), "starts of its own"): mirrored}
    monkeypatch.setattr(first_look, "first_score", lambda query, starts: scores[id(query), starts])
    of_mirror = Once(lambda: first_look.mirror_score(own))
    assert first_look.is_clear(own, "starts", [best, other], of_mirror) == is_clear


def test_the_mirrored_query_is_that_of_the_mirrored_photo():
    """Its tilt is mirrored with it; where it heads, nothing is known."""
    panorama = rooms.as_panorama(rooms.query(1).rgb)
    asked = _query(panorama, replace(KNOWN, prior=Prior(heading_deg=30.0)))
    tilted = replace(asked, R_cam_from_level=exp_so3(np.array([0.0, 0.3, 0.0])))
    mirror = first_look.mirrored(tilted)
    other = _query(_turned_over(panorama))
    own, expected = (
        images.search.rgbx.view(np.uint8).astype(int) for images in (mirror.images, other.images)
    )
    assert np.abs(own - expected).max() <= 1  # level
    assert mirror.settings.prior == Prior()
    d = np.array([0.6, -0.2, 0.77])
    across = np.array([1.0, -1.0, 1.0])
    np.testing.assert_allclose(
        mirror.R_cam_from_level @ (across * d), across * (tilted.R_cam_from_level @ d), atol=1e-12
    )


def test_the_first_score_tells_a_photo_from_its_mirror():
    asked = _query(rooms.as_panorama(rooms.query(1).rgb))
    mirror = first_look.mirrored(asked)
    own, other = (refinement.first_score(q, search_poses(q, "known")) for q in (asked, mirror))
    assert own > 1.5 * other > 0.0


@pytest.mark.parametrize(
    ("gravity", "brief"),
    [("auto", {"num_rotations": 1000, "max_starts": 300}), ("unknown", {})],
)
def test_a_tilted_sphere_without_features_is_found_by_whole_views(monkeypatch, gravity, brief):
    """With the gravity `auto`, where the upright search came first, by a brief search."""
    made = []

    def searched(query, gravity):
        made.append((gravity, query.settings, len(query.scan_map.sparse)))
        return search_poses(query, gravity)

    monkeypatch.setattr(method, "search_poses", searched)
    monkeypatch.setattr(query, "match", lambda *_: NO_MATCHES)
    taken, settings = rooms.query(1, "tilt"), CoarseToFineSettings(gravity=gravity)
    found = _localized(rooms.as_panorama(taken.rgb), settings)
    assert is_correct(found.pose, taken.pose)
    how, asked, num_searched = made[-1]
    num_candidates = len(rooms.scan_map(1).sparse)
    assert (how, asked) == ("unknown", replace(settings, **brief))
    assert 0.3 < num_searched / num_candidates < 0.7 if brief else num_searched == num_candidates


def test_a_brief_search_keeps_what_little_a_prior_leaves():
    whole = rooms.scan_map(1)
    few = whole.narrowed(np.arange(len(whole.sparse)) < 7)
    asked = _query(rooms.as_panorama(rooms.query(1).rgb))
    assert (
        first_look.tilted_query(replace(asked, scan_map=few)).scan_map.sparse.tolist() == few.sparse.tolist()
    )
    assert 0.3 < len(first_look.tilted_query(asked).scan_map.sparse) / len(whole.sparse) < 0.7
