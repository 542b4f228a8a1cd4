"""The places of the map that look like a frame, by whole views."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ...geometry.nearness import ONE_ANSWER, ONE_PLACE, non_maximum_suppression
from ...geometry.pose import Pose, multiply, uniform_yaws
from ...judge.probability import LOCALIZED, MODELS, Standing, pose_features
from ...judge.result import Result
from ...localization.beam import Ends, descend_briefly, score_briefly, score_mirror, score_near
from ...localization.means import Means
from ...problem.problem import Problem
from ...problem.settings import Effort
from .expectation import Place
from .frames import MOST_ODDS, State
from .path import COPY_LOG_ODDS

MOST_PLACES = 64  # of a frame: as many as a hotel has rooms that look alike


def fits_mirror(problem: Problem, means: Means) -> bool:
    """Return True if, by brief searches, the photo fits better mirrored than as it is."""
    effort = means.effort.brief()
    own = score_briefly(problem, effort, means.workers)
    return score_mirror(problem, effort, means.workers) > own


def list_key_states(
    problem: Problem, own: Sequence[State], means: Means, alone: Result | None = None
) -> list[State]:
    """List the states of a key frame: the poses that were found for it, best first, and all other places.

    `alone` is the result of a frame that was searched by itself.
    """
    best = own[0]
    others = [
        (pose, behind)
        for pose, behind in find_places(problem, best.pose, means)
        if not any(ONE_PLACE.holds(pose, state.pose) for state in own)
    ][:MOST_PLACES]
    most = math.inf if alone is None else most_elsewhere(problem, alone, best, len(others))
    rough = [State(pose, min(best.log_odds + behind, most)) for pose, behind in others]
    states: list[State] = []
    for state in (*own, *rough):
        if not any(ONE_ANSWER.holds(state.pose, other.pose) for other in states):
            states.append(state)
    return states[:MOST_PLACES]


def most_elsewhere(problem: Problem, alone: Result, best: State, count: int) -> float:
    """Return the largest log odds of a place at which the search of a frame by itself found no pose.

    If the photo is sure by itself, they are the lowest that one frame may give. For a photo of a part of the
    sphere, of which views alone show little, all `count` places together have the odds that none of the
    photo's poses is right.
    """
    if alone.status == LOCALIZED:
        return best.log_odds - MOST_ODDS - COPY_LOG_ODDS
    return -math.log(max(count, 1)) - COPY_LOG_ODDS if problem.profile.is_partial else math.inf


def narrow_down(problem: Problem, pose: Pose, radius: float, effort: Effort) -> tuple[Problem, Effort]:
    """Return the problem of whole views within a radius [m] of a pose, in its tilt and any heading.

    Return also the effort of its brief search.
    """
    m = problem.scan_map
    distances = np.linalg.norm(m.centers[m.sparse] - pose.center_world, axis=1)
    near = m if math.isinf(radius) else m.narrow(distances <= max(radius, float(distances.min())))
    level = multiply(pose.R_cam_from_world, uniform_yaws(effort.num_yaws))
    close = replace(problem.by_views(), scan_map=near, rotations=level)
    return close, effort.brief(max(len(near.sparse), 1))


def find_places(problem: Problem, own: Pose, means: Means) -> list[Place]:
    """Find the distinct poses that look like a photo, with the tilt of its pose `own`; best first."""
    close, effort = narrow_down(problem, own, math.inf, means.effort)
    ends = descend_briefly(close, effort, means.workers)
    return list_places(problem, ends, score_near(problem, own, means.workers))


def list_places(problem: Problem, ends: Ends, own_score: float) -> list[Place]:
    """List the distinct ends with their log odds against a pose with the score `own_score`."""
    R = ends.poses.R_cam_from_map
    centers = ends.poses.center_map
    kept = non_maximum_suppression(R, centers, MOST_PLACES, ONE_ANSWER)
    found = zip(ends.poses.take(kept).poses(), ends.scores[kept], strict=True)
    return [(pose, log_behind(problem, float(score), own_score)) for pose, score in found]


def log_behind(problem: Problem, score: float, own_score: float) -> float:
    """Return the log odds of a pose against another by their scores, at most 0, by the model of views."""
    standing = Standing(score / max(own_score, 1e-9), 1.0, None, problem.profile.by_views().evidence)
    weight = MODELS[standing.evidence].weights[0]
    return min(weight * float(pose_features(standing)[0]), 0.0)
