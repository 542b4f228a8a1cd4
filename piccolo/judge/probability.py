"""Probabilities from evidence, that each pose is right and that none is; and the status that follows."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..problem.method import METHOD, Method
from ..problem.profile import EvidenceKind
from ..system.arrays import Array

LOCALIZED = "localized"
AMBIGUOUS = "ambiguous"
NOT_LOCALIZED = "not_localized"


class Standing(NamedTuple):
    """Evidence for one of a photo's poses."""

    ratio: float  # area that it explains, divided by that of the best pose, over what both views show
    score: float  # [0, 1] what the photo's blocks explain beyond chance
    num_matches: int | None  # local features that agree with it; None with whole views alone
    evidence: EvidenceKind
    log_prior: float = 0.0  # log odds by prior knowledge: lower if the pose contradicts it
    drawn_score: float | None = None  # score of the edges drawn at the pose, in a scan without colours


class Mirrored(NamedTuple):
    """Evidence for a photo that was mirrored, left for right."""

    standing: Standing | None  # evidence for its best pose; None if it explains far less than the photo
    fits_better: bool = False  # than the photo as it is


class ChoiceModel(NamedTuple):
    """A conditional logit (McFadden, 1974) of K + 1 answers: each of the poses, and that none is right."""

    weights: tuple[float, ...]  # of a pose's features
    none_weights: tuple[float, float]  # of no right pose: a constant, and log10 of the best's deviation [rad]


LEAST_STD = 0.00075  # [rad] smaller deviations count as this: 3 mm in a large room
MOST_STD = 0.075  # [rad] larger deviations count as this
LEAST_LOGIT_SCORE = 0.02
LEAST_DRAWN = 0.01
MOST_RATIO = 1.2
# Of 33 crops of a house and a hospital at their right poses three fit nearly as well mirrored, where the
# building is symmetric; of 16 wrong poses eleven did.
SYMMETRIC = 0.08  # share of right poses whose photo fits as well mirrored
TURNED_OVER = 0.02  # chosen: share of photos that were mirrored
CONTRADICTED_ODDS = 0.01  # odds that the user's prior knowledge is wrong
# By tools/benchmark.py calibration. Each feature counts in one direction only.
FEATURES = ("log of the ratio", "log of the score", "log of the matches, or of the drawn score")
NONE_FEATURES = ("constant", "log10 of the largest deviation [rad]")
MODELS: dict[EvidenceKind, ChoiceModel] = {
    "shape": ChoiceModel((11.0, 1.8, 1.7), (-3.613, 3.3)),
    "views": ChoiceModel((5.75, 0.43), (6.34, 3.82)),
    "drawn scan": ChoiceModel((5.38, 1.27, 2.91), (12.994, 3.96)),
}


def pose_features(standing: Standing, method: Method = METHOD) -> Array:
    """Return the features of a pose's odds, as FEATURES names them; by coloured views alone the first two."""
    ratio = min(max(standing.ratio, method.least_ratio), MOST_RATIO)
    of_views = [ratio, max(standing.score, LEAST_LOGIT_SCORE)]
    if standing.drawn_score is not None:
        return np.log([*of_views, max(standing.drawn_score, LEAST_DRAWN)])
    if standing.num_matches is None:
        return np.log(of_views)
    return np.log([*of_views, standing.num_matches + method.noise_matches])


def log_odds(standing: Standing, method: Method = METHOD, model: ChoiceModel | None = None) -> float:
    """Return the logarithm of a pose's odds, up to a constant; by default with the model of its evidence."""
    model = model or MODELS[standing.evidence]
    return float(pose_features(standing, method) @ np.array(model.weights)) + standing.log_prior


def none_features(std: float | None) -> Array:
    """Return the features (2,) of the odds that no pose is right, as NONE_FEATURES names them.

    `std` is the largest deviation [rad] of the best pose by image and scan; None if it is not known.
    """
    return np.array([1.0, math.log10(min(max(std or MOST_STD, LEAST_STD), MOST_STD))])


def posterior(
    standings: Sequence[Standing],
    std_of_fit: float | None,
    method: Method = METHOD,
    model: ChoiceModel | None = None,
    mirrored: Mirrored | None = None,
) -> Array:
    """Return the probabilities (K + 1,) that the place of each of K poses is right, and that none of them is.

    `std_of_fit` is the largest deviation of the best position with an exact focal length, as an angle [rad].
    The default model is that of the poses' kind of evidence. It is calibrated for photos of which half were
    taken in the scan. The larger the deviation, the likelier it is that no place is right: the photo then
    fits nearly as well a little away from the best pose. So it is if the `mirrored` photo fits as well, as it
    is nowhere in the scan, unless that is symmetric.
    """
    model = model or MODELS[standings[0].evidence]
    logits = [log_odds(standing, method, model) for standing in standings]
    of_none = none_features(std_of_fit)
    logits.append(float(of_none @ np.array(model.none_weights)))
    if mirrored is not None and mirrored.standing is not None:
        logits[-1] += weigh_mirrored(log_odds(mirrored.standing, method, model) - max(logits[:-1]))
    odds = np.exp(np.array(logits) - max(logits))
    return np.asarray(odds / odds.sum())


def weigh_mirrored(difference: float) -> float:
    """Return the log likelihood ratio of no right pose against a right one, by the mirrored photo.

    `difference` is the log of its odds less that of the photo as it is. A mirrored photo that fits far worse
    tells nothing: two rooms may look alike as they are.
    """
    return math.log1p(1.0 / (SYMMETRIC * (1.0 + math.exp(-difference))))


def share_unmirrored(
    standings: Sequence[Standing], mirrored: Mirrored | None, method: Method = METHOD
) -> float:
    """Return the probability that a photo that is right as it is, or mirrored, is so as it is.

    By the photo alone: what is known of the place holds for both. Photos of a group are rarely mirrored one
    by one, so that this does not count near others that are sure.
    """
    if mirrored is None or mirrored.standing is None:
        return 1.0
    of_mirrored, *own = (
        log_odds(one._replace(log_prior=0.0), method) for one in (mirrored.standing, *standings)
    )
    return 1.0 / (1.0 + TURNED_OVER * math.exp(of_mirrored - max(own)))


def classify(probabilities: Array, min_confidence: float) -> str:
    """Return the status for probabilities (K + 1,): ambiguous if the poses are likely only all together."""
    if probabilities[0] >= min_confidence:
        return LOCALIZED
    return AMBIGUOUS if 1.0 - probabilities[-1] >= min_confidence else NOT_LOCALIZED
