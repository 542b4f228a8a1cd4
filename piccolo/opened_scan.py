"""A scan prepared for a method: `Scan`, the commands and the batches localize photos in it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from .arrays import Bytes
from .camera import Calibration
from .cloud.settings import CloudSettings, from_wgs84
from .errors import InputError, is_passing
from .evidence.occlusion import occlusion_mask
from .files.json_file import reading_once
from .geometry.colors import Labels
from .geometry.nearness import CONFIRMED
from .geometry.pose import Pose, check_pose
from .jobs.memory import check_memory
from .jobs.threads import Stopwatch, Workers
from .judge.localization import FocalLength, Localization
from .judge.probability import LOCALIZED, NOT_LOCALIZED
from .localization.localize import has_guessed_focal, localize, localize_guessed
from .localization.means import NO_TRACE, Means, Trace
from .localization.places import add_places
from .panorama import Panorama, check_labels, read_panorama
from .panorama.photo import PhotoFacts, read_photo_facts, sha256_of
from .paper.localize import PaperMap, PaperSettings, localize as localize_by_paper
from .photo import GpsPrior, Photo, Prior
from .problem.problem import prepare_problem
from .problem.settings import CoarseToFineSettings
from .result import Result, Source, describe_failure, unreadable_result, with_localization
from .scan_map.scan_map import ScanMap, check_within
from .together.beside import SurePhoto, localize_beside, place_sure
from .together.bundle import localize_bundle
from .together.bundle_adjustment import UNKNOWN_SCALE, RelativeErrors, RelativeScale

LABELS_WARNING = "`labels`: the confidence was fitted to colours; with labels it is a rough estimate"
MEMORY_OF_PHOTO = 8e7  # [byte] that a photo keeps while others of its bundle are localized
ONLY_DEFAULT = ("refine_focal", "gravity_vector")  # options of photos that the preset paper does not have
Settings = CoarseToFineSettings | PaperSettings


@dataclass(frozen=True)
class OpenedScan:
    """A scan prepared for a method. Several threads may use it at once."""

    prepared: ScanMap | PaperMap = field(repr=False)
    name: str | tuple[str, ...]  # path as given, or the paths of several files that are one scan
    cloud_settings: CloudSettings
    settings: Settings  # defaults of photos
    workers: Workers
    seconds: dict[str, float]  # [s] spent on reading and preparing the scan, by stage

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the scan, one line each."""
        return self.prepared.warnings

    def occlusion_mask(self, photo: Photo, pose: Pose) -> Bytes:
        """Return the pixels (H, W) of a photo that contradict the scan at a pose (`Scan.occlusion_mask`)."""
        pose = self.prepared.from_world(check_pose(pose, "`pose`"))
        return occlusion_mask(self.prepared.points, self.read(photo), pose)

    def read(self, photo: Photo) -> Panorama:
        """Read a photo, of labels if the scan is one of labels."""
        return read_panorama(photo, self.cloud_settings.labels)

    def localize(
        self,
        photo: Photo,
        settings: Settings,
        focal: FocalLength | None = None,
        trace: Trace = NO_TRACE,
    ) -> Result:
        """Localize a photo; `focal` is its focal length as found with those of others, which counts then.

        `trace` notes the steps of the default method.
        """
        watch = Stopwatch()
        self.check_options(photo, settings)
        picture, facts = self._take(photo, focal, watch)
        gps = None
        if isinstance(self.prepared, PaperMap):
            assert isinstance(settings, PaperSettings)
            found = localize_by_paper(self.prepared, picture, settings, self.workers, watch)
        else:
            assert isinstance(settings, CoarseToFineSettings)
            gps = self.make_gps_prior(facts, settings.prior)
            run = localize_guessed if has_guessed_focal(picture) else localize
            means = Means(settings.effort, self.workers, watch, trace)
            found = Localization()
            if gps is not None:
                near = replace(settings, prior=gps.apply_to(settings.prior))
                found = run(self.prepared, picture, near, means)
            if found.status != LOCALIZED:
                gps = gps and replace(gps, is_used=False)
                found = run(self.prepared, picture, settings, means)
        if focal is not None:
            found = replace(found, focal_length=focal.update(found.focal_length))
        blank = self.make_blank(photo, picture, facts, settings, watch.seconds)
        return replace(self.add_localization(blank, found), gps_prior=gps)

    def place_keypoints(self, photo: Photo, result: Result, settings: Settings) -> SurePhoto | None:
        """Return the keypoints of a photo that is localized; None if it is another photo now."""
        prepared, settings = self.require_default_method("photos beside others", settings)
        with reading_once():
            picture = self.read(photo.with_refined_camera(result.cameras))
            digest = read_photo_facts(photo).sha256
        if digest != result.source.pano_sha256 or result.best_pose is None:
            return None
        problem = prepare_problem(picture, prepared, settings.prior, settings.gravity)
        pose = result.best_pose
        return place_sure(problem, pose, result.covariance, result.confidence, self.workers)

    def localize_again(
        self,
        photo: Photo,
        first: Result,
        list_pictures: Callable[[], Mapping[str, SurePhoto]],
        settings: Settings,
    ) -> tuple[Result, tuple[str, ...]]:
        """Localize a photo that is not sure, beside others that are; return also the names of these.

        `list_pictures` returns those that are asked, by name. If none shows the same, the result is the
        first one. A photo whose focal length is a guess is not looked at.
        """
        watch = Stopwatch(dict(first.seconds))
        prepared, settings = self.require_default_method("photos beside others", settings)
        focal = first.focal_length
        picture, facts = self._take(photo, focal, watch)
        if has_guessed_focal(picture) or prepared.has_shape or facts.sha256 != first.source.pano_sha256:
            return first, ()
        known = [pose for pose in (first.best_pose, *(a.pose for a in first.alternatives)) if pose]
        poses = [self.prepared.from_world(pose) for pose in known]
        with watch.stage("read"):
            pictures = list_pictures()
        found, names = localize_beside(prepared, picture, poses, pictures, settings, self.workers, watch)
        is_surer = found.confidence > first.confidence
        is_other = first.best_pose and found.pose and not CONFIRMED.holds(found.pose, first.best_pose)
        if not names or not (is_surer or is_other):
            return first, ()
        if focal is not None:
            found = replace(found, focal_length=focal.update(found.focal_length))
        elif found.focal_length is not None:  # only what a photo says alone counts for others
            alone = replace(found.focal_length, picture_px=None, picture_std_px=None)
            found = replace(found, focal_length=alone)
        blank = self.make_blank(photo, picture, facts, settings, watch.seconds)
        return replace(self.add_localization(blank, found), gps_prior=first.gps_prior), names

    def _take(self, photo: Photo, focal: FocalLength | None, watch: Stopwatch) -> tuple[Panorama, PhotoFacts]:
        """Read a photo, with the focal length that other photos of its camera have, if that is known."""
        with watch.stage("read"), reading_once():
            picture = self.read(photo)
            if focal is not None and focal.others_px is not None and focal.others_std_px is not None:
                picture = picture.expect_focal(focal.others_px, focal.others_std_px / focal.others_px)
            return picture, read_photo_facts(photo)

    def require_default_method(self, what: str, settings: Settings) -> tuple[ScanMap, CoarseToFineSettings]:
        """Return the map and settings; InputError for the preset paper, which does not have `what`."""
        if not isinstance(self.prepared, ScanMap) or not isinstance(settings, CoarseToFineSettings):
            raise InputError(f"{what}: not available with the preset paper")
        return self.prepared, settings

    def localize_bundle(
        self,
        photos: Sequence[Photo],
        cams_from_bundle: Sequence[Pose],
        settings: Settings,
        relative_scale: RelativeScale = "metres",
    ) -> list[Result]:
        """Localize photos together whose poses in a common frame are known; its scale may be unknown.

        Raises InputError for a photo that can't be read, for the preset paper, and for a focal length that is
        a guess.
        """
        prepared, settings = self.require_default_method("`relative_poses`", settings)
        for photo in photos:
            self.check_options(photo, settings)
        poses = [check_pose(pose, "`relative_poses`") for pose in cams_from_bundle]
        if not photos:
            return []
        watch = Stopwatch()
        needed = len(photos) * MEMORY_OF_PHOTO
        check_memory(needed, f"{len(photos)} photos together", "localize fewer together")
        with watch.stage("read"), reading_once():
            pictures = [self.read(photo) for photo in photos]
            facts = [read_photo_facts(photo) for photo in photos]
        if any(map(has_guessed_focal, pictures)):
            raise InputError("`relative_poses`: found a focal length that is a guess, wanted a known one")
        errors = RelativeErrors()
        if relative_scale == "unknown":
            errors = errors._replace(log_scale=UNKNOWN_SCALE)
        found = localize_bundle(prepared, pictures, poses, settings, self.workers, watch, errors)
        seconds = {stage: spent / len(found) for stage, spent in watch.seconds.items()}
        return [
            self.add_localization(self.make_blank(photo, picture, about, settings, seconds), one)
            for photo, picture, about, one in zip(photos, pictures, facts, found, strict=True)
        ]

    def make_blank(
        self,
        photo: Photo,
        picture: Panorama,
        facts: PhotoFacts,
        settings: Settings,
        seconds: dict[str, float],
    ) -> Result:
        """Return the result of a photo that is not localized yet."""
        has_labels = self.cloud_settings.labels is not None
        return Result(
            NOT_LOCALIZED,
            0.0,
            self.name,
            photo.name,
            seconds=seconds,
            settings=settings_json(settings, self.cloud_settings, photo),
            warnings=self.warnings + picture.warnings + ((LABELS_WARNING,) if has_labels else ()),
            source=Source(
                self.prepared.scan_sha256 or None, facts.sha256, facts.image_size, facts.capture_time
            ),
            cameras=picture.cameras,
        )

    def add_localization(self, result: Result, found: Localization) -> Result:
        """Return a result with what was found, and where in the scan that is."""
        if isinstance(self.prepared, ScanMap):
            found = add_places(self.prepared, found)
        return replace(with_localization(result, found), cameras=found.cameras or result.cameras)

    def check_options(self, photo: Photo, settings: Settings) -> None:
        """Raise InputError for options that this scan or its method does not have."""
        check_labels(photo, self.cloud_settings.labels)
        if isinstance(self.prepared, ScanMap) and isinstance(settings, CoarseToFineSettings):
            check_within(self.prepared, settings.prior.within)
        elif given := [name for name in ONLY_DEFAULT if getattr(photo, name)]:
            raise InputError(f"`{given[0]}`: not an option of the preset paper")

    def make_gps_prior(self, photo: PhotoFacts, prior: Prior) -> GpsPrior | None:
        """Return the photo's GPS position in the scan; None if it is not known, or not wanted."""
        gps = photo.gps
        crs = self.cloud_settings.crs or getattr(self.prepared, "crs", "")
        if gps is None or not crs or not prior.use_gps or prior.near is not None:
            return None
        place = from_wgs84(crs, gps.latitude_deg, gps.longitude_deg)
        if place is None:
            return None
        radius = 3.0 * max(gps.accuracy or 10.0, 5.0)  # [m] three sigmas; 10 m where the file does not say
        return GpsPrior(place, radius)


