"""Photos with known poses relative to each other, localized as one rigid camera.

Each photo is searched by itself. Its poses vote for poses of the bundle, and the best few of these are tested
in every photo. Then the bundle, its scale and the errors of the relative poses are adjusted to the poses of
single photos, and each photo gets the mean of its own pose and the one that the others expect. A photo that
contradicts the others keeps its own result. If the relative poses contradict photos that are sure, these keep
their results, and the others get none.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ..evidence.examine import complete, examine
from ..evidence.focal_length import FocalFit
from ..geometry.nearness import RIGHT
from ..geometry.pose import Pose
from ..geometry.pose_gaussian import PoseGaussian, subtract
from ..judge.by_others import LOCAL_ERRORS, Shares, believe_together
from ..judge.candidate import Selection
from ..judge.consensus import MOST_CONFLICT
from ..judge.probability import LOCALIZED
from ..judge.result import Result, nothing_found
from ..localization.claimed_geometry import calibrate
from ..localization.judging import Found, decide_case, gather_case, try_mirrored
from ..localization.means import NO_TRACE, Means, Trace
from ..photo.panorama import Panorama
from ..poses.bundle_adjustment import (
    NUM_ADJUSTMENT_ROUNDS,
    Adjusted,
    Bundle,
    Estimate,
    RelativeErrors,
    adjust,
    estimate_errors,
    find_contradicting,
    find_scale,
    move_origin_near,
)
from ..problem.accuracy import Demand
from ..problem.settings import CoarseToFineSettings
from ..scan_map.scan_map import ScanMap
from ..system.arrays import Array
from ..system.jobs.threads import Stopwatch, Workers, one_blas_thread
from .bundle_search import PosedMember, Support, find_supports, propose_bundles, weigh_bundles
from .members import Member, Shot, find_members

EVEN_ODDS = 0.5
NUM_EXCHANGED = 8  # chosen: photos whose relative poses a photo may have got by mistake
MOST_GAIN = 3.0  # [log] that a photo gains at most by being where it was expected
REPORTED_ERRORS = 2.0  # deviations of the scale, and ratio of other errors to the expected: more are reported
NOT_FOUND = "`relative_poses`: no pose of all photos together was found"
DOUBTED = "`relative_poses`: they contradict the photos that are sure; only these keep their poses"
UNSEEN = "`relative_poses`: this photo does not show the place where the others put it"
CONTRADICTS_OTHERS = "`relative_poses`: this photo contradicts the others; it is judged by itself"


class Agreed(NamedTuple):
    """A bundle that is believed."""

    adjusted: Adjusted
    errors: RelativeErrors
    estimates: dict[int, Estimate]  # own poses of the photos that agree with the bundle
    apart: frozenset[int]  # photos that contradict the bundle
    warnings: tuple[str, ...]


class Posed(NamedTuple):
    """A photo whose pose relative to others is known."""

    panorama: Panorama
    cam_from_bundle: Pose  # in any common frame
    settings: CoarseToFineSettings
    trace: Trace = NO_TRACE


@one_blas_thread()
def localize_bundle(
    scan_map: ScanMap, posed: Sequence[Posed], workers: Workers, watch: Stopwatch, errors: RelativeErrors
) -> list[Result]:
    """Localize photos together; their settings are alike, but for priors and traces.

    `errors` are the expected errors of the relative poses; a large deviation of the scale stands for an
    unknown one.
    """
    shots = [Shot(one.panorama, one.settings, one.trace) for one in posed]
    alone, found, _ = find_members(scan_map, shots, workers, watch)
    cams = move_origin_near([one.cam_from_bundle for one in posed])
    members = {k: PosedMember(member.found, member.alone, cams[k]) for k, member in sorted(found.items())}
    settings = posed[0].settings
    with watch.stage("refine"):
        means = Means(settings.effort, workers, watch)
        together = judge_members(members, errors, means, settings.demand)
    return [together.get(k, one) for k, one in enumerate(alone)]


def judge_members(
    members: dict[int, PosedMember], errors: RelativeErrors, means: Means, demand: Demand
) -> dict[int, Result]:
    """Return the results of photos together, or each by itself with the reason."""
    workers = means.workers
    bundles = propose_bundles(list(members.values()), errors)
    tested = [dict[int, Support]() for _ in bundles]
    for k, member in members.items():
        problem = member.found.problem.forget()
        for bundle, supports in zip(bundles, tested, strict=True):
            (supports[k],) = find_supports(member, problem, [bundle.place(member.cam_from_bundle)], workers)
    probabilities = weigh_bundles([list(supports.values()) for supports in tested], list(members.values()))
    best = int(probabilities[:-1].argmax()) if bundles else 0
    if not bundles or probabilities[best] < EVEN_ODDS:
        is_any_sure = any(member.alone.status == LOCALIZED for member in members.values())
        reason = DOUBTED if is_any_sure and len(members) > 1 else NOT_FOUND
        return {k: refuse(member, reason) for k, member in members.items()}
    supports = tested[best]
    agreed = agree(members, bundles[best], supports, errors)
    if not isinstance(agreed, str):  # photos not found are refined where the others expect them
        near = agreed.adjusted.bundle
        supports |= {
            k: find_supports(
                members[k],
                members[k].found.problem.forget(),
                [near.place(members[k].cam_from_bundle)],
                workers,
                [near.place(cam) for cam in list_neighbors(members, k)],
            )[0]
            for k, support in supports.items()
            if not support.is_found
        }
        agreed = agree(members, near, supports, errors)
        probabilities = weigh_bundles([list(one.values()) for one in tested], list(members.values()))
    if isinstance(agreed, str):
        return {k: refuse(member, agreed) for k, member in members.items()}
    others = [i for i in range(len(bundles)) if i != best]
    ranked = probabilities[[best, *others, -1]]
    elsewhere = [bundles[i] for i in others]
    judge_one = partial(judge_member, agreed=agreed, elsewhere=elsewhere, probabilities=ranked, means=means)
    return {k: judge_one(members[k], k, supports[k], demand) for k in members}


def list_neighbors(members: dict[int, PosedMember], k: int) -> list[Pose]:
    """Return the relative poses of the photos next to photo `k`, which it may have got by mistake."""
    others = sorted((j for j in members if j != k), key=lambda j: abs(j - k))
    return [members[j].cam_from_bundle for j in others[:NUM_EXCHANGED]]


def agree(
    members: dict[int, PosedMember], bundle: Bundle, supports: dict[int, Support], errors: RelativeErrors
) -> Agreed | str:
    """Adjust the bundle to the photos that agree with it; return the reason if it is not believed.

    The errors of the relative poses are estimated from the photos' own poses. Then each own pose gets the
    errors of a local optimum too, in proportion to the probability that it is one.
    """
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
        return f"`relative_poses`: positions are {describe_scale(log_scale)}; only sure photos keep poses"
    excess = max(log_scale**2 - std**2 - errors.log_scale**2, 0.0)
    errors = errors._replace(log_scale=math.hypot(errors.log_scale, math.sqrt(excess)))
    blurred = blur_local(bundle, own, {k: supports[k].local_share for k in own}, errors)
    adjusted = adjust(bundle, list(blurred.values()), errors)
    warnings = []
    if abs(adjusted.bundle.log_scale) > REPORTED_ERRORS * expected.log_scale:
        warnings.append(f"`relative_poses`: positions are {describe_scale(adjusted.bundle.log_scale)}")
    if errors.turn > REPORTED_ERRORS * expected.turn or errors.move > REPORTED_ERRORS * expected.move:
        text = f"{errors.move:.2f} m and {math.degrees(errors.turn):.1f} deg"
        warnings.append(f"`relative_poses`: they are off by about {text} each")
    apart = (every - frozenset(own)) & frozenset(sure)
    return Agreed(adjusted, errors, blurred, apart, tuple(warnings))


def blur_local(
    bundle: Bundle, own: dict[int, Estimate], local_shares: dict[int, float], errors: RelativeErrors
) -> dict[int, Estimate]:
    """Add the errors of local optima to the photos' own poses, times the probability that each is one.

    This probability begins as in `local_shares`, and decreases if the pose is near the one that the others
    expect. Poses and probabilities are computed in turn (expectation maximization).
    """
    shares = local_shares
    for _ in range(NUM_ADJUSTMENT_ROUNDS):
        blurred = {
            k: Estimate(one.own.blur(shares[k] * LOCAL_ERRORS), one.cam_from_bundle) for k, one in own.items()
        }
        shares = {}
        for k, (found, cam_from_bundle) in own.items():
            rest = [one for n, one in blurred.items() if n != k]
            expected = adjust(bundle, rest, errors).predict(cam_from_bundle, errors) if rest else None
            shares[k] = weigh_local(local_shares[k], expected, found)
    return blurred


def describe_scale(log_scale: float) -> str:
    """Describe how far distances are too long or too short, by the log of the scale that corrects them."""
    percent = 100.0 * abs(math.expm1(-log_scale))
    return f"{percent:.0f} % too {'short' if log_scale > 0.0 else 'long'}"


def judge_apart(member: Member, reason: str) -> Result:
    """Return a photo's own result, with the reason."""
    return replace(member.alone, warnings=(*member.alone.warnings, reason))


