"""From evidence to a status: how likely a pose is right, and what to call it."""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.pose import MAX_DISTANCE
from .covariance import PoseCovariance
from .score import Evidence


class LogisticModel(NamedTuple):
    """Logistic regression on the first features."""

    bias: float
    weights: tuple[float, ...]


LOCALIZED = "localized"
AMBIGUOUS = "ambiguous"
NOT_LOCALIZED = "not_localized"
MIN_CONFIDENCE = 0.9

LEAST_STD, MOST_STD = 0.003, 0.3  # [m] smaller or larger tells nothing more
LEAST_SCORE = 0.02
COPY_MARGIN = (
    0.25  # with less, a pose elsewhere explains as much of what both show: one of two, whatever the rest
)
SAFETY = 2.0  # errors that the whole sphere shares, as by blur, are not in the deviations
NOISE_MATCHES = 8  # local features that agree with a wrong pose by chance, at most
# Logistic regression by tools/calibrate_confidence.py on tools/evaluate_confidence.py --seeds 0 8, but for
# mirrored photos, which are told otherwise. Each feature counts in one direction only.
FEATURES = ("margin", "log of the score", "lead of matches", "log10 of the largest deviation [m]")
DIRECTIONS = (1, 1, 1, -1)
MODEL = LogisticModel(-4.16, (5.88, 1.04, 3.49, -1.69))
# The preset paper knows no covariance, and too few alternatives to tell places that repeat: learnt without
# those, on tools/evaluate_confidence.py --preset paper --seeds 0 6 and --seeds 100 104.
PAPER_MODEL = LogisticModel(-0.20, (6.37, 2.51))


def features_of(evidence: Evidence, covariance: PoseCovariance | None) -> NDArray[np.float64]:
    """What the confidence goes by, (4,), as FEATURES names them."""
    e = evidence
    margin = min(max(e.margin, 0.0), 1.0)
    lead = math.log((e.num_matches + NOISE_MATCHES) / (e.alternative_matches + NOISE_MATCHES))
    std = MOST_STD if covariance is None else min(max(covariance.largest_std, LEAST_STD), MOST_STD)
    return np.array([margin, math.log(max(e.score, LEAST_SCORE)), max(lead, 0.0), math.log10(std)])


def paper_features_of(evidence: Evidence) -> NDArray[np.float64]:
    """What the confidence of preset paper goes by, (2,): margin and log of the agreement."""
    return np.array([evidence.margin, math.log(max(evidence.agreement, LEAST_SCORE))])


def confidence_of(evidence: Evidence, covariance: PoseCovariance | None, model: LogisticModel) -> float:
    """How likely it is that the pose is within 0.1 m and 5 degrees: of those with 0.9, nine in ten.

    It holds where half of all queries have an answer, as in the trials from which it was learnt. A pose whose
    own deviation makes 0.1 m doubtful has less, and one that has a copy half at most.
    """
    is_paper = model is PAPER_MODEL
    features = paper_features_of(evidence) if is_paper else features_of(evidence, covariance)
    logit = model.bias + float(features @ np.array(model.weights))
    factor = 0.5 if evidence.margin < COPY_MARGIN and not is_paper else 1.0
    if covariance is not None:
        factor *= math.erf(MAX_DISTANCE / (SAFETY * covariance.largest_std * math.sqrt(2.0)))
    return factor / (1.0 + math.exp(-min(max(logit, -30.0), 30.0)))


def classify(
    evidence: Evidence,
    covariance: PoseCovariance | None,
    has_alternatives: bool,
    min_confidence: float,
    model: LogisticModel = MODEL,
) -> tuple[str, float]:
    """Status and confidence; ambiguous is a pose that would be called localized if it had no alternative."""
    confidence = confidence_of(evidence, covariance, model)
    if confidence >= min_confidence:
        return LOCALIZED, confidence
    alone = replace(evidence, margin=1.0, alternative_matches=0)
    if has_alternatives and confidence_of(alone, covariance, model) >= min_confidence:
        return AMBIGUOUS, confidence
    return NOT_LOCALIZED, confidence


def check_confidence(min_confidence: float) -> None:
    """Refuse a line that no confidence can pass or fail."""
    if not 0.0 < min_confidence < 1.0:
        raise InputError(f"--min-confidence: found {min_confidence}, wanted above 0 and below 1")
