"""Descend on a loss from one start: step 4 of the paper's Algorithm 1, and other solvers."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import numpy as np

from ..geometry.levenberg_marquardt import GRADIENT, LOSS, MATRIX, levenberg_marquardt
from ..geometry.points import PackedPoints
from ..geometry.pose import Pose, exp_so3, left_jacobian, orthonormal, step
from ..optimize.sampling_loss import sampling_equations, sampling_loss
from ..photo.panorama.texels import Texels
from ..system.arrays import Array
from ..views.zbuffer import visible_points

LEAST_STEP = 1e-7  # [rad + m] of Gauss-Newton: a shorter one ends the descent

Equations = tuple[float, Array, Array]  # loss, its gradient (6,) by a step, normal matrix (6, 6)
Objective = Callable[[Pose], Equations]
Solver = Literal["gauss-newton", "lbfgs", "adam"]


@dataclass(frozen=True)
class DescentSettings:
    """A descent on a loss; the paper's names in brackets."""

    solver: Solver = "adam"
    num_iterations: int = 100  # [N_iter] of the solver
    step_size: float = 0.1  # Adam's first step [rad, m]
    step_decay: float = 0.8  # factor on the step whenever the loss has not fallen for `patience` iterations
    patience: int = 5
    use_visibility: bool = True  # leave out the points that the camera can't see
    num_culls: int = 4  # times during the descent at which hidden points are found and left out


@dataclass(frozen=True)
class Loss:
    """A loss of poses, to be minimised: functions of the points that count and of the pose."""

    value: Callable[[PackedPoints, Pose], float]
    equations: Callable[[PackedPoints, Pose], Equations]


def make_sampling_loss(texels: Texels) -> Loss:
    """Make the paper's sampling loss of a panorama."""
    return Loss(
        lambda points, pose: sampling_loss(points, texels, pose),
        lambda points, pose: sampling_equations(points, texels, pose),
    )


@dataclass
class Refined:
    """The best pose of a descent, and its loss: at the end of all, over the points visible from the pose."""

    pose: Pose
    loss: float = np.inf

    def offer(self, pose: Pose, loss: float) -> None:
        """Keep `pose` if it is better."""
        if loss < self.loss:
            self.pose = pose
            self.loss = loss


@dataclass
class Adam:
    """Adam (Kingma and Ba, 2015) on steps (rotation, translation), with the paper's decay of the step."""

    step_size: float  # [rad, m]
    step_decay: float
    patience: int
    mean: Array = field(default_factory=lambda: np.zeros(6))
    mean_square: Array = field(default_factory=lambda: np.zeros(6))
    num_updates: int = 0
    best_loss: float = np.inf
    num_stalled: int = 0

    def update(self, loss: float, gradient: Array) -> Array:
        """Return the step (6,) from a pose with this loss and gradient (6,)."""
        self.num_stalled = 0 if loss < self.best_loss else self.num_stalled + 1
        self.best_loss = min(self.best_loss, loss)
        if self.num_stalled == self.patience:
            self.step_size *= self.step_decay
            self.num_stalled = 0
        self.num_updates += 1
        self.mean = 0.9 * self.mean + 0.1 * gradient
        self.mean_square = 0.999 * self.mean_square + 0.001 * gradient**2
        mean = self.mean / (1.0 - 0.9**self.num_updates)
        mean_square = self.mean_square / (1.0 - 0.999**self.num_updates)
        return np.asarray(-self.step_size * mean / (np.sqrt(mean_square) + 1e-8))


def descend_adam(objective: Objective, pose: Pose, adam: Adam, num_iterations: int) -> Refined:
    """Take `num_iterations` steps of `adam`, which keeps its state; return the best pose."""
    best = Refined(pose)
    for _ in range(num_iterations):
        loss, gradient, _ = objective(pose)
        if not np.isfinite(loss):
            break
        best.offer(pose, loss)
        pose = step(pose, adam.update(loss, gradient))
    return best


def descend_lbfgs(objective: Objective, start: Pose, num_iterations: int) -> Refined:
    """Run at most `num_iterations` of SciPy's L-BFGS-B; return the best pose.

    Its parameters are a rotation vector w, R = exp([w]x) R_start, and the displacement of the camera.
    """
    from scipy.optimize import minimize  # noqa: PLC0415  # Adam need not wait for it: 0.25 s

    best = Refined(start)

    def value(parameters: Array) -> tuple[float, Array]:
        w = parameters[:3]
        R_cam_from_world = orthonormal(exp_so3(w) @ start.R_cam_from_world)
        pose = Pose(R_cam_from_world, start.center_world + parameters[3:])
        loss, gradient, _ = objective(pose)
        best.offer(pose, loss)
        by_w = left_jacobian(w).T @ gradient[:3]
        by_center = R_cam_from_world.T @ gradient[3:]
        return loss, np.concatenate([by_w, by_center])

    minimize(value, np.zeros(6), jac=True, method="L-BFGS-B", options={"maxiter": num_iterations})
    return best


def descend_gauss_newton(objective: Objective, start: Pose, num_iterations: int) -> Refined:
    """Minimise reweighted least squares in at most `num_iterations` steps; return the best pose."""
    best = Refined(start)

    def equations(_: None, R_cam_from_world: Array, center_world: Array, sums: Array) -> None:
        pose = Pose(orthonormal(R_cam_from_world), center_world.copy())
        sums[LOSS], sums[GRADIENT:MATRIX], matrix = objective(pose)
        sums[MATRIX:] = matrix[np.triu_indices(6)]
        best.offer(pose, sums[LOSS])

    at = Pose(start.R_cam_from_world.copy(), start.center_world.copy())
    levenberg_marquardt(equations)(None, num_iterations, LEAST_STEP, at.R_cam_from_world, at.center_world)
    return best


def refine_by_solver(points: PackedPoints, loss: Loss, start: Pose, settings: DescentSettings) -> Refined:
    """Descend from `start`, leaving out the points hidden from the camera; these are found `num_culls` times.

    Leaving out other points changes the loss, so that its values before and after are not comparable: the
    result is the best pose of the last part of the descent.
    """
    adam = Adam(settings.step_size, settings.step_decay, settings.patience)
    bounds = np.linspace(0, settings.num_iterations, settings.num_culls + 1).astype(int)
    pose = start

    def find_visible(at: Pose) -> PackedPoints:
        return visible_points(points, at.center_world) if settings.use_visibility else points

    for num_iterations in np.diff(bounds).tolist():
        objective = partial(loss.equations, find_visible(pose))
        if settings.solver == "adam":
            adam.best_loss = np.inf
            pose = descend_adam(objective, pose, adam, num_iterations).pose
        else:
            descend = descend_lbfgs if settings.solver == "lbfgs" else descend_gauss_newton
            pose = descend(objective, pose, num_iterations).pose
    return Refined(pose, loss.value(find_visible(pose), pose))
