"""What is believed of a pose: products, statuses, reasons, and how photos that help each other change it."""

from dataclasses import replace

import numpy as np
import pytest

from piccolo.geometry.pose import Pose
from piccolo.judge.belief import NOTHING, decide, make_belief
from piccolo.judge.by_others import Shares, believe_beside, believe_together, share_place
from piccolo.judge.reasons import WORDS, Contradiction, Reason, explain
from piccolo.judge.result import Result, nothing_found
from piccolo.judge.result_parts import Alternative, Evidence
from piccolo.localization.paper import believe_roughly as believe_by_paper

BELIEF = make_belief([0.9, 0.06], within=0.8, doubt=0.05)
BUNDLES = np.array([0.9, 0.07, 0.03])


def test_place_accuracy_and_doubt_are_multiplied_once():
    expected = [0.95 * 0.8 * 0.9, 0.95 * 0.8 * 0.06]
    np.testing.assert_allclose(BELIEF.probabilities, [*expected, 1.0 - sum(expected)])
    np.testing.assert_allclose(BELIEF.sound_places, [0.95 * 0.9, 0.95 * 0.06, 1.0 - 0.95 * 0.96])
    assert sum(BELIEF.place) == pytest.approx(1.0)
    assert make_belief([0.7, 0.3 + 1e-16]).place[-1] == 0.0


@pytest.mark.parametrize("reason", Reason)
def test_what_is_ruled_out_has_no_probability_whatever_else_is_believed(reason):
    refused = BELIEF.rule_out(reason)
    for changed in (refused, refused.scale(1.0), replace(refused, within=1.0, doubt=0.0)):
        assert changed.probabilities.tolist() == changed.sound_places.tolist() == [0.0, 0.0, 1.0]
        assert decide(changed, 0.01).status == "not_localized"
    assert refused.rule_out(Reason.NEAR, Reason.MIRRORED).ruled_out == {reason, Reason.NEAR, Reason.MIRRORED}
    assert refused.place == BELIEF.place, "it is known all the same"


@pytest.mark.parametrize(
    ("places", "within", "doubt", "status"),
    [
        ([0.9, 0.06], 1.0, 0.0, "localized"),
        ([0.89, 0.07], 1.0, 0.0, "ambiguous"),
        ([0.06, 0.89], 1.0, 0.0, "ambiguous"),
        ([0.5, 0.3], 1.0, 0.0, "not_localized"),
        ([0.99, 0.0], 0.92, 0.0, "localized"),
        ([0.99, 0.0], 0.9, 0.0, "not_localized"),
        ([0.99, 0.0], 1.0, 0.1, "not_localized"),
        ([], 1.0, 0.0, "not_localized"),
    ],
)
def test_a_status_is_that_of_the_products(places, within, doubt, status):
    belief = make_belief(places, within, doubt)
    decided = decide(belief, 0.9)
    assert decided.status == status
    np.testing.assert_array_equal(decided.probabilities, belief.probabilities)


def test_a_result_has_its_probabilities_by_its_belief():
    here, away = (Pose(np.eye(3), np.array([x, 0.0, 0.0])) for x in (0.0, 3.0))
    judged = Result(best_pose=here, alternatives=(Alternative(away, 0.3, 4),))
    found = judged.take_belief(make_belief([0.9, 0.06]), 0.9)
    assert (found.status, found.belief) == ("localized", make_belief([0.9, 0.06]))
    told = found.confidence, found.alternatives[0].probability, found.probability_none
    assert told == pytest.approx((0.9, 0.06, 0.04))
    less = found.take_belief(found.belief.scale(0.5), 0.9)
    told = less.confidence, less.alternatives[0].probability, less.probability_none
    assert (less.status, told) == ("not_localized", pytest.approx((0.45, 0.03, 0.52)))
    nothing = nothing_found()
    assert (nothing.belief, nothing.confidence, nothing.probability_none) == (NOTHING, 0.0, 1.0)


