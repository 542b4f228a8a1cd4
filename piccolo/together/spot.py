"""The spot where somebody takes photos around: from sure photos follows where others were taken.

A person turns about their own axis and holds the camera before them, as far out as an arm reaches. So a
photo's position is that of the axis plus an offset that turns with the camera's heading. Axis, offset and how
steadily both are kept are estimated from the photos that are sure; an offset of zero is a turn on the spot.
Who walks straight on leaves the axis along one way only, and who takes a few steps leaves it to all sides.
Bayesian linear regression, averaged over these ways and deviations (Bishop, Pattern Recognition and Machine
Learning, 2006, section 3.5).
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..geometry.pose import Pose
from ..geometry.pose_gaussian import PoseGaussian
from ..system.arrays import Array

LEAST_AT_SPOT = 3  # photos by which it is told how steadily somebody stands
STEPS_APART = 1.0  # chosen: [m] from a photo to the nearest other that was taken at the same spot
ARM = 0.4  # chosen: [m] deviation of the offset, ahead and to each side
LEAST_LEVEL = 0.5  # part of the direction of view that is level, from which it tells the heading
STEADINESSES = (0.03, 0.06, 0.12, 0.24, 0.48, 0.96)  # [m] deviations of who stands, each as likely
WALKS = 0.5  # chosen: probability that somebody walks straight on
PACES = (0.5, 1.0)  # [m] deviations along that way, each as likely
STRAIGHTNESSES = (0.02, 0.04, 0.08)  # [m] deviations from it, each as likely
NUM_WAYS = 36  # level directions in which somebody may walk, each as likely
ROUGH_MOVE = 0.3  # chosen: [m] deviation of a pose that the photo does not fix
FREE = 1e3  # [m] deviation of the axis's position before any photo


class Positioned(NamedTuple):
    """A position in the map, and the covariance (3, 3) [m^2] of its error."""

    center: Array  # (3,) [m]
    covariance: Array


class Spot(NamedTuple):
    """Axis and offset of somebody who takes photos, for each way in which these may be kept."""

    probabilities: Array  # (S,) of the ways
    means: Array  # (S, 5) [m] the axis's position in the map, and the camera's offset ahead and to the left
    covariances: Array  # (S, 5, 5) [m^2]
    spreads: Array  # (S, 3, 3) [m^2] covariances of positions about axis and offset

    @property
    def axis(self) -> Array:
        """Position (3,) of the axis in the map [m]."""
        return np.asarray((self.probabilities @ self.means)[:3])

    def place(self, R_cam_from_map: Array) -> Positioned:
        """Return where a camera with a rotation (3, 3) is expected."""
        A = differentiate_position(R_cam_from_map)
        centers = self.means @ A.T
        center = self.probabilities @ centers
        apart = centers - center
        every = A @ self.covariances @ A.T + self.spreads + apart[:, :, None] * apart[:, None]
        return Positioned(center, np.tensordot(self.probabilities, every, 1))

    def attract(self, R_cam_from_map: Array, found: Array) -> Pose:
        """Return a pose with a rotation (3, 3) where it is expected, near where it was found (3,).

        That position may be off by ROUGH_MOVE.
        """
        center, covariance = self.place(R_cam_from_map)
        gain = covariance @ np.linalg.inv(covariance + ROUGH_MOVE**2 * np.eye(3))
        return Pose(R_cam_from_map, center + gain @ (found - center))


def differentiate_position(R_cam_from_map: Array) -> Array:
    """Return the derivative (3, 5) of a camera's position by the axis's position and the camera's offset.

    The offset, ahead and to the left, turns with the heading alone: the wrist lifts the camera, not the arm.
    """
    ahead, left, _ = R_cam_from_map
    if math.hypot(ahead[0], ahead[1]) < LEAST_LEVEL:  # it looks up or down
        ahead = np.array([left[1], -left[0], 0.0])
    heading = np.array([ahead[0], ahead[1], 0.0]) / math.hypot(ahead[0], ahead[1])
    beside = np.array([-heading[1], heading[0], 0.0])
    return np.column_stack([np.eye(3), heading, beside])


def find_spots(located: Sequence[PoseGaussian]) -> list[Spot]:
    """Find the spots where enough photos were taken, whose poses in the map are known."""
    groups = gather([one.pose for one in located])
    return [fit_spot([located[k] for k in group]) for group in groups if len(group) >= LEAST_AT_SPOT]


def gather(poses: Sequence[Pose]) -> list[list[int]]:
    """Return the numbers of the poses that are near each other, or by way of others, in order."""
    left = list(range(len(poses)))
    groups = []
    while left:
        group = left[:1]
        for k in group:
            apart = {n: poses[k].distance(poses[n]) for n in left if n not in group}
            group += [n for n, distance in apart.items() if distance <= STEPS_APART]
        groups.append(sorted(group))
        left = [k for k in left if k not in group]
    return groups


def fit_spot(located: Sequence[PoseGaussian]) -> Spot:
    """Estimate axis and offset of somebody who took photos, from their poses in the map."""
    origin = located[0].pose.center_world
    centers = np.array([one.pose.center_world for one in located]) - origin
    A = np.array([differentiate_position(one.pose.R_cam_from_world) for one in located])
    errors = np.array([one.own[3:, 3:] for one in located])
    priors, spreads = list_spreads(A[0, :2, 3])
    known = np.diag([FREE**-2] * 3 + [ARM**-2] * 2)
    variances = errors + spreads[:, None]  # (S, K, 3, 3)
    weights = np.linalg.inv(variances)
    weighted = A.transpose(0, 2, 1) @ weights
    information = known + (weighted @ A).sum(axis=1)
    total = (weighted @ centers[..., None]).sum(axis=1)
    means = np.linalg.solve(information, total)[..., 0]
    misfits = np.einsum("ki,skij,kj->s", centers, weights, centers) - np.sum(total[..., 0] * means, axis=1)
    volumes = np.linalg.slogdet(variances)[1].sum(axis=1) + np.linalg.slogdet(information)[1]
    logs = np.log(priors) - 0.5 * (misfits + volumes)
    likelihoods = np.exp(logs - logs.max())
    means[:, :3] += origin
    return Spot(likelihoods / likelihoods.sum(), means, np.linalg.inv(information), spreads)


def list_spreads(heading: Array) -> tuple[Array, Array]:
    """Return covariances (S, 3, 3) [m^2] of positions of who stands, or walks straight on, and priors (S,).

    The ways of walking begin at a level direction (2,).
    """
    stands = np.square(STEADINESSES)[:, None, None] * np.eye(3)
    angles = math.atan2(heading[1], heading[0]) + np.arange(NUM_WAYS) * (math.pi / NUM_WAYS)
    ways = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(NUM_WAYS)])
    along = np.square(PACES)[:, None, None, None] * (ways[:, :, None] * ways[:, None])
    aside = np.square(STRAIGHTNESSES)[:, None, None, None, None] * np.eye(3)
    walks = (along + aside).reshape(-1, 3, 3)
    priors = [(1.0 - WALKS) / len(stands)] * len(stands) + [WALKS / len(walks)] * len(walks)
    return np.array(priors), np.concatenate([stands, walks])


def compute_density(position: Positioned, center: Array) -> float:
    """Return the probability density [1/m^3] of a position (3,)."""
    offset = center - position.center
    square = float(offset @ np.linalg.solve(position.covariance, offset))
    volume = math.sqrt(math.tau**3 * float(np.linalg.det(position.covariance)))
    return math.exp(-0.5 * square) / volume
