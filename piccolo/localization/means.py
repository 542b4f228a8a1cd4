"""The means of a search: how much is searched, on which threads; and what is noted meanwhile."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from ..judge.candidate import Candidate, Selection
from ..problem.problem import Problem
from ..problem.settings import Effort
from ..system.jobs.threads import Stopwatch, Workers

Step = dict[str, Any]


@dataclass(frozen=True)
class Trace:
    """The steps of a photo's search, from which follows why it was found at a place, or not found."""

    is_wanted: bool = False
    steps: list[Step] = field(default_factory=list)

    def note(self, step: str, describe: Callable[[], Step]) -> None:
        """Note a step, if the trace is wanted."""
        if self.is_wanted:
            self.steps.append({"step": step, **describe()})


NO_TRACE = Trace()


class Means(NamedTuple):
    """The means by which a photo is searched."""

    effort: Effort
    workers: Workers
    watch: Stopwatch
    trace: Trace = NO_TRACE


def describe_candidates(problem: Problem, candidates: Sequence[Candidate]) -> list[Step]:
    """Describe candidates with their evidence, in the world."""
    return [describe_candidate(problem, candidate) for candidate in candidates]


def describe_candidate(problem: Problem, candidate: Candidate) -> Step:
    """Describe a candidate with its evidence, in the world."""
    pose = problem.scan_map.to_world(candidate.pose)
    comparison = candidate.comparison
    area = float(comparison.visible_area.sum())
    contradicted = float(comparison.visible_area[comparison.contradicts].sum())
    return {
        "center_world": pose.center_world.tolist(),
        "R_cam_from_world": pose.R_cam_from_world.tolist(),
        "score": candidate.score,
        "seen_fraction": area,
        "contradicted_fraction": contradicted / max(area, 1e-9),
        "num_matches": candidate.num_matches,
        "edge_score": candidate.edge_score,
        "against_prior": [contradiction.reason for contradiction in candidate.against_prior],
    }


def describe_selection(problem: Problem, found: Selection) -> Step:
    """Describe ranked candidates, and how far the best leads."""
    return {"margin": found.margin, "candidates": describe_candidates(problem, found.candidates)}
