import dataclasses

import numpy as np
import pytest

from piccolo.coarse_to_fine.settings import CoarseToFineSettings
from piccolo.confidence import confidence as rule
from piccolo.confidence.covariance import PoseCovariance
from piccolo.confidence.score import Evidence
from piccolo.errors import InputError
from piccolo.paper.settings import PaperSettings


def _covariance(std):
    return PoseCovariance(np.diag([1e-8] * 3 + [std**2] * 3), "")


SURE = _covariance(0.002)
RIGHT = Evidence(
    score=0.8, margin=0.9, agreement=0.85, explained_fraction=0.85, seen_fraction=0.93, num_matches=60
)
WRONG = dataclasses.replace(
    RIGHT, score=0.03, margin=0.1, agreement=0.25, num_matches=3, alternative_matches=4
)
MIDDLING = dataclasses.replace(RIGHT, score=0.15, margin=0.35, agreement=0.4, num_matches=8)
PAPER_RIGHT = dataclasses.replace(RIGHT, margin=0.6)
PAPER_MIDDLING = dataclasses.replace(RIGHT, margin=0.15, agreement=0.4)


def test_right_and_wrong_evidence():
    assert rule.classify(RIGHT, SURE, True, 0.9) == ("localized", rule.confidence_of(RIGHT, SURE, rule.MODEL))
    assert rule.classify(WRONG, None, True, 0.9)[0] == rule.NOT_LOCALIZED
    assert rule.confidence_of(RIGHT, SURE, rule.MODEL) > 0.99
    assert rule.confidence_of(WRONG, None, rule.MODEL) < 0.2
    assert rule.classify(PAPER_RIGHT, None, True, 0.9, rule.PAPER_MODEL)[0] == rule.LOCALIZED


@pytest.mark.parametrize(
    ("changes", "std", "model", "expected"),
    [
        ({}, 0.003, rule.MODEL, 0.9314),
        ({}, None, rule.MODEL, 0.3160),
        ({"margin": 0.6, "alternative_matches": 4}, 0.003, rule.MODEL, 0.9348),
        ({"margin": 0.2}, 0.003, rule.MODEL, 0.4244),
        ({"margin": 0.15}, None, rule.PAPER_MODEL, 0.1759),
        ({}, None, rule.PAPER_MODEL, 0.4328),
    ],
)
def test_confidence_is_what_was_learnt(changes, std, model, expected):
    """From the models as they were fitted, by a pocket calculator; a new fit changes these numbers."""
    assert tuple(np.sign(model.weights)) == rule.DIRECTIONS[: len(model.weights)]
    evidence = dataclasses.replace(MIDDLING, **changes)
    assert rule.confidence_of(evidence, std and _covariance(std), model) == pytest.approx(expected, abs=0.001)


@pytest.mark.parametrize(("std", "most"), [(0.05, 0.683), (0.1, 0.383), (0.3, 0.132)])
def test_a_pose_that_may_be_a_decimetre_off_is_doubtful_whatever_the_evidence(std, most):
    """The part of a normal distribution within 0.1 m, of twice the deviation."""
    sure = dataclasses.replace(RIGHT, margin=1.0, num_matches=500)
    assert rule.confidence_of(sure, _covariance(std), rule.MODEL) == pytest.approx(most, abs=0.002)


def test_an_alternative_as_good_makes_it_ambiguous_and_nothing_else_does():
    twin = dataclasses.replace(RIGHT, margin=-0.05, alternative_matches=58)
    status, confidence = rule.classify(twin, SURE, True, 0.9)
    assert status == rule.AMBIGUOUS
    assert confidence < 0.9
    assert rule.classify(twin, SURE, False, 0.9)[0] == rule.NOT_LOCALIZED
    weak = dataclasses.replace(WRONG, margin=0.2)
    assert rule.classify(weak, None, False, 0.9)[0] == rule.NOT_LOCALIZED
    assert rule.classify(WRONG, None, True, 0.9)[0] == rule.NOT_LOCALIZED


def test_the_line_moves():
    confidence = rule.confidence_of(RIGHT, SURE, rule.MODEL)
    assert rule.classify(RIGHT, SURE, False, 0.5 * (1.0 + confidence))[0] != rule.LOCALIZED
    assert rule.classify(RIGHT, SURE, False, confidence)[0] == rule.LOCALIZED
    half = 0.5 * rule.confidence_of(WRONG, None, rule.MODEL)
    assert rule.classify(WRONG, None, False, half)[0] == rule.LOCALIZED


@pytest.mark.parametrize(("name", "more"), [("margin", 0.1), ("score", 0.1), ("num_matches", 5)])
def test_more_evidence_is_more_confidence(name, more):
    stronger = dataclasses.replace(MIDDLING, **{name: getattr(MIDDLING, name) + more})
    assert rule.confidence_of(MIDDLING, SURE, rule.MODEL) < rule.confidence_of(stronger, SURE, rule.MODEL)
    if name == "margin":
        clearer = dataclasses.replace(PAPER_MIDDLING, margin=0.25, agreement=0.5)
        pair = (rule.confidence_of(e, None, rule.PAPER_MODEL) for e in (PAPER_MIDDLING, clearer))
        assert next(pair) < next(pair)


def test_a_pose_that_is_no_minimum_and_matches_elsewhere_are_held_against_it():
    assert rule.confidence_of(MIDDLING, None, rule.MODEL) < rule.confidence_of(MIDDLING, SURE, rule.MODEL)
    challenged = dataclasses.replace(MIDDLING, alternative_matches=8)
    assert rule.confidence_of(challenged, SURE, rule.MODEL) < rule.confidence_of(MIDDLING, SURE, rule.MODEL)


@pytest.mark.parametrize(("a", "b"), [(1.0, 50.0), (0.003, 0.001)])
def test_deviations_beyond_reason_change_nothing_more(a, b):
    np.testing.assert_array_equal(*(rule.features_of(RIGHT, _covariance(std)) for std in (a, b)))
    assert (rule.features_of(RIGHT, None) == rule.features_of(RIGHT, _covariance(0.3))).all()


@pytest.mark.parametrize("settings", [CoarseToFineSettings, PaperSettings])
@pytest.mark.parametrize("value", [0.0, 1.0, -1.0, float("nan")])
def test_lines_that_mean_nothing_are_refused(settings, value):
    with pytest.raises(InputError, match=f"--min-confidence: found {value}, wanted above 0 and below 1"):
        settings(min_confidence=value)
    assert settings(min_confidence=0.01).min_confidence == 0.01
