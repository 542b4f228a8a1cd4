"""The poses that a bundle of photos may have, by the photos' own poses, and how likely each is."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..arrays import Array
from ..evidence.covariance import estimate_errors
from ..evidence.examine import complete, count_agreeing, examine
from ..evidence.verification import draw_near, verify
from ..geometry.nearness import ONE_IN_BUNDLE
from ..geometry.pose import Pose, angle_between
from ..geometry.pose_gaussian import PoseGaussian
from ..jobs.threads import Workers
from ..judge.by_others import LEAST_NONE, MISSED, local_share
from ..judge.candidate import Candidate, Selection
from ..judge.case import Errors
from ..judge.consensus import MOST_CONFLICT
from ..judge.probability import CONTRADICTED_ODDS, posterior
from ..judge.result import Result
from ..judge.selection import assess
from ..localization.judging import Found
from ..localization.ladder import refine
from ..localization.last_descent import HOPELESS_SCORE
from ..problem.problem import Problem
from ..problem.stages import FINE
from .bundle_adjustment import Bundle, Estimate, RelativeErrors, adjust

MOST_UNSEEN = 1.0 / 3.0  # chosen: of photos, those that may show nothing
SILENT = 0.05  # chosen: of photos of the bundle, those that show nothing of their place
CHANCE_NEAR = 0.02  # chosen: probability that a photo has a pose near that by a wrong pose of the bundle
NUM_BUNDLES = 4  # poses of the bundle that are tested
SCALES = 0.5, 2.0  # of positions in metres that are proposed, so that a wrong scale is seen
LEAST_DISTANCE = 0.5  # [m] photos nearer to each other say nothing of the scale
NUM_LIKELY = 2  # poses of a photo that propose a scale, those with the most probability


@dataclass(frozen=True)
class Member:
    """A photo of the bundle, found by itself."""

    found: Found  # without what takes memory
    alone: Result
    cam_from_bundle: Pose

    @property
    def is_misplaced(self) -> bool:
        """True if its focal length contradicts that of the other photos, as at a wrong place."""
        prior = self.found.problem.given.focal_prior
        fit = self.found.fit
        has_conflict = fit is not None and fit.conflict > MOST_CONFLICT
        return has_conflict and prior is not None and prior.is_measured

    @property
    def own_poses(self) -> list[tuple[Candidate, float]]:
        """Poses in the map with the probabilities of their places, best first; none if ruled out."""
        if self.alone.best_pose is None or self.alone.belief.ruled_out:
            return []
        places = self.alone.belief.sound_places[:-1].tolist()
        return list(zip(self.found.selection.candidates, places, strict=False))


class Support(NamedTuple):
    """Evidence of a photo for a pose of the bundle."""

    own: Candidate  # its own pose there
    gaussian: PoseGaussian | None  # that pose with its covariance; None where the points do not fix it
    is_found: bool  # by the photo alone
    odds: float  # of that pose's place, against that none of the photo's poses is right
    odds_elsewhere: float  # of the places of the photo's other poses
    num_places: int  # of the scan where a photo alone may be
    odds_exchanged: float = 0.0  # of the places of other photos of the bundle, in the mean

    @property
    def weights(self) -> Array:
        """Odds (4,): own pose right; own pose missed; photo outside of the scan; photo at another pose.

        The odds of a photo alone allow for `num_places` places, of which it has the best. If the others leave
        one place, or the few of exchanged photos, the odds are multiplied by `num_places`.
        """
        belongs = 1.0 - CONTRADICTED_ODDS
        here = self.odds * self.num_places
        right = belongs * (1.0 - self.local_share) * here
        exchanged = self.odds_exchanged * self.num_places
        of_others = [CONTRADICTED_ODDS, CONTRADICTED_ODDS * (self.odds_elsewhere + exchanged)]
        return np.array([right, belongs * (self.local_share * here + SILENT), *of_others])

    @property
    def local_share(self) -> float:
        """Probability that the own pose is a local optimum near the right one."""
        return local_share(self.odds)

    @property
    def shares(self) -> Array:
        """Probabilities (4,) of `weights`."""
        return np.asarray(self.weights / self.weights.sum())


def move_origin_near(cams_from_bundle: Sequence[Pose]) -> list[Pose]:
    """Move the origin of the common frame to the photos' mean position, so that turns hardly move them."""
    mean = np.mean([pose.center_world for pose in cams_from_bundle], axis=0)
    return [Pose(pose.R_cam_from_world, pose.center_world - mean) for pose in cams_from_bundle]


