import itertools
import math

import numpy as np
import pytest

from piccolo.confidence import confidence as rule
from piccolo.confidence.confidence import Standing, classify, posterior
from piccolo.confidence.covariance import PoseCovariance
from piccolo.errors import InputError
from piccolo.localization.settings import CoarseToFineSettings
from piccolo.paper.settings import PaperSettings


def _covariance(std):
    return PoseCovariance(np.diag([1e-8] * 3 + [std**2] * 3), "")


SURE = _covariance(0.002)
RIGHT, WRONG = Standing(1.0, 0.8, 60), Standing(1.0, 0.03, 3)
ELSEWHERE = Standing(0.1, 0.05, 3)
MODEL = rule.ChoiceModel((3.0, 1.0, 2.0), (10.0, 2.0))


def test_probabilities_are_those_of_the_formula_and_add_up_to_one():
    """A conditional logit by a pocket calculator, with made-up weights."""
    p = posterior([Standing(1.0, 0.5, 12), Standing(0.5, 0.1, 2)], _covariance(0.01), MODEL)
    e = math.exp
    odds = [
        0.5 * 20.0**2,
        0.5**3 * 0.1 * 10.0**2,
        e(10.0 - 2.0 * 2.0),
    ]
    doubt = math.erf(0.1 / (0.01 * math.sqrt(2.0)))
    expected = [doubt * odds[0] / sum(odds), doubt * odds[1] / sum(odds)]
    np.testing.assert_allclose(p, [*expected, 1.0 - sum(expected)], rtol=1e-12)


def test_right_and_wrong_evidence():
    assert all(w > 0.0 for w in rule.MODEL.weights)
    assert rule.MODEL.none_weights[1] >= 0.0
    p = posterior([RIGHT, ELSEWHERE], SURE)
    assert p[0] > 0.98
    assert classify(p, 0.9) == rule.LOCALIZED
    p = posterior([WRONG, ELSEWHERE._replace(share=0.9)], None)
    assert p[0] < 0.2
    assert classify(p, 0.9) == rule.NOT_LOCALIZED


@pytest.mark.parametrize("copies", [2, 3, 5])
def test_copies_share_the_probability_alike_and_none_of_them_is_localized(copies):
    p = posterior([RIGHT] * copies, SURE)
    np.testing.assert_allclose(p[:-1], (1.0 - p[-1]) / copies)
    assert p[-1] < 0.05
    assert classify(p, 0.9) == rule.AMBIGUOUS


def test_what_a_copy_explains_less_makes_it_less_likely():
    shares = (1.0, 0.95, 0.8, 0.6, 0.3)
    best = [posterior([RIGHT, RIGHT._replace(share=share)], SURE)[0] for share in shares]
    assert all(a < b for a, b in itertools.pairwise(best))
    assert best[0] < 0.51
    assert best[-1] > 0.9


@pytest.mark.parametrize(("name", "more"), [("score", 0.1), ("num_matches", 5)])
def test_more_evidence_is_more_probability(name, more):
    middling = Standing(1.0, 0.15, 8)
    stronger = middling._replace(**{name: getattr(middling, name) + more})
    assert posterior([middling], SURE)[0] < posterior([stronger], SURE)[0]
    assert posterior([middling], None)[0] < posterior([middling], SURE)[0]
    pair = [posterior([middling, e], SURE)[0] for e in (middling, stronger)]
    assert pair[1] < pair[0] < posterior([middling], SURE)[0]


@pytest.mark.parametrize(("std", "most"), [(0.05, 0.954), (0.1, 0.683), (0.3, 0.261)])
def test_a_pose_that_may_be_a_decimetre_off_is_doubtful_whatever_the_evidence(std, most):
    """The part of a normal distribution within 0.1 m."""
    p = posterior([RIGHT._replace(num_matches=10**7)], _covariance(std))
    assert p[0] == pytest.approx(most, abs=0.002)
    assert p.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(("a", "b"), [(1.0, 50.0), (0.003, 0.001)])
def test_numbers_beyond_reason_change_nothing_more(a, b):
    np.testing.assert_array_equal(*(rule.none_features_of(_covariance(std)) for std in (a, b)))
    assert (rule.none_features_of(None) == rule.none_features_of(_covariance(0.3))).all()
    least, less = Standing(0.0, 0.02, 0), Standing(-0.5, -0.3, 0)
    faint, nothing = (rule.features_of(standing) for standing in (least, less))
    np.testing.assert_array_equal(faint, nothing)
    np.testing.assert_array_equal(faint, np.log([0.1, 0.02, 8.0]))


def test_the_line_moves():
    p = np.array([0.6, 0.3, 0.1])
    for line, status in ((0.6, rule.LOCALIZED), (0.61, rule.AMBIGUOUS), (0.9, rule.AMBIGUOUS)):
        assert classify(p, line) == status
    assert classify(p, 0.91) == rule.NOT_LOCALIZED


@pytest.mark.parametrize("settings", [CoarseToFineSettings, PaperSettings])
@pytest.mark.parametrize("value", [0.0, 1.0, -1.0, float("nan")])
def test_lines_that_mean_nothing_are_refused(settings, value):
    with pytest.raises(InputError, match=f"--min-confidence: found {value}, wanted above 0 and below 1"):
        settings(min_confidence=value)
    assert settings(min_confidence=0.01).min_confidence == 0.01
