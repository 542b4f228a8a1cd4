"""Photos of one place that were all mirrored, left for right.

A rack or a thin wall, seen from behind, looks like the mirror image of its front: a mirrored photo of a part
of a room may fit there, and several confirm each other. Their mirror images are found where the photos were
taken.
"""

from collections.abc import Mapping
from dataclasses import replace

from ..evidence.examine import choose
from ..judge.probability import LOCALIZED
from ..judge.reasons import MIRRORED, Reason
from ..judge.result import Result
from ..judge.selection import is_sure, rank
from ..localization.attempts import plan_attempts
from ..localization.localize import make_attempts
from ..localization.means import Means
from ..problem.problem import Problem
from .members import Member


def refuse_mirrored(
    together: Mapping[int, Result], members: Mapping[int, Member], means: Means, min_confidence: float
) -> dict[int, Result]:
    """Return the results of photos together, none of them sure by itself, refused if they were mirrored.

    They were if the mirror image of any of them is sure. It is not searched if no photo is localized.
    """
    numbers = [k for k, result in together.items() if result.status == LOCALIZED]
    if not any(is_found(members[k].found.problem.mirror(), means) for k in numbers):
        return dict(together)
    return {
        k: replace(
            result.take_belief(result.belief.rule_out(Reason.MIRRORED), min_confidence),
            warnings=(*result.warnings, MIRRORED),
        )
        for k, result in together.items()
    }


def is_found(problem: Problem, means: Means) -> bool:
    """Return True if the search of a photo ends with a pose that is sure."""
    asked, candidates = make_attempts(plan_attempts(problem), means)
    return is_sure(asked.profile, choose(asked, rank(candidates), means.workers))
