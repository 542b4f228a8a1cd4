"""A scan prepared for a method: `Scan`, the commands and the batches localize photos in it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .camera import Calibration
from .cloud.settings import CloudSettings
from .cloud.soa import PackedPoints
from .confidence.confidence import LOCALIZED, NOT_LOCALIZED
from .confidence.localization import FocalLength, Localization
from .confidence.occlusion import occlusion_mask
from .errors import InputError
from .files.json_file import reading_once
from .geometry.colors import Labels
from .geometry.nearness import CONFIRMED
from .geometry.pose import Pose, check_pose
from .jobs.memory import check_memory
from .jobs.stopwatch import Stopwatch
from .jobs.threads import Workers
from .localization.beside import SurePhoto, localize_beside, locate
from .localization.bundle import localize_bundle
from .localization.bundle_adjustment import UNKNOWN_SCALE, RelativeErrors, RelativeScale
from .localization.localize import has_guessed_focal, localize, localize_guessed
from .localization.settings import CoarseToFineSettings
from .panorama import Panorama, ReadOptions, read_photo
from .panorama.photo import PhotoFacts, read_photo_facts, sha256_of
from .paper.localize import PaperMap
from .paper.localize import localize as localize_by_paper
from .paper.settings import PaperSettings
from .result import Result, Source, describe_failure, unreadable_result, with_localization
from .scan_map.named_scans import add_places, check_within
from .scan_map.prior import GpsPrior, Prior, gps_prior
from .scan_map.scan_map import ScanMap

OTHER_METHOD = "`settings`: found another method than that for which the scan was prepared"
LABELS_WARNING = "`labels`: the confidence was fitted to colours; with labels it is a rough estimate"
MEMORY_OF_PHOTO = 8e7  # [byte] that a photo keeps while others of its bundle are localized
File = str | PathLike[str]
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
    def points(self) -> PackedPoints:
        """Coloured points, to draw the scan, in the frame of `from_world`."""
        return self.prepared.points

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about the scan, one line each."""
        return self.prepared.warnings

    def from_world(self, pose: Pose) -> Pose:
        """Transform a pose from the scan's own coordinates to the frame of `points`."""
        return self.prepared.from_world(pose)

    def occlusion_mask(
        self,
        panorama: File | NDArray[np.uint8],
        pose: Pose,
        read_options: ReadOptions,
        is_masked: NDArray[np.bool_] | None = None,
    ) -> NDArray[np.uint8]:
        """Return the pixels (H, W) of a photo that contradict the scan at a pose (`Scan.occlusion_mask`)."""
        pose = self.from_world(check_pose(pose, "`pose`"))
        return occlusion_mask(self.points, read_photo(panorama, read_options, is_masked), pose)

    def localize_query(
        self,
        panorama: File | NDArray[np.uint8],
        read_options: ReadOptions,
        settings: Settings,
        is_masked: NDArray[np.bool_] | None = None,
        calibration: Calibration | None = None,
        focal: FocalLength | None = None,
    ) -> Result:
        """Localize a photo.

        `is_masked` (H, W) is the mask of a photo that is an array, True where it is ignored. `calibration` is
        the photo's camera, if `read_options` give none. `focal` is its focal length as found before, with
        that of other photos, which counts then.
        """
        watch = Stopwatch()
        self.check_options(read_options, settings)
        asked = read_options
        if calibration is not None and read_options.calibration is None:
            read_options = replace(read_options, calibration=calibration)
        with watch.stage("read"), reading_once():
            picture = expect_focal(read_photo(panorama, read_options, is_masked), focal)
            photo = read_photo_facts(panorama, read_options.rig)
        gps = None
        if isinstance(self.prepared, ScanMap) and isinstance(settings, CoarseToFineSettings):
            attempts: list[tuple[CoarseToFineSettings, GpsPrior | None]] = [(settings, None)]
            if read_options.use_gps and (gps := self.make_gps_prior(photo, settings)):
                near = replace(settings, prior=gps.apply_to(settings.prior))
                attempts = [(near, gps), (settings, replace(gps, is_used=False))]
            run = localize_guessed if has_guessed_focal(picture) else localize
            for tried, gps in attempts:  # noqa: B007  near the GPS position, or else anywhere
                found = run(self.prepared, picture, tried, self.workers, watch)
                if found.status == LOCALIZED:
                    break
        elif isinstance(self.prepared, PaperMap) and isinstance(settings, PaperSettings):
            found = localize_by_paper(self.prepared, picture, settings, self.workers, watch)
        else:
            raise InputError(OTHER_METHOD)
        if focal is not None:
            found = replace(found, focal_length=focal.after(found.focal_length))
        about = settings_json(settings, self.cloud_settings, asked)
        return replace(self.make_result(panorama, picture, photo, found, about, watch.seconds), gps_prior=gps)

    def locate(
        self, panorama: File, result: Result, read_options: ReadOptions, settings: Settings
    ) -> SurePhoto | None:
        """Return the keypoints of a photo that is localized; None if it is another photo now."""
        if result.best_pose is None:
            raise ValueError("a photo without a pose")
        prepared, settings = self.require_default_method("photos beside others", settings)
        with reading_once():
            read_options = read_options.with_refined_camera(result.cameras, Path(panorama))
            picture = read_photo(panorama, read_options)
            photo = read_photo_facts(panorama, read_options.rig)
        if photo.sha256 != result.source.pano_sha256:
            return None
        pose = result.best_pose
        found = Localization(confidence=result.confidence, pose=pose, covariance=result.covariance)
        return locate(prepared, picture, found, settings, self.workers)

    def localize_again(
        self,
        panorama: File,
        first: Result,
        list_pictures: Callable[[], Mapping[str, SurePhoto]],
        read_options: ReadOptions,
        settings: Settings,
    ) -> tuple[Result, tuple[str, ...]]:
        """Localize a photo that is not sure, beside others that are; return also the names of these.

        `list_pictures` returns those that are asked, by name. If none shows the same, the result is the
        first one. A photo whose focal length is a guess is not looked at.
        """
        watch = Stopwatch(dict(first.seconds))
        prepared, settings = self.require_default_method("photos beside others", settings)
        focal = first.focal_length
        with watch.stage("read"), reading_once():
            picture = expect_focal(read_photo(panorama, read_options), focal)
            photo = read_photo_facts(panorama, read_options.rig)
        if has_guessed_focal(picture) or prepared.has_shape or photo.sha256 != first.source.pano_sha256:
            return first, ()
        known = [pose for pose in (first.best_pose, *(a.pose for a in first.alternatives)) if pose]
        poses = [self.from_world(pose) for pose in known]
        with watch.stage("read"):
            pictures = list_pictures()
        found, names = localize_beside(prepared, picture, poses, pictures, settings, self.workers, watch)
        is_surer = found.confidence > first.confidence
        is_other = first.best_pose and found.pose and not CONFIRMED.holds(found.pose, first.best_pose)
        if not names or not (is_surer or is_other):
            return first, ()
        if focal is not None:
            found = replace(found, focal_length=focal.after(found.focal_length))
        elif found.focal_length is not None:  # only what a photo says alone counts for others
            alone = replace(found.focal_length, picture_px=None, picture_std_px=None)
            found = replace(found, focal_length=alone)
        about = settings_json(settings, self.cloud_settings, read_options)
        result = self.make_result(panorama, picture, photo, found, about, watch.seconds)
        return replace(result, gps_prior=first.gps_prior), names

    def require_default_method(self, what: str, settings: Settings) -> tuple[ScanMap, CoarseToFineSettings]:
        """Return the map and settings; InputError for the preset paper, which does not have `what`."""
        if not isinstance(self.prepared, ScanMap) or not isinstance(settings, CoarseToFineSettings):
            raise InputError(f"{what}: not available with the preset paper")
        return self.prepared, settings

    def localize_bundle(
        self,
        panoramas: Sequence[File | NDArray[np.uint8]],
        cams_from_bundle: Sequence[Pose],
        read_options: ReadOptions,
        settings: Settings,
        is_masked: NDArray[np.bool_] | None = None,
        relative_scale: RelativeScale = "metres",
    ) -> list[Result]:
        """Localize photos together whose poses in a common frame are known; its scale may be unknown.

        Raises InputError for a photo that can't be read, for the preset paper, and for a focal length that is
        a guess.
        """
        prepared, settings = self.require_default_method("`relative_poses`", settings)
        self.check_options(read_options, settings)
        poses = [check_pose(pose, "`relative_poses`") for pose in cams_from_bundle]
        if not panoramas:
            return []
        watch = Stopwatch()
        needed = len(panoramas) * MEMORY_OF_PHOTO
        check_memory(needed, f"{len(panoramas)} photos together", "localize fewer together")
        with watch.stage("read"), reading_once():
            pictures = [read_photo(panorama, read_options, is_masked) for panorama in panoramas]
            photos = [read_photo_facts(panorama, read_options.rig) for panorama in panoramas]
        if any(map(has_guessed_focal, pictures)):
            raise InputError("`relative_poses`: found a focal length that is a guess, wanted a known one")
        errors = RelativeErrors()
        if relative_scale == "unknown":
            errors = errors._replace(log_scale=UNKNOWN_SCALE)
        found = localize_bundle(prepared, pictures, poses, settings, self.workers, watch, errors)
        about = settings_json(settings, self.cloud_settings, read_options)
        seconds = {stage: spent / len(found) for stage, spent in watch.seconds.items()}
        return [
            self.make_result(*parts, about, seconds)
            for parts in zip(panoramas, pictures, photos, found, strict=True)
        ]

    def make_result(
        self,
        panorama: File | NDArray[np.uint8],
        picture: Panorama,
        photo: PhotoFacts,
        found: Localization,
        settings: dict[str, object],
        seconds: dict[str, float],
    ) -> Result:
        """Return the result of a photo; `settings` are as in its JSON."""
        has_labels = self.cloud_settings.labels is not None
        if isinstance(self.prepared, ScanMap):
            found = add_places(self.prepared, found)
        blank = Result(
            NOT_LOCALIZED,
            0.0,
            self.name,
            "array" if isinstance(panorama, np.ndarray) else str(panorama),
            seconds=seconds,
            settings=settings,
            warnings=self.warnings + picture.warnings + ((LABELS_WARNING,) if has_labels else ()),
            source=Source(
                self.prepared.scan_sha256 or None, photo.sha256, photo.image_size, photo.capture_time
            ),
            cameras=found.cameras or picture.cameras,
        )
        return with_localization(blank, found)

    def check_options(self, read_options: ReadOptions, settings: Settings) -> None:
        """Raise InputError for options that this scan or its method does not have."""
        if isinstance(self.prepared, ScanMap) and isinstance(settings, CoarseToFineSettings):
            check_within(self.prepared, settings.prior.within)
        elif read_options.refine_focal:
            raise InputError("`refine_focal`: not an option of the preset paper")

    def make_gps_prior(self, photo: PhotoFacts, settings: CoarseToFineSettings) -> GpsPrior | None:
        """Return the photo's GPS position in the scan; None if either is unknown or `near_world` is given."""
        crs = self.cloud_settings.crs or getattr(self.prepared, "crs", "")
        if photo.gps is None or not crs or settings.prior.near_world is not None:
            return None
        return gps_prior(photo.gps, crs, self.cloud_settings.scale)