def propose_bundles(members: Sequence[Member], errors: RelativeErrors) -> list[Bundle]:
    """Return distinct poses of the bundle in the map, the likeliest first, by the photos' own poses."""
    proposed = [
        Bundle(member.cam_from_bundle.inverse() @ own.pose)
        for member in members
        for own, _ in member.own_poses
    ]
    for one, other in itertools.combinations(members, 2):
        for (a, _), (b, _) in itertools.product(one.own_poses[:NUM_LIKELY], other.own_poses[:NUM_LIKELY]):
            proposed += propose_with_scale(one, a.pose, other, b.pose, errors)
    votes = [sum(vote(member, bundle) for member in members) for bundle in proposed]
    kept: list[Bundle] = []
    for i in np.argsort(-np.array(votes), kind="stable"):
        bundle = join_near(members, proposed[i], errors)
        if len(kept) < NUM_BUNDLES and not any(is_same_bundle(members, bundle, other) for other in kept):
            kept.append(bundle)
    return kept


def propose_with_scale(
    one: Member, own: Pose, other: Member, own_of_other: Pose, errors: RelativeErrors
) -> list[Bundle]:
    """Return the bundle whose scale is that of two photos' own poses; nothing if these do not fit."""
    relative = other.cam_from_bundle @ one.cam_from_bundle.inverse()
    found = own_of_other @ own.inverse()
    given_apart = float(np.linalg.norm(relative.center_world))
    found_apart = float(np.linalg.norm(found.center_world))
    if angle_between(relative.R_cam_from_world, found.R_cam_from_world) > ONE_IN_BUNDLE.angle:
        return []
    is_free = errors.log_scale > 1.0
    if found_apart < LEAST_DISTANCE or given_apart <= 0.0:
        return []
    scale = found_apart / given_apart
    if not is_free and not SCALES[0] < scale < SCALES[1]:
        return []
    scaled = Bundle(own, math.log(scale)).scale(one.cam_from_bundle)
    return [Bundle(scaled.inverse() @ own, math.log(scale))]


def join_near(members: Sequence[Member], bundle: Bundle, errors: RelativeErrors) -> Bundle:
    """Adjust a bundle to the photos' poses near it, all of one deviation."""
    nothing = np.zeros((6, 6))
    near = []
    for member in members:
        expected = bundle.place(member.cam_from_bundle)
        own = next((own for own, _ in member.own_poses if ONE_IN_BUNDLE.holds(own.pose, expected)), None)
        if own:
            near.append(Estimate(PoseGaussian(own.pose, nothing, nothing), member.cam_from_bundle))
    loose = errors._replace(log_scale=max(errors.log_scale, 1.0))
    return adjust(bundle, near, loose).bundle if len(near) > 1 else bundle


def is_same_bundle(members: Sequence[Member], bundle: Bundle, other: Bundle) -> bool:
    """Return True if two poses of the bundle put every photo at the same place."""
    cams = [member.cam_from_bundle for member in members]
    return all(ONE_IN_BUNDLE.holds(bundle.place(cam), other.place(cam)) for cam in cams)


def vote(member: Member, bundle: Bundle) -> float:
    """Return the probability of a photo's own pose that supports a pose of the bundle."""
    expected = bundle.place(member.cam_from_bundle)
    return max((p for own, p in member.own_poses if ONE_IN_BUNDLE.holds(own.pose, expected)), default=0.0)


