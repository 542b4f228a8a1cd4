"""Second looks at photos: with the focal length by others, beside sure ones, or together."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Protocol

from ..geometry.nearness import CONFIRMED
from ..judge.result import Result
from ..judge.result_parts import Beside, FocalLength
from ..localization.place_names import add_places
from ..localization.run import has_guessed_focal
from ..photo.panorama import Panorama
from ..photo.panorama.facts import PhotoFacts
from ..photo.photo import Photo
from ..problem.problem import prepare_problem
from ..problem.settings import CoarseToFineSettings
from ..scan_map.scan_map import ScanMap
from ..system.errors import InputError, is_passing
from ..system.jobs.threads import Stopwatch, Workers
from ..together.among import Known, localize_among
from ..together.beside import SurePhoto, localize_beside, place_sure
from ..together.second_looks import MOST_PICTURES, Look, follow, is_doubtful, names_of
from .photo_reader import PhotoReader
from .scan_photo import Asked


@dataclass(frozen=True)
class Looking:
    """A scan that is prepared for the default method, with what second looks need."""

    scan_map: ScanMap
    reader: PhotoReader
    workers: Workers

    def place(self, photo: Photo, result: Result, settings: CoarseToFineSettings) -> SurePhoto | None:
        """Return the keypoints of a localized photo; None if its file has changed, or is gone, since then."""
        taken = self.take_again(photo.with_refined_camera(result.cameras), result, Stopwatch())
        if taken is None or result.best_pose is None:
            return None
        problem = prepare_problem(taken[0], self.scan_map, settings.prior, settings.gravity, settings.method)
        return place_sure(problem, result.best_pose, result.covariance, result.confidence, self.workers)

    def take_again(
        self, photo: Photo, known: Result, watch: Stopwatch, focal: FocalLength | None = None
    ) -> tuple[Panorama, PhotoFacts] | None:
        """Read a photo again that has a result; None if its file has changed, or is gone, since then."""
        try:
            taken = self.reader.take(photo, watch, focal)
        except (OSError, InputError) as error:
            if is_passing(error):
                raise
            return None
        return taken if taken[1].sha256 == known.source.pano_sha256 else None

    def localize_series(self, asked: Sequence[Asked], known: Sequence[Result]) -> dict[Result, Result]:
        """Localize the photos of a series that are not sure together with the others.

        `known` are the results so far. Return the new results of photos that were found by others, by their
        results so far.
        """
        watch = Stopwatch()
        blanks: dict[Result, Result] = {}

        def take(photo: Photo, result: Result, settings: CoarseToFineSettings) -> Panorama | None:
            is_unsure = is_doubtful(result)
            by_camera = photo if is_unsure else photo.with_refined_camera(result.cameras)
            taken = self.take_again(by_camera, result, watch, result.focal_length if is_unsure else None)
            if taken is None:
                return None
            blanks[result] = self.reader.make_blank(photo, *taken, settings, {})
            return taken[0]

        photos = [
            Known(partial(take, photo, result, settings), settings, result, is_doubtful(result))
            for (photo, settings), result in zip(asked, known, strict=True)
            if isinstance(settings, CoarseToFineSettings)
        ]
        found = localize_among(self.scan_map, photos, self.workers, watch)
        seconds = {stage: spent / len(asked) for stage, spent in watch.seconds.items()}
        results = {}
        for k, (result, others) in found.items():
            before = photos[k].result
            blank = replace(blanks[before], seconds=seconds)
            placed = follow(before, add_places(self.scan_map, result).complete(blank))
            names = tuple(photos[other].result.pano for other in others)
            results[before] = replace(placed, beside=Beside(names, ""))
        return results

    def look(self, asked: Asked, first: Result, look: Look, others: "Others") -> Result:
        """Return the result of a look at a photo; `first` is its result without the others beside it."""
        if look.series:
            return take_surer(first, others.localize_series(look.series).get(first), look.asked_sha256)
        if look.beside:
            return self.look_beside(asked, first, look, others)
        # `first` is by the others' focal length already; or no photo that it was found beside is still sure
        return replace(first, beside=None)

    def look_beside(self, asked: Asked, first: Result, look: Look, others: "Others") -> Result:
        """Return the result of a photo beside photos that are sure, with the digest of these photos."""

        def list_pictures() -> dict[str, SurePhoto]:
            found = ((result.pano, others.place(result)) for result in look.beside)
            return {name: picture for name, picture in found if picture}

        assert isinstance(asked.settings, CoarseToFineSettings)
        found, names = self.localize_again(asked.photo, first, list_pictures, asked.settings)
        return replace(found, beside=Beside(names, look.asked_sha256))

    def localize_again(
        self,
        photo: Photo,
        first: Result,
        list_pictures: Callable[[], Mapping[str, SurePhoto]],
        settings: CoarseToFineSettings,
    ) -> tuple[Result, tuple[str, ...]]:
        """Localize a photo that is not sure by its matches with photos that are; return also their names.

        `list_pictures` returns the sure photos by name. The result is `first` if none of them shows the same,
        if the new result is neither surer nor elsewhere, and for a photo whose focal length is a guess.
        """
        watch = Stopwatch(dict(first.seconds))
        picture, facts = self.reader.take(photo, watch, first.focal_length)
        is_another = facts.sha256 != first.source.pano_sha256
        if has_guessed_focal(picture) or self.scan_map.has_shape or is_another:
            return first, ()
        candidates = [pose for pose in (first.best_pose, *(a.pose for a in first.alternatives)) if pose]
        poses = [self.scan_map.from_world(pose) for pose in candidates]
        with watch.stage("read"):
            pictures = list_pictures()
        found, names = localize_beside(self.scan_map, picture, poses, pictures, settings, self.workers, watch)
        is_surer = found.confidence > first.confidence
        before = first.best_pose
        after = found.best_pose
        is_other = before and after and not CONFIRMED.holds(after, before)
        if not names or not (is_surer or is_other):
            return first, ()
        blank = self.reader.make_blank(photo, picture, facts, settings, watch.seconds)
        return follow(first, add_places(self.scan_map, found).complete(blank)), names


def take_surer(first: Result, found: Result | None, asked_sha256: str) -> Result:
    """Return the surer of two results of a photo, `first` or `found` with its series, marked as such."""
    if found is None or found.confidence <= first.confidence:
        beside = first.beside or Beside((), asked_sha256)
        return replace(first, beside=replace(beside, is_together=True))
    return replace(found, beside=Beside(names_of(found), asked_sha256, is_together=True))


class Opened(Protocol):
    """A scan in which second looks are taken; for the preset paper there are none."""

    @property
    def looking(self) -> Looking:
        """Return what second looks need. Raise InputError for the preset paper."""


class Others:
    """The other photos of a batch, which provide a second look with their keypoints or results."""

    def __init__(self, scan: Opened, ask: Callable[[Result], Asked]) -> None:
        """Take the scan, and a function that returns the photo of a result with its settings."""
        self._scan = scan
        self._ask = ask
        self.place = lru_cache(MOST_PICTURES)(self._place)
        self.localize_series = lru_cache(1)(self._localize_series)  # those of one series come together

    def _place(self, result: Result) -> SurePhoto | None:
        """Return the keypoints of the photo that has a result, which is sure."""
        photo, settings = self._ask(result)
        assert isinstance(settings, CoarseToFineSettings)
        return self._scan.looking.place(photo, result, settings)

    def _localize_series(self, series: tuple[Result, ...]) -> Mapping[Result, Result]:
        """Return the new results of photos in a series that are found by others, by their results so far."""
        return self._scan.looking.localize_series([self._ask(result) for result in series], series)
