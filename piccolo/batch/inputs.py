"""The photos of a batch: files, what is in folders, names on standard input; and when they were taken."""

import codecs
import csv
import os
import re
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from typing import TextIO

from ..errors import InputError, printable
from ..files.json_file import read_bytes, read_text
from ..panorama.cube import SUFFIXES, is_cube
from ..panorama.photo import read_photo_facts
from ..walk.frames import check_times

STDIN = "-"
WANTED_LIST = "wanted a text file, a photo's path on each line"
MAX_KINDS = 5  # of files left out that are named
EXIF = "exif"
NAMES = "names"
ORDER = "order"
NUMBER = re.compile(r"\d+(?:\.\d+)?")
WANTED_TIMES = "wanted a CSV file whose first line is name,time: frames by path or file name, and seconds"


def is_from_stdin(words: Sequence[str]) -> bool:
    """Return True if names come on standard input, so that nobody knows how many."""
    return STDIN in words


def list_panoramas(
    words: Iterable[str], stdin: TextIO, left_out: Counter[str], is_panorama: Callable[[Path], bool] = is_cube
) -> Iterator[Path]:
    """Yield the panoramas that words name, in order: pictures, folders, `@list.txt`, `-` for stdin.

    A folder is one panorama if it holds the six faces of a cube, or what else `is_panorama` tells, else all
    pictures in it and in its folders, sorted by path; its other files are counted in `left_out` by suffix.
    Raises InputError if a list can't be read, or a folder holds no picture.
    """
    for word in words:
        if word == STDIN:
            with open(stdin.fileno(), "rb", buffering=0, closefd=False) as file:
                # Past Python's buffers: a thread that waits there for a name would hold their lock, without
                # which the program can't end.
                yield from _names(file)
        elif word.startswith("@"):
            content = read_bytes(Path(word[1:]), WANTED_LIST)
            yield from _names(content.removeprefix(codecs.BOM_UTF8).split(b"\n"))
        else:
            yield from _at(Path(word), left_out, is_panorama)


def _names(lines: Iterable[bytes]) -> Iterator[Path]:
    return (Path(os.fsdecode(line.rstrip(b"\r\n"))) for line in lines if line.strip())


def _at(path: Path, left_out: Counter[str], is_panorama: Callable[[Path], bool]) -> Iterator[Path]:
    if not os.path.isdir(path) or is_panorama(path):  # noqa: PTH112  # Path.is_dir raises for a long name
        yield path
        return
    found: list[Path] = []
    others = Counter[str]()
    for folder, is_one in _folders(path, is_panorama):
        if is_one:
            found.append(folder)
            continue
        files = [file for file in folder.iterdir() if file.name[0] != "." and not file.is_dir()]
        found += [file for file in files if file.suffix.lower() in SUFFIXES]
        others.update(file.suffix.lower() for file in files if file.suffix.lower() not in SUFFIXES)
    left_out.update(others)
    if not found:
        text = f"{path}: a folder without a JPEG, PNG, TIFF, WebP or HEIC picture"
        raise InputError("; ".join(filter(None, (text, describe_left_out(others)))))
    yield from sorted(found)


def _folders(top: Path, is_panorama: Callable[[Path], bool]) -> Iterator[tuple[Path, bool]]:
    """Yield a folder and those in it, by a link only what has no other name; and if each is one panorama."""
    waiting = deque([top])
    seen = set[tuple[int, int]]()
    while waiting:
        folder = waiting.popleft()
        status = folder.stat()
        if (status.st_dev, status.st_ino) not in seen:
            seen.add((status.st_dev, status.st_ino))
            is_one = is_panorama(folder)
            yield folder, is_one
            for entry in () if is_one else folder.iterdir():
                if entry.is_dir():
                    (waiting.append if entry.is_symlink() else waiting.appendleft)(entry)


def describe_left_out(left_out: Counter[str]) -> str:
    """Say how many files are left out, by kind; nothing if none are."""
    kinds = sorted(left_out.items(), key=lambda kind: (-kind[1], kind[0]))[:MAX_KINDS]
    if rest := left_out.total() - sum(count for _, count in kinds):
        kinds.append(("of other kinds", rest))
    listed = ", ".join(f"{count} {printable(kind) or 'without a suffix'}" for kind, count in kinds)
    return f"{left_out.total()} files left out: {listed}" if kinds else ""


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
