"""A frame that is found from other frames: where it was expected, or at the best place within reach."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ...evidence.examine import complete, examine
from ...evidence.verification import draw_near, verify
from ...geometry.nearness import ONE_ANSWER, RIGHT
from ...geometry.pose import Pose
from ...geometry.pose_gaussian import PoseGaussian, probability_near
from ...judge.by_others import LOCAL_ERRORS, local_share
from ...judge.candidate import Selection
from ...judge.probability import posterior
from ...judge.selection import assess
from ...judge.sure import SURE_ODDS
from ...local_features.hypotheses import propose_poses
from ...localization.beam import descend_briefly, score_mirror, score_near
from ...localization.means import Means
from ...localization.near import Near, refine_near
from ...problem.problem import Problem
from ...system.jobs.threads import Workers
from ..beside import attach_by_matches, confirm, fuse_allowed
from .expectation import ExpectedFrame, Followed, describe_end, is_acceptable, list_alike, list_starts
from .frames import MOST_EXPECTED, State, log_ratio, put_state
from .places import list_places, log_behind, narrow_down

LEAST_SCORE = 0.05  # of a tracked pose: with a lower score it explains nothing


class KnownPoses(NamedTuple):
    """Poses that help to track a narrow photo."""

    known: Sequence[Pose] = ()  # poses at which it was found before
    beside: Sequence[PoseGaussian | None] = ()  # poses of the photos beside, with which it is matched


NO_KNOWN_POSES = KnownPoses()


def find_near(
    problem: Problem, expected: ExpectedFrame, means: Means, poses: KnownPoses = NO_KNOWN_POSES
) -> Followed | None:
    """Track a frame from the expected pose, or from the best place within reach.

    The expected pose is the first start if it looks hardly worse than the best place; if tracking from it
    fails, or if it looks worse, the frame is tracked from that place. An end away from the expected pose
    counts only if the photo is sure of it by itself. A narrow photo has further starts, the last at an
    expected pose that looks worse, whose end counts only if the photo is sure of it. All are tried until one
    end is sure; the likeliest end counts. Return None if no end counts, or if the mirrored photo fits better.
    """
    near, effort = narrow_down(problem, expected.last, expected.reach, means.effort)
    workers = means.workers
    is_narrow = problem.profile.is_narrow
    ends = descend_briefly(near, effort, workers)
    if not problem.profile.is_partial and score_mirror(near, effort, workers) > ends.best_score:
        return None
    score = score_near(problem, expected.pose, workers)
    best_score = max(ends.best_score, score)
    behind = log_behind(problem, score, best_score)
    alike = list_alike(expected, list_places(problem, ends, best_score))
    others = [*propose_beside(problem, workers), *poses.known] if is_narrow else []
    accepted: list[State] = []
    for start in list_starts(expected, behind, alike, is_narrow, others):
        end = track(problem, start.pose, workers)
        if end is not None and is_acceptable(end, expected, start.must_be_sure):
            accepted.append(end)
            if not is_narrow or end.log_odds >= SURE_ODDS:
                break
    if not accepted:
        return None
    best = choose_accepted(accepted)
    share = 1.0
    if problem.profile.is_partial:
        best, share = join_beside(problem, best, poses.beside)
    return describe_end(replace(best, gain=share * compute_gain(problem, near)), expected, alike)


def choose_accepted(ends: Sequence[State]) -> State:
    """Return the likeliest of the ends that count; ends at other poses are evidence against it."""
    best = max(ends, key=lambda state: state.log_odds)
    others = sum(math.exp(state.log_odds) for state in ends if not RIGHT.holds(state.pose, best.pose))
    return replace(best, log_odds=best.log_odds - math.log1p(others))


def propose_beside(problem: Problem, workers: Workers) -> list[Pose]:
    """Return the poses of a photo by its matches with each of the photos beside."""
    telling = [matches for matches in problem.beside if len(matches.query) > problem.method.chance_matches]
    return [one.pose for matches in telling for one in propose_poses(matches, 1, workers)]


def compute_gain(problem: Problem, near: Problem) -> float:
    """Return the log odds that a frame gains if it is found among few places, as chance is less likely."""
    share = len(near.scan_map.sparse) / len(problem.scan_map.sparse)
    return min(-math.log(share), MOST_EXPECTED)


def join_beside(
    problem: Problem, own: State, of_others: Sequence[PoseGaussian | None]
) -> tuple[State, float]:
    """Return the mean of a frame's pose and of the pose by a photo beside, the first that confirms it.

    Return also the probability that the photo beside confirms the pose; 0 if none does. A narrow photo that
    is not confirmed gains nothing by being found within reach: it may look the same at two poses near each
    other.
    """
    for matches, gaussian in zip(problem.beside, of_others, strict=True):
        confirmed = confirm(matches, own.pose, problem.method.sure_matches) if gaussian else None
        if gaussian is None or confirmed is None:
            continue
        expected = attach_by_matches(gaussian, confirmed, matches)
        mean = expected
        if own.gaussian is not None:
            local = local_share(math.exp(own.log_odds)) * LOCAL_ERRORS
            fused = fuse_allowed(problem, expected, own.gaussian.blur(local))
            if fused is None:
                continue
            mean = fused
        share = probability_near(mean.pose, expected, RIGHT)  # of the place, whatever accuracy is wanted
        return replace(own, pose=mean.pose, gaussian=mean), share
    return own, 0.0


def track(problem: Problem, start: Pose, workers: Workers) -> State | None:
    """Refine a pose; None if the end is more likely wrong than right, or explains nothing.

    A narrow photo is tracked again from the pose by its matches.
    """
    ends = [refine_near(problem, start, workers)]
    if problem.profile.is_narrow:
        first = ends[0].end
        drawn = draw_near(problem, first.pose, first.drawn, workers).matches
        ends.append(refine_near(problem, verify(problem, first.pose, drawn).pose, workers))
    return choose_end(ends)


def choose_end(ends: Sequence[Near]) -> State | None:
    """Return the likeliest end; None if it is more likely wrong than right, or explains nothing."""
    odds = [log_ratio(near.place, 1.0 - near.place) for near in ends]
    best = int(np.argmax(odds))
    end, gaussian, _ = ends[best]
    is_wrong = odds[best] < 0.0 or end.score < LEAST_SCORE
    return None if is_wrong else State(end.pose, odds[best], end.score, gaussian, end.forget())


def refine_state(problem: Problem, states: Sequence[State], rough: State, workers: Workers) -> list[State]:
    """Refine a rough state; return all states.

    Its odds are then those of the best refined state, times the ratio of the two by whole views. The state is
    dropped if tracking from it fails, or ends at the pose of another state.
    """
    best = max((s for s in states if s.is_refined), key=lambda s: s.log_odds)
    end = track(problem, rough.pose, workers)
    others = [s for s in states if s is not rough]
    if end is None or any(s.is_refined and ONE_ANSWER.holds(s.pose, end.pose) for s in others):
        return others
    by_views = problem.by_views()
    ends = [s.end or replace(examine(by_views, s.pose), score=s.score or 0.0) for s in (best, end)]
    standings = assess(by_views.profile, complete(by_views, Selection(ends[0], (ends[1],)), workers))
    first, second = posterior(standings, None)[:2]
    return put_state(others, replace(end, log_odds=best.log_odds + log_ratio(float(second), float(first))))
