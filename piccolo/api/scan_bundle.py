"""Photos with known relative poses: the work of `Scan.localize_bundle`."""

from collections.abc import Sequence
from typing import NamedTuple

from ..geometry.pose import Pose
from ..judge.result import Result
from ..localization.means import NO_TRACE, Trace
from ..localization.place_names import add_places
from ..localization.run import has_guessed_focal
from ..photo.photo import Photo
from ..poses.bundle_adjustment import UNKNOWN_SCALE, RelativeErrors, RelativeScale
from ..problem.settings import CoarseToFineSettings
from ..scan_map.scan_map import ScanMap
from ..system.errors import InputError
from ..system.jobs.threads import Stopwatch, Workers
from ..together.bundle import Posed, localize_bundle
from ..together.members import check_photos
from .photo_reader import PhotoReader


class AskedPosed(NamedTuple):
    """A photo with its pose in the frame of its bundle, and the settings for localizing it."""

    photo: Photo
    cam_from_bundle: Pose
    settings: CoarseToFineSettings
    trace: Trace = NO_TRACE


def localize_posed(
    scan_map: ScanMap,
    reader: PhotoReader,
    workers: Workers,
    asked: Sequence[AskedPosed],
    relative_scale: RelativeScale,
) -> list[Result]:
    """Localize photos as a bundle; return their results in order.

    Raise InputError for a photo that can't be read, and for a focal length that is a guess.
    """
    if not asked:
        return []
    watch = Stopwatch()
    check_photos(len(asked))
    taken = [reader.take(one.photo, watch) for one in asked]
    if any(has_guessed_focal(picture) for picture, _ in taken):
        raise InputError("`relative_poses`: found a focal length that is a guess, wanted a known one")
    errors = RelativeErrors()
    if relative_scale == "unknown":
        errors = errors._replace(log_scale=UNKNOWN_SCALE)
    posed = [
        Posed(picture, one.cam_from_bundle, one.settings, one.trace)
        for one, (picture, _) in zip(asked, taken, strict=True)
    ]
    found = localize_bundle(scan_map, posed, workers, watch, errors)
    seconds = {stage: spent / len(found) for stage, spent in watch.seconds.items()}
    results = []
    for one, (picture, facts), result in zip(asked, taken, found, strict=True):
        blank = reader.make_blank(one.photo, picture, facts, one.settings, seconds)
        results.append(add_places(scan_map, result).complete(blank))
    return results