def find_support(
    member: Member, problem: Problem, bundle: Bundle, workers: Workers, exchanged: Sequence[Pose] = ()
) -> Support:
    """Return a photo's evidence for a bundle pose: its best own pose near the prediction.

    `exchanged` are relative poses of other photos, one of which may be its own.
    """
    expected = bundle.place(member.cam_from_bundle)
    ranked = [own for own, _ in member.own_poses]
    own = next((h for h in ranked if ONE_IN_BUNDLE.holds(h.pose, expected)), None)
    found = own or max(list_near(problem, expected, workers), key=lambda h: h.score)
    if own is None:
        ranked.append(found)
    places = [place for place in map(bundle.place, exchanged) if not ONE_IN_BUNDLE.holds(place, expected)]
    ranked += [examine(problem, p) for p in places if not any(ONE_IN_BUNDLE.holds(h.pose, p) for h in ranked)]
    k = next(k for k, h in enumerate(ranked) if h is found)
    selection = complete(problem, Selection(ranked[0], tuple(ranked[1:])), workers)
    ranked = selection.candidates
    errors = Errors(member.alone.gaussian, member.alone.std_of_fit)
    fit = member.found.fit
    if found.pose is not member.found.selection.best.pose and found.score > HOPELESS_SCORE:
        is_counted = not problem.profile.is_narrow or ranked[k].num_matches is not None
        counted = ranked[k] if is_counted else count_agreeing(problem, ranked[k], workers)
        errors = estimate_errors(problem, counted, workers)
        errors = errors.widen(fit.pose_covariance) if fit else errors
    p = posterior(assess(problem.profile, selection), errors.std_of_fit, problem.method)
    none = max(float(p[-1]), LEAST_NONE)
    odds_elsewhere = float(p[:-1].sum() - p[k]) / none
    num_places = len(problem.scan_map.sparse)
    is_there = [any(ONE_IN_BUNDLE.holds(h.pose, place) for place in places) for h in ranked]
    odds_there = float(p[:-1][is_there].sum()) / none / max(len(places), 1)
    odds = float(p[k]) / none
    return Support(ranked[k], errors.gaussian, own is not None, odds, odds_elsewhere, num_places, odds_there)


def list_near(problem: Problem, expected: Pose, workers: Workers) -> list[Candidate]:
    """Return a photo's poses near the one expected: by whole views, by matches, and that itself."""
    poses = [refine(problem, expected, workers, FINE).pose]
    if problem.profile.refines_on_matches:
        drawn = draw_near(problem, expected, None, workers).matches
        poses.append(verify(problem, expected, drawn).pose)
    near = [pose for pose in poses if ONE_IN_BUNDLE.holds(pose, expected)]
    return [examine(problem, pose) for pose in (*near, expected)]


def weigh_bundles(tested: Sequence[Sequence[Support]], members: Sequence[Member]) -> Array:
    """Return the probability (K + 1,) of each of K poses of the bundle, and of none.

    The photos are independent evidence, but a missed pose is charged once, as bare walls and changed places
    lie together, and the third of the photos with the least odds is not charged. Agreement of photos counts
    as far as it exceeds chance among all proposed poses. Wrong relative poses, with each photo at any of its
    own poses, count as none.
    """
    num_proposed = max(sum(len(member.own_poses) for member in members), 1)
    logits = []
    for of_one in tested:
        odds_of_seen = sorted(s.odds for s in of_one)[int(len(of_one) * MOST_UNSEEN) :]
        missed = min(math.log((o + MISSED) / (o + 1.0)) for o in odds_of_seen)
        gain = (1 - sum(s.is_found for s in of_one)) * math.log(CHANCE_NEAR)
        coincidence = max(gain - math.log(num_proposed), min(gain, 0.0))
        of_photos = sum(math.log1p(s.odds + CONTRADICTED_ODDS * s.odds_elsewhere) for s in of_one)
        logits.append(of_photos + missed + coincidence)
    alone = [sum(p for _, p in member.own_poses) for member in members]
    apart = math.log(CONTRADICTED_ODDS) - sum(math.log(max(1.0 - p, LEAST_NONE)) for p in alone)
    odds = np.exp(np.array([*logits, 0.0, apart]) - max([*logits, 0.0, apart]))
    odds = np.append(odds[:-2], odds[-2:].sum())
    return np.asarray(odds / odds.sum())
