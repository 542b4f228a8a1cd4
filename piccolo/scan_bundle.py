"""Photos of a scan whose poses relative to each other are known, as `Scan.localize_bundle` localizes them."""

from collections.abc import Sequence

from .errors import InputError
from .geometry.pose import Pose
from .jobs.memory import check_memory
from .jobs.threads import Stopwatch, Workers
from .judge.result import Result
from .localization.localize import has_guessed_focal
from .localization.places import add_places
from .photo import Photo
from .photo_reader import PhotoReader
from .problem.settings import CoarseToFineSettings
from .scan_map.scan_map import ScanMap
from .together.bundle import localize_bundle
from .together.bundle_adjustment import UNKNOWN_SCALE, RelativeErrors, RelativeScale

MEMORY_OF_PHOTO = 8e7  # [byte] that a photo keeps while others of its bundle are localized


def localize_posed(
    scan_map: ScanMap,
    reader: PhotoReader,
    workers: Workers,
    photos: Sequence[Photo],
    cams_from_bundle: Sequence[Pose],
    relative_scale: RelativeScale,
    settings: CoarseToFineSettings,
) -> list[Result]:
    """Return the results of photos together; `cams_from_bundle` are their poses in any common frame.

    Raises InputError for a photo that can't be read, and for a focal length that is a guess.
    """
    if not photos:
        return []
    watch = Stopwatch()
    needed = len(photos) * MEMORY_OF_PHOTO
    check_memory(needed, f"{len(photos)} photos together", "localize fewer together")
    taken = [reader.take(photo, watch) for photo in photos]
    pictures = [picture for picture, _ in taken]
    if any(map(has_guessed_focal, pictures)):
        raise InputError("`relative_poses`: found a focal length that is a guess, wanted a known one")
    errors = RelativeErrors()
    if relative_scale == "unknown":
        errors = errors._replace(log_scale=UNKNOWN_SCALE)
    found = localize_bundle(scan_map, pictures, cams_from_bundle, settings, workers, watch, errors)
    seconds = {stage: spent / len(found) for stage, spent in watch.seconds.items()}
    return [
        add_places(scan_map, one).complete(reader.make_blank(photo, picture, facts, settings, seconds))
        for photo, (picture, facts), one in zip(photos, taken, found, strict=True)
    ]
