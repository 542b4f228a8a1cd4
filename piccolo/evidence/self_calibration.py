"""Poses found together with corrections of the photo's geometry, by the loss of the default method.

The geometry that a photo's file states is a claim. The scan's points are displaced as a photo with
corrections would show them (`camera.corrections`), so that pose and corrections are optimised together and no
photo is projected again. The errors of the corrections follow from the blocks of the sphere, as those of a
pose do.
"""

from typing import NamedTuple

import numpy as np

from ..geometry.gauss_newton import Equations, minimize
from ..geometry.pose import Pose, step
from ..judge.claim import PictureCorrections
from ..optimize.channel_loss import ChannelProblem
from ..optimize.corrected_equations import NUM_OF_POSE, FreeSums, sum_free_equations
from ..photo.camera.corrections import Corrections
from ..photo.panorama.local_normalization import LEVELS_PER_UNIT, to_levels
from ..photo.panorama.texels import Texels
from ..problem.stages import Limits
from ..system.arrays import Array, Array32, Int64s
from ..views.view import Cells
from .blocks import jackknife_gradients, sort_by_block, take

MASKED_LOSS = 0.25  # loss of a point on masked pixels, as a multiple of the square of the loss's scale
# factor on the Gauss-Newton matrix, which ignores that the loss flattens: with this factor, 95 % of the true
# corrections of 48 crops of three scenes lie within two deviations
CURVATURE = 0.25


class Freedom(NamedTuple):
    """Corrections that are free, and in which limits."""

    corrections: Corrections
    deviations: Array  # (p,) expected of each correction, which the loss charges; infinite: it charges none
    most: Array  # (p,) largest absolute values that are searched


class FreeEnd(NamedTuple):
    """The end of a descent of pose and corrections."""

    pose: Pose
    values: Array  # (p,) corrections
    loss: float  # with the charge for the corrections, by the deviations of the freedom
    sums: FreeSums  # of the equations, by the blocks of the sphere

    @property
    def start(self) -> tuple[Pose, Array]:
        """Pose and corrections, from which another descent may begin."""
        return self.pose, self.values


class LensEstimate(NamedTuple):
    """Corrections by the photo and the scan alone, and how the pose moves with them."""

    by_picture: PictureCorrections
    motion: (
        Array  # (6, p) of the pose with them: rotation about the camera's axes [rad], centre in the map [m]
    )


class Points(NamedTuple):
    """Points around a pose, by the blocks of the sphere in which they lie."""

    around: Cells
    begins: Int64s  # (B + 1,)
    levels: Array32  # (3, N) their channels


def sort_points(cells: Cells, pose: Pose) -> Points:
    """Sort the cells or points that count by their blocks around a pose."""
    around, begins = sort_by_block(take(cells, cells.weights > 0.0).around(pose.center_world))
    return Points(around, begins, to_levels(around.channels))


def evaluate(
    points: Points, image: Texels, scale: float, corrections: Corrections, pose: Pose, values: Array
) -> FreeSums:
    """Return the sums of the equations at a pose with corrections (p,); scale [levels]."""
    offsets = points.around.around(pose.center_world).offsets
    offsets_cam = np.ascontiguousarray(pose.R_cam_from_world.astype(np.float32) @ offsets)
    shown = corrections.displace(offsets_cam, values)
    weights = points.around.weights * shown.is_shown
    problem = ChannelProblem(shown.points, points.levels, weights, image.rgbx, image.width, scale)
    return sum_free_equations(problem, shown.moves, points.begins)


def relate_to_chance(sums: FreeSums) -> float:
    """Return the factor that makes the loss the negative logarithm of a likelihood, by its gradients."""
    gradients = sums.gradients
    matrix = sums.matrices.sum(axis=0)
    return len(matrix) / max(float(np.trace(np.linalg.pinv(matrix) @ gradients.T @ gradients)), 1e-12)


def descend_freely(
    cells: Cells, image: Texels, freedom: Freedom, pose: Pose, values: Array, limits: Limits
) -> FreeEnd:
    """Descend from a pose and corrections (p,), both free."""
    points = sort_points(cells, pose)
    scale = limits.loss_scale * LEVELS_PER_UNIT
    total_weight = float(points.around.weights.sum())

    def at(where: Pose, corrected: Array) -> FreeEnd:
        sums = evaluate(points, image, scale, freedom.corrections, where, corrected)
        masked = MASKED_LOSS * scale * scale * (total_weight - float(sums.weight.sum()))
        return FreeEnd(where, corrected, float(sums.loss.sum()) + masked, sums)

    def equations(end: FreeEnd) -> Equations:
        found = Equations(end.loss, end.sums.gradients.sum(axis=0), end.sums.matrices.sum(axis=0))
        return found.add_known(np.concatenate([np.zeros(NUM_OF_POSE), end.values]), known)

    def move(end: FreeEnd, by: Array) -> FreeEnd:
        corrected = np.clip(end.values + by[NUM_OF_POSE:], -freedom.most, freedom.most)
        return at(step(end.pose, by[:NUM_OF_POSE]), corrected)

    start = at(pose, values)
    precision = freedom.deviations**-2.0 / relate_to_chance(start.sums)
    known = np.diag(np.concatenate([np.zeros(NUM_OF_POSE), precision]))
    end, found = minimize(equations, move, start, limits.num_iterations, limits.tolerance)
    return end._replace(loss=found.loss)


def estimate_corrections(end: FreeEnd, curvature: float = CURVATURE) -> LensEstimate:
    """Estimate the corrections by photo and scan alone, with the pose free, at the end of a descent."""
    matrix = curvature * end.sums.matrices.sum(axis=0)
    shown = end.sums.weight > 0.0
    gradients = jackknife_gradients(end.sums.gradients[shown], end.sums.matrices[shown])
    inverse = np.linalg.pinv(matrix)
    covariance = (inverse @ gradients.T @ gradients @ inverse)[NUM_OF_POSE:, NUM_OF_POSE:]
    motion = -np.linalg.pinv(matrix[:NUM_OF_POSE, :NUM_OF_POSE]) @ matrix[:NUM_OF_POSE, NUM_OF_POSE:]
    motion[3:] = end.pose.R_cam_from_world.T @ motion[3:]
    by_slopes = inverse[NUM_OF_POSE:]
    of_blocks = by_slopes @ end.sums.matrices[shown] @ by_slopes.T
    return LensEstimate(PictureCorrections(end.values, invert(covariance), of_blocks), np.asarray(motion))


def displace_blocks(end: FreeEnd, variance: Array) -> Array:
    """Return the covariance (p, p) of the corrections by surfaces of the scan that are displaced.

    The surfaces of each block are displaced independently, with the covariance `variance` (3, 3) [m^2] in the
    map. A displacement acts as if the camera had moved the other way for the block's points alone, so that
    the slopes change by the block's part of the normal equations.
    """
    R = end.pose.R_cam_from_world
    inverse = np.linalg.pinv(end.sums.matrices.sum(axis=0))
    by_move = inverse[NUM_OF_POSE:] @ end.sums.matrices[:, :, 3:NUM_OF_POSE]  # (B, p, 3) [1 / m]
    return np.asarray(np.einsum("bik,kl,bjl->ij", by_move, R @ variance @ R.T, by_move))


def invert(matrix: Array) -> Array:
    """Return the inverse (p, p) of a covariance or of an information; 0 in directions in which this is 0."""
    found = np.linalg.pinv(matrix, hermitian=True)
    values, axes = np.linalg.eigh(0.5 * (found + found.T))
    return np.asarray((axes * np.maximum(values, 0.0)) @ axes.T)
