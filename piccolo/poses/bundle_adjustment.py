"""Pose and scale of a bundle of photos, adjusted to the photos' own poses, and errors of relative poses.

The relative poses that a user gives have errors like everything else. The photos that are found by themselves
tell how large these are, whether the positions are too long, and which photo does not belong to the others.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple, TypeVar

import numpy as np

from ..geometry.gauss_newton import Equations, minimize, sum_observations, whiten
from ..geometry.pose import Pose
from ..geometry.pose_gaussian import LIKELY, LOOSE, PoseGaussian, add, differentiate, mean_of, subtract
from ..geometry.robust import redescend
from ..system.arguments import check_kind
from ..system.arrays import Array

RelativeScale = Literal["metres", "unknown"]  # of the positions of relative poses
UNKNOWN_SCALE = 10.0  # deviation of the logarithm of a scale that is not known
NUM_ADJUSTMENTS = 6  # steps, at most
BUNDLE_SETTLED = 1e-6  # [rad, m] of a step, after which there is none
NUM_ADJUSTMENT_ROUNDS = 4  # in which errors of relative poses and the bundle are estimated in turn
TELLING_RATIO = 10.0  # ratio of variances (F) by which one photo differs from the others: it contradicts them
MEDIAN = 2.366  # of chi square of 3
QUANTILE = 1.645  # deviations of the normal distribution below which 95 % lie


@dataclass(frozen=True)
class RelativePoses:
    """Poses of photos relative to each other.

    Parameters
    ----------
    poses
        One of each photo, in any common frame, such as that of a phone's tracker.
    scale
        "metres" if positions are good to 1 %, "unknown" if they may have any scale, as of COLMAP.

    Raises
    ------
    InputError
        A value is of another kind.
    """

    poses: Sequence[Pose]
    scale: RelativeScale = "metres"

    def __post_init__(self) -> None:
        """Refuse values of other kinds, by the name that a user gave them."""
        check_kind("relative_poses", self.poses, Sequence[Pose])
        check_kind("scale", self.scale, RelativeScale)


class RelativeErrors(NamedTuple):
    """Standard deviations of the relative poses that a user gives."""

    turn: float = math.radians(0.5)  # [rad] about each axis, as of phones' trackers and structure from motion
    move: float = 0.02  # [m] along each axis
    log_scale: float = 0.01  # of all positions' scale

    @property
    def covariance(self) -> Array:
        """Covariance (6, 6) of one photo's relative pose."""
        return np.asarray(np.diag(np.repeat([self.turn**2, self.move**2], 3)))


LOOSER = 0.04  # chosen: of the information of a given pose that counts before scale or clock are known
Item = TypeVar("Item")
LEAST_ERRORS = RelativeErrors(math.radians(0.01), 0.001)  # chosen: no given pose is better
robustly = partial(redescend, limit=LIKELY)


class Bundle(NamedTuple):
    """The common frame of relative poses, placed in the map."""

    pose: Pose  # in the map
    log_scale: float = 0.0  # logarithm of the factor of relative positions

    def place(self, cam_from_bundle: Pose) -> Pose:
        """Return the pose in the map of a photo with a relative pose."""
        return self.scale(cam_from_bundle) @ self.pose

    def scale(self, cam_from_bundle: Pose) -> Pose:
        """Return a relative pose with its position scaled."""
        center = math.exp(self.log_scale) * cam_from_bundle.center_world
        return Pose(cam_from_bundle.R_cam_from_world, center)


class Estimate(NamedTuple):
    """A photo's own pose in the map, and its relative pose."""

    own: PoseGaussian
    cam_from_bundle: Pose


