"""A photo near a pose that is known from elsewhere: its own pose there, and how likely that is."""

from dataclasses import replace
from typing import NamedTuple

from ..confidence.alternatives import Hypothesis
from ..confidence.confidence import Standing, posterior
from ..geometry.pose import MAX_DISTANCE, Pose
from ..geometry.pose_gaussian import PoseGaussian, std_of
from .comparison import score_pose
from .covariance import estimate_covariance
from .last_descent import FULL_LIMITS, HOPELESS_SCORE, NEARLY, settle
from .query import Query
from .refinement import descend, refine_on_middle_cells
from .selection import assess_poses
from .verification import is_near, verify


class Near(NamedTuple):
    """A pose near one that was given, judged by the photo alone."""

    pose: Pose  # in the map
    score: float  # as of Evidence
    gaussian: PoseGaussian | None  # with its covariance; None where the points do not fix it
    probability: float  # that the pose is right


def has_own_matches(query: Query) -> bool:
    """Return True for a narrow photo whose features can be matched with the scan drawn at a pose."""
    return query.photo.is_partial and query.num_parts > 0


def refine_near(query: Query, start: Pose) -> Near:
    """Descend from a pose and from poses around it, then on the points, and judge the end by whole views.

    A narrow photo converges slowly: its descent goes on.
    """
    middle, seen_from = refine_on_middle_cells(query, start)
    pose = descend(query.points_at(middle), query.photo.images.full(), middle, FULL_LIMITS)
    end = score_pose(query, pose, seen_from if pose.distance(seen_from) < NEARLY else None)
    end = settle(query, end) if query.photo.is_partial else end
    errors = None
    if end.score >= HOPELESS_SCORE:
        sees_same = end.pose.distance(middle) < NEARLY
        errors = estimate_covariance(query, end.pose, seen_from=middle if sees_same else None)
    gaussian, std_of_fit = errors or (None, None)
    probability = float(posterior([assess_end(query, end)], std_of(gaussian), std_of_fit)[0])
    return Near(end.pose, end.score, gaussian, probability)


def assess_end(query: Query, end: Hypothesis) -> Standing:
    """Return the evidence for a pose by whole views; of a narrow photo by its matches there too.

    Matches do not count if they put the photo elsewhere, with photos beside or without.
    """
    standing = assess_poses(replace(query, num_parts=0), end, [])[0]
    if not has_own_matches(query):
        return standing
    found = [verify(some, end.pose) for some in (query, replace(query, beside=()))]
    own = [v.num_matches for v in found if is_near(v.pose, end.pose, MAX_DISTANCE)]
    return standing._replace(num_matches=max(own, default=0), is_drawn=True)
