"""Photos with known poses relative to each other, localized as one rigid camera.

Each photo is searched by itself. Its poses vote for poses of the bundle, and the best few of these are tested
in every photo. Then the bundle, its scale and the errors of the relative poses are adjusted to the poses of
single photos, and each photo's pose is what it and the others say together. A photo that contradicts the
others is judged by itself, and so are all if the relative poses contradict the photos that are sure.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ..confidence.alternatives import Hypothesis
from ..confidence.confidence import CONTRADICTED, LOCALIZED, posterior
from ..confidence.localization import Localization
from ..geometry.pose import Array, Pose, angle_between, log_so3
from ..geometry.pose_gaussian import PoseGaussian, probability_near, probability_within, std_of
from ..jobs.blas import one_blas_thread
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import Workers
from ..panorama import Panorama
from ..scan_map.scan_map import ScanMap
from .bundle_adjustment import (
    Adjusted,
    Bundle,
    Estimate,
    RelativeErrors,
    adjust,
    estimate_errors,
    find_contradicting,
    find_scale,
)
from .comparison import score_pose
from .covariance import estimate_covariance
from .focal_length import FocalFit, calibrate
from .judge import MOST_CONFLICT, judge, judge_together
from .last_descent import HOPELESS_SCORE
from .localize import find_pose
from .query import Query
from .refinement import descend_fine
from .selection import Selection, assess_poses
from .settings import CoarseToFineSettings
from .verification import verify

MISSED = 0.25  # chosen: of photos, those whose right pose is not found (BENCHMARK.md, phone photos: a sixth)
MOST_UNSEEN = 1.0 / 3.0  # chosen: of photos, those that may show nothing
SILENT = 0.05  # chosen: of photos of the bundle, those that show nothing of their place
CHANCE = 0.02  # chosen: probability that a photo has a pose near that by a wrong pose of the bundle
LEAST_NONE = 1e-6
EVEN = 0.5
NUM_BUNDLES = 4  # poses of the bundle that are tested
SAME_PLACE = 0.5  # [m] a photo's pose this near to that by the bundle,
SAME_TURN = math.radians(6.0)  # and this, supports it
SCALES = 0.5, 2.0  # of positions in metres that are proposed, so that a wrong scale is seen
LEAST_APART = 0.5  # [m] photos nearer to each other say nothing of the scale
NUM_LIKELY = 2  # poses of a photo that propose a scale, those with the most probability
TOLD = 2.0  # deviations of the scale, and ratio of other errors to those expected, that are reported
NOT_FOUND = "`relative_poses`: no pose of all photos together was found"
DOUBTED = "`relative_poses`: they contradict the photos that are sure; each photo is judged by itself"
UNSEEN = "`relative_poses`: this photo does not show the place where the others put it"
CONTRADICTS = "`relative_poses`: this photo contradicts the others; it is judged by itself"


@dataclass(frozen=True)
class Member:
    """A photo of the bundle, found by itself."""

    query: Query  # without what takes memory
    selection: Selection
    fit: FocalFit | None
    alone: Localization
    cam_from_bundle: Pose

    @property
    def own_poses(self) -> list[tuple[Hypothesis, float]]:
        """Poses in the map with their probabilities, best first; none if the best one is ruled out."""
        if self.alone.is_ruled_out:
            return []
        hypotheses = [self.selection.best, *self.selection.alternatives]
        own = [self.alone.confidence, *(a.probability or 0.0 for a in self.alone.alternatives)]
        return list(zip(hypotheses, own, strict=False))


class Support(NamedTuple):
    """Evidence of a photo for a pose of the bundle."""

    own: Hypothesis  # its own pose there
    gaussian: PoseGaussian | None  # that pose with its covariance; None where the points do not fix it
    is_found: bool  # by the photo alone
    odds: float  # of that pose, against that none of the photo's poses is right
    odds_elsewhere: float  # of the photo's other poses
    num_places: int  # of the scan where a photo alone may be

    @property
    def weights(self) -> Array:
        """Odds (4,) that the own pose is right, that the photo misses its own, and that it does not belong.

        The last are of no place in the scan, and of another pose of the photo. The odds of a photo alone are
        those of the best of all places; if the others say which place it is, they are as many times larger.
        """
        belongs = 1.0 - CONTRADICTED
        here = self.odds * self.num_places
        missed = MISSED / (1.0 + self.odds)
        right = belongs * (1.0 - missed) * here
        of_others = [CONTRADICTED, CONTRADICTED * self.odds_elsewhere]
        return np.array([right, belongs * (missed * here + SILENT), *of_others])

    @property
    def shares(self) -> Array:
        """Probabilities (4,) of `weights`."""
        return np.asarray(self.weights / self.weights.sum())


class Agreed(NamedTuple):
    """A bundle that is believed."""

    adjusted: Adjusted
    errors: RelativeErrors
    estimates: dict[int, Estimate]  # own poses of the photos that agree with it
    apart: frozenset[int]  # photos that contradict it
    warnings: tuple[str, ...]


@one_blas_thread
def localize_bundle(
    scan_map: ScanMap,
    panoramas: Sequence[Panorama],
    cams_from_bundle: Sequence[Pose],
    settings: CoarseToFineSettings,
    workers: Workers,
    watch: Stopwatch,
    errors: RelativeErrors,
) -> list[Localization]:
    """Localize photos together; `cams_from_bundle` are their poses in any common frame.

    `errors` are those expected of these poses; their scale is unknown if its deviation is large.
    """
    cams_from_bundle = move_origin_near(cams_from_bundle)
    alone: list[Localization] = []
    members: dict[int, Member] = {}
    for k, panorama in enumerate(panoramas):
        found = find_pose(scan_map, panorama, settings, workers, watch)
        alone.append(found if isinstance(found, Localization) else judge(*found, may_change=False))
        if not isinstance(found, Localization) and alone[k].pose is not None:
            query, selection, fit = found
            members[k] = Member(query.forget(), selection, fit, alone[k], cams_from_bundle[k])
    with watch.stage("refine"):
        together = judge_members(members, errors)
    return [together.get(k, one) for k, one in enumerate(alone)]


def judge_members(members: dict[int, Member], errors: RelativeErrors) -> dict[int, Localization]:
    """Return the results of photos together, or each by itself with the reason."""
    bundles = propose_bundles(list(members.values()), errors)
    tested = [dict[int, Support]() for _ in bundles]
    for k, member in members.items():
        query = member.query.forget()
        for bundle, supports in zip(bundles, tested, strict=True):
            supports[k] = find_support(member, query, bundle)
    probabilities = weigh_bundles([list(supports.values()) for supports in tested], list(members.values()))
    best = int(probabilities[:-1].argmax()) if bundles else 0
    if not bundles or probabilities[best] < EVEN:
        is_any_sure = any(member.alone.status == LOCALIZED for member in members.values())
        reason = DOUBTED if is_any_sure and len(members) > 1 else NOT_FOUND
        return {k: judge_apart(member, reason) for k, member in members.items()}
    supports = tested[best]
    agreed = agree(members, bundles[best], supports, errors)
    if not isinstance(agreed, str):  # photos that were not found are refined again from where they now belong
        near = agreed.adjusted.bundle
        supports |= {
            k: find_support(members[k], members[k].query.forget(), near)
            for k, support in supports.items()
            if not support.is_found
        }
        agreed = agree(members, near, supports, errors)
    if isinstance(agreed, str):
        return {k: judge_apart(member, agreed) for k, member in members.items()}
    others = [i for i in range(len(bundles)) if i != best]
    ranked = probabilities[[best, *others, -1]]
    elsewhere = [bundles[i] for i in others]
    return {k: judge_member(members[k], k, supports[k], agreed, elsewhere, ranked) for k in members}


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
    if angle_between(relative.R_cam_from_world, found.R_cam_from_world) > SAME_TURN:
        return []
    is_free = errors.log_scale > 1.0
    if found_apart < LEAST_APART or given_apart <= 0.0:
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
        own = next((own for own, _ in member.own_poses if is_same(own.pose, expected)), None)
        if own:
            near.append(Estimate(PoseGaussian(own.pose, nothing, nothing), member.cam_from_bundle))
    loose = errors._replace(log_scale=max(errors.log_scale, 1.0))
    return adjust(bundle, near, loose).bundle if len(near) > 1 else bundle


def is_same_bundle(members: Sequence[Member], bundle: Bundle, other: Bundle) -> bool:
    """Return True if two poses of the bundle put every photo at the same place."""
    return all(is_same(bundle.place(m.cam_from_bundle), other.place(m.cam_from_bundle)) for m in members)


def vote(member: Member, bundle: Bundle) -> float:
    """Return the probability of a photo's own pose that supports a pose of the bundle."""
    expected = bundle.place(member.cam_from_bundle)
    return max((p for own, p in member.own_poses if is_same(own.pose, expected)), default=0.0)


