"""Photos with known poses relative to each other, localized as one rigid camera.

Each photo is searched by itself. Its poses vote for poses of the bundle, and the best few of these are tested
in every photo. Then the bundle is adjusted to the photos' own poses by their covariances, and each photo's
pose is what it and the others say together.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..confidence.alternatives import Hypothesis
from ..confidence.confidence import classify, posterior
from ..confidence.covariance import PoseCovariance, least_constrained_direction
from ..confidence.localization import Alternative, Localization
from ..geometry.pose import MAX_DISTANCE, Array, Pose, exp_so3, log_so3, orthonormal, skew
from ..jobs.blas import one_blas_thread
from ..jobs.stopwatch import Stopwatch
from ..jobs.threads import Workers
from ..panorama import Panorama
from ..scan_map.scan_map import ScanMap
from .comparison import score_pose
from .covariance import estimate_covariance
from .localize import Found, find_pose
from .prior import contradictions
from .query import Query
from .refinement import descend_fine
from .selection import Selection, assess_poses
from .settings import CoarseToFineSettings
from .verdict import judge
from .verification import verify

MISSED = 0.25  # of photos, those whose right pose is not found: BENCHMARK.md, phone photos
CHANCE = 0.02  # probability that a photo has a pose near that by a wrong pose of the bundle
LEAST_NONE = 1e-6
NUM_BUNDLES = 4  # poses of the bundle that are tested
SAME_PLACE = 0.5  # [m] a photo's pose this near to that by the bundle,
SAME_TURN = math.radians(6.0)  # and this, supports it
TURN_STD = math.radians(0.5)  # of relative poses, as phones' trackers and structure from motion have it
MOVE_STD = 0.02  # [m]
RELATIVE = np.diag([TURN_STD**2] * 3 + [MOVE_STD**2] * 3)
NUM_ADJUSTMENTS = 6
ROBUST = 12.6  # chi square of 6 at 95 %: a photo whose squared deviations are larger counts less
LOOSE = 1e-6  # [1/rad^2, 1/m^2] information that makes matrices invertible


class Member(NamedTuple):
    """A photo of the bundle, found by itself."""

    found: Found
    alone: Localization
    cam_from_bundle: Pose

    @property
    def own_poses(self) -> list[tuple[Hypothesis, float]]:
        """Poses in the map with their probabilities, best first."""
        hypotheses = [self.found.selection.best, *self.found.selection.alternatives]
        own = [self.alone.confidence, *(a.probability or 0.0 for a in self.alone.alternatives)]
        return list(zip(hypotheses, own, strict=False))


class Support(NamedTuple):
    """Evidence of a photo for a pose of the bundle."""

    own: Hypothesis  # its own pose there
    is_found: bool  # by the photo alone
    probability: float  # of the pose
    probability_none: float  # that none of the photo's poses is right


class Estimate(NamedTuple):
    """A photo's own pose in the map, with its covariance (6, 6), axes as of PoseCovariance but in the map."""

    pose: Pose
    covariance: Array
    cam_from_bundle: Pose


@one_blas_thread
def localize_bundle(
    scan_map: ScanMap,
    panoramas: Sequence[Panorama],
    cams_from_bundle: Sequence[Pose],
    settings: CoarseToFineSettings,
    workers: Workers,
    watch: Stopwatch,
) -> list[Localization]:
    """Localize photos together; `cams_from_bundle` are their poses in any common frame, in metres."""
    cams_from_bundle = move_origin_near(cams_from_bundle)
    alone: list[Localization] = []
    members: dict[int, Member] = {}
    for k, panorama in enumerate(panoramas):
        found = find_pose(scan_map, panorama, settings, workers, watch)
        alone.append(found if isinstance(found, Localization) else judge(*found, may_change=False))
        if not isinstance(found, Localization) and alone[k].pose is not None:
            members[k] = Member(found, alone[k], cams_from_bundle[k])
    bundles = propose_bundles(list(members.values()))
    if not bundles:
        return alone
    tested = [{k: find_support(member, bundle) for k, member in members.items()} for bundle in bundles]
    num_proposed = sum(len(member.own_poses) for member in members.values())
    probabilities = weigh_bundles([list(supports.values()) for supports in tested], num_proposed)
    order = np.argsort(-probabilities[:-1], kind="stable")
    ranked = probabilities[[*order, -1]]
    own = {k: estimate_own(members[k], support) for k, support in tested[order[0]].items()}
    estimates = {k: estimate for k, estimate in own.items() if estimate}
    if not estimates:  # the points fix no photo
        return alone
    bundle = adjust_bundle(bundles[order[0]], list(estimates.values()))
    others = [bundles[i] for i in order[1:]]
    for k, member in members.items():
        rest = [estimate for i, estimate in estimates.items() if i != k]
        pose, covariance = fuse_pose(bundle, rest, own[k], member.cam_from_bundle)
        alone[k] = describe_member(member, pose, covariance, others, ranked)
    return alone


