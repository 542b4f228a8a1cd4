"""Boresight calibration: how a camera sits on what carries it, from photos that were localized.

With body_from_world(t) the given poses: cam_from_world(t) = cam_from_body @ body_from_world(t + clock). The
rotation and lever arm of cam_from_body and the clock offset are fitted robustly. Errors of the given poses
are estimated from what is left.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...geometry.gauss_newton import Equations, minimize, sum_observations, whiten
from ...geometry.pose import Pose
from ...geometry.pose_gaussian import LOOSE, add, subtract
from ...poses.bundle_adjustment import (
    RelativeErrors,
    choose_agreed,
    find_odd,
    match_median,
    robustly,
)
from ...system.arrays import Array
from ...system.errors import InputError

LEAST_PHOTOS = 4
NUM_ROUNDS = 5  # in which errors and the mount are estimated in turn
MOST_ALIKE = 0.9  # correlation of errors of neighbouring photos
NUM_STEPS = 8  # at most
SETTLED = 1e-6  # [rad, m, s] of a step, after which there is none
NEAR_S = 0.01  # [s] on either side, over which a velocity is taken
MARGIN_S = 1.0  # [s] chosen: by which clocks may differ where a photo is at an end of the trajectory
MOST_ERRORS = RelativeErrors(math.radians(5.0), 0.5)  # chosen: such poses are in another frame, or of others


class Trajectory(NamedTuple):
    """Given poses by time."""

    times: Array  # (N,) [s], rising; of poses without times their numbers
    poses: Sequence[Pose]  # body_from_world
    has_clock: bool = True

    def at(self, time: float) -> Pose:
        """Return the pose at a time: linear between two poses, and beyond the first and last."""
        k = min(max(int(np.searchsorted(self.times, time)), 1), len(self.times) - 1)
        before = self.poses[k - 1]
        after = self.poses[k]
        share = (time - self.times[k - 1]) / (self.times[k] - self.times[k - 1])
        return add(before, share * subtract(after, before))


class Sighting(NamedTuple):
    """A photo that was localized."""

    pose: Pose
    covariance: Array  # (6, 6)
    time: float  # by the photos' clock, or of its given pose


class Unknowns(NamedTuple):
    """The unknowns of a mount."""

    cam_from_body: Pose
    clock: float  # [s] to be added to photos' times


class MountFit(NamedTuple):
    """A camera's mount."""

    cam_from_body: Pose  # center_world is the lever arm in the body's axes [m]
    clock: float  # [s] to be added to photos' times; 0 without times
    covariance: Array  # (7, 7) of rotation [rad] about the camera's axes, lever arm [m], clock [s]
    errors: RelativeErrors  # of a given pose
    is_odd: tuple[bool, ...]  # True for photos that contradict the others
    steps: Array  # (N, 6) of photos from where the mount puts them [rad, m]


def fit_mount(sightings: Sequence[Sighting], trajectory: Trajectory) -> MountFit:
    """Fit a mount; InputError for too few photos, and for poses that do not fit at all."""
    if len(sightings) < LEAST_PHOTOS or len(trajectory.poses) < LEAST_PHOTOS:
        found = f"found {len(sightings)} localized photos with a given pose"
        raise InputError(f"{found}, wanted {LEAST_PHOTOS} or more")
    if trajectory.has_clock:
        _check_times(np.array([sighting.time for sighting in sightings]), trajectory.times)
    own = [sighting.covariance for sighting in sightings]
    errors = RelativeErrors()
    mount = Unknowns(_begin(sightings, trajectory, errors), 0.0)
    for _ in range(NUM_ROUNDS):
        mount, covariance = _adjust(mount, sightings, trajectory, errors)
        steps = np.array([-_compare(mount, sighting, trajectory)[0] for sighting in sightings])
        errors = match_median(own, steps, errors)
    if errors.turn > MOST_ERRORS.turn or errors.move > MOST_ERRORS.move:
        off = f"{errors.move:.2g} m and {math.degrees(errors.turn):.2g} deg"
        wanted = "wanted those of one rigid mount in the scan's coordinates"
        raise InputError(f"found given poses that are off by {off}, {wanted}")
    is_odd = find_odd(own, steps, errors)
    covariance = covariance * _repeat(own, steps, errors, is_odd)
    return MountFit(mount.cam_from_body, mount.clock, covariance, errors, is_odd, steps)


def _adjust(
    begin: Unknowns, sightings: Sequence[Sighting], trajectory: Trajectory, errors: RelativeErrors
) -> tuple[Unknowns, Array]:
    """Adjust a mount to photos; those far off count less. Return also its covariance (7, 7)."""
    spreads = np.array([sighting.covariance + errors.covariance for sighting in sightings])

    def equations(at: Unknowns) -> Equations:
        compared = [_compare(at, sighting, trajectory) for sighting in sightings]
        off, J = (whiten(spreads, np.array(values)) for values in zip(*compared, strict=True))
        return sum_observations(off, J, robustly).add_known(np.zeros(7), LOOSE * np.eye(7))

    def move(at: Unknowns, step: Array) -> Unknowns:
        return Unknowns(add(at.cam_from_body, step[:6]), at.clock + float(step[6]))

    mount, found = minimize(equations, move, begin, NUM_STEPS, SETTLED)
    return mount, np.asarray(np.linalg.inv(found.matrix))


def _check_times(times: Array, clock: Array) -> None:
    """Refuse photos of which most were not taken during the trajectory: their clock is another."""
    begin, *_, end = clock
    is_within = (times > begin - MARGIN_S) & (times < end + MARGIN_S)
    if 2 * np.count_nonzero(is_within) < len(times):
        found = f"found photos at {times.min():.3f} to {times.max():.3f} s"
        wanted = (
            f"wanted times within those of the given poses, {begin:.3f} to {end:.3f} s, but for an offset"
        )
        raise InputError(f"{found}, {wanted}")


def _repeat(own: Sequence[Array], steps: Array, errors: RelativeErrors, is_odd: Sequence[bool]) -> float:
    """Return how many successive photos tell as much as one, by how alike the errors of two neighbours are.

    Given poses drift: those of neighbouring photos are off in the same way, which is not averaged away.
    """
    whitened = whiten(np.array(own) + errors.covariance, steps)[~np.array(is_odd)]
    alike = float((whitened[1:] * whitened[:-1]).sum() / max(np.square(whitened).sum(), 1e-12))
    alike = min(max(alike, 0.0), MOST_ALIKE)
    return (1.0 + alike) / (1.0 - alike)


def _begin(sightings: Sequence[Sighting], trajectory: Trajectory, errors: RelativeErrors) -> Pose:
    """Return the mount that one photo says and most others agree with."""
    mounts = [sighting.pose @ trajectory.at(sighting.time).inverse() for sighting in sightings]
    return choose_agreed(mounts, lambda mount: np.array([subtract(m, mount) for m in mounts]), errors)


def _compare(mount: Unknowns, sighting: Sighting, trajectory: Trajectory) -> tuple[Array, Array]:
    """Return the step (6,) from a photo's pose to where the mount puts it, and its derivative (6, 7)."""
    cam_from_body, clock = mount
    time = sighting.time + clock
    body = trajectory.at(time)
    J = np.zeros((6, 7))
    J[:3, :3] = np.eye(3)
    J[3:, 3:6] = body.R_cam_from_world.T
    if trajectory.has_clock:
        ends = [cam_from_body @ trajectory.at(time + side) for side in (-NEAR_S, NEAR_S)]
        J[:, 6] = subtract(ends[1], ends[0]) / (2.0 * NEAR_S)
    return subtract(cam_from_body @ body, sighting.pose), J
