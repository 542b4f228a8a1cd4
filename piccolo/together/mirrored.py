"""Photos of one place that were all mirrored, left for right.

A rack or a thin wall, seen from behind, looks like the mirror image of its front: a mirrored photo of a part
of a room may fit there, and several confirm each other. Their mirror images are found where the photos were
taken.
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
from .bundle_search import Support
from .members import Member

# Chosen: of mirrored photos, against the photos as they are. Of 15 photos of a hospital none had more than
# 0.41; two of racks that were mirrored had 1.8 together.
LEAST_LOG_ODDS = 1.0


def refuse_mirrored(
    together: Mapping[int, Result],
    members: Mapping[int, Member],
    supports: Mapping[int, Support],
    means: Means,
    min_confidence: float,
) -> dict[int, Result]:
    """Return the results of photos together, none of them sure by itself, refused if they were mirrored.

    That is asked if any is localized. Their supports tell how much what each shows counts.
    """
    if not any(result.status == LOCALIZED for result in together.values()):
        return dict(together)
    odds = sum(supports[k].weight * compare_mirrored(members[k], means) for k in together)
    if odds < LEAST_LOG_ODDS:
        return dict(together)
    return {
        k: replace(
            result.take_belief(result.belief.rule_out(Reason.MIRRORED), min_confidence),
            warnings=(*result.warnings, MIRRORED),
        )
        for k, result in together.items()
    }


def compare_mirrored(member: Member, means: Means) -> float:
    """Return the log odds of the best pose of the mirrored photo, less those of the photo's own."""
    problem = member.found.problem.mirror()
    asked, candidates = make_attempts(plan_attempts(problem), means)
    mirrored = assess(asked.profile, choose(asked, rank(candidates), means.workers))
    own = member.alone.standings
    return log_odds(mirrored[0], problem.method) - max(log_odds(one, problem.method) for one in own)
