"""Which pose is taken, each in a made-up case where one rule decides."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import rooms
from made_up import PARTIAL, PROBLEM, WHOLE, make_candidate, make_selection, place, places

from piccolo.evidence.examine import complete, count_agreeing, examine
from piccolo.geometry.pose import step
from piccolo.judge.candidate import Selection
from piccolo.judge.probability import MOST_RATIO, Standing
from piccolo.judge.result import nothing_found
from piccolo.judge.selection import (
    assess,
    assess_mirrored,
    credit_copies,
    list_drawn,
    select,
    select_mirrored,
)
from piccolo.localization import last_descent
from piccolo.localization.attempts import end_search
from piccolo.localization.beam import refine_matches
from piccolo.localization.copies import put_first
from piccolo.localization.judging import Found, judge
from piccolo.localization.ladder import FINE, refine
from piccolo.localization.last_descent import refine_best
from piccolo.photo.panorama.texels import pack_texels
from piccolo.problem.settings import CoarseToFineSettings
from piccolo.system.jobs.threads import Workers

TIER = "scene"

ALONE = Workers(1)


def test_of_poses_that_matches_gave_the_better_end_is_taken():
    _, panorama, true = rooms.scene(1)
    problem = rooms.ask(panorama, rooms.scan_map(1))
    off = np.array([[0, 0, 0.1, 0.2, -0.1, 0], [0, 0, 0, 0, 0, 0], [0, 0, 1.0, 0.5, 0, 0]], float)
    starts = [step(true, delta) for delta in off]
    found = refine_matches(problem, starts, rooms.WORKERS)
    ends = [refine(problem, start, ALONE, FINE).pose for start in starts]
    scores = [[examine(problem, pose).score for pose in pair] for pair in zip(starts, ends, strict=True)]
    assert [h.score for h in found] == sorted(map(max, scores), reverse=True)
    assert {int(np.argmax(pair)) for pair in scores} == {0, 1}


@pytest.fixture
def last_way(monkeypatch):
    """What is done to candidates on their last way, by their places, and where they come to rest.

    Elsewhere that only makes the score what they explain.
    """
    made = []
    ends = {}

    def note(name):
        def refine(problem, candidate, workers):
            made.append((name, place(candidate.pose)))
            explained = replace(candidate, score=candidate.comparison.score)
            return ends.get(made[-1], explained)

        return refine

    for name in ("climb_to_full", "climb_unoccluded", "settle"):
        monkeypatch.setattr(last_descent, name, note(name))
    return made, ends


@pytest.fixture
def done(last_way):
    return last_way[0]


def test_alternatives_that_come_near_are_refined_and_the_greatest_odds_win(done):
    """By score or by matches; the third explains more of what both show, though its score is less."""
    candidates = [
        make_candidate(9.0, 0.1, 11),
        make_candidate(0.0, 0.5, 11),
        make_candidate(6.0, 0.31, 11, explains=0.6),
        make_candidate(3.0, 0.4, 3),
        make_candidate(12.0, 0.05, 12),
    ]
    found = refine_best(PROBLEM, candidates, ALONE)
    assert done == [*(("climb_to_full", x) for x in (0.0, 3.0, 6.0, 12.0)), ("settle", 6.0)]
    assert places(found.candidates) == [6.0, 0.0, 3.0, 9.0, 12.0]
    assert found.rival_ratio == pytest.approx(0.5 / 0.6)


@pytest.mark.parametrize(
    ("best", "num_matches", "gain", "num_refined"),
    [(0.09, 6, 0.0, 0), (0.09, 7, 0.0, 5), (0.1, 6, 0.0, 5), (0.09, 6, 0.02, 5)],
)
def test_of_a_faint_pose_no_alternative_is_refined_unless_it_gains(
    done, best, num_matches, gain, num_refined
):
    first, *others = (make_candidate(3.0 * k, best - 0.001 * k, num_matches) for k in range(8))
    gaining = make_candidate(0.0, best, num_matches, explains=best + gain)
    refine_best(PROBLEM, [gaining if gain else first, *others], ALONE)
    assert [name for name, _ in done].count("climb_to_full") == num_refined


@pytest.mark.parametrize(
    ("best", "num_matches", "expected"),
    [
        (0.5, 20, ["climb_unoccluded", "settle"]),  # which refines it at full resolution
        (0.09, 7, ["climb_unoccluded", "settle"]),
        (0.09, 6, ["climb_unoccluded"]),  # never localized
        (0.019, 20, []),
    ],
)
def test_a_pose_without_rivals_is_refined_by_itself(done, best, num_matches, expected):
    candidates = [make_candidate(0.0, best, num_matches), make_candidate(9.0, 0.1 * best)]
    found = refine_best(PROBLEM, candidates, ALONE)
    assert done == [(name, 0.0) for name in expected]
    assert places(found.candidates) == [0.0, 9.0]


@pytest.mark.parametrize(
    ("explains", "matches", "best"),
    [
        ((0.5, 0.5), (20, 20), 0.0),  # by score
        ((0.5, 0.6), (20, 20), 3.0),  # by what both views show
        ((0.5, 0.5), (20, 60), 3.0),  # by matches
        ((0.5, 0.2), (20, 60), 0.0),
    ],
)
def test_the_pose_with_the_greatest_odds_is_selected(explains, matches, best):
    evidence = zip((0.0, 3.0), (0.5, 0.4), matches, explains, strict=True)
    given = make_selection(*(make_candidate(*one) for one in evidence))
    found = select(WHOLE, given)
    assert places([found.best]) == [best]
    assert found.rival_ratio == pytest.approx(explains[0 if best else 1] / explains[1 if best else 0])
    alone = Selection(given.best, ())
    assert select(WHOLE, alone) is alone


def test_whole_views_alone_have_no_matches_and_ratios_are_to_the_best():
    given = make_selection(make_candidate(0.0, 0.5, 20), make_candidate(3.0, 0.3, 7, explains=0.4))
    found = assess(WHOLE, given)
    assert [(s.score, s.num_matches) for s in found] == [(0.5, 20), (0.3, 7)]
    assert [s.ratio for s in found] == pytest.approx([1.0, 0.8])
    by_views = assess(WHOLE.by_views(), given)
    assert by_views == [s._replace(num_matches=None, evidence="views") for s in found]


def test_of_poses_that_beat_each_other_in_turn_the_one_beaten_least_is_best():
    """Each two are compared over other parts of the sphere."""
    ratios = {(0.0, 3.0): 0.7, (3.0, 6.0): 0.8, (6.0, 0.0): 0.9}  # of the first, by the second
    ratios |= {(second, first): 1.0 / ratio for (first, second), ratio in ratios.items()}
    ratios |= {(place, place): 1.0 for place in (0.0, 3.0, 6.0)}

    class Seen(NamedTuple):
        place: float

        def compute_ratio(self, other):
            return ratios[self.place, other.place]

    for order in ((0.0, 3.0, 6.0), (6.0, 0.0, 3.0), (3.0, 6.0, 0.0)):
        given = make_selection(*(replace(make_candidate(x, 0.5, 20), comparison=Seen(x)) for x in order))
        selected = select(WHOLE, given)
        assert places(selected.candidates) == [6.0, 0.0, 3.0]
        assert selected.rival_ratio == pytest.approx(1.0 / 0.9)


def test_the_best_pose_has_come_to_rest_and_is_still_the_best(last_way):
    """At rest, the first explains less than the second; of the two at rest, the second is better."""
    done, ends = last_way
    ends["settle", 0.0] = make_candidate(0.01, 0.5, 20, 0.3)
    ends["settle", 3.0] = make_candidate(3.01, 0.5, 20, 0.46)
    given = make_selection(make_candidate(0.0, 0.5, 20), make_candidate(3.0, 0.5, 20, 0.45))
    found = last_descent.settle_best(PROBLEM, given, ALONE)
    assert done == [("settle", 0.0), ("settle", 3.0)]
    assert places(found.candidates) == [3.01, 0.01]
    done.clear()
    ends["settle", 0.0] = make_candidate(0.01, 0.5, 20, 0.49)
    found = last_descent.settle_best(PROBLEM, given, ALONE)
    assert (done, place(found.best.pose)) == ([("settle", 0.0)], 0.01)


def test_margin_is_the_lesser_of_two_leads():
    for score, other, rival, margin in ((0.5, 0.1, 0.3, 0.7), (0.5, 0.4, 0.3, 0.2), (0.1, 0.4, 0.0, -1.0)):
        found = make_selection(make_candidate(0.0, score), make_candidate(3.0, other), rival_ratio=rival)
        assert found.margin == pytest.approx(margin)
    assert make_selection(make_candidate(0.0, 0.3)).margin == 1.0


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
def test_a_pose_is_sure_by_its_score_its_matches_and_its_odds_elsewhere(scores, counts, is_sure):
    given = [make_candidate(*one) for one in zip((0.0, 3.0), scores, counts, strict=True)]
    found, is_enough = end_search(PROBLEM, given, ALONE)
    assert is_enough == is_sure
    assert found == given


def test_copies_are_credited_with_the_most_matches_of_one():
    """How many a copy has by itself says how it was scanned."""
    standings = [Standing(1.0, 0.5, n, "drawn scan") for n in (12, 3, 4, 20)]
    found = credit_copies(standings, [True, True, False, True])
    assert [s.num_matches for s in found] == [20, 20, 4, 20]
    assert credit_copies(standings, [False] * 4) == standings


def test_copies_by_shape_are_as_likely_as_the_best_unless_a_prior_excludes_them():
    """The pose that was found at the same place as a copy is not reported beside it."""
    found = make_selection(make_candidate(0.0, 0.3), make_candidate(3.1, 0.2), make_candidate(6.0, 0.1))
    reported, is_copy = put_first(found, [make_candidate(3.0, 0.1)])
    assert (places(reported.candidates), is_copy) == ([0.0, 3.0, 6.0], [True, True, False])
    standings = [Standing(r, s, None, "shape", p, s) for r, s, p in ((1.0, 0.3, 0.0), (0.4, 0.1, -4.0))]
    best, copy, other = credit_copies([*standings, standings[1]], is_copy)
    assert (best, copy, other) == (standings[0], standings[0]._replace(log_prior=-4.0), standings[1])


def test_evidence_counts_what_agrees_with_the_pose_and_elsewhere():
    """Of a photo at its true pose, beside two others in the room."""
    _, panorama, true = rooms.scene(1)
    problem = rooms.ask(panorama, rooms.scan_map(1))
    steps = [[0.0] * 6, [0.0, 0.0, 1.5, 0.5, 0.0, 0.0], [0.0, 0.0, 3.0, 0.0, 0.5, 0.0]]
    best, *others = (examine(problem, step(true, np.array(delta))) for delta in steps)
    num_best, *nums = (count_agreeing(problem, h, rooms.WORKERS).num_matches for h in (best, *others))

    def judged(*candidates, rival_ratio=0.0, asked=problem):
        selection = make_selection(*candidates, rival_ratio=rival_ratio)
        selection = complete(asked, selection, rooms.WORKERS)
        return judge(Found(asked, selection, None), rooms.means(), CoarseToFineSettings().demand)

    found = judged(best, *others, rival_ratio=0.3)
    e = found.evidence
    assert (e.score, e.num_matches, e.alternative_matches) == (best.score, num_best, max(nums))
    assert e.margin == pytest.approx(0.7)
    assert e.num_matches > 40 > max(nums)
    assert min(e.seen_fraction, e.explained_fraction) > 0.8
    assert e.agreement > 0.5
    assert max(e.contradicted_fraction, found.loss) < 0.1
    told = [(a.score, a.num_matches, a.pose.key) for a in found.alternatives]
    to_world = problem.scan_map.to_world
    assert told == [(h.score, n, to_world(h.pose).key) for h, n in zip(others, nums, strict=True)]
    assert found.standings[0].ratio == 1.0 > found.standings[1].ratio
    stated = [found.confidence, *(a.probability for a in found.alternatives), found.probability_none]
    assert sum(stated) == pytest.approx(1.0)
    assert found.status == "localized"
    alone = judged(best)
    assert (alone.evidence.margin, alone.evidence.alternative_matches) == (1.0, 0)
    nothing = pack_texels(panorama.rgb, np.zeros_like(panorama.is_valid))
    assert judged(best, asked=replace(problem, colors=lambda: nothing)) == nothing_found()  # no point is seen


@pytest.mark.parametrize(("score", "ratio"), [(0.5, 0.8), (0.0, MOST_RATIO)])
def test_a_mirrored_photo_is_compared_with_the_photo_by_what_poses_explain(score, ratio):
    own, mirrored = make_candidate(0.0, score, 12), make_candidate(0.0, 0.4, 9)
    standing = assess_mirrored(PARTIAL, own, mirrored)
    assert standing == Standing(ratio, 0.4 * PARTIAL.discount, 9, PARTIAL.evidence)


@pytest.mark.parametrize(("count", "expected"), [(12, 2), (11, 6)])
def test_a_pose_that_explains_less_than_half_of_a_sure_one_is_not_drawn(count, expected):
    """Of a whole photo, the scan is drawn at four others at most."""
    scores = (0.8, 0.5, 0.4, 0.39, 0.3, 0.2, 0.1)
    ranked = [make_candidate(k, score, count) for k, score in enumerate(scores)]
    assert list_drawn(PARTIAL, ranked) == [k <= expected for k in range(7)]
    assert list_drawn(WHOLE, ranked) == [k <= min(expected, 4) for k in range(7)]
    assert list_drawn(PARTIAL.by_views(), ranked) == [False] * 7


@pytest.mark.parametrize(
    ("differences", "one_is_mirrored", "expected"),
    [
        ((0.3, 1.1), False, [0, 1]),  # one tells that all were mirrored
        ((-2.0, 1.1), False, []),  # the other tells more
        ((-2.0, 1.1), True, [1]),  # similar things link a mirrored photo with one that is not
        ((-2.0, 0.9), True, []),
        ((), True, []),
    ],
)
def test_linked_photos_are_mirrored_as_the_one_that_tells_most(differences, one_is_mirrored, expected):
    assert select_mirrored(dict(enumerate(differences)), one_is_mirrored) == expected
