"""Which photos of a batch may have been taken together, by their times and names."""

import math
import re
from collections.abc import Sequence
from datetime import datetime
from itertools import pairwise
from pathlib import PurePath

from ..judge.result import Result

MOST_PAUSE = 60.0  # [s] chosen: between successive photos of one place
MOST_IN_SERIES = 24  # chosen: two turns of twelve; longer series are divided


def list_series(results: Sequence[Result]) -> list[list[int]]:
    """List the series, of two photos and more, that may have been taken together, by the photos' numbers.

    Only photos with `cameras` are listed. Photos with times form a series if at most a minute is between one
    and the next. Photos without times form a series if their names are alike but for a number; those whose
    names are like no other's form one series, as their pictures decide later whether they belong together.
    """
    timed: dict[bool, list[tuple[datetime, int]]] = {}  # True: times without an offset from UTC
    named: dict[str, list[int]] = {}
    for k, result in enumerate(results):
        if result.cameras and result.source.capture_time:
            time = datetime.fromisoformat(result.source.capture_time)
            timed.setdefault(time.tzinfo is None, []).append((time, k))
        elif result.cameras:
            named.setdefault(name_series(result.pano), []).append(k)
    found = [series for clock in timed.values() for series in divide_at_pauses(sorted(clock))]
    found += [numbers for numbers in named.values() if len(numbers) > 1]
    found.append([numbers[0] for numbers in named.values() if len(numbers) == 1])
    return sorted(part for series in found for part in divide_evenly(series) if len(part) > 1)


def name_series(pano: str) -> str:
    """Return a photo's path without the last number in its name."""
    path = PurePath(pano)
    return str(path.with_name(re.sub(r"\d+(?=\D*$)", "#", path.stem)))


def divide_at_pauses(timed: Sequence[tuple[datetime, int]]) -> list[list[int]]:
    """Divide photos in the order of their times where a pause is too long; return their numbers."""
    series = [[number] for _, number in timed[:1]]
    for (before, _), (time, number) in pairwise(timed):
        if (time - before).total_seconds() > MOST_PAUSE:
            series.append([])
        series[-1].append(number)
    return series


def divide_evenly(series: list[int]) -> list[list[int]]:
    """Divide a series that is too long into parts of about one length."""
    num_parts = math.ceil(len(series) / MOST_IN_SERIES)
    bounds = [k * len(series) // num_parts for k in range(num_parts + 1)] if series else []
    return [series[begin:end] for begin, end in pairwise(bounds)]
