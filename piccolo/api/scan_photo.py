"""One photo on its own: the work of `Scan.localize`."""

from dataclasses import replace
from typing import NamedTuple

from ..judge.probability import LOCALIZED
from ..judge.result import Result, nothing_found
from ..judge.result_parts import FocalLength
from ..localization.means import NO_TRACE, Means, Trace
from ..localization.paper import PaperMap, PaperSettings, localize_by_paper
from ..localization.place_names import add_places
from ..localization.run import has_guessed_focal, localize, localize_guessed
from ..photo.photo import Photo
from ..problem.settings import CoarseToFineSettings
from ..scan_map.scan_map import ScanMap
from ..system.jobs.threads import Stopwatch, Workers
from .photo_reader import PhotoReader, Settings


class Asked(NamedTuple):
    """A photo, and the settings for localizing it."""

    photo: Photo
    settings: Settings


def localize_photo(
    prepared: ScanMap | PaperMap,
    reader: PhotoReader,
    workers: Workers,
    asked: Asked,
    focal: FocalLength | None = None,
    trace: Trace = NO_TRACE,
) -> Result:
    """Localize a photo in a scan that was prepared for the method of the photo's settings.

    `focal` is its focal length by other photos of its camera, which replaces its own. `trace` notes the steps
    of the default method. A photo with a GPS position is first searched near that, and if it is not localized
    there, everywhere.
    """
    photo, settings = asked
    watch = Stopwatch()
    picture, facts = reader.take(photo, watch, focal)
    gps = None
    if isinstance(prepared, PaperMap):
        assert isinstance(settings, PaperSettings)
        found = localize_by_paper(prepared, picture, settings, workers, watch)
    else:
        assert isinstance(settings, CoarseToFineSettings)
        gps = reader.make_gps_prior(facts, settings.prior)
        run = localize_guessed if has_guessed_focal(picture) else localize
        means = Means(settings.effort, workers, watch, trace)
        found = nothing_found()
        if gps is not None:
            near = replace(settings, prior=gps.apply_to(settings.prior))
            found = run(prepared, picture, near, means)
        if found.status != LOCALIZED:
            gps = gps and replace(gps, is_used=False)
            found = run(prepared, picture, settings, means)
        found = add_places(prepared, found)
    if focal is not None:
        found = replace(found, focal_length=focal.update(found.focal_length))
    blank = reader.make_blank(photo, picture, facts, settings, watch.seconds)
    return replace(found.complete(blank), gps_prior=gps)
