"""A pose with the covariance of its error, of which a part may be shared with other poses.

An error is a step (6,): a rotation [rad] about the camera's axes, then a translation [m] along the axes of
the pose's frame: R_true = exp([w]x) R, center_true = center + d.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..system.arrays import Array, Floats
from .nearness import Nearness
from .pose import Pose, exp_so3, log_so3, multiply, orthonormal, rotate_points, skew

LIKELY = 12.6  # chi square of 6 at 95 %: poses that differ by more contradict each other
LEAST_VARIANCE = 1e-18  # [m^2], [rad^2]
MOST_DEVIATIONS = 8.0  # deviations that an integral goes to
SURE_DEVIATIONS = 4.0  # chosen: a rotation is within them with 0.9989; no covariance is that sure of more
NODES, NODE_WEIGHTS = np.polynomial.legendre.leggauss(64)
COSINES = np.cos((np.arange(32) + 0.5) * math.pi / 32.0)  # of directions in half a turn
LOOSE = 1e-6  # [1/rad^2, 1/m^2] information that makes matrices invertible


@dataclass(frozen=True)
class PoseGaussian:
    """A pose, the covariance of its own error, and that of the error that it has in common with others.

    What is in common, as the noise of a scan or the focal length of one camera, is not averaged away.
    """

    pose: Pose
    own: Array  # (6, 6) [rad, m]
    common: Array  # (6, 6) [rad, m]

    @property
    def covariance(self) -> Array:
        """Covariance (6, 6) of the whole error."""
        return self.own + self.common

    @property
    def largest_std(self) -> float:
        """Standard deviation of the position in its least constrained direction [m]."""
        return largest_std(self.covariance)

    def attach(self, other_from_cam: Pose, relative: Array) -> "PoseGaussian":
        """Return the pose of another camera on the same rig, whose place there has a covariance (6, 6)."""
        J = differentiate(self.pose, other_from_cam)
        return PoseGaussian(other_from_cam @ self.pose, J @ self.own @ J.T + relative, J @ self.common @ J.T)

    def widen(self, common: Array) -> "PoseGaussian":
        """Return this with a further error in common (6, 6)."""
        return replace(self, common=self.common + common)

    def blur(self, own: Array) -> "PoseGaussian":
        """Return this with a further error of its own (6, 6)."""
        return replace(self, own=self.own + own)

    def square_distance(self, other: "PoseGaussian") -> float:
        """Return the squared distance to another estimate of the pose, in deviations: chi square of 6.

        What both have in common makes no difference.
        """
        step = subtract(other.pose, self.pose)
        mine, theirs = self.split_from(other)
        return float(step @ np.linalg.solve(mine + theirs, step))

    def split_from(self, other: "PoseGaussian") -> tuple[Array, Array]:
        """Return the covariances (6, 6) of what this pose and another do not have in common.

        If errors in common make one pose more uncertain than the other, as that of a photo of a bare wall,
        only the excess counts.
        """
        variances, axes = np.linalg.eigh(self.common - other.common)
        mine = (axes * np.maximum(variances, 0.0)) @ axes.T
        theirs = (axes * np.maximum(-variances, 0.0)) @ axes.T
        return self.own + mine, other.own + theirs

    def fuse(self, other: "PoseGaussian") -> "PoseGaussian":
        """Return the mean of two estimates of a pose, weighted by what they do not have in common.

        If they contradict each other, the covariance of its own error grows by as much.
        """
        excess = max(self.square_distance(other) - LIKELY, 0.0) + 1.0
        mine, theirs = self.split_from(other)
        gain = mine @ np.linalg.inv(mine + theirs)  # of Kalman
        rest = np.eye(6) - gain
        pose = add(self.pose, gain @ subtract(other.pose, self.pose))
        own = excess * (rest @ self.own @ rest.T + gain @ other.own @ gain.T)
        root = rest @ square_root(self.common) + gain @ square_root(other.common)
        return PoseGaussian(pose, 0.5 * (own + own.T), root @ root.T)


def largest_std(covariance: Array) -> float:
    """Return the largest deviation [m] of a position by the covariance (6, 6) of a pose."""
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance[3:, 3:])[-1]), 0.0))


def probability_of_ball(covariance: Array, radius: float) -> float:
    """Return the probability that an error (3,) of mean zero with a covariance (3, 3) is within a radius [m].

    Across the axis of the greatest variance it is the mean over directions of two standard normal numbers,
    each of which has 1 - exp(-r^2 / 2 v). Along that axis it is integrated by Gauss and Legendre.
    """
    variances = np.maximum(np.linalg.eigvalsh(covariance), LEAST_VARIANCE)
    std = math.sqrt(variances[2])
    reach = min(radius, MOST_DEVIATIONS * std)
    along = reach * NODES
    density = np.exp(-0.5 * (along / std) ** 2) / (std * math.sqrt(math.tau))
    across = variances[0] * COSINES**2 + variances[1] * (1.0 - COSINES**2)
    left = np.maximum(radius**2 - along**2, 0.0)
    inside = 1.0 - np.exp(-0.5 * left[:, None] / across).mean(axis=1)
    return min(float(reach * NODE_WEIGHTS @ (density * inside)), 1.0)


def probability_of_turn(covariance: Array, angle: float) -> float:
    """Return the probability that a rotation's error (3,) with a covariance (3, 3) is within an angle [rad].

    A small rotation is a vector as an error of the position is. 1 if it surely is within.
    """
    return 1.0 if _is_sure_turn(covariance, angle) else probability_of_ball(covariance, angle)


def probability_near(pose: Pose, expected: PoseGaussian, near: Nearness) -> float:
    """Return the probability that a pose is near the true one, if that is as expected.

    Along an offset and across it the covariance counts by its largest deviation.
    """
    step = subtract(pose, expected.pose)
    covariance = expected.covariance
    of_position = _probability_at(step[3:], covariance[3:, 3:], near.distance)
    turn = step[:3]
    of_turn = covariance[:3, :3]
    if _is_sure_turn(of_turn, near.angle - float(np.linalg.norm(turn))):
        return of_position
    return of_position * _probability_at(turn, of_turn, near.angle)


def _is_sure_turn(covariance: Array, angle: float) -> bool:
    """Return True if a rotation's error is within an angle [rad] but for SURE_DEVIATIONS."""
    std = math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), LEAST_VARIANCE))
    return angle >= SURE_DEVIATIONS * std


