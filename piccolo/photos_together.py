"""Photos that were taken at one place: each is read, all are localized together, each gets its result."""

import json
from collections.abc import Sequence
from dataclasses import replace
from hashlib import sha256

from .jobs.memory import check_memory
from .jobs.threads import Stopwatch, Workers
from .judge.result import Result
from .judge.result_parts import Beside
from .localization.places import add_places
from .panorama import Panorama
from .panorama.photo import PhotoFacts
from .photo import Photo
from .photo_reader import PhotoReader
from .problem.settings import CoarseToFineSettings
from .scan_map.scan_map import ScanMap
from .together.group import localize_group

MEMORY_OF_PHOTO = 8e7  # [byte] that a photo keeps while others are localized


def localize_photos(
    reader: PhotoReader,
    scan_map: ScanMap,
    photos: Sequence[Photo],
    settings: CoarseToFineSettings,
    workers: Workers,
) -> list[Result]:
    """Localize photos together as far as they show the same; one that can't be read says so."""
    watch = Stopwatch()
    check_memory(len(photos) * MEMORY_OF_PHOTO, f"{len(photos)} photos together", "localize fewer together")
    results: dict[int, Result] = {}
    taken: dict[int, tuple[Panorama, PhotoFacts]] = {}
    for k, photo in enumerate(photos):
        try:
            taken[k] = reader.take(photo, watch)
        except Exception as error:
            results[k] = reader.make_failed(photo, error, settings)
    numbers = list(taken)
    found = localize_group(scan_map, [taken[k][0] for k in numbers], settings, workers, watch)
    seconds = {stage: spent / max(len(numbers), 1) for stage, spent in watch.seconds.items()}
    asked = [(photos[k].name, facts.sha256) for k, (_, facts) in taken.items()]
    asked_sha256 = sha256(json.dumps(asked).encode()).hexdigest()
    for k, (result, others) in zip(numbers, found, strict=True):
        blank = reader.make_blank(photos[k], *taken[k], settings, seconds)
        complete = add_places(scan_map, result).complete(blank)
        names = tuple(photos[numbers[other]].name for other in others)
        results[k] = replace(complete, beside=Beside(names, asked_sha256)) if names else complete
    return [results[k] for k in range(len(photos))]
