"""Photos of one place that were all mirrored, left for right.

A rack or a thin wall, seen from behind, looks like the mirror image of its front: a mirrored photo of a part
of a room may fit there, and several such photos confirm each other. If they are mirrored back, they are found
where they were taken.
"""

from collections.abc import Collection, Mapping

from ..judge.conclude import rule_out_mirrored
from ..judge.probability import LOCALIZED, log_odds
from ..judge.reasons import Reason
from ..judge.result import Result
from ..judge.selection import select_mirrored
from .members import Member


def refuse_mirrored(
    results: Mapping[int, Result],
    others: Mapping[int, Collection[int]],
    members: Mapping[int, Member],
    min_confidence: float,
) -> dict[int, Result]:
    """Return refused results of those localized photos among linked ones that were mirrored.

    `others` are the photos with which each was localized together. Mostly all of these were mirrored or none
    was. So the mirror images are compared if one of the linked photos was ruled out as mirrored by itself, or
    if no localized photo was sure by itself.
    """
    localized = [k for k, result in results.items() if result.status == LOCALIZED]
    one_is_mirrored = any(Reason.MIRRORED in members[k].alone.belief.ruled_out for k in results)
    one_is_sure = any(members[k].alone.status == LOCALIZED for k in localized)
    if not localized or (one_is_sure and not one_is_mirrored):
        return {}
    differences = {k: compare_mirrored(members[k], results[k]) for k in localized}

    def was_mirrored(number: int) -> bool:
        together = {k: differences[k] for k in (number, *others[number]) if k in differences}
        return number in select_mirrored(together, one_is_mirrored)

    return {k: rule_out_mirrored(results[k], min_confidence) for k in filter(was_mirrored, localized)}


def compare_mirrored(member: Member, result: Result) -> float:
    """Return the log odds of the best pose of the mirrored photo, less those of the poses of its result.

    If the mirrored photo explains far less, it is the bound below which it does.
    """
    method = member.found.problem.method
    own = max(result.standings, key=lambda standing: log_odds(standing, method))
    less = own._replace(ratio=method.decoy_ratio * own.ratio, score=method.decoy_ratio * own.score)
    mirrored = result.mirrored and result.mirrored.standing
    return log_odds(mirrored or less, method) - log_odds(own, method)
