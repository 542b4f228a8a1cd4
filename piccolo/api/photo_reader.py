"""Photos as they are read for a scan: pictures, facts, and the results that they begin with."""

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
    """A scan as its photos need it: they are read for it, and their results repeat it."""

    scan: str | tuple[str, ...]  # its name
    cloud_settings: CloudSettings
    scan_sha256: str | None
    crs: str  # coordinate system of the scan; empty if it is not known
    warnings: tuple[str, ...]  # about the scan

    def take(
        self, photo: Photo, watch: Stopwatch, focal: FocalLength | None = None
    ) -> tuple[Panorama, PhotoFacts]:
        """Read a photo and its facts; `focal` says what other photos of its camera know, if anything."""
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
        """Return the result of a photo, by `name`, that raised an error; one of the program is raised."""
        name = name or photo.name
        digest = None if isinstance(photo.picture, np.ndarray) else sha256_of(photo.path, photo.instant)
        source = Source(self.scan_sha256, digest)
        about = {"settings": settings_json(settings, self.cloud_settings, photo), "source": source}
        text = describe_failure(error).replace(photo.name, name)
        return unreadable_result(text, self.scan, name, is_passing(error), **about)

    def make_gps_prior(self, facts: PhotoFacts, prior: Prior) -> GpsPrior | None:
        """Return a photo's GPS position in the scan; None if it is not known, or not wanted."""
        gps = facts.gps
        if gps is None or not self.crs or not prior.use_gps or prior.near is not None:
            return None
        place = from_wgs84(self.crs, gps.latitude_deg, gps.longitude_deg)
        if place is None:
            return None
        radius = 3.0 * max(gps.accuracy or 10.0, 5.0)  # [m] three sigmas; 10 m where the file does not say
        return GpsPrior(place, radius)


def settings_json(settings: Settings, cloud_settings: CloudSettings, photo: Photo) -> dict[str, object]:
    """Return the settings as a result's JSON has them."""
    return {**settings.to_json(), "cloud": asdict(cloud_settings), "panorama": photo.to_json()}


def describe_failure(error: Exception) -> str:
    """Return in one line why a photo has no result; an error of none, but of the program, is raised."""
    if isinstance(error, OSError | InputError):
        return text_of(error)
    if is_shortage(error):
        return f"not enough memory ({' '.join(str(error).split()) or 'none is left'})"
    raise error


def unreadable_result(
    error: str, cloud: str | tuple[str, ...], pano: str, is_passing: bool = False, **more: Any
) -> Result:
    """Return the result of a photo that can't be read, or could not at the moment; `more` as in Result."""
    status = FAILED if is_passing else UNREADABLE
    return Result(status, 0.0, cloud, pano, error=error, **more)