def is_same(pose: Pose, other: Pose) -> bool:
    """Return True if two poses may be one, with the errors of relative poses."""
    turn = np.linalg.norm(log_so3(pose.R_cam_from_world @ other.R_cam_from_world.T))
    return bool(turn < SAME_TURN and pose.distance(other) < SAME_PLACE)


def find_support(member: Member, query: Query, bundle: Bundle) -> Support:
    """Return a photo's evidence for a bundle pose: its best own pose near the prediction."""
    expected = bundle.place(member.cam_from_bundle)
    poses = [own for own, _ in member.own_poses]
    own = next((h for h in poses if is_same(h.pose, expected)), None)
    found = own or max(refine_near(query, expected), key=lambda h: h.score)
    if own is None:
        poses.append(found)
    gaussian = member.alone.gaussian
    std_of_fit = member.alone.std_of_fit
    if found is not member.selection.best and found.score > HOPELESS_SCORE:
        errors = estimate_covariance(query, found.pose, member.fit is None)
        gaussian, std_of_fit = errors or (None, None)
        if gaussian is not None and member.fit is not None:
            gaussian = gaussian.widen(member.fit.pose_covariance)
    p = posterior(assess_poses(query, poses[0], poses[1:]), std_of(gaussian), std_of_fit)
    k = next(k for k, h in enumerate(poses) if h is found)
    none = max(float(p[-1]), LEAST_NONE)
    odds_elsewhere = float(p[:-1].sum() - p[k]) / none
    num_places = len(query.scan_map.sparse)
    return Support(found, gaussian, own is not None, float(p[k]) / none, odds_elsewhere, num_places)