def refuse(member: Member, reason: str) -> Result:
    """Return a photo's own result if it is sure, else a result without a pose, with the reason."""
    if member.alone.status == LOCALIZED:
        return judge_apart(member, reason)
    return nothing_found(*member.alone.warnings, reason)


class Placement(NamedTuple):
    """The pose of a photo among others."""

    gaussian: PoseGaussian | None  # in the map; None if neither the photo nor the others determine it
    shares: Shares
    expected: PoseGaussian | None  # the pose by the others alone


def place_member(member: PosedMember, number: int, shares: Shares, agreed: Agreed) -> Placement:
    """Place a photo by its own pose, and by where the others expect it."""
    rest = [estimate for k, estimate in agreed.estimates.items() if k != number]
    estimate = agreed.estimates.get(number)
    expected = None
    if rest:
        adjusted = adjust(agreed.adjusted.bundle, rest, agreed.errors)
        expected = adjusted.predict(member.cam_from_bundle, agreed.errors)
    return place_between(shares, None if estimate is None else estimate.own, expected)


def place_between(shares: Shares, own: PoseGaussian | None, expected: PoseGaussian | None) -> Placement:
    """Return the mean of a photo's own pose and the one that others expect, or the likelier of them."""
    if expected is None:
        return Placement(own, shares, None)
    gaussian = expected
    if own is not None:
        shares = shares.weigh_own(compare_errors(expected, own))
        if shares.right >= shares.missed:
            gaussian = expected.fuse(own)
    return Placement(gaussian, shares, expected)


