"""When photos were taken: by EXIF, by their names, or by a table."""

import csv
import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

from ..photo.panorama.facts import read_photo_facts
from ..system.arguments import EXIF, NAMES, ORDER
from ..system.errors import InputError
from ..system.files.json_file import read_text

WANTED_TIMES = "wanted a CSV file whose first line is name,time: frames by path or file name, and seconds"

NUMBER = re.compile(r"\d+(?:\.\d+)?")


def check_times(times: Sequence[float]) -> None:
    """Refuse times that are not finite or do not rise."""
    if not all(math.isfinite(time) for time in times):
        raise InputError("times: found one that is no finite number, wanted seconds")
    for k, (before, after) in enumerate(pairwise(times)):
        if after <= before:
            raise InputError(f"times: found {after} after {before} at frame {k + 1}, wanted them to rise")


def times_of(frames: Sequence[Path], source: str | None) -> list[float] | None:
    """Seconds of each frame, by the clock of its source; None where only their order counts.

    By EXIF, by the last number in each name, or by a table; without a source by EXIF if it tells the times of
    all frames, one after another. Raises InputError if the source lacks a frame, or its times do not rise.
    """
    if source == ORDER:
        return None
    if source in (None, EXIF):
        times = exif_times(frames)
        if source is None and not (times and all(a < b for a, b in pairwise(times))):
            return None
        if times is None:
            raise InputError("`times` exif: found a frame without a time in EXIF, wanted one in all")
    elif source == NAMES:
        times = [_number_in(frame) for frame in frames]
    else:
        times = _times_in(Path(str(source)), frames)
    check_times(times)
    return times


def exif_times(frames: Sequence[Path]) -> list[float] | None:
    """Seconds by EXIF; None if one has none, or can't be read.

    Times without an offset from UTC count as they are: in a guessed time zone an hour may come twice. If only
    some have one, none counts.
    """
    times: list[datetime] = []
    for frame in frames:
        try:
            text = read_photo_facts(frame).capture_time
        except (OSError, InputError):
            return None
        if text is None:
            return None
        times.append(datetime.fromisoformat(text))
    if not all(time.tzinfo for time in times):
        times = [time.replace(tzinfo=UTC) for time in times]
    return [time.timestamp() for time in times]


def _number_in(frame: Path) -> float:
    found = NUMBER.findall(frame.stem)
    if not found:
        raise InputError(f"`times` names: found no number in {frame.name}, wanted seconds in each name")
    return float(found[-1])


def _times_in(path: Path, frames: Sequence[Path]) -> list[float]:
    rows = csv.DictReader(read_text(path, WANTED_TIMES).splitlines())
    try:
        by_name = {row["name"]: float(row["time"]) for row in rows}
    except (KeyError, ValueError, TypeError, csv.Error) as error:
        raise InputError(f"{path}: found {type(error).__name__} {error}, {WANTED_TIMES}") from error
    times = []
    for frame in frames:
        time = by_name.get(str(frame), by_name.get(frame.name))
        if time is None:
            raise InputError(f"{path}: found no time of {frame}, {WANTED_TIMES}")
        times.append(time)
    return times