def refine_near(query: Query, expected: Pose) -> list[Hypothesis]:
    """Return a photo's poses near the one expected: by whole views, by matches, and that itself."""
    poses = [descend_fine(query, expected).pose]
    if query.photo.is_partial:
        poses.append(verify(query, expected).pose)
    near = [pose for pose in poses if is_same(pose, expected)]
    return [score_pose(query, pose) for pose in (*near, expected)]


def weigh_bundles(tested: Sequence[Sequence[Support]], members: Sequence[Member]) -> Array:
    """Return the probability (K + 1,) of each of K poses of the bundle, and of none.

    The photos are independent evidence. A third of them may show nothing, or not belong to the others. If
    more have missed a pose, these count as one: bare walls and changed places lie together. Photos that have
    found the same pose of the bundle are more than chance, if they are more than chance would give among all
    poses that were proposed. If the relative poses are wrong, each photo may have any of its own poses; that
    counts as none.
    """
    num_proposed = max(sum(len(member.own_poses) for member in members), 1)
    logits = []
    for of_one in tested:
        odds_of_seen = sorted(s.odds for s in of_one)[int(len(of_one) * MOST_UNSEEN) :]
        missed = min(math.log((o + MISSED) / (o + 1.0)) for o in odds_of_seen)
        gain = (1 - sum(s.is_found for s in of_one)) * math.log(CHANCE)
        coincidence = max(gain - math.log(num_proposed), min(gain, 0.0))
        of_photos = sum(math.log1p(s.odds + CONTRADICTED * s.odds_elsewhere) for s in of_one)
        logits.append(of_photos + missed + coincidence)
    alone = [sum(p for _, p in member.own_poses) for member in members]
    apart = math.log(CONTRADICTED) - sum(math.log(max(1.0 - p, LEAST_NONE)) for p in alone)
    odds = np.exp(np.array([*logits, 0.0, apart]) - max([*logits, 0.0, apart]))
    odds = np.append(odds[:-2], odds[-2:].sum())
    return np.asarray(odds / odds.sum())


