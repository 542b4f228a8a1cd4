"""The best candidates refined to the top of the ladder, until one stays the best."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

from ..evidence.examine import choose, complete
from ..judge.candidate import Candidate, Selection
from ..judge.selection import count_matches, is_faint, rank
from ..problem.method import Method
from ..problem.problem import Problem
from ..system.jobs.threads import Workers
from .ladder import climb_to_full, climb_unoccluded, settle

HOPELESS_SCORE = 0.02  # black, white and noisy pictures, and most photos of other places, have less
MAX_REFINED = 4  # alternatives


def refine_best(problem: Problem, candidates: Sequence[Candidate], workers: Workers) -> Selection:
    """Refine the best candidate and the alternatives that come near it, and select the best.

    If all are faint, only the best is refined first, on fine cells; if it stays faint, refinement ends.
    """
    found = complete(problem, rank(candidates), workers)
    if found.best.score < HOPELESS_SCORE:
        return found
    if is_faint(problem.profile, found):
        best = climb_unoccluded(problem, found.best, workers)
        found = choose(problem, rank([best, *found.alternatives]), workers)
        if is_faint(problem.profile, found):
            return found
    near, far = part_near(problem.method, found, count_matches(problem.profile, found.candidates)[1:])
    if not near:
        best = climb_unoccluded(problem, found.best, workers)
        return settle_best(problem, rank([best, *found.alternatives]), workers)
    refined = workers.map(partial(climb_to_full, problem, workers=workers), [found.best, *near], "descend")
    return settle_best(problem, choose(problem, rank([*refined, *far]), workers), workers)


def part_near(
    method: Method, found: Selection, counts: Sequence[int]
) -> tuple[list[Candidate], list[Candidate]]:
    """Divide the alternatives: those near the best, by score or by `counts` of matches, and the others."""
    near: list[Candidate] = []
    far: list[Candidate] = []
    for h, count in zip(found.alternatives, counts, strict=True):
        is_near = h.score > method.near_score * found.best.score or count >= method.sure_matches
        (near if is_near and len(near) < MAX_REFINED else far).append(h)
    return near, far


def settle_best(problem: Problem, found: Selection, workers: Workers) -> Selection:
    """Refine the best pose to convergence; repeat if another becomes the best."""
    at_rest: list[Candidate] = []
    with workers.beside(partial(problem.surroundings_at, found.best.pose)):  # the pose hardly moves
        for _ in range(1 + len(found.alternatives)):
            best = settle(problem, found.best, workers)
            at_rest.append(best)
            found = choose(problem, replace(found, best=best), workers)
            if any(found.best.pose is h.pose for h in at_rest):
                break
    return found
