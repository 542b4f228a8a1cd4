"""Changes of the belief in a photo by photos that help it."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..system.arrays import Array
from .belief import Belief, make_belief

LEAST_NONE = 1e-6
MISSED = 0.25  # chosen: share of photos without a right pose found (a sixth of BENCHMARK.md's phone photos)
# Chosen: the same, of photos that were turned to all sides at a spot. Of 26 photos of made and real rooms
# that were turned there, with a place of 0.9 or more, one was more than 5 degrees off.
MISSED_TURNED = 0.05
IS_NEARBY = 0.8  # chosen: probability that a photo of a group was taken within reach of the others
IS_AT_SPOT = 0.7  # chosen: probability that it was taken where somebody stands who took the others
LOCAL_ERRORS = np.diag(np.repeat([math.radians(2.0) ** 2, 0.15**2], 3))  # chosen: of local optima, [rad, m]


def local_share(odds: float, missed: float = MISSED) -> float:
    """Return the probability that a photo's own pose is a local optimum near the right one, by its odds."""
    return missed / (1.0 + odds)


class Shares(NamedTuple):
    """Probabilities that a photo belongs where others put it, and that its own pose is right there."""

    right: float  # it belongs there, and its own pose is right
    missed: float  # it belongs there, and its own pose is missing or a local optimum near the right one

    @property
    def here(self) -> float:
        """Probability that the photo belongs where the others put it."""
        return self.right + self.missed

    def weigh_own(self, likelihood_ratio: float) -> "Shares":
        """Return the shares after evidence about the own pose: of a right one against a local optimum."""
        right = self.right * likelihood_ratio
        here = self.here / (right + self.missed)
        return Shares(right * here, self.missed * here)


def believe_together(
    shares: Shares, bundles: Array, within_own: float, within_others: float, alone: Belief | None = None
) -> Belief:
    """Return the belief in a photo's poses in a bundle, of which the first is believed.

    `bundles` (K + 1,) are the probabilities of K poses of the bundle, and of none. The pose is exact enough
    with the probability `within_own` if the photo's own pose is right, else `within_others`, that of the pose
    expected by the others. `alone` is the belief in a photo that is sure by itself: that the other photos
    show nothing is no evidence against it.
    """
    place = shares.here * float(bundles[0])
    within = (shares.right * within_own + shares.missed * within_others) / shares.here
    if alone is not None and alone.place[0] * alone.within > place * within:
        place = alone.place[0]
        within = alone.within
    left = min(1.0, (1.0 - place) / max(1.0 - float(bundles[0]), LEAST_NONE))
    return make_belief([place, *(left * bundles[1:-1])], within)


class Prospect(NamedTuple):
    """Chances of a photo, before it is searched where others of its group were taken."""

    elsewhere: float  # odds of its places if it was not taken with them
    gain: float  # how many times larger the whole scan is than its part near the others
    trust: float  # probability of the place of the surest of those near it


def believe_nearby(near: Belief, prospect: Prospect) -> Belief:
    """Return the belief in a photo that was searched where others of its group were taken.

    `near` is the belief by the photo alone, as if the whole scan had been searched. A place that looks like
    that of the others deceives all of them, so the photo is not surer than they are.
    """
    odds = np.array(near.place[:-1]) / max(near.place[-1], LEAST_NONE)
    here = IS_NEARBY * prospect.gain * odds
    rest = 1.0 + (1.0 - IS_NEARBY) * prospect.elsewhere
    belief = make_belief(prospect.trust * here / (here.sum() + rest), near.within, near.doubt)
    return replace(belief, ruled_out=near.ruled_out)


def weigh_stray(near: float, far: float, num_near: int, num_far: int) -> tuple[float, float]:
    """Return the probabilities that a photo was taken at its places near others, and at its places far away.

    `near` are the odds of the former if it was taken near the others, `far` those of the latter if it was
    not. Before its evidence, it was as the other sure photos are, of which `num_near` are near each other and
    `num_far` elsewhere (Laplace's rule of succession).
    """
    of_far = (num_far + 1.0) / (num_near + num_far + 2.0)
    of_near = 1.0 - of_far
    total = of_near * (near + MISSED) + of_far * (far + 1.0)
    return of_near * near / total, of_far * far / total


class NearbyShares(NamedTuple):
    """Prior probabilities that a photo was taken in one place of the scan, by photos that are sure."""

    at_spot: float  # where somebody stands who took them
    elsewhere: float  # elsewhere within reach of them

    @property
    def of_spot(self) -> float:
        """Probability that a photo that was taken in this place was taken at the spot."""
        return self.at_spot / (self.at_spot + self.elsewhere)


def share_nearby(at_spots: Sequence[float], num_near: int) -> NearbyShares:
    """Return the prior probabilities of one of `num_near` places that are within reach.

    `at_spots` are the probabilities, at most 1, that a photo taken at each of the known spots is in this
    place.
    """
    of_spots = IS_AT_SPOT if at_spots else 0.0
    at_spot = of_spots * sum(min(one, 1.0) for one in at_spots) / max(len(at_spots), 1)
    return NearbyShares(at_spot, (IS_NEARBY - of_spots) / num_near)


def log_odds_nearby(shares: NearbyShares, num_near: int) -> float:
    """Return the logarithm of a place's odds by the spots, against that of any of the places within reach."""
    return math.log((shares.at_spot + shares.elsewhere) * num_near / IS_NEARBY)


class NearbyErrors(NamedTuple):
    """Probabilities that a photo's pose near others is exact enough, by what it rests on."""

    at_spot: float  # it was taken at the spot, and its own pose is right
    missed: float  # it was taken at the spot, and its own pose is a local optimum there
    alone: float  # it was taken elsewhere
    likelihood_ratio: float = 1.0  # of a right pose against a local optimum, by its distance from the spot


def believe_exact(shares: NearbyShares, errors: NearbyErrors, local: float) -> float:
    """Return the probability that a photo's pose near others is exact enough.

    The others give the place, but do not exclude local optima there, of which the pose is one with the
    probability `local`: without evidence of its own, no photo is exact. At a known spot they tell the
    position of a local optimum too.
    """
    own = Shares(1.0 - local, local)
    at_spot = own.weigh_own(errors.likelihood_ratio)
    here = at_spot.right * errors.at_spot + at_spot.missed * errors.missed
    return shares.of_spot * here + (1.0 - shares.of_spot) * own.right * errors.alone


def believe_beside(alone: Belief, confidences: Sequence[float], within: float | None) -> Belief:
    """Return the belief in a photo beside others, which is no surer than the surest of them.

    `within` belongs to the mean of its own pose and the pose by the others; None if there is no mean.
    """
    belief = alone.scale(max(confidences))
    return belief if within is None else replace(belief, within=within)


def share_place(best: Belief, confidences: Sequence[float]) -> tuple[float, list[float]]:
    """Divide the place of the best of several results among them, in proportion to their confidences.

    The results are at different places. Returns the factor by which the best result's own places are
    multiplied, and the probabilities of the others' places.
    """
    shares = np.array(confidences) / sum(confidences)
    return float(shares[0]), (best.place[0] * shares[1:]).tolist()