def agree(
    members: dict[int, Member], bundle: Bundle, supports: dict[int, Support], errors: RelativeErrors
) -> Agreed | str:
    """Adjust the bundle to the photos whose own poses agree with it; a text says why it is not believed."""
    own = {
        k: Estimate(support.gaussian, members[k].cam_from_bundle)
        for k, support in supports.items()
        if support.shares.argmax() == 0 and support.gaussian is not None
    }
    sure = [k for k, member in members.items() if member.alone.status == LOCALIZED]
    every = frozenset(own)
    while (out := find_contradicting(bundle, list(own.values()), errors)) is not None:
        del own[list(own)[out]]
    if 2 * sum(k in own for k in sure) < len(sure) or not own:
        return DOUBTED if sure else NOT_FOUND
    estimates = list(own.values())
    expected = errors
    free = errors._replace(log_scale=max(errors.log_scale, 1.0))
    errors = estimate_errors(bundle, estimates, free)._replace(log_scale=errors.log_scale)
    log_scale, std = find_scale(bundle, estimates, errors)
    if abs(log_scale) > MOST_CONFLICT * math.hypot(std, errors.log_scale):
        return f"`relative_poses`: positions are {describe_scale(log_scale)}; each photo is judged by itself"
    adjusted = adjust(bundle, estimates, errors)
    warnings = []
    if abs(adjusted.bundle.log_scale) > TOLD * errors.log_scale:
        warnings.append(f"`relative_poses`: positions are {describe_scale(adjusted.bundle.log_scale)}")
    if errors.turn > TOLD * expected.turn or errors.move > TOLD * expected.move:
        text = f"{errors.move:.2f} m and {math.degrees(errors.turn):.1f} deg"
        warnings.append(f"`relative_poses`: they are off by about {text} each")
    apart = (every - frozenset(own)) & frozenset(sure)
    return Agreed(adjusted, errors, own, apart, tuple(warnings))


def describe_scale(log_scale: float) -> str:
    """Return by how much positions are too long or too short that are to be multiplied by a scale."""
    percent = 100.0 * abs(math.expm1(-log_scale))
    return f"{percent:.0f} % too {'short' if log_scale > 0.0 else 'long'}"


def judge_apart(member: Member, reason: str) -> Localization:
    """Return the result of a photo by itself, with the reason; no pose if that is not sure."""
    alone = member.alone
    if alone.status != LOCALIZED and reason is not CONTRADICTS:
        return Localization(warnings=(*alone.warnings, reason))
    return replace(alone, warnings=(*alone.warnings, reason))


def judge_member(
    member: Member,
    number: int,
    support: Support,
    agreed: Agreed,
    elsewhere: Sequence[Bundle],
    probabilities: Array,
) -> Localization:
    """Return the result of a photo in a bundle that is believed.

    `elsewhere` are the other poses of the bundle; `probabilities` (K + 1,) are of all of them, and of none.
    """
    if member.alone.is_ruled_out:
        return replace(member.alone, warnings=member.alone.warnings + agreed.warnings)
    right, missed, *_ = support.shares
    if right + missed < EVEN or number in agreed.apart:
        return judge_apart(member, CONTRADICTS)
    rest = [estimate for k, estimate in agreed.estimates.items() if k != number]
    own = agreed.estimates.get(number)
    gaussian = None if own is None else own.own
    within = 0.0
    if rest:
        adjusted = adjust(agreed.adjusted.bundle, rest, agreed.errors)
        expected = adjusted.predict(member.cam_from_bundle, agreed.errors)
        gaussian = expected if gaussian is None else expected.fuse(gaussian)
        offset = gaussian.pose.center_world - expected.pose.center_world
        within = missed * probability_near(offset, expected.covariance[3:, 3:])
    if gaussian is None:
        return judge_apart(member, NOT_FOUND)
    of_own = probability_within(gaussian.largest_std)
    confidence = (within + right * of_own) * probabilities[0]
    before = member.alone.gaussian
    if member.alone.status == LOCALIZED and own and before:
        # that others show nothing says nothing against a photo that is sure
        gain = of_own / probability_within(before.largest_std)
        confidence = max(confidence, member.alone.confidence * min(gain, 1.0))
    others = probabilities[1:-1] * min(1.0, (1.0 - confidence) / max(1.0 - probabilities[0], LEAST_NONE))
    p = np.array([confidence, *others, max(1.0 - confidence - others.sum(), 0.0)])
    query, fit = recalibrate_at(member, support)
    placed = [score_pose(query, bundle.place(member.cam_from_bundle)) for bundle in elsewhere]
    selection = Selection(score_pose(query, gaussian.pose), tuple(placed))
    result = judge_together(query, selection, fit, gaussian, p)
    doubts = (UNSEEN,) if right < EVEN else ()
    return replace(result, warnings=result.warnings + doubts + agreed.warnings)


def recalibrate_at(member: Member, support: Support) -> tuple[Query, FocalFit | None]:
    """Return the query, and the focal length fitted at a photo's own pose, if it is not exact."""
    query = member.query.forget()
    if member.fit is None or support.own is member.selection.best:
        return query, member.fit
    query, _, fit = calibrate(query, Selection(support.own, ()))
    return query, fit
