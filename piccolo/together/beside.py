"""A second look at a photo that is not sure, beside others that are.

Photos taken near each other show the same things in the same light, more alike than the scan drawn there. The
keypoints of the sure photos get their ranges from the scan, and the matches of the unsure photo with these
keypoints give its pose.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

from ..evidence.contradictions import contradictions
from ..evidence.covariance import split_errors
from ..evidence.focal_length import FocalFit
from ..evidence.verification import match_beside, match_covariance, place_keypoints
from ..geometry.nearness import CONFIRMED
from ..geometry.pose import Pose
from ..geometry.pose_gaussian import PoseGaussian, turn_positions
from ..judge.by_others import believe_beside
from ..judge.conclude import take_pose
from ..judge.pose_covariance import PoseCovariance
from ..judge.result import Result, nothing_found
from ..local_features.hypotheses import exact_pose, propose_poses
from ..local_features.matching import Located, Matches
from ..localization.judging import Found, judge
from ..localization.means import Means
from ..localization.run import refine_known
from ..photo.panorama import Panorama
from ..problem.method import Method
from ..problem.prior import apply_prior
from ..problem.problem import Problem, prepare_problem
from ..problem.settings import CoarseToFineSettings
from ..scan_map.scan_map import ScanMap
from ..system.jobs.threads import Stopwatch, Workers, one_blas_thread

MOST_BESIDE = 3  # photos beside, those with the most matches


class SurePhoto(NamedTuple):
    """A photo that is sure."""

    located: Located
    confidence: float  # of its pose
    gaussian: PoseGaussian | None  # its pose in the map with its covariance


class Neighbor(NamedTuple):
    """A sure photo that shows the same things as the photo that is localized, here called the query."""

    name: str
    picture: SurePhoto
    matches: Matches
    pose: Pose  # of the query, by the matches


@one_blas_thread()
def place_sure(
    problem: Problem,
    pose_world: Pose,
    covariance: PoseCovariance | None,
    confidence: float,
    workers: Workers,
) -> SurePhoto:
    """Return the keypoints of a photo that is localized, and its pose with its errors."""
    pose = problem.scan_map.from_world(pose_world)
    gaussian = recall_gaussian(problem, pose, covariance)
    return SurePhoto(place_keypoints(problem, pose, workers), confidence, gaussian)


def recall_gaussian(problem: Problem, pose: Pose, covariance: PoseCovariance | None) -> PoseGaussian | None:
    """Return a photo's pose in the map with its errors; those of the scan are common to all photos."""
    if covariance is None:
        return None
    in_map = turn_positions(covariance.matrix, problem.scan_map.R_map_from_world)
    return split_errors(problem, pose, in_map)


@one_blas_thread()
def localize_beside(
    scan_map: ScanMap,
    panorama: Panorama,
    known: Sequence[Pose],
    pictures: Mapping[str, SurePhoto],
    settings: CoarseToFineSettings,
    workers: Workers,
    watch: Stopwatch,
) -> tuple[Result, tuple[str, ...]]:
    """Localize a photo of a part of the sphere by others that are sure, given by their names.

    `known` are poses in the map that were found for the photo alone. Returns the result, and the names of the
    pictures that show the same things; if there are none, the result is empty. The photo is no surer than the
    surest of these pictures.
    """
    allowed_map = apply_prior(scan_map, settings.prior)
    with watch.stage("match"):
        problem = prepare_problem(panorama, allowed_map, settings.prior, settings.gravity, settings.method)
        is_asked = problem.profile.is_narrow and len(allowed_map.sparse) > 0
        asked = list(pictures.items()) if is_asked else []
        matched = filter(None, workers.map(partial(match_picture, problem, workers), asked, "match"))
        found = [other for other, _ in sorted(matched, key=lambda pair: -pair[1])[:MOST_BESIDE]]
    if not found:
        return nothing_found(), ()
    means = Means(settings.effort, workers, watch)
    with watch.stage("refine"):
        problem = replace(problem, beside=tuple(other.matches for other in found))
        poses = [*known, *(other.pose for other in found)]
        ended = refine_known(problem, poses, means)
        if isinstance(ended.fit, FocalFit):  # the photo beside confirms the pose
            ended = ended._replace(fit=ended.fit._replace(of_picture=None))
        judged = judge(ended, means, settings.demand)
        kept = list_agreeing(ended.problem.method, judged, found, ended.problem.beside, scan_map)
        if not kept:
            return nothing_found(), ()
        within = None
        fused = fuse(judged, kept[0], ended)
        if fused is not None:
            within = settings.accuracy.probability(fused)
            judged = take_pose(judged, fused, scan_map)
        belief = believe_beside(judged.belief, [other.picture.confidence for other in kept], within)
    return judged.take_belief(belief, settings.min_confidence), tuple(other.name for other in kept)


def list_agreeing(
    method: Method,
    judged: Result,
    found: Sequence[Neighbor],
    matches: Sequence[Matches],
    scan_map: ScanMap,
) -> list[Neighbor]:
    """List the neighbours whose matches (with rays by the final camera) confirm the pose of the result."""
    if judged.best_pose is None:
        return []
    own = scan_map.from_world(judged.best_pose)
    agreeing = []
    for other, turned in zip(found, matches, strict=True):
        exact = confirm(turned, own, method.sure_matches)
        if exact:
            agreeing.append(other._replace(matches=turned, pose=exact))
    return agreeing


def confirm(matches: Matches, own: Pose, least: int) -> Pose | None:
    """Return a photo's pose by its matches with another; None if fewer than `least` confirm its `own`."""
    exact = exact_pose(matches, own)
    is_confirmed = exact and exact.num_matches >= least and CONFIRMED.holds(exact.pose, own)
    return exact.pose if exact and is_confirmed else None


def attach_by_matches(of_other: PoseGaussian, pose: Pose, matches: Matches) -> PoseGaussian:
    """Return a photo's pose by its matches with another photo, with the errors of that photo's pose."""
    return of_other.attach(pose @ of_other.pose.inverse(), match_covariance(matches, pose))


def fuse(judged: Result, other: Neighbor, ended: Found) -> PoseGaussian | None:
    """Return the mean of a result's own pose and of the pose by the photo beside, in the map.

    Errors of the focal length and of the scan are common to both poses. None if the result is ruled out, or
    if the mean would contradict the prior.
    """
    own = judged.gaussian
    of_photo = other.picture.gaussian
    if own is None or of_photo is None or judged.belief.ruled_out:
        return None
    expected = attach_by_matches(of_photo, other.pose, other.matches)
    if ended.fit is not None:
        expected = expected.widen(ended.fit.pose_covariance)
    return fuse_allowed(ended.problem, expected, own)


def match_picture(
    problem: Problem, workers: Workers, named: tuple[str, SurePhoto]
) -> tuple[Neighbor, int] | None:
    """Match a photo with another, given with its name; return the neighbour and how many matches agree.

    None if fewer agree than a sure pose has.
    """
    name, picture = named
    matches = match_beside(problem, picture.located, workers)
    least = problem.method.sure_matches
    found = propose_poses(matches, 1, workers) if len(matches.query) >= least else []
    if not found or found[0].num_matches < least:
        return None
    return Neighbor(name, picture, matches, found[0].pose), found[0].num_matches


def fuse_allowed(problem: Problem, one: PoseGaussian, other: PoseGaussian) -> PoseGaussian | None:
    """Return the mean of two estimates of a pose in the map; None if it contradicts the prior."""
    fused = one.fuse(other)
    return None if contradictions(problem.scan_map, fused.pose, problem.prior) else fused
