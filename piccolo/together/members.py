"""Photos of one camera, each found by itself, before they are put together."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ..geometry.nearness import ONE_IN_BUNDLE
from ..geometry.pose import Pose
from ..judge.candidate import Candidate
from ..judge.consensus import LEAST_AGREEING_PHOTOS, MOST_CONFLICT, Consensus
from ..judge.probability import LOCALIZED
from ..judge.reasons import Reason
from ..judge.result import Result, nothing_found
from ..localization.judging import Found, judge
from ..localization.means import NO_TRACE, Means, Trace
from ..localization.run import (
    explain_nothing,
    find,
    find_by_edges,
    list_guessed,
    prepare_search,
    refine_known,
)
from ..photo.panorama import Panorama
from ..problem.settings import CoarseToFineSettings
from ..scan_map.scan_map import ScanMap
from ..system.jobs.memory import check_memory
from ..system.jobs.threads import Stopwatch, Workers


@dataclass(frozen=True)
class Member:
    """A photo that was found by itself."""

    found: Found  # without images and matches, which take memory
    alone: Result

    @property
    def is_misplaced(self) -> bool:
        """True if its focal length contradicts that of the other photos, as if its place is wrong."""
        prior = self.found.problem.given.focal_prior
        fit = self.found.fit
        has_conflict = fit is not None and fit.conflict > MOST_CONFLICT
        return has_conflict and prior is not None and prior.is_measured

    def has_focal(self, panorama: Panorama) -> bool:
        """Return True if it was found with about the focal length of a panorama."""
        used = self.found.problem.given.cameras[0].camera.focal[0]
        return abs(math.log(panorama.cameras[0].camera.focal[0] / used)) < ABOUT_SAME_FOCAL

    def is_best(self, pose: Pose) -> bool:
        """Return True if a pose is at the place of the best that was found alone."""
        return ONE_IN_BUNDLE.holds(pose, self.found.selection.best.pose)

    @property
    def own_poses(self) -> list[tuple[Candidate, float]]:
        """Poses in the map with the probabilities of their places, best first; none if ruled out."""
        if self.alone.best_pose is None or self.alone.belief.ruled_out:
            return []
        places = self.alone.belief.sound_places[:-1].tolist()
        return list(zip(self.found.selection.candidates, places, strict=False))


class Grouped(NamedTuple):
    """The result of a photo, and the photos with which it was localized together."""

    result: Result
    others: tuple[int, ...]  # numbers of these photos; empty if it was localized alone


ABOUT_SAME_FOCAL = 0.05  # chosen: difference of logarithms; a search finds the same poses with both
MEMORY_OF_PHOTO = 4e7  # [byte] that a photo keeps while others are localized; 23e6 of 1024 x 768 px measured


def check_photos(number: int) -> None:
    """Refuse to localize more photos together than the free memory holds."""
    check_memory(number * MEMORY_OF_PHOTO, f"{number} photos together", "localize fewer together")


class Shot(NamedTuple):
    """A photo to be found."""

    panorama: Panorama
    settings: CoarseToFineSettings
    trace: Trace = NO_TRACE
    is_confirmed: bool = False  # enough sure photos of the same camera agree with what is given of it

    @property
    def camera(self) -> tuple[object, ...]:
        """All that was given of its camera; photos for which it is the same were taken by one camera."""
        prior = self.panorama.focal_prior
        if prior is None:
            return ()
        camera = self.panorama.cameras[0].camera
        return camera.width, camera.height, prior.source, prior.focal


def find_members(
    scan_map: ScanMap, shots: Sequence[Shot], workers: Workers, watch: Stopwatch
) -> tuple[list[Result], dict[int, Member], list[Shot]]:
    """Find each of several photos by itself.

    Photos that are not sure are found again with the focal length that sure photos of the same camera have;
    if these are enough, no single photo contradicts what is given of the camera. Returns the result of
    each photo alone, the photos that could be searched by their numbers, and all photos as they were searched
    last.
    """
    alone = [nothing_found() for _ in shots]
    members: dict[int, Member] = {}
    asked = list(shots)

    def find_each(numbered: Iterable[tuple[int, Shot]]) -> None:
        for k, shot in numbered:
            asked[k] = shot
            member = find_alone(scan_map, shot, workers, watch, members.get(k))
            if member is None:
                alone[k] = explain_nothing(scan_map, shot.panorama, shot.settings.prior)
            else:
                alone[k] = member.alone
                members[k] = member

    find_each(enumerate(shots))
    for camera in dict.fromkeys(shot.camera for shot in shots):
        numbers = [k for k, shot in enumerate(shots) if shot.camera == camera]
        expected = expect_focal([shots[k].panorama for k in numbers], [alone[k] for k in numbers])
        find_each((numbers[n], shots[numbers[n]]._replace(panorama=one)) for n, one in expected.items())
        if sum(alone[k].status == LOCALIZED for k in numbers) >= LEAST_AGREEING_PHOTOS:
            for k in numbers:
                asked[k] = asked[k]._replace(is_confirmed=True)
            for k in (k for k in numbers if Reason.CALIBRATION in alone[k].belief.ruled_out):
                members[k] = confirm_camera(
                    members[k], asked[k], Means(asked[k].settings.effort, workers, watch)
                )
                alone[k] = members[k].alone
    return alone, members, asked


def confirm_camera(member: Member, shot: Shot, means: Means) -> Member:
    """Return a photo judged again, as the camera is as given by others."""
    found = member.found.confirm()
    judged = judge(found, means._replace(trace=shot.trace), shot.settings.demand, may_promote=False)
    return Member(found.forget(), judged)


def find_alone(
    scan_map: ScanMap, shot: Shot, workers: Workers, watch: Stopwatch, before: Member | None = None
) -> Member | None:
    """Find a photo by itself, with the best of several guessed focal lengths; None if nothing is searched.

    If it was found `before` with about the same focal length, its poses are refined with this one.
    """
    settings = shot.settings
    means = Means(settings.effort, workers, watch, shot.trace)
    found: list[Member] = []
    for photo in list_guessed(shot.panorama):
        problem = prepare_search(scan_map, photo, settings, watch)
        if problem is None:
            return None
        if before is not None and before.has_focal(photo):
            known = [one.pose for one in before.found.selection.candidates]
            with watch.stage("refine"):
                ended = refine_known(problem, known, means)
        else:
            search = find_by_edges if problem.profile.follows_walls else find
            ended = search(problem, scan_map, means)
        judged = judge(ended, means, settings.demand, may_promote=False)
        found.append(Member(ended.forget(), judged))
        if judged.status == LOCALIZED:
            break
    return max(found, key=lambda member: member.alone.confidence)


def expect_focal(panoramas: Sequence[Panorama], alone: Sequence[Result]) -> dict[int, Panorama]:
    """Return the photos that are not sure, by number, with the focal length by those that are.

    The photos are of one camera; the given focal length and the estimates of the sure photos are averaged. A
    photo that fits better mirrored is left out: another focal length does not turn it over.
    """
    opinions = [one.focal_length.opinion for one in alone if one.status == LOCALIZED and one.focal_length]
    by_sure = Consensus(opinions).opinion(least=1)
    if by_sure is None:
        return {}
    expected: dict[int, Panorama] = {}
    for k, (panorama, one) in enumerate(zip(panoramas, alone, strict=True)):
        prior = panorama.focal_prior
        is_open = one.status != LOCALIZED and Reason.MIRRORED not in one.belief.ruled_out
        if is_open and prior is not None:
            share = by_sure.share_of_given(prior.deviation)
            focal_px = prior.focal * math.exp((1.0 - share) * by_sure.off)
            expected[k] = panorama.expect_focal(focal_px, prior.deviation * math.sqrt(share))
    return expected
