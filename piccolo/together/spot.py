"""The spot where somebody stands and takes photos around: from sure photos follows where others were taken.

A person turns about their own axis and holds the camera before them, as far out as an arm reaches. So a
photo's position is that of the axis plus an offset that turns with the camera's heading. Axis, offset and how
steadily both are kept are estimated from the photos that are sure; an offset of zero is a turn on the spot,
and an unsteady one are a few steps. Bayesian linear regression, averaged over the deviations that may remain
(Bishop, Pattern Recognition and Machine Learning, 2006, section 3.5).
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
STEADINESSES = (0.02, 0.04, 0.08, 0.16, 0.32, 0.64, 1.28)  # [m] deviations that may remain, each as likely
FREE = 1e3  # [m] deviation of the axis's position before any photo


class Positioned(NamedTuple):
    """A position in the map, and the covariance (3, 3) [m^2] of its error."""

    center: Array  # (3,) [m]
    covariance: Array


class Spot(NamedTuple):
    """Axis and offset of somebody who takes photos, for each deviation that may remain."""

    probabilities: Array  # (S,) of the deviations
    means: Array  # (S, 5) [m] the axis's position in the map, and the camera's offset ahead and to the left
    covariances: Array  # (S, 5, 5) [m^2]

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
        within = A @ self.covariances @ A.T + np.square(STEADINESSES)[:, None, None] * np.eye(3)
        every = within + apart[:, :, None] * apart[:, None]
        return Positioned(center, np.tensordot(self.probabilities, every, 1))


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
    known = np.diag([FREE**-2] * 3 + [ARM**-2] * 2)
    logs = []
    means = []
    covariances = []
    for steadiness in STEADINESSES:
        variances = errors + steadiness**2 * np.eye(3)
        weights = np.linalg.inv(variances)
        weighted = A.transpose(0, 2, 1) @ weights
        information = known + (weighted @ A).sum(axis=0)
        total = (weighted @ centers[..., None]).sum(axis=0)[:, 0]
        mean = np.linalg.solve(information, total)
        misfit = np.einsum("ki,kij,kj->", centers, weights, centers) - total @ mean
        volumes = np.linalg.slogdet(variances)[1].sum() + np.linalg.slogdet(information)[1]
        logs.append(-0.5 * (misfit + volumes))
        means.append(np.concatenate([mean[:3] + origin, mean[3:]]))
        covariances.append(np.linalg.inv(information))
    likelihoods = np.exp(np.array(logs) - max(logs))
    return Spot(likelihoods / likelihoods.sum(), np.array(means), np.array(covariances))


def compute_density(position: Positioned, center: Array) -> float:
    """Return the probability density [1/m^3] of a position (3,)."""
    offset = center - position.center
    square = float(offset @ np.linalg.solve(position.covariance, offset))
    volume = math.sqrt(math.tau**3 * float(np.linalg.det(position.covariance)))
    return math.exp(-0.5 * square) / volume
