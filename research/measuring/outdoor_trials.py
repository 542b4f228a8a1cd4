"""Trials outdoors: yards, streets and fronts by several scanners, with photos and panoramas taken there."""

import math
from collections.abc import Iterator, Sequence

import numpy as np

from piccolo.photo.panorama.cameras import OF_PIXELS
from piccolo.system.jobs.threads import Workers

from ..synthetic.outdoor_photos import take_panorama, take_photo
from ..synthetic.outdoor_scans import SCANNERS, scan_place
from ..synthetic.outdoors import make_place
from .claims import Points, Trial

WIDTH = 1024  # of the panoramas [px]
NUM_PHOTOS = 5  # of a place
NUM_PANORAMAS = 3
NUM_ELSEWHERE = 2  # photos of another such place
ANOTHER = 100_000  # from a place's seed to that of another


def outdoor_trials(seed: int, kinds: Sequence[str], workers: Workers) -> Iterator[tuple[Points, list[Trial]]]:
    """Yield clouds of places of some kinds, by each of their scanners, each with the same photos.

    A focal length that is given is as exact as such numbers are taken for.
    """
    for kind in kinds:
        place = make_place(kind, seed)
        rng = np.random.default_rng([seed, 64])
        taken = [take_photo(place, index, workers) for index in range(NUM_PHOTOS)]
        photos = [(photo, photo.focal_px * math.exp(rng.normal(0.0, OF_PIXELS))) for photo in taken]
        panoramas = [take_panorama(place, index, WIDTH, workers) for index in range(NUM_PANORAMAS)]
        other = make_place(kind, seed + ANOTHER)
        foreign = [take_photo(other, index, workers) for index in range(NUM_ELSEWHERE)]
        for scanner in SCANNERS[kind]:
            case = f"{kind} by {scanner}"
            trials = [Trial(f"{case}, photo", p.rgb, p.pose, focal_px=given) for p, given in photos]
            trials += [Trial(f"{case}, panorama", p.rgb, p.pose) for p in panoramas]
            trials += [Trial(f"{case}, elsewhere", p.rgb, None, focal_px=p.focal_px) for p in foreign]
            yield scan_place(place, scanner, workers), trials
