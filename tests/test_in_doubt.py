"""How much search a photo needs, each in a made-up case where one rule decides."""

from dataclasses import replace

import pytest
import rooms
from made_up import QUERY, at, places

from piccolo.jobs.stopwatch import Stopwatch
from piccolo.jobs.threads import Workers
from piccolo.localization import attempts
from piccolo.localization import localize as method
from piccolo.localization.settings import METHOD, CoarseToFineSettings

LOOK = ("look_first", 0, "known", False)
HALF = ("search_matches", 1, "known", False)
ALL = ("search_matches", 2, "known", False)
UPRIGHT = ("search_views", 2, "known", False)
TILTED = ("search_views", 2, "unknown", False)
BRIEFLY = ("search_views", 2, "unknown", True)


@pytest.mark.parametrize(
    ("is_whole", "gravity", "parts", "expected"),
    [
        (True, "auto", {}, [LOOK, HALF, ALL, UPRIGHT, BRIEFLY]),
        (True, "known", {}, [LOOK, HALF, ALL, UPRIGHT]),
        (False, "auto", {}, [HALF, ALL, UPRIGHT, TILTED]),
        (False, "unknown", {}, [HALF, ALL, TILTED]),
        (True, "auto", {"uses_features": False}, [UPRIGHT, TILTED]),
        (True, "auto", {"uses_search": False}, [HALF, ALL]),
    ],
)
def test_attempts_are_made_in_this_order(monkeypatch, is_whole, gravity, parts, expected):
    monkeypatch.setattr(attempts, "is_whole", lambda query: is_whole)
    settings = CoarseToFineSettings(gravity=gravity)
    found = attempts.attempts_for(replace(QUERY, method=METHOD._replace(**parts), settings=settings))
    assert [(attempt.run.__name__, *attempt[1:]) for attempt in found] == expected


@pytest.mark.parametrize(("sure", "num_made"), [(1, 1), (2, 2), (None, 3)])
def test_attempts_are_made_until_one_is_sure(monkeypatch, sure, num_made):
    """What is found adds up, and as many features are asked in the end as in the last attempt."""

    def run(query, attempt, hypotheses, watch):
        return [*hypotheses, at(query.num_halves, 0.5)], query.num_halves == sure

    made = [attempts.Attempt(run, k) for k in (1, 2, 0)]
    monkeypatch.setattr(method, "attempts_for", lambda query: made)
    monkeypatch.setattr(method, "refine_to_the_end", lambda query, found: found)
    monkeypatch.setattr(method, "evaluate", lambda query, found: (query.num_halves, found))
    how = CoarseToFineSettings(), Workers(1), Stopwatch()
    num_halves, found = method.localize(rooms.scan_map(1), rooms.scene(1)[1], *how)
    assert places(found) == [1, 2, 0][:num_made]
    assert num_halves == places(found)[-1]


@pytest.mark.parametrize(
    ("num_halves", "num_matches", "is_sure", "kept"),
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
    monkeypatch, num_halves, num_matches, is_sure, kept
):
    """As many matches as a clear whole view is worth, and no pose of the first look near it."""
    looked = at(9, 0.2)
    monkeypatch.setattr(attempts, "matched_poses", lambda query: [] if num_matches is None else ["pose"])
    monkeypatch.setattr(attempts, "count_matches", lambda matches, pose: num_matches)
    monkeypatch.setattr(attempts, "is_sure", lambda query, found: found[0] is looked and is_sure)
    monkeypatch.setattr(attempts, "refine_matches", lambda query, poses: [at(query.num_halves, 0.5)])
    attempt = attempts.Attempt(attempts.search_matches, num_halves)
    query = replace(QUERY, num_halves=num_halves)
    found, is_enough = attempts.search_matches(query, attempt, [looked], Stopwatch())
    assert places(found) == kept
    assert is_enough == (is_sure and len(kept) == 2)
