"""A photo whose focal length is a guess, localized with several."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..confidence.alternatives import MAX_ALTERNATIVES
from ..confidence.confidence import classify
from ..confidence.localization import Alternative, Localization
from ..geometry.pose import is_correct
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import Workers
from ..panorama import Panorama
from ..scan_map.scan_map import ScanMap
from .focal_length import WIDE, changed
from .localize import localize
from .settings import CoarseToFineSettings

GUESSES = (0.0, -0.15, 0.15)  # of the logarithm of a focal length: a fifth off is within reach of one of them


def localize_guessed(
    scan_map: ScanMap, panorama: Panorama, settings: CoarseToFineSettings, workers: Workers, watch: Stopwatch
) -> Localization:
    """Localize a photo, with several focal lengths where its own is a guess."""
    prior = panorama.focal_prior
    if prior is None or prior.deviation <= WIDE:
        return localize(scan_map, panorama, settings, workers, watch)
    width = panorama.rgb.shape[1]
    camera = panorama.cameras[0].camera
    taken = [panorama.retaken(changed(camera, np.array([guess])), width) for guess in GUESSES]
    return likeliest([localize(scan_map, photo, settings, workers, watch) for photo in taken], settings)


def likeliest(found: Sequence[Localization], settings: CoarseToFineSettings) -> Localization:
    """Return the most confident of several results; it shares its probability with those of other poses."""
    ranked = sorted(found, key=lambda f: -f.confidence)
    best = ranked[0]
    rivals: list[Localization] = []
    for other in ranked[1:]:
        if other.pose and other.evidence and not any(is_correct(f.pose, other.pose) for f in (best, *rivals)):
            rivals.append(other)
    total = best.confidence + sum(f.confidence for f in rivals)
    if total <= best.confidence:
        return best
    share = best.confidence / total
    others = [
        Alternative(f.pose, f.evidence.score, None, f.evidence.num_matches, share * f.confidence)
        for f in rivals
        if f.pose and f.evidence
    ]
    listed = [*others, *best.alternatives][:MAX_ALTERNATIVES]
    confidence = share * best.confidence
    none = 1.0 - confidence - sum(a.probability or 0.0 for a in listed)
    probabilities = np.array([confidence, *(a.probability or 0.0 for a in listed), none])
    status = classify(probabilities, settings.min_confidence)
    return replace(
        best, status=status, confidence=confidence, probability_none=none, alternatives=tuple(listed)
    )
