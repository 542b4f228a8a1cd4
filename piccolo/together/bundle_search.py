"""The poses that a bundle of photos may have, by the photos' own poses, and how likely each is."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ..evidence.covariance import estimate_pose_errors
from ..evidence.examine import complete, count_agreeing, examine
from ..evidence.verification import draw_near, verify
from ..geometry.nearness import ONE_IN_BUNDLE, RIGHT
from ..geometry.pose import Pose, angle_between
from ..geometry.pose_gaussian import PoseGaussian
from ..judge.by_others import LEAST_NONE, MISSED, local_share
from ..judge.candidate import Candidate, Selection
from ..judge.case import Errors
from ..judge.probability import CONTRADICTED_ODDS, log_odds, posterior
from ..judge.selection import assess, credit_copies
from ..localization.copies import list_copies
from ..localization.ladder import refine
from ..localization.last_descent import HOPELESS_SCORE
from ..poses.bundle_adjustment import Bundle, Estimate, RelativeErrors, adjust
from ..problem.problem import Problem
from ..problem.stages import FINE
from ..system.arrays import Array
from ..system.jobs.threads import Workers
from .members import Member

MOST_UNSEEN = 1.0 / 3.0  # chosen: share of photos that may be no evidence for their place
SILENT = 0.05  # chosen: share of photos of a bundle that show nothing of their place
CHANCE_NEAR = 0.02  # chosen: probability that a photo has a pose near the one by a wrong pose of the bundle
NUM_BUNDLES = 4  # poses of the bundle that are tested
SCALES = 0.5, 2.0  # of positions in metres: proposed too, so that a wrong scale is noticed
LEAST_DISTANCE = 0.5  # [m] photos nearer to each other do not determine the scale
NUM_LIKELY = 2  # poses of a photo that propose a scale, those with the most probability


@dataclass(frozen=True)
class PosedMember(Member):
    """A photo whose pose relative to the others is known."""

    cam_from_bundle: Pose


class Support(NamedTuple):
    """Evidence of a photo for a pose of the bundle."""

    own: Candidate  # its own pose there
    gaussian: PoseGaussian | None  # its own pose with its covariance; None where the points do not fix it
    is_found: bool  # the search of the photo alone has found its own pose
    odds: float  # of its own pose's place, against that none of the photo's poses is right
    odds_elsewhere: float  # of the places of the photo's other poses
    num_places: int  # number of places of the scan where a photo alone may be
    odds_exchanged: float = 0.0  # mean odds of the places of other photos of the bundle
    belongs: float = 1.0 - CONTRADICTED_ODDS  # prior probability that the photo is where others expect it
    weight: float = 1.0  # of this evidence: less if other photos show the same

    def miss(self) -> "Support":
        """Return the evidence of a photo that does not show the place at all."""
        elsewhere = self.odds_elsewhere + self.odds
        return self._replace(is_found=False, odds=0.0, odds_elsewhere=elsewhere)

    @property
    def weights(self) -> Array:
        """Odds (4,): own pose right; own pose missed; photo outside of the scan; photo at another pose.

        The odds of a photo alone allow for its pose being the best of `num_places` places. If the others
        leave one place, or the few places of exchanged photos, the odds are multiplied by `num_places`.
        """
        belongs = self.belongs
        here = self.odds * self.num_places
        right = belongs * (1.0 - self.local_share) * here
        exchanged = self.odds_exchanged * self.num_places
        of_others = [1.0 - belongs, (1.0 - belongs) * (self.odds_elsewhere + exchanged)]
        return np.array([right, belongs * (self.local_share * here + SILENT), *of_others])

    @property
    def local_share(self) -> float:
        """Probability that the own pose is a local optimum near the right one."""
        return local_share(self.odds)

    @property
    def shares(self) -> Array:
        """Probabilities (4,) of `weights`."""
        return np.asarray(self.weights / self.weights.sum())


def propose_bundles(members: Sequence[PosedMember], errors: RelativeErrors) -> list[Bundle]:
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
    one: PosedMember, own: Pose, other: PosedMember, own_of_other: Pose, errors: RelativeErrors
) -> list[Bundle]:
    """Return the bundle with the scale by two photos' own poses; an empty list if the poses do not fit."""
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


def join_near(members: Sequence[PosedMember], bundle: Bundle, errors: RelativeErrors) -> Bundle:
    """Adjust a bundle to the photos' own poses near it, which all get the same deviation."""
    nothing = np.zeros((6, 6))
    near = []
    for member in members:
        expected = bundle.place(member.cam_from_bundle)
        own = next((own for own, _ in member.own_poses if ONE_IN_BUNDLE.holds(own.pose, expected)), None)
        if own:
            near.append(Estimate(PoseGaussian(own.pose, nothing, nothing), member.cam_from_bundle))
    loose = errors._replace(log_scale=max(errors.log_scale, 1.0))
    return adjust(bundle, near, loose).bundle if len(near) > 1 else bundle


def is_same_bundle(members: Sequence[PosedMember], bundle: Bundle, other: Bundle) -> bool:
    """Return True if two poses of the bundle put every photo at the same place."""
    cams = [member.cam_from_bundle for member in members]
    return all(ONE_IN_BUNDLE.holds(bundle.place(cam), other.place(cam)) for cam in cams)


def vote(member: PosedMember, bundle: Bundle) -> float:
    """Return the probability of a photo's own pose that supports a pose of the bundle."""
    expected = bundle.place(member.cam_from_bundle)
    return max((p for own, p in member.own_poses if ONE_IN_BUNDLE.holds(own.pose, expected)), default=0.0)


