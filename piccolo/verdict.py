"""From evidence to a verdict: how likely a pose is right, and what to call it."""

from .certainty import Certainty
from .verify import Evidence

LOCALIZED = "localized"
AMBIGUOUS = "ambiguous"
NOT_LOCALIZED = "not_localized"


def verdict(evidence: Evidence, certainty: Certainty | None, min_confidence: float) -> tuple[str, float]:
    """Status and confidence in [0, 1]."""
    ok = evidence.score >= 0.25 and evidence.margin >= 0.12
    return (LOCALIZED, 1.0) if ok else (NOT_LOCALIZED, 0.0)
