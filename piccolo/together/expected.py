"""Positions and rotations of the photos of a group, by their own poses and by the matches between them."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ..geometry.pose_gaussian import LIKELY, PoseGaussian
from ..judge.by_others import LOCAL_ERRORS, MISSED
from ..local_features.hypotheses import count_inliers
from .bundle import weigh_local
from .bundle_search import Support
from .links import FIRM, WEAK, Links, Places, find_pose

MOST_SOURCES = 3  # photos by whose errors a photo is placed
MOST_STD_OF_SOURCE = 0.1  # chosen: [m] deviation of the own pose of a photo by which others are placed
NUM_LOCATED = 2  # rounds that distinguish local optima from right poses
UNCERTAIN = np.zeros((6, 6))


class Expected(NamedTuple):
    """The pose of a photo by its matches with others."""

    gaussian: PoseGaussian
    num_matches: int  # that agree with it

    @property
    def local_share(self) -> float:
        """Probability that it is a local optimum, as few matches of a wall have."""
        return MISSED * min(FIRM.least / self.num_matches, 1.0)

    def temper(self, own: PoseGaussian | None, local_share: float) -> PoseGaussian:
        """Return the expected pose with the errors of local optima, as far as it may be one.

        It is one if the photo's own pose contradicts it and is surer: `local_share` is the probability that
        the own pose is a local optimum.
        """
        if own is None:
            return self.gaussian.blur(self.local_share * LOCAL_ERRORS)
        is_doubted = local_share < self.local_share and own.square_distance(self.gaussian) > LIKELY
        return self.gaussian.blur(LOCAL_ERRORS) if is_doubted else self.gaussian


def locate_all(
    links: Links, places: Places, supports: Mapping[int, Support]
) -> tuple[dict[int, PoseGaussian], dict[int, PoseGaussian]]:
    """Return the photos' own poses that agree with a place of a group, and where others expect each photo.

    Own poses get the errors of local optima too, in proportion to the probability that they are such. Poses
    and probabilities are computed in turn, as in a bundle.
    """
    found = {
        number: support.gaussian
        for number, support in supports.items()
        if support.shares.argmax() == 0 and support.gaussian is not None
    }
    local_shares = {number: supports[number].local_share for number in found}
    shares = local_shares
    for _ in range(NUM_LOCATED):
        own = {number: one.blur(shares[number] * LOCAL_ERRORS) for number, one in found.items()}
        expected = {
            k: one.temper(found.get(k), local_shares.get(k, 1.0))
            for k, one in expect_all(links, places, own).items()
        }
        shares = {k: weigh_local(local_shares[k], expected.get(k), one) for k, one in found.items()}
    return own, expected


def expect_all(links: Links, places: Places, own: Mapping[int, PoseGaussian]) -> dict[int, Expected]:
    """Return where the others expect each photo.

    The pose of each of the others is its own, or, if that is uncertain as of a bare wall, the one expected.
    """
    known = {number: one for number, one in own.items() if one.largest_std < MOST_STD_OF_SOURCE}
    located = {number: links.place(number, one.pose) for number, one in known.items()}
    expected: dict[int, Expected] = {}
    for number in [*known, *(k for k in places if k not in known)]:
        rest = {k: gaussian for k, gaussian in known.items() if k != number}
        found = expect_by_matches(links, number, {k: located[k] for k in rest}, rest)
        if found is not None:
            expected[number] = found
            if number not in known:
                known[number] = found.gaussian
                located[number] = links.place(number, found.gaussian.pose)
    return expected


def expect_by_matches(
    links: Links, number: int, located: Places, known: Mapping[int, PoseGaussian]
) -> Expected | None:
    """Return the pose of a photo by its matches with others; None if too few agree.

    Its errors are those of the matches and of the poses of the photos that determine it most; if few matches
    agree, also those of local optima.
    """
    parts = links.match(number, located)
    if not parts:
        return None
    found = find_pose(parts.values(), [known[k].pose for k in parts], WEAK, links.workers)
    if found is None:
        return None
    counts = {k: count_inliers(matches, found.pose) for k, matches in parts.items()}
    telling = {k: counts[k] / known[k].largest_std ** 2 for k in parts}
    sources = sorted(telling, key=lambda k: -telling[k])[:MOST_SOURCES]
    shares = np.array([telling[k] for k in sources]) / sum(telling[k] for k in sources)
    attached = [known[k].attach(found.pose @ known[k].pose.inverse(), UNCERTAIN) for k in sources]
    num_matches = sum(counts.values())
    of_chance = LOCAL_ERRORS if num_matches < FIRM.least else UNCERTAIN
    own = sum((share**2 * one.own for share, one in zip(shares, attached, strict=True)), of_chance)
    common = sum((share * one.common for share, one in zip(shares, attached, strict=True)), UNCERTAIN)
    return Expected(PoseGaussian(found.pose, own + found.covariance, common), num_matches)