def _probability_at(offset: Array, covariance: Array, limit: float) -> float:
    """Return the probability that an error (3,) is within a limit of an offset (3,)."""
    std = math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), LEAST_VARIANCE)) * math.sqrt(2.0)
    gap = float(np.linalg.norm(offset))
    return 0.5 * (math.erf((limit - gap) / std) + math.erf((limit + gap) / std))


def square_root(covariance: Array) -> Array:
    """Return the symmetric square root of a covariance (6, 6)."""
    variances, axes = np.linalg.eigh(covariance)
    return np.asarray((axes * np.sqrt(np.maximum(variances, 0.0))) @ axes.T)


def mean_of(covariances: Sequence[Array]) -> Array:
    """Return the mean (6, 6) of covariances; zeros if there are none."""
    return np.asarray(sum(covariances, np.zeros((6, 6))) / max(len(covariances), 1))


def turn_positions(covariance: Array, R_target_from_source: Array) -> Array:
    """Turn the positions' axes of a pose covariance (6, 6)."""
    J = np.eye(6)
    J[3:, 3:] = R_target_from_source
    return np.asarray(J @ covariance @ J.T)


def differentiate(pose: Pose, other_from_cam: Pose) -> Array:
    """Return the derivative (6, 6) of another camera's pose on the same rig by that of a camera."""
    J = np.eye(6)
    J[:3, :3] = other_from_cam.R_cam_from_world
    J[3:, :3] = pose.R_cam_from_world.T @ skew(other_from_cam.center_world)
    return J


def differentiate_rays(points_world: Floats, pose: Pose) -> tuple[Array, Array]:
    """Return unit rays (N, 3) to points (N, 3) in the camera's axes, and derivatives (N, 3, 6) by the pose.

    The pose turns about the camera's axes [rad] and moves along the world's [m]: a ray u to a point at
    distance r changes by w x u - (I - u u^T) R d / r.
    """
    offsets = rotate_points(points_world - pose.center_world, pose.R_cam_from_world)
    ranges = np.linalg.norm(offsets, axis=1)
    rays = offsets / ranges[:, None]
    across = rays[:, :, None] * rays[:, None] - np.eye(3)
    of_moves = across @ pose.R_cam_from_world / ranges[:, None, None]
    of_turns = np.cross(np.eye(3), rays[:, None]).swapaxes(1, 2)
    return rays, np.concatenate([of_turns, of_moves], axis=2)


def subtract(pose: Pose, other: Pose) -> Array:
    """Return the step (6,) that takes `other` to `pose`."""
    turn = log_so3(multiply(pose.R_cam_from_world, other.R_cam_from_world.T))
    return np.concatenate([turn, pose.center_world - other.center_world])


def add(pose: Pose, step: Array) -> Pose:
    """Apply a step (6,) of `subtract`."""
    return Pose(orthonormal(multiply(exp_so3(step[:3]), pose.R_cam_from_world)), pose.center_world + step[3:])
