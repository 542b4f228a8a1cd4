import dataclasses

import numpy as np
import pytest

from piccolo.coarse_to_fine.settings import CoarseToFineSettings
from piccolo.confidence.confidence import (
    AMBIGUOUS,
    LOCALIZED,
    NOT_LOCALIZED,
    classify,
    confidence_of,
    features_of,
)
from piccolo.confidence.covariance import PoseCovariance
from piccolo.confidence.score import Evidence
from piccolo.errors import InputError
from piccolo.paper.settings import PaperSettings

SURE = PoseCovariance(np.diag([1e-8] * 3 + [4e-6] * 3), "")
RIGHT = Evidence(
    score=0.8,
    margin=0.6,
    agreement=0.85,
    explained_fraction=0.85,
    seen_fraction=0.93,
)
WRONG = dataclasses.replace(RIGHT, score=0.18, margin=0.02, agreement=0.25)


def test_right_and_wrong_evidence():
    assert classify(RIGHT, SURE, True, 0.9) == (LOCALIZED, confidence_of(RIGHT, SURE))
    assert classify(WRONG, None, True, 0.9)[0] == NOT_LOCALIZED
    assert confidence_of(RIGHT, SURE) > 0.99
    assert confidence_of(WRONG, None) < 0.2
    assert classify(OF_PAPER, None, True, 0.9)[0] == LOCALIZED


def test_an_alternative_as_good_makes_it_ambiguous():
    twin = dataclasses.replace(RIGHT, margin=0.01, alternative_score_ratio=0.98)
    status, confidence = classify(twin, SURE, True, 0.9)
    assert status == AMBIGUOUS
    assert confidence < 0.9


def test_without_an_alternative_nothing_is_ambiguous():
    weak = dataclasses.replace(WRONG, margin=0.18)
    assert classify(weak, None, False, 0.9)[0] == NOT_LOCALIZED


def test_the_line_moves():
    confidence = confidence_of(RIGHT, SURE)
    assert classify(RIGHT, SURE, False, 0.5 * (1.0 + confidence))[0] != LOCALIZED
    assert classify(WRONG, None, False, 0.5 * confidence_of(WRONG, None))[0] == LOCALIZED


@pytest.mark.parametrize("name", ["margin", "agreement"])
def test_more_evidence_is_more_confidence(name):
    weaker = dataclasses.replace(RIGHT, **{name: 0.1}, score=0.3)
    stronger = dataclasses.replace(weaker, **{name: 0.3})
    assert confidence_of(weaker, SURE) < confidence_of(stronger, SURE)


def test_a_pose_that_is_no_bottom_and_a_credible_alternative_are_held_against_it():
    middling = dataclasses.replace(RIGHT, score=0.35, margin=0.15, agreement=0.4)
    assert confidence_of(middling, None) < confidence_of(middling, SURE)
    challenged = dataclasses.replace(middling, alternative_score_ratio=0.9)
    assert confidence_of(challenged, SURE) < confidence_of(middling, SURE)


def test_deviations_beyond_reason_change_nothing_more():
    wide, wider = (PoseCovariance(np.diag([1e-8] * 3 + [std**2] * 3), "") for std in (1.0, 50.0))
    np.testing.assert_array_equal(features_of(RIGHT, wide), features_of(RIGHT, wider))


@pytest.mark.parametrize("settings", [CoarseToFineSettings, PaperSettings])
@pytest.mark.parametrize("value", [0.0, 1.0, -1.0, float("nan")])
def test_lines_that_mean_nothing_are_refused(settings, value):
    with pytest.raises(InputError, match=f"--min-confidence: found {value}, wanted above 0 and below 1"):
        settings(min_confidence=value)
