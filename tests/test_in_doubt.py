"""How much search a photo needs, each in a made-up case where one rule decides."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
import rooms
from made_up import QUERY, at, compared, places

from piccolo.confidence.alternatives import Hypothesis
from piccolo.jobs.stopwatch import Stopwatch
from piccolo.jobs.threads import Workers
from piccolo.localization import localize as method
from piccolo.localization.config import METHOD
from piccolo.localization.settings import CoarseToFineSettings


def _run(monkeypatch, matched, searches, gravity="auto", config=METHOD):
    """Localize with made-up poses from matches and from searches; the searches made, what is evaluated.

    A score in hundredths is also how many features agree, and what a pose explains.
    """
    made, left = [], list(searches)
    scan_map = SimpleNamespace(sparse=np.zeros(1))
    scores = {h.pose.center_world[0]: h.score for some in (matched, *searches) for h in some}

    def search_poses(query, gravity):
        made.append(gravity)
        return gravity

    monkeypatch.setattr(method, "apply_prior", lambda *_: scan_map)
    settings = CoarseToFineSettings(gravity=gravity)
    own = {"matches": None, "settings": settings, "colors": None, "soon_needed": list}
    query = SimpleNamespace(**vars(QUERY) | own)
    query.method = config
    monkeypatch.setattr(method, "prepare_query", lambda *_: query)
    monkeypatch.setattr(method, "first_query", lambda query: query)
    monkeypatch.setattr(method, "is_whole", lambda query: False)
    monkeypatch.setattr(method, "matched", lambda query, found: (query, [*found, *matched]))
    compared(monkeypatch, scores, {x: 100 * score for x, score in scores.items()})
    monkeypatch.setattr(method, "search_poses", search_poses)
    monkeypatch.setattr(method, "refine", lambda query, starts, beam: left.pop(0))
    monkeypatch.setattr(method, "refine_full_resolution", lambda query, h, num_rounds: h)
    monkeypatch.setattr(method, "refine_unoccluded", lambda query, h: (query, h))
    monkeypatch.setattr(method, "settle", lambda query, h: Hypothesis(h.pose, h.score + 0.001))
    monkeypatch.setattr(method, "evaluate", lambda query, panorama, found: found)
    found = method.localize(None, rooms.scene(1)[1], settings, Workers(1), Stopwatch(), config)
    return made, found


@pytest.mark.parametrize(
    ("matched", "searches", "gravity", "num_made", "best"),
    [
        ([at(1, 0.6)], [], "auto", 0, 1),
        ([], [[at(1, 0.6)]], "auto", 1, 1),
        ([at(1, 0.1)], [[at(2, 0.6)]], "auto", 1, 2),  # too few matches
        ([at(1, 0.6), at(5, 0.4)], [[at(7, 0.1)], [at(7, 0.1)]], "auto", 2, 1),  # two that are alike
        ([at(1, 0.1)], [[at(2, 0.11)], [at(3, 0.09)]], "auto", 2, 2),
        ([], [[at(2, 0.1)]], "known", 1, 2),
        ([at(1, 0.08)], [[at(2, 0.05)]], "unknown", 1, 1),
    ],
)
def test_searches_are_made_where_matches_leave_doubt(monkeypatch, matched, searches, gravity, num_made, best):
    made, found = _run(monkeypatch, matched, searches, gravity)
    assert made == [way for way in ("known", "unknown") if gravity in ("auto", way)][:num_made]
    assert found.best.pose.center_world[0] == best
    assert found.best.score in {h.score + 0.001 for some in (matched, *searches) for h in some}  # settled


def test_matches_or_searches_can_be_taken_out(monkeypatch):
    alone = METHOD._replace(uses_features=False)
    made, found = _run(monkeypatch, [at(1, 0.6)], [[at(2, 0.1)], [at(2, 0.1)]], config=alone)
    assert (made, places([found.best])) == (["known", "unknown"], [2])
    made, found = _run(monkeypatch, [at(1, 0.1)], [], config=METHOD._replace(uses_search=False))
    assert (made, places([found.best])) == ([], [1])


@dataclass(frozen=True)
class Asked:
    """A query of which only the halves of its features count."""

    num_halves: int = 2

    @property
    def matches(self):
        return self.num_halves


@pytest.mark.parametrize(
    ("num_matches", "is_sure", "halves"),
    [(40, True, 1), (39, True, 2), (40, False, 2), (None, True, 2)],
)
def test_half_of_the_features_are_asked_where_these_leave_no_doubt(monkeypatch, num_matches, is_sure, halves):
    """As many matches as a clear whole view is worth, and no pose of the first look near it."""
    looked, asked = at(9, 0.2), []

    def poses(query):
        asked.append(query.num_halves)
        return [] if num_matches is None else [f"poses of {query.num_halves}"]

    def sure(query, found):
        assert found[0] is looked
        return is_sure

    monkeypatch.setattr(method, "matched_poses", poses)
    monkeypatch.setattr(method, "count_matches", lambda matches, pose: num_matches)
    monkeypatch.setattr(method, "is_sure", sure)
    monkeypatch.setattr(method, "refine_matched", lambda query, poses: [at(query.num_halves, 0.5)])
    query, found = method.matched(Asked(), [looked])
    assert query == Asked(halves)
    assert places(found) == [9, halves]
    assert asked == [1, 2][:halves]