class Adjusted(NamedTuple):
    """A bundle adjusted to photos."""

    bundle: Bundle
    covariance: Array  # (7, 7) of a step of its pose, and of its logarithm of the scale
    common: Array  # (6, 6) of errors that all photos have in common

    def predict(self, cam_from_bundle: Pose, errors: RelativeErrors) -> PoseGaussian:
        """Return the pose that a photo has by the others."""
        J = differentiate_bundle(self.bundle, cam_from_bundle)
        own = J @ self.covariance @ J.T + errors.covariance
        return PoseGaussian(self.bundle.place(cam_from_bundle), own, self.common)


def differentiate_bundle(bundle: Bundle, cam_from_bundle: Pose) -> Array:
    """Return the derivative (6, 7) of a photo's pose by the bundle's, and by its logarithm of the scale."""
    scaled = bundle.scale(cam_from_bundle)
    J = np.zeros((6, 7))
    J[:, :6] = differentiate(bundle.pose, scaled)
    J[3:, 6] = bundle.pose.R_cam_from_world.T @ scaled.center_world
    return J


def adjust(bundle: Bundle, estimates: Sequence[Estimate], errors: RelativeErrors) -> Adjusted:
    """Adjust pose and scale of a bundle to the photos' own poses; those far off count less."""
    spreads = np.array([own.own + errors.covariance for own, _ in estimates]).reshape(-1, 6, 6)
    known = np.diag([LOOSE] * 6 + [errors.log_scale**-2])

    def equations(at: Bundle) -> Equations:
        off = np.array([subtract(at.place(cam), own.pose) for own, cam in estimates]).reshape(-1, 6)
        J = np.array([differentiate_bundle(at, cam) for _, cam in estimates]).reshape(-1, 6, 7)
        found = sum_observations(whiten(spreads, off), whiten(spreads, J), robustly)
        return found.add_known(np.array([*np.zeros(6), at.log_scale]), known)

    def move(at: Bundle, step: Array) -> Bundle:
        return Bundle(add(at.pose, step[:6]), at.log_scale + float(step[6]))

    adjusted, found = minimize(equations, move, bundle, NUM_ADJUSTMENTS, BUNDLE_SETTLED)
    common = mean_of([own.common for own, _ in estimates])
    return Adjusted(adjusted, np.asarray(np.linalg.inv(found.matrix)), common)


def sum_squares(bundle: Bundle, estimates: Sequence[Estimate], errors: RelativeErrors) -> Array:
    """Return chi square of the rotations and that of the positions (2,) of photos in a bundle."""
    total = np.zeros(2)
    for own, cam_from_bundle in estimates:
        step = subtract(own.pose, bundle.place(cam_from_bundle))
        covariance = own.own + errors.covariance
        for k, part in enumerate((slice(0, 3), slice(3, 6))):
            total[k] += step[part] @ np.linalg.solve(covariance[part, part], step[part])
    return total


def count_freedom(num_photos: int) -> Array:
    """Return the degrees of freedom (2,) of rotations and positions that a pose and a scale leave."""
    return np.asarray(np.maximum(3.0 * num_photos - np.array([3.0, 4.0]), 0.0))


def find_limit(freedom: float) -> float:
    """Return chi square at 95 % for a number of degrees of freedom (Wilson and Hilferty, 1931)."""
    if freedom == 0.0:
        return math.inf
    spread = 2.0 / (9.0 * freedom)
    return float(freedom * (1.0 - spread + QUANTILE * math.sqrt(spread)) ** 3)


def estimate_errors(bundle: Bundle, estimates: Sequence[Estimate], errors: RelativeErrors) -> RelativeErrors:
    """Return the errors of relative poses, larger than expected where the photos' own poses say so.

    From few photos a variance is taken larger: chi square / (freedom - 2), as by Student's t.
    """
    freedom = count_freedom(len(estimates))
    for _ in range(NUM_ADJUSTMENT_ROUNDS):
        squares = sum_squares(adjust(bundle, estimates, errors).bundle, estimates, errors)
        factors = [
            math.sqrt(max(square / max(free - 2.0, 1.0), 1.0)) if square > find_limit(free) else 1.0
            for square, free in zip(squares, freedom, strict=True)
        ]
        errors = errors._replace(turn=errors.turn * factors[0], move=errors.move * factors[1])
        if max(factors) == 1.0:
            break
    return errors


