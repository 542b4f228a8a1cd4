"""Poses of a photo at a spot where others were taken: turned there until it fits best, and weighed by it."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..evidence.examine import choose, examine
from ..evidence.turning import estimate_turn, turn
from ..geometry.nearness import ONE_ANSWER
from ..geometry.pose import Pose
from ..geometry.pose_gaussian import LIKELY, PoseGaussian
from ..judge.alternatives import sort_by_score, suppress_near
from ..judge.by_others import (
    LOCAL_ERRORS,
    NearbyErrors,
    NearbyShares,
    believe_exact,
    log_odds_nearby,
    share_nearby,
)
from ..judge.candidate import Candidate, Selection
from ..judge.probability import log_odds
from ..judge.selection import assess
from ..localization.judging import Found
from ..problem.accuracy import Accuracy
from ..problem.problem import Problem
from ..scan_map.camera_positions import COARSE_SPACING
from ..system.jobs.threads import Workers
from .optima import spread_optima
from .spot import Positioned, Spot, compute_density

NUM_TURNED = 4  # poses of a photo whose rotations are tried at a spot
ROUNDS_AT_SPOT = 2  # of a turn: the position follows the rotation
CELL_VOLUME = COARSE_SPACING**3  # [m^3] of a place of the scan
LOOSE_TURN = 1.0  # [rad] deviation of a rotation that others do not tell
OF_POSITION = slice(3, 6)  # in a step
LOCAL_TURN = np.diag([*np.diag(LOCAL_ERRORS)[:3], 0.0, 0.0, 0.0])  # errors (6, 6) of local optima at a spot


class Nearby(NamedTuple):
    """Where a photo may have been taken, by those that are sure."""

    spots: Sequence[Spot]
    num_near: int  # places of the scan within reach of them

    def share(self, pose: Pose) -> NearbyShares:
        """Return the prior probabilities of a pose's place."""
        densities = [compute_density(self.blur(spot, pose), pose.center_world) for spot in self.spots]
        return share_nearby([CELL_VOLUME * density for density in densities], self.num_near)

    def blur(self, spot: Spot, pose: Pose) -> Positioned:
        """Return where a photo is expected at a spot, with the errors of local optima."""
        center, covariance = spot.place(pose.R_cam_from_world)
        return Positioned(center, covariance + LOCAL_ERRORS[OF_POSITION, OF_POSITION])

    def find_likeliest(self, pose: Pose) -> Spot:
        """Return the spot at which a photo with a pose was taken likeliest."""
        return max(self.spots, key=lambda spot: compute_density(self.blur(spot, pose), pose.center_world))

    def is_turned(self, pose: Pose) -> bool:
        """Return True if a pose is exactly where a spot expects it."""
        places = [spot.place(pose.R_cam_from_world).center for spot in self.spots]
        return any(np.array_equal(place, pose.center_world) for place in places)

    def weigh(self, candidate: Candidate) -> Candidate:
        """Return a candidate with the odds of its place by the sure photos."""
        return replace(candidate, log_by_others=log_odds_nearby(self.share(candidate.pose), self.num_near))


def turn_at_spots(found: Found, nearby: Nearby, workers: Workers) -> Found:
    """Return the poses found for a photo, and what they become at a spot, chosen by where others are too."""
    problem = found.problem
    turned = [
        examine(problem, turn_at(problem, candidate.pose, spot))
        for candidate in found.selection.candidates[:NUM_TURNED]
        for spot in nearby.spots
    ]
    every = sort_by_score(list(map(nearby.weigh, (*found.selection.candidates, *turned))))
    standings = assess(problem.profile, Selection(every[0], tuple(every[1:])))
    order = np.argsort([-log_odds(standing, problem.method) for standing in standings], kind="stable")
    best, *others = suppress_near([every[k] for k in order], len(every), ONE_ANSWER)
    return found._replace(selection=choose(problem, Selection(best, tuple(others)), workers))


def move_to(spot: Spot, pose: Pose) -> Pose:
    """Return a pose with the same rotation at a spot."""
    return Pose(pose.R_cam_from_world, spot.place(pose.R_cam_from_world).center)


def turn_at(problem: Problem, pose: Pose, spot: Spot) -> Pose:
    """Return the pose at a spot whose rotation fits the photo best, near that of a pose."""
    for _ in range(ROUNDS_AT_SPOT):
        pose = turn(problem, move_to(spot, pose))
    return move_to(spot, pose)


class Placed(NamedTuple):
    """The pose of a photo near others, and the probability that it is exact enough if its place is right."""

    gaussian: PoseGaussian  # in the map
    within: float


def place_nearby(
    problem: Problem,
    best: Candidate,
    own: PoseGaussian | None,
    nearby: Nearby,
    odds: float,
    accuracy: Accuracy,
    workers: Workers,
) -> Placed | None:
    """Return the pose of a photo near others; None if nothing fixes it.

    `own` is the pose by the photo alone, and `odds` are those of its place. At a spot it is averaged with the
    position there. If the photo does not fix its position, or was turned there, the spot does.
    """
    shares = nearby.share(best.pose)
    if nearby.is_turned(best.pose):  # the covariance by the photo alone holds where it fits best
        own = None
    if own is not None:
        own = own.blur(spread_optima(problem, best, own, workers))
    expected = expect_at_spot(problem, best, nearby) if shares.at_spot > shares.elsewhere else None
    if expected is None:
        return None if own is None else place_elsewhere(own, odds, accuracy)
    gaussian = own and hold_position(nearby.find_likeliest(best.pose), own)
    gaussian = gaussian or expected
    errors = NearbyErrors(
        accuracy.probability(gaussian),
        accuracy.probability_at(gaussian.pose, expected.blur(LOCAL_TURN)),
        0.0 if own is None else accuracy.probability_at(gaussian.pose, own),
    )
    return Placed(gaussian, believe_exact(shares, errors, odds))


def place_elsewhere(own: PoseGaussian, odds: float, accuracy: Accuracy) -> Placed:
    """Return the pose of a photo near others that was not taken at one of their spots."""
    errors = NearbyErrors(0.0, 0.0, accuracy.probability(own))
    return Placed(own, believe_exact(NearbyShares(0.0, 1.0), errors, odds))


def expect_at_spot(problem: Problem, best: Candidate, nearby: Nearby) -> PoseGaussian | None:
    """Return the pose of a photo turned at the spot that is likeliest for it; None if nothing fixes it."""
    spot = nearby.find_likeliest(best.pose)
    turned = best if nearby.is_turned(best.pose) else examine(problem, turn_at(problem, best.pose, spot))
    return estimate_turn(problem, turned, spot.place(turned.pose.R_cam_from_world).covariance)


def hold_position(spot: Spot, own: PoseGaussian) -> PoseGaussian | None:
    """Return the mean of a photo's own pose and where a spot expects it; None if these contradict."""
    center, covariance = spot.place(own.pose.R_cam_from_world)
    errors = np.diag(np.repeat([LOOSE_TURN**2, 0.0], 3))
    errors[OF_POSITION, OF_POSITION] = covariance
    there = PoseGaussian(Pose(own.pose.R_cam_from_world, center), errors, np.zeros((6, 6)))
    return own.fuse(there) if own.square_distance(there) <= LIKELY else None
