"""Photos of one place that were all mirrored, left for right.

A rack or a thin wall, seen from behind, looks like the mirror image of its front: a mirrored photo of a part
of a room may fit there, and several such photos confirm each other. If they are mirrored back, they are found
where they were taken.
"""

from collections.abc import Mapping
from dataclasses import replace

from ..evidence.examine import choose
from ..judge.probability import LOCALIZED, log_odds
from ..judge.reasons import MIRRORED, Reason
from ..judge.result import Result
from ..judge.selection import assess, rank
from ..localization.attempts import plan_attempts
from ..localization.means import Means
from ..localization.run import make_attempts
from .members import Member

# Chosen: log odds of a mirrored photo against the photo as it is. Of 15 photos of a hospital none had more
# than 0.41; one of the mirrored photos of racks had 2.3.
LEAST_LOG_ODDS = 1.0


def refuse_mirrored(
    results: Mapping[int, Result], members: Mapping[int, Member], means: Means, min_confidence: float
) -> dict[int, Result]:
    """Return refused results of the localized photos among linked ones, if all were mirrored; else none.

    No mirrored photo is linked with one that is not. So the mirror images are searched if one of the photos
    was ruled out as mirrored by itself, or if no localized photo was sure by itself. The photo with the
    largest log odds, for or against, decides.
    """
    localized = [k for k, result in results.items() if result.status == LOCALIZED]
    one_is_mirrored = any(Reason.MIRRORED in members[k].alone.belief.ruled_out for k in results)
    one_is_sure = any(members[k].alone.status == LOCALIZED for k in localized)
    if not localized or (one_is_sure and not one_is_mirrored):
        return {}
    most = max((compare_mirrored(members[k], results[k], means) for k in localized), key=abs)
    if most < LEAST_LOG_ODDS:
        return {}
    return {k: rule_out_mirrored(results[k], min_confidence) for k in localized}


def rule_out_mirrored(result: Result, min_confidence: float) -> Result:
    """Return the result of a photo, ruled out as mirrored, with the warning."""
    refused = result.take_belief(result.belief.rule_out(Reason.MIRRORED), min_confidence)
    return replace(refused, warnings=(*refused.warnings, MIRRORED))


def compare_mirrored(member: Member, result: Result, means: Means) -> float:
    """Return the log odds of the best pose of the mirrored photo, less those of the poses of its result.

    They are 0 if the mirrored photo is not found: that tells nothing.
    """
    problem = member.found.problem.mirror()
    searched, candidates = make_attempts(plan_attempts(problem), means)
    ranked = rank(candidates)
    if ranked.best.score < problem.method.faint_score:
        return 0.0
    mirrored = assess(searched.profile, choose(searched, ranked, means.workers))
    own = max(log_odds(standing, problem.method) for standing in result.standings)
    return log_odds(mirrored[0], problem.method) - own