def move_origin_near(cams_from_bundle: Sequence[Pose]) -> list[Pose]:
    """Move the origin of the common frame to the photos' mean position, so that turns hardly move them."""
    mean = np.mean([pose.center_world for pose in cams_from_bundle], axis=0)
    return [Pose(pose.R_cam_from_world, pose.center_world - mean) for pose in cams_from_bundle]


def propose_bundles(members: Sequence[Member]) -> list[Pose]:
    """Return distinct poses of the bundle in the map, the likeliest first, by the photos' own poses."""
    proposed = [
        member.cam_from_bundle.inverse() @ own.pose for member in members for own, _ in member.own_poses
    ]
    votes = [sum(vote(member, bundle) for member in members) for bundle in proposed]
    kept: list[Pose] = []
    for i in np.argsort(-np.array(votes), kind="stable"):
        bundle = join_near(members, proposed[i])
        if len(kept) < NUM_BUNDLES and not any(is_same_bundle(members, bundle, other) for other in kept):
            kept.append(bundle)
    return kept


def join_near(members: Sequence[Member], bundle: Pose) -> Pose:
    """Adjust a pose of the bundle to the photos' poses near it, all of one deviation."""
    near = []
    for member in members:
        expected = member.cam_from_bundle @ bundle
        own = next((own for own, _ in member.own_poses if is_same(own.pose, expected)), None)
        if own:
            near.append(Estimate(own.pose, RELATIVE, member.cam_from_bundle))
    return adjust_bundle(bundle, near)


def is_same_bundle(members: Sequence[Member], bundle: Pose, other: Pose) -> bool:
    """Return True if two poses of the bundle put every photo at the same place."""
    return all(is_same(m.cam_from_bundle @ bundle, m.cam_from_bundle @ other) for m in members)


def vote(member: Member, bundle: Pose) -> float:
    """Return the probability of a photo's own pose that supports a pose of the bundle."""
    expected = member.cam_from_bundle @ bundle
    return max((p for own, p in member.own_poses if is_same(own.pose, expected)), default=0.0)


def is_same(pose: Pose, other: Pose) -> bool:
    """Return True if two poses may be one, with the errors of relative poses."""
    turn = np.linalg.norm(log_so3(pose.R_cam_from_world @ other.R_cam_from_world.T))
    return bool(turn < SAME_TURN and pose.distance(other) < SAME_PLACE)


def find_support(member: Member, bundle: Pose) -> Support:
    """Return what a photo says of a pose of the bundle, by its own best pose near the one expected."""
    query = member.found.query
    expected = member.cam_from_bundle @ bundle
    poses = [own for own, _ in member.own_poses]
    own = next((h for h in poses if is_same(h.pose, expected)), None)
    found = own or max(refine_near(query, expected), key=lambda h: h.score)
    if own is None:
        poses.append(found)
    p = posterior(assess_poses(query, poses[0], poses[1:]), member.alone.covariance)
    k = next(k for k, h in enumerate(poses) if h is found)
    return Support(found, own is not None, float(p[k]), max(float(p[-1]), LEAST_NONE))


def refine_near(query: Query, expected: Pose) -> list[Hypothesis]:
    """Return a photo's poses near the one expected: by whole views, by matches, and that itself."""
    poses = [descend_fine(query, expected).pose]
    if query.photo.is_partial:
        poses.append(verify(query, expected).pose)
    near = [pose for pose in poses if is_same(pose, expected)]
    return [score_pose(query, pose) for pose in (*near, expected)]


def weigh_bundles(supports: Sequence[Sequence[Support]], num_proposed: int) -> Array:
    """Return the probability (K + 1,) of each of K poses of the bundle, and of none.

    The photos are independent evidence. Those that have missed a pose count as one: bare walls and changed
    places lie together. Photos that have found the same pose of the bundle are more than chance, if they are
    more than chance would give among all poses that were proposed.
    """
    logits = []
    for of_one in supports:
        p = np.array([s.probability for s in of_one])
        none = np.array([s.probability_none for s in of_one])
        missed = np.log((p + MISSED * none) / (p + none)).min()
        gain = (1 - sum(s.is_found for s in of_one)) * math.log(CHANCE)
        coincidence = max(gain - math.log(num_proposed), min(gain, 0.0))
        logits.append(np.log((p + none) / none).sum() + missed + coincidence)
    odds = np.exp(np.array([*logits, 0.0]) - max([*logits, 0.0]))
    return np.asarray(odds / odds.sum())


def estimate_own(member: Member, support: Support) -> Estimate | None:
    """Return a photo's own pose with its covariance; None where the points do not fix it."""
    query, _, fit = member.found
    found = estimate_covariance(query, support.own.pose, fit and fit.pose_covariance)
    if found is None:
        return None
    covariance = turn_positions(found.matrix, query.scan_map.R_map_from_world)
    return Estimate(support.own.pose, covariance, member.cam_from_bundle)