def expect_focal(picture: Panorama, focal: FocalLength | None) -> Panorama:
    """Return a photo with the focal length that other photos of its camera have, if that is known."""
    if focal is None or focal.others_px is None or focal.others_std_px is None:
        return picture
    return picture.expect_focal(focal.others_px, focal.others_std_px / focal.others_px)


def settings_json(
    settings: Settings, cloud_settings: CloudSettings, read_options: ReadOptions
) -> dict[str, object]:
    """Return the settings as a result's JSON has them."""
    reading = {k: str(v) if isinstance(v, Path) else v for k, v in asdict(read_options).items()}
    return {**settings.to_json(), "cloud": asdict(cloud_settings), "panorama": reading}


def read_options_of(result: Result) -> ReadOptions:
    """Return the options with which the photo of a result was read when it was localized."""
    how: Any = result.settings.get("panorama") or {}
    labels = Labels(tuple(how["labels"]["ignored"])) if how.get("labels") else None
    if result.cameras:
        return ReadOptions(labels=labels, calibration=Calibration("the result", result.cameras))
    names = "fov_deg", "projection", "cube_order"
    return ReadOptions(labels=labels, **{name: how.get(name) for name in names})


def make_failed_result(
    scan: OpenedScan,
    panorama: File | NDArray[np.uint8],
    error: Exception,
    read_options: ReadOptions,
    settings: Settings,
    name: str | None = None,
) -> Result:
    """Return the result of a photo that raised an error; an error in the program is raised again.

    `name` replaces the photo's path in the result.
    """
    text, is_passing = describe_failure(error)
    digest = None
    path = "array"
    if not isinstance(panorama, np.ndarray):
        path = str(panorama)
        digest = sha256_of(Path(panorama), read_options.rig)
    name = name or path
    return unreadable_result(
        text.replace(path, name),
        scan.name,
        name,
        is_passing,
        settings=settings_json(settings, scan.cloud_settings, read_options),
        source=Source(scan.prepared.scan_sha256 or None, digest),
    )


def replace_settings(settings: Settings, given: dict[str, Any]) -> Settings:
    """Return settings with options changed; InputError if the method has no such option."""
    if unknown := given.keys() - {f.name for f in fields(settings)}:
        raise InputError(f"`{min(unknown)}`: not an option of the preset paper")
    return replace(settings, **given)


def make_prior(given: dict[str, Any], settings: Settings) -> Prior:
    """Return the prior that options give; InputError if one is invalid, or the method uses no prior."""
    if not isinstance(settings, CoarseToFineSettings):
        raise InputError(f"`{min(given)}`: not an option of the preset paper")
    return replace(settings.prior, **given | {"within": tuple(given.get("within", settings.prior.within))})