def judge_member(
    member: PosedMember,
    number: int,
    support: Support,
    demand: Demand,
    agreed: Agreed,
    elsewhere: Sequence[Bundle],
    probabilities: Array,
    means: Means,
) -> Result:
    """Return the result of a photo in a bundle that is believed.

    `elsewhere` are the other poses of the bundle; `probabilities` (K + 1,) are those of all poses of the
    bundle, this one first, and of none.
    """
    if member.alone.belief.ruled_out and not member.is_misplaced:
        return replace(member.alone, warnings=member.alone.warnings + agreed.warnings)
    belongs = Shares(*support.shares[:2].tolist())
    if belongs.here < EVEN_ODDS or number in agreed.apart:
        return judge_apart(member, CONTRADICTS_OTHERS)
    placed = place_member(member, number, belongs, agreed)
    if placed.gaussian is None:
        return refuse(member, NOT_FOUND)
    places = [bundle.place(member.cam_from_bundle) for bundle in elsewhere]
    is_agreed = number in agreed.estimates
    result = judge_placed(member, support, placed, is_agreed, places, probabilities, means, demand)
    doubts = (UNSEEN,) if placed.shares.right < EVEN_ODDS else ()
    return replace(result, warnings=result.warnings + doubts + agreed.warnings)


def judge_placed(
    member: Member,
    support: Support,
    placed: Placement,
    is_agreed: bool,
    elsewhere: Sequence[Pose],
    probabilities: Array,
    means: Means,
    demand: Demand,
) -> Result:
    """Return the result of a photo that is placed by itself and by others.

    `is_agreed` is True if its own pose agrees with the others. `elsewhere` are the photo's poses if all
    photos were taken at another place; `probabilities` (K + 1,) are those of all places, this one first, and
    of none.
    """
    gaussian, shares, expected = placed
    assert gaussian is not None
    within = demand.accuracy.probability(gaussian)
    within_others = 0.0 if expected is None else demand.accuracy.probability_at(gaussian.pose, expected)
    alone = None
    stays = is_agreed and member.is_best(gaussian.pose)
    if member.alone.status == LOCALIZED and stays and member.alone.gaussian:
        alone = replace(member.alone.belief, within=min(within, member.alone.belief.within))
    elsewhere, probabilities = merge_places(gaussian.pose, elsewhere, probabilities)
    belief = believe_together(shares, probabilities, within, within_others, alone)
    found = recalibrate_at(member, support, gaussian.pose, elsewhere, means.workers)
    case = gather_case(found, gaussian, means)
    if case is None:
        return nothing_found()
    if member.is_best(gaussian.pose):
        case = case._replace(mirrored=member.alone.mirrored)
    case = try_mirrored(found.problem, case, belief, means)
    return decide_case(found.problem, case, belief, means, demand.min_confidence)