@pytest.mark.parametrize(
    ("contradiction", "text"),
    [
        ((Reason.WITHIN, None, "'b', 'c'"), "the pose found is in the scan None, not in 'b', 'c'"),
        ((Reason.NEAR, 1.404, (0.5,)), "the pose found is 1.40 m from the place given, not within 0.5 m"),
        ((Reason.HEIGHT, 2.0, (0.5, 1.0)), "the pose found is 2.00 m above the floor, not 0.5 to 1 m"),
        (
            (Reason.HEADING, 27.4, (20.0,)),
            "the pose found looks 27 deg away from the heading given, more than 20 deg",
        ),
    ],
)
def test_reasons_in_words(contradiction, text):
    assert explain(Contradiction(*contradiction)) == text
    assert contradiction[0] in WORDS


def test_a_photo_in_a_bundle_is_within_by_its_own_pose_or_by_that_of_the_others():
    shares = Shares(0.6, 0.2)
    belief = believe_together(shares, BUNDLES, within_own=0.9, within_others=0.5)
    place = 0.8 * 0.9
    assert belief.place == pytest.approx((place, 0.07, 0.93 - place))
    assert belief.within == pytest.approx((0.6 * 0.9 + 0.2 * 0.5) / 0.8)
    crowded = believe_together(Shares(0.99, 0.01), np.array([0.5, 0.5, 0.0]), 1.0, 1.0)
    assert crowded.place == pytest.approx((0.5, 0.5, 0.0))


def test_an_own_pose_where_it_was_expected_counts_more_but_not_the_photo():
    shares = Shares(0.4, 0.4)
    likelier = shares.weigh_own(3.0)
    assert likelier == pytest.approx((0.6, 0.2))
    assert likelier.here == pytest.approx(shares.here)


@pytest.mark.parametrize(("own", "is_kept"), [(0.99, True), (0.5, False)])
def test_that_others_show_nothing_says_nothing_against_a_photo_that_is_sure(own, is_kept):
    alone = make_belief([own], within=0.9, doubt=0.3)
    belief = believe_together(Shares(0.6, 0.3), BUNDLES, 0.9, 0.0, alone)
    if is_kept:
        assert (belief.place[0], belief.within, belief.doubt) == (own, 0.9, 0.0)
        assert belief.place[1] == pytest.approx(0.07 * (1.0 - own) / 0.1)
    else:
        assert belief == believe_together(Shares(0.6, 0.3), BUNDLES, 0.9, 0.0)
    assert sum(belief.place) == pytest.approx(1.0)


@pytest.mark.parametrize(("within", "expected"), [(None, 0.8), (0.95, 0.95)])
def test_a_photo_is_no_surer_than_those_beside_it_and_as_exact_as_the_mean(within, expected):
    belief = believe_beside(BELIEF, [0.96, 0.98, 0.97], within)
    assert belief.place == pytest.approx((0.98 * 0.9, 0.98 * 0.06, 1.0 - 0.98 * 0.96))
    assert (belief.within, belief.doubt) == (expected, BELIEF.doubt)
    assert believe_beside(BELIEF.rule_out(Reason.NEAR), [0.99], 1.0).ruled_out == {Reason.NEAR}


def test_results_at_several_places_share_the_probability_of_the_best_ones_place():
    """So that the products are in proportion, however exact the best is."""
    best = make_belief([0.96, 0.01], within=0.9, doubt=0.1)
    confidence = float(best.probabilities[0])
    factor, others = share_place(best, [confidence, 0.3, 0.1])
    total = confidence + 0.4
    together = replace(best, place=make_belief([factor * 0.96, *others]).place)
    expected = [confidence * p / total for p in (confidence, 0.3, 0.1)]
    np.testing.assert_allclose(together.probabilities[:-1], expected)


@pytest.mark.parametrize(
    ("margin", "num_others", "status"),
    [(0.6, 1, "localized"), (0.02, 2, "ambiguous"), (0.02, 0, "not_localized")],
)
def test_the_preset_paper_is_judged_by_the_same_rule(margin, num_others, status):
    evidence = Evidence(score=0.6, margin=margin, agreement=0.7, explained_fraction=0.8, seen_fraction=0.9)
    belief = believe_by_paper(evidence, num_others)
    assert len(belief.place) == num_others + 2
    assert len(set(belief.place[1:-1])) <= 1, "nothing tells others apart"
    assert decide(belief, 0.9).status == status
