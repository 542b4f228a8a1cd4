"""Which pose is taken, each in a made-up case where one rule decides."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import rooms
from made_up import QUERY, at, compared, place, places

from piccolo.confidence.confidence import Standing
from piccolo.confidence.localization import Localization
from piccolo.evidence.comparison import score_pose
from piccolo.evidence.covariance import UNKNOWN_ERRORS
from piccolo.evidence.verification import count_agreeing
from piccolo.geometry.pose import step
from piccolo.judge import decide as judging, selection
from piccolo.judge.selection import Selection
from piccolo.localization import beam, last_descent
from piccolo.localization.last_descent import refine_best


def test_of_poses_that_matches_gave_the_better_end_is_taken(monkeypatch):
    query = compared(monkeypatch, {0.0: 0.3, 1.0: 0.5, 5.0: 0.6, 6.0: 0.2}, {})
    monkeypatch.setattr(beam, "refine", lambda query, pose, stage: at(place(pose) + 1.0, 0.9))
    found = beam.refine_matches(query, [at(0.0, 0).pose, at(5.0, 0).pose])
    assert places(found) == [5.0, 1.0]
    assert [h.score for h in found] == pytest.approx([0.6, 0.5])


@pytest.fixture
def done(monkeypatch):
    """What is done to poses on their last way, by their places; it changes nothing."""
    made = []

    def full(query, pose):
        made.append(("full", place(pose)))
        return at(place(pose), selection.compare(query, pose).score)

    def unoccluded(query, pose):
        made.append(("unoccluded", place(pose)))
        return query, at(place(pose), selection.compare(query, pose).score)

    monkeypatch.setattr(last_descent, "climb_to_full", full)
    monkeypatch.setattr(last_descent, "climb_unoccluded", unoccluded)
    monkeypatch.setattr(last_descent, "settle", lambda query, h: made.append(("settled", place(h.pose))) or h)
    return made


def test_alternatives_that_come_near_are_refined_and_the_greatest_odds_win(monkeypatch, done):
    """By score or by matches; the third explains more of what both show, though its score is less."""
    explains = {0.0: 0.5, 3.0: 0.4, 6.0: 0.6, 9.0: 0.1, 12.0: 0.05}
    query = compared(monkeypatch, explains, {0.0: 60, 3.0: 3, 6.0: 61, 9.0: 11, 12.0: 12})
    found = refine_best(query, [at(9.0, 0.1), at(0.0, 0.5), at(6.0, 0.31), at(3.0, 0.4), at(12.0, 0.05)])
    assert done == [*(("full", x) for x in (0.0, 3.0, 6.0, 12.0)), ("settled", 6.0)]
    assert places([found.best, *found.alternatives]) == [6.0, 0.0, 3.0, 9.0, 12.0]
    assert found.rival_ratio == pytest.approx(0.5 / 0.6)


@pytest.mark.parametrize(
    ("best", "num_matches", "gain", "num_refined"),
    [(0.09, 6, 0.0, 0), (0.09, 7, 0.0, 5), (0.1, 6, 0.0, 5), (0.09, 6, 0.02, 5)],
)
def test_of_a_faint_pose_no_alternative_is_refined_unless_it_gains(
    monkeypatch, done, best, num_matches, gain, num_refined
):
    explains = {3.0 * k: best - 0.001 * k for k in range(8)}
    hypotheses = [at(x, score) for x, score in explains.items()]
    query = compared(monkeypatch, explains | {0.0: best + gain}, dict.fromkeys(explains, num_matches))
    refine_best(query, hypotheses)
    assert [name for name, _ in done].count("full") == num_refined


@pytest.mark.parametrize(
    ("best", "num_matches", "expected"),
    [
        (0.5, 20, ["unoccluded", "settled"]),  # which refines it at full resolution
        (0.09, 7, ["unoccluded", "settled"]),
        (0.09, 6, ["unoccluded"]),  # never localized
        (0.019, 20, []),
    ],
)
def test_a_pose_without_rivals_is_refined_by_itself(monkeypatch, done, best, num_matches, expected):
    query = compared(monkeypatch, {0.0: best, 9.0: 0.1 * best}, {0.0: num_matches, 9.0: 0})
    found = refine_best(query, [at(0.0, best), at(9.0, 0.1 * best)])
    assert done == [(name, 0.0) for name in expected]
    assert places([found.best, *found.alternatives]) == [0.0, 9.0]


@pytest.mark.parametrize(
    ("explains", "matches", "best"),
    [
        ((0.5, 0.5), (20, 20), 0.0),  # by score
        ((0.5, 0.6), (20, 20), 3.0),  # by what both views show
        ((0.5, 0.5), (20, 60), 3.0),  # by matches
        ((0.5, 0.2), (20, 60), 0.0),
    ],
)
def test_the_pose_with_the_greatest_odds_is_selected(monkeypatch, explains, matches, best):
    query = compared(monkeypatch, *(dict(zip((0.0, 3.0), pair, strict=True)) for pair in (explains, matches)))
    found = selection.select(query, Selection(at(0.0, 0.5), (at(3.0, 0.4),)))
    assert places([found.best]) == [best]
    assert found.rival_ratio == pytest.approx(explains[0 if best else 1] / explains[1 if best else 0])
    alone = Selection(at(0.0, 0.5), ())
    assert selection.select(query, alone) is alone


def test_whole_views_alone_have_no_matches_and_ratios_are_to_the_best(monkeypatch):
    query = compared(monkeypatch, {0.0: 0.5, 3.0: 0.4}, {0.0: 20, 3.0: 7})
    poses = at(0.0, 0.5), [at(3.0, 0.3)]
    found = selection.assess_poses(query, *poses)
    assert [(s.score, s.num_matches) for s in found] == [(0.5, 20), (0.3, 7)]
    assert [s.ratio for s in found] == pytest.approx([1.0, 0.8])
    by_views = selection.assess_poses(query.by_views(), *poses)
    assert by_views == [s._replace(num_matches=None, evidence="views") for s in found]


def test_of_poses_that_beat_each_other_in_turn_the_one_beaten_least_is_best(monkeypatch):
    """Each two are compared over other parts of the sphere."""
    query = compared(monkeypatch, {}, {0.0: 20, 3.0: 20, 6.0: 20})
    ratios = {(0.0, 3.0): 0.7, (3.0, 6.0): 0.8, (6.0, 0.0): 0.9}  # of the first, by the second
    ratios |= {(second, first): 1.0 / ratio for (first, second), ratio in ratios.items()}
    ratios |= {(place, place): 1.0 for place in (0.0, 3.0, 6.0)}

    class Seen(NamedTuple):
        place: float

        def compute_ratio(self, other):
            return ratios[self.place, other.place]

    monkeypatch.setattr(selection, "compare", lambda query, pose: Seen(pose.center_world[0]))
    for first, second, third in ((0.0, 3.0, 6.0), (6.0, 0.0, 3.0), (3.0, 6.0, 0.0)):
        found = Selection(at(first, 0.5), (at(second, 0.5), at(third, 0.5)))
        selected = selection.select(query, found)
        assert places([selected.best, *selected.alternatives]) == [6.0, 0.0, 3.0]
        assert selected.rival_ratio == pytest.approx(1.0 / 0.9)


def test_the_best_pose_has_come_to_rest_and_is_still_the_best(monkeypatch):
    """At rest, the first explains less than the second; of the two at rest, the second is better."""
    explains, rested = {0.0: 0.5, 3.0: 0.45, 0.01: 0.3, 3.01: 0.46}, []
    query = compared(monkeypatch, explains, dict.fromkeys(explains, 20))

    def settle(query, h):
        rested.append(place(h.pose))
        return at(rested[-1] + 0.01, h.score) if rested[-1] in (0.0, 3.0) else h

    monkeypatch.setattr(last_descent, "settle", settle)
    found = last_descent.settle_best(query, Selection(at(0.0, 0.5), (at(3.0, 0.5),)))
    assert rested == [0.0, 3.0]
    assert places([found.best, *found.alternatives]) == [3.01, 0.01]
    rested.clear()
    query = compared(monkeypatch, explains | {0.01: 0.49}, dict.fromkeys(explains, 20))
    found = last_descent.settle_best(query, Selection(at(0.0, 0.5), (at(3.0, 0.5),)))
    assert (rested, found.best.pose.center_world[0]) == ([0.0], 0.01)


def test_margin_is_the_lesser_of_two_leads():
    for score, other, rival, margin in ((0.5, 0.1, 0.3, 0.7), (0.5, 0.4, 0.3, 0.2), (0.1, 0.4, 0.0, -1.0)):
        found = Selection(at(0.0, score), (at(3.0, other),), rival)
        assert found.margin == pytest.approx(margin)
    assert Selection(at(0.0, 0.3), ()).margin == 1.0


@pytest.mark.parametrize(
    ("scores", "counts", "is_sure"),
    [
        ((0.11, 0.02), (12, 0), True),
        ((0.09, 0.02), (12, 0), False),  # a faint pose ends no search
        ((0.5, 0.1), (11, 0), False),
        ((0.5, 0.4), (20, 0), True),  # many features agree with the one, none with the other
        ((0.5, 0.4), (40, 25), False),
    ],
)
def test_a_pose_is_sure_by_its_score_its_matches_and_its_odds_elsewhere(monkeypatch, scores, counts, is_sure):
    query = compared(monkeypatch, *(dict(zip((0.0, 3.0), pair, strict=True)) for pair in (scores, counts)))
    assert selection.is_sure(query, [at(0.0, scores[0]), at(3.0, scores[1])]) == is_sure


def _all_rivals(query, _, others):
    return list(others) if query.uses_matches else []


def test_copies_are_credited_with_the_most_matches_of_one(monkeypatch):
    """How many a copy has by itself says how it was scanned."""
    asked = []
    copies = {1.0: True, 2.0: False, 3.0: True}

    def find_copies(_query, pose, others):
        asked.append(place(pose))
        return [copies[place(other)] for other in others]

    monkeypatch.setattr(judging, "find_copies", find_copies)
    monkeypatch.setattr(judging, "list_rivals", _all_rivals)
    best, *others = (at(x, 0.0) for x in (0.0, 1.0, 2.0, 3.0))
    standings = [Standing(1.0, 0.5, n, "drawn scan") for n in (12, 3, 4, 20)]
    for evidence, expected in (("drawn scan", [20, 20, 4, 20]), ("views", [12, 3, 4, 20])):
        query = replace(QUERY, evidence=evidence)
        found = judging.credit_copies(standings, judging.list_copies(query, best, others))
        assert [s.num_matches for s in found] == expected
    assert asked == [0.0]


def test_copies_by_shape_are_as_likely_as_the_best_unless_a_prior_excludes_them(monkeypatch):
    """The pose that was found at the same place as a copy is not reported beside it."""
    query = replace(QUERY, evidence="shape")
    monkeypatch.setattr(judging, "find_alike", lambda _, best: [at(best.center_world[0] + 3.0, 0.0).pose])
    monkeypatch.setattr(judging, "score_pose", lambda _, pose: at(place(pose), 0.1))
    found = Selection(at(0.0, 0.3), (at(3.1, 0.2), at(6.0, 0.1)))
    reported, is_copy = judging.list_reported(query, found)
    assert (places(reported), is_copy) == ([3.0, 6.0], [True, True, False])
    standings = [Standing(r, s, None, "shape", p, s) for r, s, p in ((1.0, 0.3, 0.0), (0.4, 0.1, -4.0))]
    best, copy, other = judging.credit_copies([*standings, standings[1]], is_copy)
    assert (best, copy, other) == (standings[0], standings[0]._replace(log_prior=-4.0), standings[1])


@pytest.mark.parametrize(("is_copy", "order"), [(True, [3.0, 0.0, 6.0]), (False, [0.0, 3.0, 6.0])])
def test_a_copy_of_its_place_that_is_likelier_becomes_the_best(monkeypatch, is_copy, order):
    query = compared(monkeypatch, {0.0: 0.3, 3.0: 0.5, 6.0: 0.1}, {0.0: 20, 3.0: 20})
    monkeypatch.setattr(judging, "find_copies", lambda *_: [is_copy, False])
    monkeypatch.setattr(judging, "list_rivals", _all_rivals)
    monkeypatch.setattr(judging, "settle", lambda _, h: h)
    measured = judging.Measured(at(0.0, 0.0).pose, UNKNOWN_ERRORS, 0.05, None)
    monkeypatch.setattr(judging, "measure", lambda *_: measured)
    monkeypatch.setattr(judging, "conclude", lambda _, found, *more: found)
    found = Selection(at(0.0, 0.3), (at(3.0, 0.5), at(6.0, 0.1)))
    judged = judging.judge(query, found)
    assert places([judged.best, *judged.alternatives]) == order


def test_evidence_counts_what_agrees_with_the_pose_and_elsewhere(monkeypatch):
    """Of a photo at its true pose, beside two others in the room."""
    _, panorama, true = rooms.scene(1)
    query = rooms.ask(panorama, rooms.scan_map(1))
    steps = [[0.0] * 6, [0.0, 0.0, 1.5, 0.5, 0.0, 0.0], [0.0, 0.0, 3.0, 0.0, 0.5, 0.0]]
    best, *others = (score_pose(query, step(true, np.array(delta))) for delta in steps)
    found = judging.judge(query, Selection(best, tuple(others), 0.3))
    e, most = found.evidence, max(count_agreeing(query, h.pose) for h in others)
    assert (e.score, e.num_matches, e.alternative_matches) == (best.score, count_agreeing(query, true), most)
    assert e.margin == pytest.approx(0.7)
    assert e.num_matches > 40 > most
    assert min(e.seen_fraction, e.explained_fraction) > 0.8
    assert e.agreement > 0.5
    assert max(e.contradicted_fraction, found.loss) < 0.1
    told = [(a.score, a.num_matches, a.pose.key) for a in found.alternatives]
    to_world = query.scan_map.to_world
    assert told == [(h.score, count_agreeing(query, h.pose), to_world(h.pose).key) for h in others]
    assert found.standings[0].ratio == 1.0 > found.standings[1].ratio
    stated = [found.confidence, *(a.probability for a in found.alternatives), found.probability_none]
    assert sum(stated) == pytest.approx(1.0)
    assert found.status == "localized"
    alone = judging.judge(query, Selection(best, ()))
    assert (alone.evidence.margin, alone.evidence.alternative_matches) == (1.0, 0)
    monkeypatch.setattr(judging, "sampling_loss", lambda *_: np.inf)  # no point is seen
    assert judging.judge(query, Selection(best, ())) == Localization()