def merge_places(pose: Pose, elsewhere: Sequence[Pose], probabilities: Array) -> tuple[list[Pose], Array]:
    """Merge a photo's poses that are the same though the bundle differs; add up their probabilities.

    `probabilities` (K + 1,) are those of `pose`, of the poses `elsewhere`, and of none. Returns the poses
    elsewhere that are left, and the probabilities.
    """
    places = [pose]
    sums = [float(probabilities[0])]
    for other, probability in zip(elsewhere, probabilities[1:-1].tolist(), strict=True):
        same = next((k for k, place in enumerate(places) if RIGHT.holds(place, other)), None)
        if same is None:
            places.append(other)
            sums.append(probability)
        else:
            sums[same] += probability
    return places[1:], np.array([*sums, probabilities[-1]])


def weigh_local(share: float, expected: PoseGaussian | None, own: PoseGaussian) -> float:
    """Return the probability that a photo's own pose is a local optimum, by where the others expect it."""
    odds = (1.0 - share) * (1.0 if expected is None else compare_errors(expected, own))
    return share / (share + odds)


def compare_errors(expected: PoseGaussian, own: PoseGaussian) -> float:
    """Return the likelihood ratio of a photo's own pose, by its distance from the expected one.

    The ratio is that of a right pose against a local optimum of the loss near the right one, which has
    further errors.
    """
    step = subtract(own.pose, expected.pose)
    right = expected.own + own.own
    logs = [
        -0.5 * (step @ np.linalg.solve(S, step) + np.linalg.slogdet(S)[1])
        for S in (right, right + LOCAL_ERRORS)
    ]
    return math.exp(min(logs[0] - logs[1], MOST_GAIN))


def recalibrate_at(
    member: Member, support: Support, pose: Pose, elsewhere: Sequence[Pose], workers: Workers
) -> Found:
    """Return a photo's poses by all photos: `pose`, and the poses `elsewhere`.

    The focal length, if it is not exact, is fitted at the photo's own pose.
    """
    problem, selection, fit = member.found
    problem = problem.forget()
    if isinstance(fit, FocalFit) and support.own.pose is not selection.best.pose:
        own = complete(problem, Selection(support.own, ()), workers)
        problem, _, fit = calibrate(problem, own, workers)
    placed = [examine(problem, other) for other in elsewhere]
    return Found(problem, Selection(examine(problem, pose), tuple(placed)), fit)
