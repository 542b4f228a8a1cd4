"""The panoramas of a batch: pictures, folders of pictures, lists, and names that come on standard input."""

import codecs
import os
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TextIO

from ..errors import InputError, printable
from ..files.json_file import read_bytes
from ..panorama.cube import SUFFIXES, is_cube

STDIN = "-"
WANTED_LIST = "wanted a text file, a photo's path on each line"
MAX_KINDS = 5  # of files left out that are named


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
    """Yield a folder and those in it, and whether each is one panorama.

    By a link only what has no other name.
    """
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
