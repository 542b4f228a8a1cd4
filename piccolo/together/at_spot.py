"""Poses of a photo at a spot where others were taken: averaged with the spot, or turned there until they fit.

A photo that fixes its own position is averaged with the spot, unless both contradict each other: then it was
taken elsewhere. One of a bare wall fixes no position. It has that of the spot, if it fits there as well as
where it fits best.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ..evidence.covariance import estimate_pose_errors
from ..evidence.examine import choose, examine, examine_each
from ..evidence.loose_covariance import estimate_loosely
from ..geometry.nearness import DESCENDED, ONE_ANSWER
from ..geometry.pose import Pose
from ..geometry.pose_gaussian import LIKELY, PoseGaussian
from ..judge.alternatives import best_distinct, sort_by_score, suppress_near
from ..judge.by_others import LOCAL_ERRORS, NearbyErrors, NearbyShares, log_odds_nearby, share_nearby
from ..judge.candidate import Candidate, Selection
from ..judge.probability import log_odds
from ..judge.selection import assess, explains_more
from ..localization.judging import Found
from ..localization.ladder import refine
from ..localization.means import Means
from ..localization.search import list_rotations
from ..localization.turning import turn, turn_roughly
from ..problem.accuracy import Accuracy
from ..problem.problem import Problem
from ..problem.stages import FULL
from ..scan_map.camera_positions import COARSE_SPACING
from ..system.arrays import Array
from ..system.jobs.threads import Workers
from .bundle import EVEN_ODDS, compare_errors
from .optima import spread_optima
from .relation import spread_over
from .spot import LEAST_AT_SPOT, Positioned, Spot, compute_density, fit_spot, gather

NUM_SEARCHED = 12  # rotations at a spot, the best of all, that are turned to where the photo fits best
NUM_HELD = 4  # poses of a photo that are held at a spot
LEAST_HELD = 0.7  # chosen: their score, divided by the best one's
FITS_THERE = 0.9  # chosen: score of a pose that was turned at a spot, divided by that of where it fits best
MOST_MOVED = 0.1  # chosen: [m] that a mean moves a pose, over which its covariance holds; else it is turned
ROUNDS_AT_SPOT = 2  # of a turn: the position follows the rotation
CELL_VOLUME = COARSE_SPACING**3  # [m^3] of a place of the scan
LOOSE_TURN = 1.0  # [rad] deviation of a rotation that others do not tell
OF_TURN = slice(0, 3)  # of a step
OF_MOVE = slice(3, 6)
LOCAL_MOVES = LOCAL_ERRORS[OF_MOVE, OF_MOVE]  # (3, 3) [m^2]
NOTHING_COMMON = np.zeros((6, 6))


class Held(NamedTuple):
    """A pose of a photo near others, and what it rests on."""

    candidate: Candidate  # with the odds of its place by the others
    gaussian: PoseGaussian | None  # in the map; None where nothing fixes the pose
    alone: PoseGaussian | None  # by the photo alone; None where it fixes nothing
    shares: NearbyShares  # of its place
    exact: NearbyErrors
    std_of_fit: float | None  # by the photo alone: as `Errors` has it
    is_turned: bool = False  # the photo was turned at the spot: where it is follows from the others

    def moves_by(self, pose: Pose) -> float:
        """Return how far it is from a pose [m]; infinitely far if nothing fixes it."""
        return math.inf if self.gaussian is None else self.gaussian.pose.distance(pose)


@dataclass(frozen=True)
class Nearby:
    """Spots of sure photos, and their surroundings, in which another photo was probably taken."""

    spots: Sequence[Spot]
    num_near: int  # places of the scan within reach of them
    accuracy: Accuracy

    def find_likeliest(self, pose: Pose) -> Spot | None:
        """Return the spot at which a photo with a pose was taken likeliest; None if no spot is known."""

        def compute(spot: Spot) -> float:
            return compute_density(blur_spot(spot, pose, LOCAL_MOVES), pose.center_world)

        return max(self.spots, key=compute, default=None)

    def weigh(self, candidate: Candidate, shares: NearbyShares) -> Candidate:
        """Return a candidate with the odds of its place."""
        return replace(candidate, log_by_others=log_odds_nearby(shares, self.num_near))

    def take_elsewhere(
        self, candidate: Candidate, alone: PoseGaussian | None = None, std_of_fit: float | None = None
    ) -> Held:
        """Return a pose that is not at a spot."""
        shares = share_nearby([0.0] * len(self.spots), self.num_near)
        within = 0.0 if alone is None else self.accuracy.probability(alone)
        exact = NearbyErrors(0.0, 0.0, within)
        return Held(self.weigh(candidate, shares), alone, alone, shares, exact, std_of_fit)

    def hold(
        self, candidate: Candidate, alone: PoseGaussian, spot: Spot, std_of_fit: float | None
    ) -> Held | None:
        """Return the mean of a pose by the photo alone and of a spot; None if both contradict each other."""
        there = expect_at_spot(alone.pose.R_cam_from_world, spot)
        fused = average_with_spot(alone, there)
        if fused is None:
            return None
        shares = self.share(alone.pose, alone.covariance[OF_MOVE, OF_MOVE])
        missed = there.own.copy()
        missed[OF_TURN, OF_TURN] = alone.covariance[OF_TURN, OF_TURN] + LOCAL_ERRORS[OF_TURN, OF_TURN]
        exact = NearbyErrors(
            self.accuracy.probability(fused),
            self.accuracy.probability_at(fused.pose, replace(there, own=missed)),
            self.accuracy.probability_at(fused.pose, alone),
            compare_errors(there, alone),
        )
        return Held(self.weigh(candidate, shares), fused, alone, shares, exact, std_of_fit)

    def share(self, pose: Pose, errors: Array) -> NearbyShares:
        """Return the prior probabilities of the place of a pose whose position has errors (3, 3) [m^2]."""
        densities = [compute_density(blur_spot(spot, pose, errors), pose.center_world) for spot in self.spots]
        return share_nearby([CELL_VOLUME * density for density in densities], self.num_near)


def blur_spot(spot: Spot, pose: Pose, errors: Array) -> Positioned:
    """Return where a photo with the rotation of a pose is expected at a spot, with further errors (3, 3)."""
    center, covariance = spot.place(pose.R_cam_from_world)
    return Positioned(center, covariance + errors)


def expect_at_spot(R_cam_from_map: Array, spot: Spot) -> PoseGaussian:
    """Return the pose that is expected of a photo with a rotation (3, 3) at a spot; its rotation is open."""
    center, covariance = spot.place(R_cam_from_map)
    errors = LOOSE_TURN**2 * np.eye(6)
    errors[OF_MOVE, OF_MOVE] = covariance
    return PoseGaussian(Pose(R_cam_from_map, center), errors, NOTHING_COMMON)


def average_with_spot(alone: PoseGaussian, there: PoseGaussian) -> PoseGaussian | None:
    """Return the mean of a pose by a photo alone and of where it is expected; None if both contradict."""
    return None if alone.square_distance(there) > LIKELY else alone.fuse(there)


def average_each(located: Sequence[PoseGaussian]) -> list[PoseGaussian]:
    """Return poses in the map of sure photos, each averaged with the spot of the others, if it is at one."""
    averaged = list(located)
    for group in gather([one.pose for one in located]):
        for k in group if len(group) > LEAST_AT_SPOT else []:
            spot = fit_spot([located[n] for n in group if n != k])
            there = expect_at_spot(located[k].pose.R_cam_from_world, spot)
            averaged[k] = average_with_spot(located[k], there) or located[k]
    return averaged


def turn_at(problem: Problem, pose: Pose, spot: Spot) -> Pose:
    """Return the pose at a spot whose rotation fits the photo best, near that of a pose."""
    turned = pose
    for _ in range(ROUNDS_AT_SPOT):
        turned = turn(problem, spot.attract(turned.R_cam_from_world, pose.center_world))
    return spot.attract(turned.R_cam_from_world, pose.center_world)


def hold_at_spots(found: Found, nearby: Nearby, means: Means) -> tuple[Found, Held]:
    """Return the poses found for a photo, chosen by where others were taken too, and the best of them."""
    problem = found.problem
    workers = means.workers
    candidates = found.selection.candidates
    least = LEAST_HELD * found.selection.best.score
    asked = [one for one in candidates[:NUM_HELD] if one.score >= least]
    every = [hold_best(found, one, nearby, workers) for one in asked]
    loose = [one for one, held in zip(asked, every, strict=True) if held.shares.of_spot <= EVEN_ODDS]
    every += [nearby.take_elsewhere(one) for one in candidates if not any(one is other for other in asked)]
    for spot in nearby.spots:
        own = [one for one in loose if nearby.find_likeliest(one.pose) is spot]
        every += turn_each(found, own, spot, nearby, len(loose) == len(asked), means)
    standings = assess(problem.profile, Selection(every[0].candidate, tuple(h.candidate for h in every[1:])))
    order = np.argsort([-log_odds(standing, problem.method) for standing in standings], kind="stable")
    best, *others = suppress_near([every[k].candidate for k in order], len(every), ONE_ANSWER)
    chosen = choose(problem, Selection(best, tuple(others)), workers)
    held = next(one for one in every if one.candidate.pose is chosen.best.pose)
    return found._replace(selection=chosen), held._replace(candidate=chosen.best)


def hold_best(found: Found, candidate: Candidate, nearby: Nearby, workers: Workers) -> Held:
    """Return a pose averaged with the likeliest spot, or as taken elsewhere if the spot would move it far."""
    problem = found.problem
    errors = estimate_pose_errors(problem, candidate, workers)
    errors = errors.widen(found.fit.pose_covariance) if found.fit else errors
    alone = errors.gaussian
    if alone is not None:
        alone = alone.blur(spread_optima(problem, candidate, alone, workers))
    elsewhere = nearby.take_elsewhere(candidate, alone, errors.std_of_fit)
    spot = nearby.find_likeliest(candidate.pose)
    if spot is None or alone is None:
        return elsewhere
    averaged = nearby.hold(candidate, alone, spot, errors.std_of_fit)
    return averaged if averaged and averaged.moves_by(alone.pose) <= MOST_MOVED else elsewhere


def turn_each(
    found: Found, own: Sequence[Candidate], spot: Spot, nearby: Nearby, is_searched: bool, means: Means
) -> list[Held]:
    """Return poses of a photo at a spot: its own ones turned there, and by a search of all rotations.

    Of these, only those are returned that fit about as well there as where they were found.
    """
    problem = found.problem
    searched = search_rotations(problem, spot, means) if is_searched else []
    turned = examine_each(problem, [turn_at(problem, one.pose, spot) for one in own], means.workers)
    begins = [*zip(turned, own, strict=True), *((one, found.selection.best) for one in searched[:NUM_HELD])]
    rotations = [*turned, *searched]
    held = [
        hold_turned(problem, begin, rotations, spot, nearby, FITS_THERE * fit.score, means.workers)
        for begin, fit in begins
    ]
    return [one for one in held if one is not None]


def hold_turned(
    problem: Problem,
    begin: Candidate,
    rotations: Sequence[Candidate],
    spot: Spot,
    nearby: Nearby,
    least_score: float,
    workers: Workers,
) -> Held | None:
    """Return the pose of a photo that does not fix it, near a start; None if it does not fit at the spot.

    Other `rotations` there that fit about as well are errors of this one. That it is near the spot, where it
    began, is no evidence against a local optimum.
    """
    refined = examine(problem, refine(problem, begin.pose, workers, FULL).pose)
    if refined.score < least_score:
        return None
    alone = estimate_loosely(problem, refined)
    if alone is None:
        return None
    alone = alone.blur(spread_rotations(problem, refined.pose, begin, rotations))
    held = nearby.hold(refined, alone, spot, None)
    return held and held._replace(is_turned=True, exact=held.exact._replace(likelihood_ratio=1.0))


def spread_rotations(problem: Problem, pose: Pose, begin: Candidate, rotations: Sequence[Candidate]) -> Array:
    """Return the errors (6, 6) of a pose at a spot by other rotations there, weighted by their odds.

    These are compared with the rotation from which the pose was reached: none of them was refined further.
    """
    near = [one for one in rotations if one is not begin and ONE_ANSWER.holds(one.pose, begin.pose)]
    standings = assess(problem.profile, Selection(begin, tuple(near)))
    odds = np.array([log_odds(standing, problem.method) for standing in standings])
    return spread_over([pose, *(one.pose for one in near)], pose, np.exp(odds - odds.max()))


def search_rotations(problem: Problem, spot: Spot, means: Means) -> list[Candidate]:
    """Search all rotations of a photo at a spot; return the best poses there, best first."""
    workers = means.workers
    tilts = "known" if problem.photo.has_tilt else problem.profile.default_tilt
    rotations = list_rotations(problem, tilts, means.effort)
    starts = [Pose(R, spot.place(R).center) for R in rotations]
    roughly = workers.map(partial(turn_roughly, problem), starts, "descend")
    best = best_distinct(roughly, NUM_SEARCHED, DESCENDED)
    turned = workers.map(lambda one: turn_at(problem, one.pose, spot), best, "descend")
    return sort_by_score(examine_each(problem, turned, workers))


def fits_mirrored(found: Found, held: Held, nearby: Nearby, means: Means) -> bool:
    """Return True if a photo with no matches explains more at a spot when it is mirrored, left for right."""
    method = found.problem.method
    if (held.candidate.num_matches or 0) > method.chance_matches:
        return False
    mirrored = found.problem.mirror()
    best = [one for spot in nearby.spots for one in search_rotations(mirrored, spot, means)[:1]]
    return any(explains_more(method, one, held.candidate) for one in best)