def turn_positions(covariance: Array, R_target_from_source: Array) -> Array:
    """Turn the positions' axes of a pose covariance (6, 6)."""
    J = np.eye(6)
    J[3:, 3:] = R_target_from_source
    return np.asarray(J @ covariance @ J.T)


def differentiate(bundle: Pose, cam_from_bundle: Pose) -> Array:
    """Return the derivative (6, 6) of a photo's pose by that of the bundle."""
    J = np.eye(6)
    J[:3, :3] = cam_from_bundle.R_cam_from_world
    J[3:, :3] = bundle.R_cam_from_world.T @ skew(cam_from_bundle.center_world)
    return J


def subtract(pose: Pose, other: Pose) -> Array:
    """Return the step (6,) that takes `other` to `pose`: a turn in the camera's axes, a move in the map's."""
    turn = log_so3(pose.R_cam_from_world @ other.R_cam_from_world.T)
    return np.concatenate([turn, pose.center_world - other.center_world])


def add(pose: Pose, step: Array) -> Pose:
    """Apply a step (6,) of `subtract`."""
    return Pose(orthonormal(exp_so3(step[:3]) @ pose.R_cam_from_world), pose.center_world + step[3:])


def weigh_robustly(step: Array, covariance: Array) -> Array:
    """Return the information (6, 6) of a step with a covariance, less if the step is improbable."""
    information = np.linalg.inv(covariance)
    square = float(step @ information @ step)
    return np.asarray(information * min(1.0, ROBUST / max(square, 1e-9)) ** 2)


def solve_bundle(bundle: Pose, estimates: Sequence[Estimate]) -> tuple[Pose, Array]:
    """Return the pose of the bundle after a Gauss-Newton step towards the photos' own poses; covariance."""
    information = LOOSE * np.eye(6)
    gradient = np.zeros(6)
    for own in estimates:
        J = differentiate(bundle, own.cam_from_bundle)
        step = subtract(own.pose, own.cam_from_bundle @ bundle)
        weighted = J.T @ weigh_robustly(step, own.covariance + RELATIVE)
        information = information + weighted @ J
        gradient = gradient + weighted @ step
    covariance = np.linalg.inv(information)
    return add(bundle, covariance @ gradient), np.asarray(covariance)


def adjust_bundle(bundle: Pose, estimates: Sequence[Estimate]) -> Pose:
    """Adjust the pose of the bundle to the photos' own poses."""
    for _ in range(NUM_ADJUSTMENTS):
        bundle, _ = solve_bundle(bundle, estimates)
    return bundle


def fuse_pose(
    bundle: Pose, rest: Sequence[Estimate], own: Estimate | None, cam_from_bundle: Pose
) -> tuple[Pose, Array]:
    """Return a photo's pose by the other photos and by itself, with its covariance (6, 6)."""
    if own is not None and not rest:
        return own.pose, own.covariance
    by_rest, of_rest = solve_bundle(bundle, rest)
    expected = cam_from_bundle @ by_rest
    J = differentiate(by_rest, cam_from_bundle)
    of_expected = J @ of_rest @ J.T + RELATIVE
    if own is None:
        return expected, of_expected
    return update(expected, of_expected, own.pose, own.covariance)


def update(expected: Pose, of_expected: Array, own: Pose, of_own: Array) -> tuple[Pose, Array]:
    """Return the weighted mean of two poses by their covariances (6, 6), and its covariance."""
    step = subtract(own, expected)
    gain = of_expected @ weigh_robustly(step, of_own + of_expected)  # of Kalman
    return add(expected, gain @ step), of_expected - gain @ of_expected


def describe_member(
    member: Member, pose: Pose, covariance: Array, others: Sequence[Pose], probabilities: Array
) -> Localization:
    """Return the result of a photo: its evidence at its pose, and the probabilities of the bundle's poses.

    `others` are the other poses of the bundle; `probabilities` (K + 1,) are of all of them, and of none.
    """
    query, _, fit = member.found
    scan_map = query.scan_map
    judged = judge(query, Selection(score_pose(query, pose), ()), fit)
    in_world = turn_positions(covariance, scan_map.R_map_from_world.T)
    words = least_constrained_direction(covariance[3:, 3:], in_world[3:, 3:])
    known = PoseCovariance(0.5 * (in_world + in_world.T), words)
    is_right = math.erf(MAX_DISTANCE / (known.largest_std * math.sqrt(2.0)))
    warnings = contradictions(scan_map, pose, query.settings.prior)
    p = np.append(is_right * probabilities[:-1], 0.0) * (not warnings)
    p[-1] = 1.0 - p.sum()
    elsewhere = [score_pose(query, member.cam_from_bundle @ other) for other in others]
    return replace(
        judged,
        status=classify(p, query.settings.min_confidence),
        confidence=float(p[0]),
        probability_none=float(p[-1]),
        pose=scan_map.to_world(pose),
        covariance=known,
        warnings=warnings,
        alternatives=tuple(
            Alternative(scan_map.to_world(h.pose), h.score, None, float(q))
            for h, q in zip(elsewhere, p[1:-1], strict=True)
        ),
    )
