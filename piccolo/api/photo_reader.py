"""Reading of photos for a scan: pictures, facts from their files, and results without a pose yet."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ..cloud.cloud_settings import CloudSettings, from_wgs84
from ..judge.result import FAILED, UNREADABLE, Result
from ..judge.result_parts import FocalLength, Source
from ..localization.paper import PaperSettings
from ..photo.panorama import Panorama, read_panorama
from ..photo.panorama.facts import PhotoFacts, read_photo_facts, sha256_of
from ..photo.photo import GpsPrior, Photo, Prior
from ..problem.settings import CoarseToFineSettings
from ..system.errors import InputError, is_passing, text_of
from ..system.files.json_file import reading_once
from ..system.jobs.memory import is_shortage
from ..system.jobs.threads import Stopwatch

Settings = CoarseToFineSettings | PaperSettings


@dataclass(frozen=True)
class PhotoReader:
    """A reader of photos for a scan; it holds what the results of photos repeat of the scan."""

    scan: str | tuple[str, ...]  # name of the scan
    cloud_settings: CloudSettings
    scan_sha256: str | None  # digest of the scan's files or arrays
    crs: str  # coordinate system of the scan; empty if it is not known
    warnings: tuple[str, ...]  # about the scan

    def take(
        self, photo: Photo, watch: Stopwatch, focal: FocalLength | None = None
    ) -> tuple[Panorama, PhotoFacts]:
        """Read a photo and its facts; `focal` may have the focal length by other photos of its camera."""
        with watch.stage("read"), reading_once():
            picture = read_panorama(photo)
            if focal is not None and focal.others_px is not None and focal.others_std_px is not None:
                picture = picture.expect_focal(focal.others_px, focal.others_std_px / focal.others_px)
            return picture, read_photo_facts(photo)

    def make_blank(
        self,
        photo: Photo,
        picture: Panorama,
        facts: PhotoFacts,
        settings: Settings,
        seconds: dict[str, float],
    ) -> Result:
        """Return the result of a photo that is not localized yet."""
        return Result(
            cloud=self.scan,
            pano=photo.name,
            seconds=seconds,
            settings=settings_json(settings, self.cloud_settings, photo),
            warnings=self.warnings + picture.warnings,
            source=Source(self.scan_sha256, facts.sha256, facts.image_size, facts.capture_time),
            cameras=picture.cameras,
        )

    def make_failed(
        self, photo: Photo, error: Exception, settings: Settings, name: str | None = None
    ) -> Result:
        """Return the result of a photo that raised an error; raise the error if it is the program's own.

        `name` replaces the photo's name in the result.
        """
        name = name or photo.name
        digest = None if isinstance(photo.picture, np.ndarray) else sha256_of(photo.path, photo.instant)
        source = Source(self.scan_sha256, digest)
        about = {"settings": settings_json(settings, self.cloud_settings, photo), "source": source}
        text = describe_failure(error).replace(photo.name, name)
        return unreadable_result(text, self.scan, name, is_passing(error), **about)

    def make_gps_prior(self, facts: PhotoFacts, prior: Prior) -> GpsPrior | None:
        """Return a photo's GPS position in the scan; None if it is unknown, or the prior excludes it."""
        gps = facts.gps
        if gps is None or not self.crs or not prior.use_gps or prior.near is not None:
            return None
        place = from_wgs84(self.crs, gps.latitude_deg, gps.longitude_deg)
        if place is None:
            return None
        radius = 3.0 * max(gps.accuracy or 10.0, 5.0)  # [m] three sigmas; 10 m if the file names none
        return GpsPrior(place, radius)


def settings_json(settings: Settings, cloud_settings: CloudSettings, photo: Photo) -> dict[str, object]:
    """Return the settings of method, scan and photo in the form of a result's JSON."""
    return {**settings.to_json(), "cloud": asdict(cloud_settings), "panorama": photo.to_json()}


def describe_failure(error: Exception) -> str:
    """Return in one line why a photo can't be localized; raise the error if it is the program's own."""
    if isinstance(error, OSError | InputError):
        return text_of(error)
    if is_shortage(error):
        return f"not enough memory ({' '.join(str(error).split()) or 'none is left'})"
    raise error


def unreadable_result(
    error: str, cloud: str | tuple[str, ...], pano: str, is_passing: bool = False, **more: Any
) -> Result:
    """Return the result of a photo that can't be read, or could not at the moment (`is_passing`).

    `more` are further fields of Result.
    """
    status = FAILED if is_passing else UNREADABLE
    return Result(status, 0.0, cloud, pano, error=error, **more)
