"""A photo near a pose that is known from elsewhere: its own pose there, and how likely that is."""

from dataclasses import replace
from typing import NamedTuple

from ..confidence.alternatives import Hypothesis
from ..confidence.confidence import Standing, posterior
from ..geometry.nearness import RIGHT
from ..geometry.pose import Pose
from ..geometry.pose_gaussian import PoseGaussian
from .comparison import Comparison, compare, compare_from
from .covariance import UNKNOWN_ERRORS, estimate_covariance
from .ladder import FULL, NEARLY, climb_from_afar, refine, settle
from .last_descent import HOPELESS_SCORE
from .query import Query
from .selection import assess_alone
from .verification import verify


class Near(NamedTuple):
    """A pose near one that was given, and how likely it is."""

    pose: Pose  # in the map
    seen: Comparison  # of the photo with the scan there
    gaussian: PoseGaussian | None  # with its covariance; None where the points do not fix it
    place: float  # probability that its place is right


def refine_near(query: Query, start: Pose) -> Near:
    """Descend from a pose and from poses around it, then on the points, and judge the end (`assess_end`).

    A partial photo converges slowly: its descent goes on.
    """
    middle, seen_from = climb_from_afar(query, start)
    pose = refine(query, middle, FULL).pose
    seen = compare_from(query, pose, seen_from if pose.distance(seen_from) < NEARLY else pose)
    end = Hypothesis(pose, seen.score)
    if query.photo.is_partial:
        end = settle(query, end, seen)
        seen = seen if end.pose is pose else compare(query, end.pose)
    errors = UNKNOWN_ERRORS
    if end.score >= HOPELESS_SCORE:
        sees_same = end.pose.distance(middle) < NEARLY
        errors = estimate_covariance(query, end.pose, seen, middle if sees_same else None)
    place = float(posterior([assess_end(query, end)], errors.std_of_fit)[0])
    return Near(end.pose, seen, errors.gaussian, place)


def assess_end(query: Query, end: Hypothesis) -> Standing:
    """Return the evidence for a pose by whole views; of a narrow photo by its matches there too.

    Matches do not count if they put the photo elsewhere, with photos beside or without.
    """
    (standing,) = assess_alone(query.by_views(), [end])
    if not query.is_narrow:
        return standing
    found = [verify(some, end.pose) for some in (query, replace(query, beside=()))]
    own = [v.num_matches for v in found if RIGHT.holds(v.pose, end.pose)]
    return standing._replace(num_matches=max(own, default=0), evidence=query.evidence)