def choose_agreed(
    candidates: Sequence[Item], find_steps: Callable[[Item], Array], errors: RelativeErrors
) -> Item:
    """Return the candidate by which most photos are off by few deviations; those far off count alike.

    `find_steps` returns the steps (N, 6) by which photos are off by a candidate.
    """
    information = LOOSER / np.diag(errors.covariance)

    def cost(candidate: Item) -> float:
        return float(np.minimum(np.square(find_steps(candidate)) @ information, LIKELY).sum())

    return min(candidates, key=cost)


def match_median(covariances: Sequence[Array], steps: Array, errors: RelativeErrors) -> RelativeErrors:
    """Return the errors by which the median photo is as far off as it should be, whatever wrong ones say.

    Photos' own poses have covariances (6, 6), and are off by steps (6,).
    """
    scales = []
    for part in (slice(0, 3), slice(3, 6)):
        spreads = [(own + errors.covariance)[part, part] for own in covariances]
        squares = [
            step[part] @ np.linalg.solve(spread, step[part])
            for spread, step in zip(spreads, steps, strict=True)
        ]
        scales.append(math.sqrt(float(np.median(squares)) / MEDIAN))
    turn = max(errors.turn * scales[0], LEAST_ERRORS.turn)
    move = max(errors.move * scales[1], LEAST_ERRORS.move)
    return errors._replace(turn=turn, move=move)


def find_odd(covariances: Sequence[Array], steps: Array, errors: RelativeErrors) -> tuple[bool, ...]:
    """Return which photos, off by steps (N, 6), contradict the others: chi square is far too large."""
    spreads = [own + errors.covariance for own in covariances]
    squares = [step @ np.linalg.solve(spread, step) for spread, step in zip(spreads, steps, strict=True)]
    return tuple(bool(square > 2.0 * LIKELY) for square in squares)


def find_contradicting(bundle: Bundle, estimates: Sequence[Estimate], errors: RelativeErrors) -> int | None:
    """Return the photo that contradicts the others, by an F test.

    None if all fit, or no single photo is to blame.
    """
    if len(estimates) < 3:
        return None
    total = squares_at_best(bundle, estimates, errors)
    if total <= find_limit(float(count_freedom(len(estimates)).sum())):
        return None
    rest = [
        squares_at_best(bundle, [*estimates[:k], *estimates[k + 1 :]], errors) for k in range(len(estimates))
    ]
    best = int(np.argmin(rest))
    left = max(rest[best] / float(count_freedom(len(estimates) - 1).sum()), 1.0)
    return best if (total - rest[best]) / 6.0 > TELLING_RATIO * left else None


def squares_at_best(bundle: Bundle, estimates: Sequence[Estimate], errors: RelativeErrors) -> float:
    """Return chi square of photos in the bundle that is adjusted to them."""
    return float(sum_squares(adjust(bundle, estimates, errors).bundle, estimates, errors).sum())


def find_scale(bundle: Bundle, estimates: Sequence[Estimate], errors: RelativeErrors) -> tuple[float, float]:
    """Return the logarithm of the scale by the photos alone, and its deviation; (0, inf) by one photo."""
    if len(estimates) < 2:
        return 0.0, math.inf
    free = adjust(bundle, estimates, errors._replace(log_scale=UNKNOWN_SCALE))
    return free.bundle.log_scale, math.sqrt(free.covariance[6, 6])


def move_origin_near(cams_from_bundle: Sequence[Pose]) -> list[Pose]:
    """Move the origin of the common frame to the photos' mean position, so that turns hardly move them."""
    mean = np.mean([pose.center_world for pose in cams_from_bundle], axis=0)
    return [Pose(pose.R_cam_from_world, pose.center_world - mean) for pose in cams_from_bundle]
