"""Photos of one camera, each found by itself, before they are put together."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from ..judge.candidate import Candidate
from ..judge.consensus import MOST_CONFLICT, Consensus
from ..judge.probability import LOCALIZED
from ..judge.result import Result, nothing_found
from ..localization.judging import Found, judge
from ..localization.localize import (
    explain_nothing,
    find,
    find_by_edges,
    list_guessed,
    prepare_search,
)
from ..localization.means import Means
from ..panorama import Panorama
from ..problem.settings import CoarseToFineSettings
from ..scan_map.scan_map import ScanMap


@dataclass(frozen=True)
class Member:
    """A photo that was found by itself."""

    found: Found  # without what takes memory
    alone: Result

    @property
    def is_misplaced(self) -> bool:
        """True if its focal length contradicts that of the other photos, as at a wrong place."""
        prior = self.found.problem.given.focal_prior
        fit = self.found.fit
        has_conflict = fit is not None and fit.conflict > MOST_CONFLICT
        return has_conflict and prior is not None and prior.is_measured

    @property
    def own_poses(self) -> list[tuple[Candidate, float]]:
        """Poses in the map with the probabilities of their places, best first; none if ruled out."""
        if self.alone.best_pose is None or self.alone.belief.ruled_out:
            return []
        places = self.alone.belief.sound_places[:-1].tolist()
        return list(zip(self.found.selection.candidates, places, strict=False))


def find_members(
    scan_map: ScanMap, panoramas: Sequence[Panorama], settings: CoarseToFineSettings, means: Means
) -> tuple[list[Result], dict[int, Member]]:
    """Find each of several photos by itself.

    Those that are not sure are found again with the focal length that those that are sure tell. Returns the
    result of each photo alone, and those that were searched by their numbers.
    """
    alone: list[Result] = [nothing_found() for _ in panoramas]
    members: dict[int, Member] = {}

    def find_each(photos: Iterable[tuple[int, Panorama]]) -> None:
        for k, panorama in photos:
            member = find_alone(scan_map, panorama, settings, means)
            if member is None:
                alone[k] = explain_nothing(scan_map, panorama, settings.prior)
            else:
                alone[k] = member.alone
                members[k] = member

    find_each(enumerate(panoramas))
    find_each(expect_focal(panoramas, alone).items())
    return alone, members


def find_alone(
    scan_map: ScanMap, panorama: Panorama, settings: CoarseToFineSettings, means: Means
) -> Member | None:
    """Find a photo by itself, with the best of several guessed focal lengths; None if nothing is searched."""
    found: list[Member] = []
    for photo in list_guessed(panorama):
        problem = prepare_search(scan_map, photo, settings, means.watch)
        if problem is None:
            return None
        search = find_by_edges if problem.profile.follows_walls else find
        ended = search(problem, scan_map, means)
        judged = judge(ended, means, settings.min_confidence, may_promote=False)
        found.append(Member(ended.forget(), judged))
        if judged.status == LOCALIZED:
            break
    return max(found, key=lambda member: member.alone.confidence)


def expect_focal(panoramas: Sequence[Panorama], alone: Sequence[Result]) -> dict[int, Panorama]:
    """Return the photos that are not sure, by number, with the focal length that those that are sure tell.

    The photos are of one camera: what was given and what these say are averaged.
    """
    opinions = [one.focal_length.opinion for one in alone if one.status == LOCALIZED and one.focal_length]
    told = Consensus(opinions).opinion(least=1)
    if told is None:
        return {}
    expected: dict[int, Panorama] = {}
    for k, (panorama, one) in enumerate(zip(panoramas, alone, strict=True)):
        prior = panorama.focal_prior
        if one.status != LOCALIZED and prior is not None:
            share = told.share_of_given(prior.deviation)
            focal_px = prior.focal * math.exp((1.0 - share) * told.off)
            expected[k] = panorama.expect_focal(focal_px, prior.deviation * math.sqrt(share))
    return expected
