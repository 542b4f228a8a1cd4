"""A frame that is found from others: where it was expected, or at the best place within reach."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...evidence.examine import complete, examine
from ...evidence.verification import draw_near, verify
from ...geometry.nearness import ONE_ANSWER
from ...geometry.pose import Pose
from ...geometry.pose_gaussian import PoseGaussian, probability_near
from ...jobs.threads import Workers
from ...judge.by_others import LOCAL_ERRORS, local_share
from ...judge.candidate import Selection
from ...judge.probability import posterior
from ...judge.selection import assess
from ...localization.beam import Ends, descend_briefly, score_mirror, score_near
from ...localization.means import Means
from ...localization.near import Near, refine_near
from ...problem.problem import Problem
from ..beside import attach_by_matches, confirm, fuse_allowed
from .expectation import Expected, Followed, describe_end, is_acceptable, list_alike, list_starts
from .frames import MOST_EXPECTED, State, log_ratio, put_state
from .path import COPY_LOG_ODDS
from .places import list_places, log_behind, narrow_down

LEAST_SCORE = 0.05  # of a tracked pose: with less it explains nothing


def find_near(problem: Problem, expected: Expected, means: Means) -> Followed | None:
    """Track a frame from the expected pose, if that looks hardly worse than the best place within reach.

    Else, or if that fails, it is tracked from that place. An end away from the expected pose counts only if
    the photo is sure of it by itself; and so does an end at an expected pose that looks worse, which is tried
    last with a narrow photo, of which views tell little. None if none holds, or if the mirrored photo fits
    better.
    """
    near, effort = narrow_down(problem, expected.last, expected.reach, means.effort)
    workers = means.workers
    ends = descend_briefly(near, effort, workers)
    if not problem.profile.is_partial and score_mirror(near, effort, workers) > ends.best_score:
        return None
    score = score_near(problem, expected.pose, workers)
    best_score = max(ends.best_score, score)
    behind = log_behind(problem, score, best_score)
    alike = list_alike(expected, list_places(problem, ends, best_score))
    for start in list_starts(expected, behind, alike, problem.profile.is_narrow):
        end = track(problem, start.pose, workers)
        if end is not None and is_acceptable(end, expected, start.must_be_sure):
            return describe_end(weigh_end(problem, near, end, ends, expected, workers), expected, alike)
    return None


def weigh_end(
    problem: Problem, near: Problem, end: State, ends: Ends, expected: Expected, workers: Workers
) -> State:
    """Return an end with what it gains; that of a narrow photo may be a local optimum."""
    if not problem.profile.is_partial:
        return replace(end, gain=compute_gain(problem, near))
    gain = compute_gain(problem, near, count_alike(problem, end.pose, ends, expected, workers))
    return replace(end, gain=gain, local=local_share(math.exp(end.log_odds)))


def compute_gain(problem: Problem, near: Problem, log_alike: float = 0.0) -> float:
    """Return what a frame gains [log] if it is found among some places: the fewer, the less it is by chance.

    `log_alike` is the log of the number of poses among these that look alike.
    """
    share = len(near.scan_map.sparse) / len(problem.scan_map.sparse)
    return min(max(-math.log(share) - log_alike, 0.0), MOST_EXPECTED)


def count_alike(problem: Problem, end: Pose, ends: Ends, expected: Expected, workers: Workers) -> float:
    """Return the log of the effective number of poses within reach that look like that of a narrow photo.

    Beside its own these are the ends of a brief search, hardly worse by whole views.
    """
    own = score_near(problem, end, workers)
    best_score = max(ends.best_score, own)
    behind = log_behind(problem, own, best_score) - COPY_LOG_ODDS
    places = list_places(problem, ends, best_score)
    rivals = [b for pose, b in places if not ONE_ANSWER.holds(pose, end) and expected.is_within(pose)]
    return float(np.logaddexp.reduce([0.0, *(min(b - behind, 0.0) for b in rivals)]))


def join_beside(problem: Problem, own: State, of_others: Sequence[PoseGaussian | None]) -> State:
    """Return the mean of a frame's pose and of that by the first frame beside whose matches confirm it.

    `of_others` are the poses of the frames beside. Where both agree, the frame's own is no local optimum.
    """
    for matches, gaussian in zip(problem.beside, of_others, strict=True):
        confirmed = confirm(matches, own.pose) if gaussian else None
        if gaussian is None or confirmed is None:
            continue
        expected = attach_by_matches(gaussian, confirmed, matches)
        mean = expected
        if own.gaussian is not None:
            fused = fuse_allowed(problem, expected, own.gaussian.blur(own.local * LOCAL_ERRORS))
            if fused is None:
                continue
            mean = fused
        offset = mean.pose.center_world - expected.pose.center_world
        local = own.local * (1.0 - probability_near(offset, expected.covariance[3:, 3:]))
        return replace(own, pose=mean.pose, gaussian=mean, local=local)
    return own


def track(problem: Problem, start: Pose, workers: Workers) -> State | None:
    """Refine a pose; None if the end more likely is wrong than right, or explains nothing.

    A narrow photo is tracked again from where its matches put it.
    """
    ends = [refine_near(problem, start, workers)]
    if problem.profile.is_narrow:
        first = ends[0].end
        drawn = draw_near(problem, first.pose, first.drawn, workers).matches
        ends.append(refine_near(problem, verify(problem, first.pose, drawn).pose, workers))
    return choose_end(ends)


def choose_end(ends: Sequence[Near]) -> State | None:
    """Return the likeliest end; None if it more likely is wrong than right, or explains nothing."""
    odds = [log_ratio(near.place, 1.0 - near.place) for near in ends]
    best = int(np.argmax(odds))
    end, gaussian, _ = ends[best]
    is_wrong = odds[best] < 0.0 or end.score < LEAST_SCORE
    return None if is_wrong else State(end.pose, odds[best], end.score, gaussian, end.forget())


def refine_state(problem: Problem, states: Sequence[State], rough: State, workers: Workers) -> list[State]:
    """Refine a rough state; its odds are then relative to those of the best refined one, by whole views.

    It is dropped if a frame would not be tracked there, or has that pose already.
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
