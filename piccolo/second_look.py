"""A second look at one photo of a scan: with the focal length that others tell, or beside sure ones."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from .errors import InputError, is_passing
from .files.json_file import reading_once
from .geometry.nearness import CONFIRMED
from .jobs.threads import Stopwatch, Workers
from .judge.result import Result
from .judge.result_parts import Beside
from .localization.localize import has_guessed_focal
from .localization.places import add_places
from .panorama.photo import read_photo_facts
from .photo import Photo
from .photo_reader import PhotoReader
from .problem.problem import prepare_problem
from .problem.settings import CoarseToFineSettings
from .scan_map.scan_map import ScanMap
from .together.beside import SurePhoto, localize_beside, place_sure
from .together.second_looks import Look

Place = Callable[[Result], SurePhoto | None]  # of a photo that is sure, by its result


@dataclass(frozen=True)
class Looking:
    """A scan of the default method as second looks need it."""

    scan_map: ScanMap
    reader: PhotoReader
    workers: Workers

    def place(self, photo: Photo, result: Result, settings: CoarseToFineSettings) -> SurePhoto | None:
        """Return the keypoints of a photo that is localized; None if it is another, or none, by now."""
        try:
            with reading_once():
                picture = self.reader.read(photo.with_refined_camera(result.cameras))
                digest = read_photo_facts(photo).sha256
        except (OSError, InputError) as error:
            if is_passing(error):
                raise
            return None
        if digest != result.source.pano_sha256 or result.best_pose is None:
            return None
        problem = prepare_problem(picture, self.scan_map, settings.prior, settings.gravity, settings.method)
        return place_sure(problem, result.best_pose, result.covariance, result.confidence, self.workers)

    def look(
        self, photo: Photo, first: Result, look: Look, place: Place, settings: CoarseToFineSettings
    ) -> Result:
        """Return the result of a look at a photo, of which `first` is that without the others beside it."""
        if not look.beside:
            return replace(first, beside=None)

        def list_pictures() -> dict[str, SurePhoto]:
            found = ((result.pano, place(result)) for result in look.beside)
            return {name: picture for name, picture in found if picture}

        found, names = self.localize_again(photo, first, list_pictures, settings)
        return replace(found, beside=Beside(names, look.asked_sha256))

    def localize_again(
        self,
        photo: Photo,
        first: Result,
        list_pictures: Callable[[], Mapping[str, SurePhoto]],
        settings: CoarseToFineSettings,
    ) -> tuple[Result, tuple[str, ...]]:
        """Localize a photo that is not sure, beside others that are; return also the names of these.

        `list_pictures` returns those that are asked, by name. If none shows the same, the result is the first
        one. A photo whose focal length is a guess is not looked at.
        """
        watch = Stopwatch(dict(first.seconds))
        focal = first.focal_length
        picture, facts = self.reader.take(photo, watch, focal)
        is_another = facts.sha256 != first.source.pano_sha256
        if has_guessed_focal(picture) or self.scan_map.has_shape or is_another:
            return first, ()
        known = [pose for pose in (first.best_pose, *(a.pose for a in first.alternatives)) if pose]
        poses = [self.scan_map.from_world(pose) for pose in known]
        with watch.stage("read"):
            pictures = list_pictures()
        found, names = localize_beside(self.scan_map, picture, poses, pictures, settings, self.workers, watch)
        is_surer = found.confidence > first.confidence
        before = first.best_pose
        after = found.best_pose
        is_other = before and after and not CONFIRMED.holds(after, before)
        if not names or not (is_surer or is_other):
            return first, ()
        if focal is not None:
            found = replace(found, focal_length=focal.update(found.focal_length))
        elif found.focal_length is not None:  # only what a photo says alone counts for others
            alone = replace(found.focal_length, picture_px=None, picture_std_px=None)
            found = replace(found, focal_length=alone)
        blank = self.reader.make_blank(photo, picture, facts, settings, watch.seconds)
        return replace(add_places(self.scan_map, found).complete(blank), gps_prior=first.gps_prior), names
