"""Covariance of a pose from blocks of the sphere, and poses from two disjoint halves of the points."""

import math
from dataclasses import dataclass

import numpy as np

from ..confidence.covariance import Certainty, weakest_direction
from ..geometry.pose import Array, Pose, angle_between, exp_so3, orthonormal
from ..geometry.sphere_grid import cell_of
from ..optimize.descent import descend
from ..optimize.normal_equations import normal_equations
from ..panorama.channels import LEVELS_PER_UNIT
from ..panorama.texels import Texels
from .query import FINISH_LOSS, FINISH_VIEW, Look, as_levels
from .view import Cells, seen_points

# A bottom wider than this is none [m]; it may be blunt where most of what both show agrees. False rivals in a
# hospital of equal wards had 0.022 and more, at agreements up to 0.47.
SHARP_STD, BLUNT_STD, LIKENESS = 0.015, 0.05, 0.55
BLOCK_RINGS = 12  # 184 blocks of 15 degrees: errors within one are taken as one error
SCALE = FINISH_LOSS * LEVELS_PER_UNIT


@dataclass(frozen=True)
class Probe:
    """At what detail the loss is looked at for a covariance."""

    image: int  # of the look's
    turn: float  # step of the differences [rad]
    move: float  # [m]
    inflation: float  # so that 95 % of true poses lie in the 95 % region (tools/calibrate_confidence.py)


# Noise roughens the loss in the finest image; where it has no bottom there, the next image tells.
PROBES = (Probe(0, math.radians(0.1), 0.005, 2.5), Probe(1, math.radians(0.3), 0.015, 0.8))


def points_at(look: Look, pose: Pose) -> Cells:
    """Offsets, channels in levels and weights of the points that the last descent goes by."""
    octree, count = look.scan_map.octree, look.settings.num_points
    offsets, features, weights = seen_points(octree, pose.center_world, FINISH_VIEW, count)
    return offsets, as_levels(features), weights


def gradient_at(image: Texels, points: Cells, R_cam_from_map: Array, shift: Array) -> Array:
    """Half the gradient (6,) of the robust loss, in the camera's frame, at a shift (3,) [m] of the centre."""
    sums = np.empty(28)
    normal_equations(*points, image.rgbx, image.width, R_cam_from_map, shift, SCALE, sums)
    return np.asarray(sums[21:27])


def hessian_at(image: Texels, points: Cells, pose: Pose, probe: Probe) -> Array:
    """Half the Hessian (6, 6) of the robust loss, by central differences over steps as large as errors are.

    The Gauss-Newton matrix leaves out that the loss flattens: with it, deviations come out several times too
    small.
    """
    rows = []
    for step in np.diag([probe.turn] * 3 + [probe.move] * 3):
        gradients = []
        for sign in (1.0, -1.0):
            R = exp_so3(sign * step[:3]) @ pose.R_cam_from_world
            gradients.append(gradient_at(image, points, R, sign * pose.R_cam_from_world.T @ step[3:]))
        rows.append((gradients[0] - gradients[1]) / (2.0 * step.sum()))
    return np.asarray(0.5 * (np.array(rows) + np.array(rows).T))


def block_gradients(image: Texels, points: Cells, pose: Pose) -> Array:
    """Half the gradients (B, 6), in the camera's frame, of the points in each block of the sphere."""
    offsets, levels, weights = points
    block = cell_of(offsets.T / np.linalg.norm(offsets, axis=0)[:, None], BLOCK_RINGS)
    gradients = []
    for b in np.unique(block):
        chosen = np.flatnonzero(block == b)
        part = offsets[:, chosen], levels[:, chosen], weights[chosen]
        gradients.append(gradient_at(image, part, pose.R_cam_from_world, np.zeros(3)))
    return np.array(gradients)


def covariance_of(hessian: Array, gradients: Array) -> Array | None:
    """Covariance (6, 6) [rad, m] in the camera's frame, robust to errors that go together within a block.

    The sandwich H^-1 (sum g g^T) H^-1 (Huber 1967; Liang and Zeger 1986 for clusters), with the usual factor
    for few blocks. None where the points do not fix the pose.
    """
    variances, axes = np.linalg.eigh(hessian)
    if len(gradients) <= 12 or variances[0] <= 1e-9 * variances[-1]:
        return None
    inverse = (axes / variances) @ axes.T
    middle = gradients.T @ gradients * (len(gradients) / (len(gradients) - 6))
    return np.asarray(inverse @ middle @ inverse)


def covariance_at(look: Look, points: Cells, pose: Pose) -> Array | None:
    """Covariance (6, 6) [rad, m] in the camera's frame, by the finest image where the loss has a bottom."""
    for probe in PROBES:
        image = look.images[probe.image]
        hessian = hessian_at(image, points, pose, probe)
        covariance = covariance_of(hessian, block_gradients(image, points, pose))
        if covariance is not None:
            return probe.inflation * covariance
    return None


def has_bottom(look: Look, pose: Pose, agreement: float) -> bool:
    """True if the loss has a bottom at the pose: where the panorama may have been taken, hardly elsewhere.

    `agreement` is that of the evidence at the pose.
    """
    covariance = covariance_at(look, points_at(look, pose), pose)
    if covariance is None:
        return False
    std = math.sqrt(float(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
    return std < (BLUNT_STD if agreement >= LIKENESS else SHARP_STD)


def certainty_at(look: Look, points: Cells, pose: Pose) -> Certainty | None:
    """How sure the pose is, in world axes; None where the points do not fix it."""
    covariance = covariance_at(look, points, pose)
    if covariance is None:
        return None
    R_map_from_cam, R_map_from_world = pose.R_cam_from_world.T, look.scan_map.R_map_from_world
    J = np.eye(6)
    J[3:, 3:] = R_map_from_cam
    covariance_map = J @ covariance @ J.T
    J[3:, 3:] = R_map_from_world.T
    covariance_world = J @ covariance_map @ J.T
    words = weakest_direction(covariance_map[3:, 3:], covariance_world[3:, 3:], points[0])
    return Certainty(0.5 * (covariance_world + covariance_world.T), words)


def disagreement_of_halves(look: Look, points: Cells, pose: Pose) -> tuple[float, float]:
    """Distance [m] and angle [rad] between the poses that two halves of the points lead to.

    The halves are opposite octants by turns, so each looks all ways, and no surface is in both but at the
    borders.
    """
    offsets, levels, weights = points
    is_first = np.signbit(offsets[0] * offsets[1] * offsets[2])
    image, poses = look.images[0], []
    for chosen in (np.flatnonzero(is_first), np.flatnonzero(~is_first)):
        R, t = pose.R_cam_from_world.copy(), np.zeros(3)
        part = offsets[:, chosen], levels[:, chosen], weights[chosen]
        descend(*part, image.rgbx, image.width, SCALE, 15, 1e-4, R, t)
        poses.append(Pose(orthonormal(R), t))
    a, b = poses
    return math.dist(a.center_world, b.center_world), angle_between(a.R_cam_from_world, b.R_cam_from_world)
