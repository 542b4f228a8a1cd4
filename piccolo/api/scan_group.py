"""Photos that were taken at one place: the work of `Scan.localize_together`."""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

from ..judge.result import Result
from ..judge.result_parts import Beside
from ..localization.means import NO_TRACE, Trace
from ..localization.place_names import add_places
from ..photo.panorama import Panorama
from ..photo.panorama.facts import PhotoFacts
from ..photo.photo import Photo
from ..problem.settings import CoarseToFineSettings
from ..scan_map.scan_map import ScanMap
from ..system.jobs.threads import Stopwatch, Workers
from ..together.group import localize_group
from ..together.members import Shot, check_photos
from ..together.second_looks import digest_of
from .photo_reader import PhotoReader

OF_RESULTS = {"together": True}  # in the settings of these results


class AskedTogether(NamedTuple):
    """A photo, and the settings for localizing it."""

    photo: Photo
    settings: CoarseToFineSettings
    trace: Trace = NO_TRACE


def localize_photos_together(
    scan_map: ScanMap, reader: PhotoReader, workers: Workers, asked: Sequence[AskedTogether]
) -> list[Result]:
    """Localize photos together, as far as they show the same; return their results in order.

    The result of a photo that can't be read says so.
    """
    watch = Stopwatch()
    check_photos(len(asked))
    results: dict[int, Result] = {}
    taken: dict[int, tuple[Panorama, PhotoFacts]] = {}
    for k, one in enumerate(asked):
        try:
            taken[k] = reader.take(one.photo, watch)
        except Exception as error:
            failed = reader.make_failed(one.photo, error, one.settings)
            results[k] = replace(failed, settings={**failed.settings, **OF_RESULTS})
    numbers = list(taken)
    shots = [Shot(taken[k][0], asked[k].settings, asked[k].trace) for k in numbers]
    found = localize_group(scan_map, shots, workers, watch)
    seconds = {stage: spent / max(len(numbers), 1) for stage, spent in watch.seconds.items()}
    for k, (result, _) in zip(numbers, found, strict=True):
        picture, facts = taken[k]
        blank = reader.make_blank(asked[k].photo, picture, facts, asked[k].settings, seconds)
        blank = replace(blank, settings={**blank.settings, **OF_RESULTS})
        results[k] = add_places(scan_map, result).complete(blank)
    every = digest_of([results[k] for k in numbers])
    for k, (_, others) in zip(numbers, found, strict=True):
        names = tuple(asked[numbers[other]].photo.name for other in others)
        results[k] = replace(results[k], beside=Beside(names, every) if names else None)
    return [results[k] for k in range(len(asked))]