def settings_json(settings: Settings, cloud_settings: CloudSettings, photo: Photo) -> dict[str, object]:
    """Return the settings as a result's JSON has them."""
    labels = cloud_settings.labels and asdict(cloud_settings.labels)
    reading = {**photo.to_json(), "labels": labels}
    return {**settings.to_json(), "cloud": asdict(cloud_settings), "panorama": reading}


def photo_of(result: Result, path: Path | None = None) -> Photo:
    """Return the photo of a result as it was read when it was localized, without masks; at another path."""
    picture = path or result.pano
    if result.cameras:
        return Photo(picture).with_calibration(Calibration("the result", result.cameras))
    how: Any = result.settings.get("panorama") or {}
    given = {name: how.get(name) for name in ("fov_deg", "projection", "cube_order")}
    return Photo(picture, **given)


def read_as_localized(result: Result) -> Panorama:
    """Read the photo of a result as when it was localized: not valid is what was masked then."""
    how: Any = result.settings.get("panorama") or {}
    nadir_deg = float(how.get("mask_nadir_deg") or 0.0)
    photo = replace(photo_of(result), mask=how.get("mask"), mask_nadir_deg=nadir_deg)
    return read_panorama(photo, labels_of(result))


def labels_of(result: Result) -> Labels | None:
    """Return how the labels of a result's photo were read; None for colours."""
    how: Any = result.settings.get("panorama") or {}
    return Labels(tuple(how["labels"]["ignored"])) if how.get("labels") else None


def make_failed_result(
    scan: OpenedScan, photo: Photo, error: Exception, settings: Settings, name: str | None = None
) -> Result:
    """Return the result of a photo, by `name`, that raised an error; one in the program is raised again."""
    name = name or photo.name
    digest = None if isinstance(photo.picture, np.ndarray) else sha256_of(photo.path, photo.instant)
    source = Source(scan.prepared.scan_sha256 or None, digest)
    about = {"settings": settings_json(settings, scan.cloud_settings, photo), "source": source}
    text = describe_failure(error).replace(photo.name, name)
    return unreadable_result(text, scan.name, name, is_passing(error), **about)
