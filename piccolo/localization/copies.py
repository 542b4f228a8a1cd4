"""Copies of a place, as rooms of one kind: poses elsewhere at which the scan looks the same."""

from collections.abc import Sequence

from ..evidence.examine import complete, examine_each
from ..evidence.verification import find_copies
from ..geometry.nearness import ONE_ANSWER
from ..judge.alternatives import MAX_ALTERNATIVES, suppress_near
from ..judge.candidate import Candidate, Selection
from ..judge.selection import list_drawn
from ..problem.problem import Problem
from ..problem.settings import Effort
from ..system.jobs.threads import Workers
from .shape import find_alike


def list_reported(
    problem: Problem, found: Selection, effort: Effort, workers: Workers
) -> tuple[Selection, list[bool]]:
    """Return the selection with the alternatives to report; for each pose, True if it is a copy of the place.

    The best pose, which is the first, counts as one. In a scan without colours, copies are searched for.
    """
    if not problem.profile.has_shape:
        reported = found.take(found.candidates[: 1 + MAX_ALTERNATIVES])
        return reported, list_copies(problem, reported.candidates, 0, workers)
    alike = find_alike(problem, found.best.pose, effort, workers)
    reported, is_copy = put_first(found, examine_each(problem, alike, workers))
    return complete(problem, reported, workers), is_copy


def put_first(found: Selection, copies: Sequence[Candidate]) -> tuple[Selection, list[bool]]:
    """Return the selection with the copies before other alternatives; True for the best and each copy."""
    others = suppress_near([*copies, *found.alternatives], MAX_ALTERNATIVES, ONE_ANSWER)
    is_copy = [any(other is copy for copy in copies) for other in others]
    return found.take([found.best, *others]), [True, *is_copy]


def list_copies(problem: Problem, ranked: Sequence[Candidate], one: int, workers: Workers) -> list[bool]:
    """Return True for candidate `one` of the ranked, and for copies of its place; all False without matches.

    Only candidates that could still win are compared with it. The first of the ranked is the best.
    """
    if not problem.profile.uses_matches:
        return [False] * len(ranked)
    is_rival = list_drawn(problem.profile, ranked)
    others = [k for k in range(len(ranked)) if k != one and is_rival[k]]
    found = find_copies(problem, ranked[one], [ranked[k] for k in others], workers)
    copies = {k for k, is_copy in zip(others, found, strict=True) if is_copy}
    return [k == one or k in copies for k in range(len(ranked))]