def find_supports(
    member: Member,
    problem: Problem,
    expected: Sequence[Pose],
    workers: Workers,
    exchanged: Sequence[Pose] = (),
) -> list[Support]:
    """Return a photo's evidence for each of several poses that may be expected of it.

    The evidence is that of its best own pose near the expected one. These own poses and its other poses are
    weighed together, against each other and against that none is right. `exchanged` are poses expected of
    other photos, one of which may be that of this photo.
    """
    own = [one for one, _ in member.own_poses]
    ranked = list(own)
    at = [place_in(ranked, problem, pose, workers) for pose in expected]
    places = [p for p in exchanged if not any(ONE_IN_BUNDLE.holds(p, pose) for pose in expected)]
    ranked += [examine(problem, p) for p in places if not any(ONE_IN_BUNDLE.holds(h.pose, p) for h in ranked)]
    selection = complete(problem, Selection(ranked[0], tuple(ranked[1:])), workers)
    ranked = list(selection.candidates)
    errors = {k: estimate_errors_at(member, problem, ranked[k], workers) for k in set(at)}
    standings = assess(problem.profile, selection)
    likeliest = max(at, key=lambda k: log_odds(standings[k], problem.method))
    is_copy = list_copies(problem, ranked, likeliest, workers)
    std_of_fit = errors[likeliest].std_of_fit
    credited = credit_copies(standings, is_copy)
    p = posterior(credited, std_of_fit, problem.method, mirrored=member.alone.mirrored)
    odds = p[:-1] / max(float(p[-1]), LEAST_NONE)
    is_there = [any(ONE_IN_BUNDLE.holds(h.pose, place) for place in places) for h in ranked]
    odds_there = float(odds[is_there].sum()) / max(len(places), 1)
    num = len(problem.scan_map.sparse)
    is_own = np.arange(len(ranked)) < len(own)
    elsewhere = odds.sum() - odds
    return [
        Support(ranked[k], errors[k].gaussian, bool(is_own[k]), odds[k], elsewhere[k], num, odds_there)
        for k in at
    ]


def place_in(ranked: list[Candidate], problem: Problem, expected: Pose, workers: Workers) -> int:
    """Return the index of the photo's pose near the expected one; if none is near it, append the best there.

    A pose that is not quite at the expected one may be a local optimum: the best near that replaces it.
    """
    near = next((k for k, own in enumerate(ranked) if ONE_IN_BUNDLE.holds(own.pose, expected)), None)
    if near is not None and RIGHT.holds(ranked[near].pose, expected):
        return near
    found = max(list_near(problem, expected, workers), key=lambda one: one.score)
    if near is None:
        ranked.append(found)
        return len(ranked) - 1
    if found.score > ranked[near].score:
        ranked[near] = found
    return near


def estimate_errors_at(member: Member, problem: Problem, found: Candidate, workers: Workers) -> Errors:
    """Return the errors of a photo's own pose: the known ones if it is the best, else estimated ones."""
    if found.pose is member.found.selection.best.pose or found.score <= HOPELESS_SCORE:
        return Errors(member.alone.gaussian, member.alone.std_of_fit)
    is_counted = not problem.profile.is_narrow or found.num_matches is not None
    counted = found if is_counted else count_agreeing(problem, found, workers)
    errors = estimate_pose_errors(problem, counted, workers)
    fit = member.found.fit
    return errors.widen(fit.pose_covariance) if fit else errors


def list_near(problem: Problem, expected: Pose, workers: Workers) -> list[Candidate]:
    """Return a photo's poses near the expected one: by whole views, by matches, and that one itself."""
    poses = [refine(problem, expected, workers, FINE).pose]
    if problem.profile.refines_on_matches:
        drawn = draw_near(problem, expected, None, workers).matches
        poses.append(verify(problem, expected, drawn).pose)
    near = [pose for pose in poses if ONE_IN_BUNDLE.holds(pose, expected)]
    return [examine(problem, pose) for pose in (*near, expected)]


def weigh_bundles(tested: Sequence[Sequence[Support]], members: Sequence[Member]) -> Array:
    """Return the probability (K + 1,) of each of K poses of the bundle, and of none.

    The photos are independent evidence as far as they show different things. But missed poses are charged
    only once for all photos, as bare walls and changed places lie together, and the third of the photos with
    the least odds is not charged at all. The agreement of photos counts as far as it exceeds chance among all
    proposed poses. That the relative poses are wrong, and each photo is at any of its own poses, counts as
    none.
    """
    num_proposed = max(sum(len(member.own_poses) for member in members), 1)
    logits = []
    for of_one in tested:
        odds_of_seen = sorted(s.odds for s in of_one)[int(len(of_one) * MOST_UNSEEN) :]
        missed = min(math.log((o + MISSED) / (o + 1.0)) for o in odds_of_seen)
        gain = (1.0 - sum(s.weight for s in of_one if s.is_found)) * math.log(CHANCE_NEAR)
        coincidence = max(gain - math.log(num_proposed), min(gain, 0.0))
        of_photos = sum(s.weight * math.log1p(s.odds + CONTRADICTED_ODDS * s.odds_elsewhere) for s in of_one)
        logits.append(of_photos + missed + coincidence)
    alone = [sum(p for _, p in member.own_poses) for member in members]
    weights = [max(s.weight for s in of_photo) for of_photo in zip(*tested, strict=True)]
    sure = [-math.log(max(1.0 - p, LEAST_NONE)) for p in alone]
    apart = math.log(CONTRADICTED_ODDS) + sum(w * s for w, s in zip(weights, sure, strict=False))
    odds = np.exp(np.array([*logits, 0.0, apart]) - max([*logits, 0.0, apart]))
    odds = np.append(odds[:-2], odds[-2:].sum())
    return np.asarray(odds / odds.sum())
