"""Copies of a place, as rooms of one kind: poses elsewhere at which the scan looks the same."""

from collections.abc import Sequence
from itertools import compress

from ..evidence.examine import complete, examine_each
from ..evidence.verification import find_copies
from ..geometry.nearness import ONE_ANSWER
from ..jobs.threads import Workers
from ..judge.alternatives import MAX_ALTERNATIVES, suppress_near
from ..judge.candidate import Candidate, Selection
from ..judge.selection import list_drawn
from ..problem.problem import Problem
from ..problem.settings import Effort
from .shape import find_alike


def list_reported(
    problem: Problem, found: Selection, effort: Effort, workers: Workers
) -> tuple[Selection, list[bool]]:
    """Return the selection with the alternatives to report; True for poses that are copies, the best first.

    In a scan without colours copies are searched.
    """
    if not problem.profile.has_shape:
        reported = found.take(found.candidates[: 1 + MAX_ALTERNATIVES])
        return reported, list_copies(problem, reported, workers)
    alike = find_alike(problem, found.best.pose, effort, workers)
    reported, is_copy = put_first(found, examine_each(problem, alike, workers))
    return complete(problem, reported, workers), is_copy


def put_first(found: Selection, copies: Sequence[Candidate]) -> tuple[Selection, list[bool]]:
    """Return the selection with copies of its place before other poses; True for them and the best."""
    others = suppress_near([*copies, *found.alternatives], MAX_ALTERNATIVES, ONE_ANSWER)
    is_copy = [any(other is copy for copy in copies) for other in others]
    return found.take([found.best, *others]), [True, *is_copy]


def list_copies(problem: Problem, found: Selection, workers: Workers) -> list[bool]:
    """Return True for the best pose and for copies of its place; of a photo without matches there False."""
    ranked = found.candidates
    if not problem.profile.uses_matches:
        return [False] * len(ranked)
    is_rival = list_drawn(problem.profile, ranked)[1:]
    rivals = [h.pose for h in compress(found.alternatives, is_rival)]
    is_copy = iter(find_copies(problem, found.best.pose, rivals, workers))
    return [True, *(is_one and next(is_copy) for is_one in is_rival)]
